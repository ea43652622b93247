"""Posterior probability of the covariances of stars, to second order, of many forms and CCDs at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import scipy.linalg

from ..gaussian_field import inverse_from_cholesky
from .covariance import LENGTH, PROCESS_COLUMNS, SmoothCovariance, columns_of_terms, trend_variances

# The search ends so far from the prior mean: stars without noise have variances of 10^6 in units of theirs.
_REACH = 24.0
# A search ends where the next step is expected to gain less, in the logarithm of the posterior: a hundredth of the
# standard deviations of the logarithms.
_LEAST_GAIN = 1e-4
# ... or where it is nearer than this to a better place of another search for the same form, in all logarithms: a
# fraction of their standard deviations.
_SAME_PLACE = 0.3
# Steps gain less than so many times what they are expected to.
_SURE = 5.0
# Most steps of a search, and the longest one of a logarithm.
_MOST_STEPS = 100
_LONGEST_STEP = 3.0
# Least eigenvalue of second derivatives that are used as they are.
_LEAST_CURVATURE = 0.02
# First part of the diagonal that is added where a step gains nothing, its growth, and where the search ends.
_DAMPING = 0.1
_DAMPING_FACTOR = 10.0
_MOST_DAMPING = 1e6
# Column of the noise that all stars have.
_NOISE = PROCESS_COLUMNS - 1
# Numbers of stars are filled up to multiples of this, so that CCDs are computed together whose numbers differ.
_STARS_TOGETHER = 8
# Distance of what fills them up: no length of a process reaches so far.
_FAR = 1e30
# Forms at a time, whose matrices stay in the processor's cache.
_FORMS = 12


class StarNumbers(NamedTuple):
    """Shape numbers of the stars of a CCD in units of their noise."""

    distance: np.ndarray  #: between stars, [n, n]
    numbers: np.ndarray  #: [n, 3]
    noise: np.ndarray  #: their variance, [n]
    terms: np.ndarray  #: of the trend, [n, n_terms]

    @property
    def filled_count(self) -> int:
        """Number of stars, and of what fills them up."""
        return -(-len(self.noise) // _STARS_TOGETHER) * _STARS_TOGETHER

    def filled(self) -> StarNumbers:
        """Return the stars and, behind them, some far away without signal."""
        room = self.filled_count - len(self.noise)
        more = ((0, room), (0, 0))
        return StarNumbers(
            np.pad(self.distance, (0, room), constant_values=_FAR),
            np.pad(self.numbers, more),
            np.pad(self.noise, (0, room)),
            np.pad(self.terms, more),
        )


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """Values of functions of several variables with their derivatives."""

    value: np.ndarray  #: [n], infinite where there is none
    slope: np.ndarray  #: [n, k]
    curvature: np.ndarray  #: second derivatives, [n, k, k]
    expected: np.ndarray  #: what they are expected to be, positive definite, [n, k, k]

    def of_forms(self, chosen: np.ndarray) -> SecondOrder:
        """Return some of them."""
        return SecondOrder(self.value[chosen], self.slope[chosen], self.curvature[chosen], self.expected[chosen])

    def replace(self, places: np.ndarray, others: SecondOrder) -> None:
        """Put others in the places of some."""
        for old, new in zip(vars(self).values(), vars(others).values(), strict=True):
            old[places] = new

    def step(self, free: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Return Newton's steps of the variables that are free, [n, k], with so much of the diagonal added [n]."""
        both, unit = free[:, :, None] & free[:, None], np.eye(free.shape[1])
        matrices = np.where(both, self.curvature, unit)
        bowl = np.linalg.eigvalsh(matrices)[:, 0] > _LEAST_CURVATURE
        if not bowl.all():
            matrices = np.where(bowl[:, None, None], matrices, np.where(both, self.expected, unit))
        if damping.any():
            matrices = matrices * (1.0 + damping[:, None, None] * unit)
        return np.asarray(-np.linalg.solve(matrices, np.where(free, self.slope, 0.0)[:, :, None])[:, :, 0])


class _Changes(NamedTuple):
    """Changes by the logarithms of the columns of kernels before those of the trend, [m, p]: three, or noise alone.

    dC are the changes of the covariance C by them, y the values of the stars, t the terms of the trend.
    """

    solved: np.ndarray  #: C^-1 times values and terms, [m, n, 3 + n_terms]
    log_determinant: np.ndarray  #: of C, [m]
    slope: np.ndarray  #: of twice the value, [m, p]
    expected: np.ndarray  #: tr(C^-1 dC C^-1 dC'), [m, p, p]
    observed: np.ndarray  #: y' C^-1 dC C^-1 dC' C^-1 y, [m, p, p]
    expected_with_terms: np.ndarray  #: t' C^-1 dC C^-1 t, [m, p, n_terms]
    with_terms: np.ndarray  #: t' C^-1 dC C^-1 y, [m, p, n_terms, 3]
    bend: np.ndarray  #: as the slope, by the part of the second change by the length that is not the first, [m]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior probability of the logarithms of kernels' columns, for numbers of the stars of CCDs."""

    distance: np.ndarray  #: between stars, [n_ccd, n, n]
    numbers: np.ndarray  #: of the stars in units of the noise, [n_ccd, n, 3]
    noise: np.ndarray  #: their variance, [n_ccd, n]
    terms: np.ndarray  #: of the trend, [n_ccd, n, n_terms]
    real: np.ndarray  #: stars, and not what fills them up, [n_ccd, n] bool
    middle: np.ndarray  #: mean of the prior, [n_columns]
    width: np.ndarray  #: its standard deviation, [n_columns]
    colour_count: int = 0  #: terms at the end that are of the colours

    @classmethod
    def of(cls, ccds: Sequence[StarNumbers], middle: np.ndarray, width: np.ndarray, colour_count: int = 0) -> Self:
        """Return it for CCDs of one :attr:`StarNumbers.filled_count`."""
        counts = np.array([len(ccd.noise) for ccd in ccds])
        filled = [ccd.filled() for ccd in ccds]
        distance, numbers, noise, terms = (np.stack(values) for values in zip(*filled, strict=True))
        real = np.arange(noise.shape[1]) < counts[:, None]
        return cls(distance, numbers, noise, terms, real, middle, width, colour_count)

    def kernels(self, logarithms: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return the columns [..., n_columns], those that are not present as 0 but for the length."""
        return np.where(present | (np.arange(present.shape[-1]) == LENGTH), np.exp(logarithms), 0.0)

    def negative_log_posterior(self, logarithms: np.ndarray, present: np.ndarray, ccd: np.ndarray) -> SecondOrder:
        """Return minus the logarithms of the posterior of forms, but for a constant, to second order.

        `logarithms` are those of the columns, `present` which there are, both [n_forms, n_columns]; all forms have a
        process, or none has. `ccd` [n_forms] are the indices of their CCDs. No form changes a byte of another.
        """
        parts = [
            self._negative_log_posterior(logarithms[part], present[part], ccd[part])
            for part in (slice(first, first + _FORMS) for first in range(0, len(ccd), _FORMS))
        ]
        if len(parts) == 1:
            return parts[0]
        return SecondOrder(*(np.concatenate(each) for each in zip(*(vars(p).values() for p in parts), strict=True)))

    def _negative_log_posterior(self, logarithms: np.ndarray, present: np.ndarray, ccd: np.ndarray) -> SecondOrder:
        kernels, values_and_terms = self.kernels(logarithms, present), self.values_and_terms[ccd]
        trend = trend_variances(kernels, self.terms.shape[2], self.colour_count)
        # A change dC of the covariance changes the value by half the sum of count C^-1 - C^-1 y y' C^-1 times dC. The
        # second derivative by two of them has the expected part count/2 tr(C^-1 dC C^-1 dC'), and without what the
        # values are expected to be y' C^-1 dC C^-1 dC' C^-1 y less that.
        changes = (self._changes_with_process if present[0, 0] else self._changes)(kernels, trend, ccd)
        count, first = self.numbers.shape[2], PROCESS_COLUMNS - changes.slope.shape[1]
        before_trend = slice(first, PROCESS_COLUMNS)
        between = values_and_terms.transpose(0, 2, 1) @ changes.solved
        of_values, of_terms = between[:, count:, :count], between[:, count:, count:]
        products = of_values @ of_values.transpose(0, 2, 1)
        away, prior = logarithms - self.middle, present * self.width**-2.0
        value = 0.5 * (
            np.einsum("mkk->m", between[:, :count, :count])
            + count * changes.log_determinant
            + np.einsum("mc,mc,mc->m", away, away, prior)
        )
        of_trend = count * np.einsum("maa->ma", of_terms) - np.einsum("maa->ma", products)
        slope = (0.5 * trend * of_trend) @ self.to_columns
        slope[:, before_trend] = 0.5 * changes.slope
        trends = trend[:, :, None] * trend[:, None] * of_terms
        matrices = self.to_columns.T @ (trends * np.stack([of_terms, products])) @ self.to_columns
        observed_with_trend = np.einsum("mpak,mak->mpa", changes.with_terms, of_values)
        rows = (trend[:, None] * np.stack([changes.expected_with_terms, observed_with_trend])) @ self.to_columns
        matrices[:, :, before_trend] += rows
        matrices[:, :, :, before_trend] += rows.swapaxes(2, 3)
        matrices[:, :, before_trend, before_trend] = np.stack([changes.expected, changes.observed])
        expected = 0.5 * count * matrices[0]
        curvature = matrices[1] - expected
        # Of logarithms the second derivative has the first one besides.
        _diagonals(curvature)[:] += slope
        if first == 0:
            curvature[:, LENGTH, LENGTH] += 0.5 * changes.bend - 2.0 * slope[:, LENGTH]
            curvature[:, 0, LENGTH] += slope[:, LENGTH]
            curvature[:, LENGTH, 0] += slope[:, LENGTH]
        for matrix in (expected, curvature):
            _diagonals(matrix)[:] += prior
        return SecondOrder(value, slope + away * prior, curvature, expected)

    def _changes_with_process(self, kernels: np.ndarray, trend: np.ndarray, ccd: np.ndarray) -> _Changes:
        """Return what changes by the first three columns of kernels with a process: its variance, length, and noise."""
        terms, values_and_terms = self.terms[ccd], self.values_and_terms[ccd]
        count, common = self.numbers.shape[2], kernels[:, _NOISE]
        ratio = self.distance[ccd] / kernels[:, LENGTH, None, None]
        # By the length for the second time, by the variance, by the length.
        changes = np.empty((len(kernels), 3, *ratio.shape[1:]))
        decay = np.multiply(kernels[:, 0, None, None], np.exp(-ratio), out=changes[:, 1])
        np.multiply(decay, ratio, out=changes[:, 2])
        np.multiply(changes[:, 2], ratio, out=changes[:, 0])
        covariance = decay + (terms * trend[:, None]) @ terms.transpose(0, 2, 1)
        _diagonals(covariance)[:] += self._variances(common, ccd)
        inverse, log_determinant = _inverses(covariance)
        solved = inverse @ values_and_terms
        changed = np.empty((len(kernels), 4, *solved.shape[1:]))
        np.matmul(changes, solved[:, None], out=changed[:, :3])
        np.multiply(common[:, None, None], solved, out=changed[:, 3])
        squares = np.einsum("mna,mpna->mpa", solved, changed)
        traces = np.einsum("mij,mpij->mp", inverse, changes)
        trace_of_noise = common * (np.einsum("mii->m", inverse) - self.filling[ccd])
        slope = count * np.column_stack([traces, trace_of_noise]) - squares[:, :, :count].sum(axis=2)
        relative = np.empty((len(kernels), 3, *ratio.shape[1:]))
        np.matmul(inverse[:, None], changes[:, 1:], out=relative[:, :2])
        np.multiply(common[:, None, None], inverse, out=relative[:, 2])
        expected = np.einsum("mpij,mqji->mpq", relative, relative)
        expected[:, 2, 2] -= common**2 * self.filling[ccd]
        of_values = changed[:, 1:, :, :count]
        return _Changes(
            solved,
            log_determinant,
            slope[:, 1:],
            expected,
            np.einsum("mpnk,mqnk->mpq", of_values, inverse[:, None] @ of_values),
            squares[:, 1:, count:],
            solved[:, None, :, count:].swapaxes(2, 3) @ of_values,
            slope[:, 0],
        )

    def _changes(self, kernels: np.ndarray, trend: np.ndarray, ccd: np.ndarray) -> _Changes:
        """Return what changes by the noise that all stars have, of kernels without a process."""
        count, common = self.numbers.shape[2], kernels[:, _NOISE, None, None]
        smooth = SmoothCovariance.of(self.terms[ccd], self._variances(kernels[:, _NOISE], ccd), trend)
        solved = smooth.solve(self.values_and_terms[ccd])
        of_values, of_terms = solved[:, :, :count], solved[:, :, count:]
        squares = np.einsum("mna,mna->ma", solved, solved)[:, None]
        trace = smooth.precision.sum(axis=1) - self.filling[ccd]
        square_trace = smooth.square - self.filling[ccd]
        observed = np.einsum("mnk,mnk->m", of_values, smooth.solve(of_values))
        return _Changes(
            solved,
            smooth.log_determinant,
            common[:, :, 0] * (count * trace[:, None] - squares[:, :, :count].sum(axis=2)),
            common**2 * square_trace[:, None, None],
            common**2 * observed[:, None, None],
            common * squares[:, :, count:],
            common[..., None] * (of_terms.swapaxes(1, 2) @ of_values)[:, None],
            np.zeros(len(kernels)),
        )

    def _variances(self, common: np.ndarray, ccd: np.ndarray) -> np.ndarray:
        """Return the variances of the stars' noise, [m, n]; 1 of what fills them up, which adds 1 each to traces."""
        return np.where(self.real[ccd], self.noise[ccd] + common[:, None], 1.0)

    @cached_property
    def filling(self) -> np.ndarray:
        """How many places of each CCD are filled up, [n_ccd]."""
        return (~self.real).sum(axis=1)

    @cached_property
    def values_and_terms(self) -> np.ndarray:
        """Numbers of the stars and terms of the trend side by side, [n_ccd, n, 3 + n_terms]."""
        return np.concatenate([self.numbers, self.terms], axis=2)

    @cached_property
    def to_columns(self) -> np.ndarray:
        """Which column of a kernel is the variance of each term, 1 or 0, [n_terms, n_columns]."""
        columns = columns_of_terms(self.terms.shape[2], self.colour_count)
        places = np.where(columns < 0, len(self.middle) - 1, columns + _NOISE)
        return np.asarray((places[:, None] == np.arange(len(self.middle))) & (columns != 0)[:, None], dtype=float)

    def minimize(
        self,
        starts: np.ndarray,
        present: np.ndarray,
        ccd: np.ndarray,
        *,
        fixed_length: bool = False,
        largest: np.ndarray | float = np.inf,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the most probable logarithms of forms, [n_forms, n_columns], and the values there, [n_forms].

        From starts by Newton's steps, with the expected second derivatives where the surface is no bowl (Fisher's
        scoring), and damped where a step gains nothing (Marquardt 1963); all forms at once, of the CCDs `ccd`
        [n_forms]. Columns that are not present stay as they were. The search for a form ends, too, where its value will
        stay above `largest`, or where one from another start has been.
        """
        low, high = self.middle - _REACH, self.middle + _REACH
        varied = present & ~(fixed_length & (np.arange(present.shape[1]) == LENGTH))
        at = np.where(varied, np.clip(starts, low, high), starts)
        here, damping, searches = self.negative_log_posterior(at, present, ccd), np.zeros(len(at)), np.arange(len(at))
        logarithms, values, most = at.copy(), here.value.copy(), np.broadcast_to(largest, len(at))
        same_form = (present[:, None] == present).all(axis=2) & (ccd[:, None] == ccd) & ~np.eye(len(at), dtype=bool)
        for _ in range(_MOST_STEPS):
            free = varied & ~((at <= low) & (here.slope > 0.0)) & ~((at >= high) & (here.slope < 0.0))
            step = here.step(free, damping)
            gain = -0.5 * (here.slope * step).sum(axis=1)
            going = (gain > _LEAST_GAIN) & (damping < _MOST_DAMPING) & (here.value - _SURE * gain < most)
            if same_form.any():
                beside = np.abs(at[:, None] - logarithms).max(axis=2) < _SAME_PLACE
                going &= ~(beside & same_form & (values < here.value[:, None])).any(axis=1)
            if not going.any():
                break
            if not going.all():
                at, step, damping, searches = at[going], step[going], damping[going], searches[going]
                here, varied, present, most = here.of_forms(going), varied[going], present[going], most[going]
                same_form, ccd = same_form[going], ccd[going]
            step *= np.minimum(1.0, _LONGEST_STEP / np.abs(step).max(axis=1, keepdims=True))
            next_at = np.where(varied, np.clip(at + step, low, high), at)
            there = self.negative_log_posterior(next_at, present, ccd)
            better = there.value < here.value
            at = np.where(better[:, None], next_at, at)
            here.replace(better, there.of_forms(better))
            lower = np.where(damping > _DAMPING, damping / _DAMPING_FACTOR, 0.0)
            damping = np.where(better, lower, np.maximum(_DAMPING_FACTOR * damping, _DAMPING))
            logarithms[searches], values[searches] = at, here.value
        return logarithms, values


def _inverses(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverses of covariances [m, n, n] and logarithms of their determinants [m], infinite where singular."""
    inverses, log_determinants = np.zeros(covariances.shape), np.full(len(covariances), np.inf)
    for i, covariance in enumerate(covariances):
        # The call of scipy.linalg.cholesky, without what it checks.
        root, failed = scipy.linalg.lapack.dpotrf(covariance, lower=1)
        if not failed:
            log_determinants[i] = 2.0 * np.log(np.diagonal(root)).sum()
            inverses[i] = inverse_from_cholesky(root)
    return inverses, log_determinants


def _diagonals(matrices: np.ndarray) -> np.ndarray:
    """Return a view of the diagonals of matrices [m, n, n], [m, n]."""
    return matrices.reshape(len(matrices), -1)[:, :: matrices.shape[1] + 1]
