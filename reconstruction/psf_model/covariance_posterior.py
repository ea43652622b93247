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
# A search ends where the next step is expected to gain less, in the logarithm of the posterior.
_LEAST_GAIN = 1e-5
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
        curvature, expected = (np.where(both, matrix, unit) for matrix in (self.curvature, self.expected))
        bowl = np.linalg.eigvalsh(curvature)[:, 0] > _LEAST_CURVATURE
        matrices = np.where(bowl[:, None, None], curvature, expected)
        matrices = matrices * (1.0 + damping[:, None, None] * unit)
        return np.asarray(-np.linalg.solve(matrices, np.where(free, self.slope, 0.0)[:, :, None])[:, :, 0])


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
        kernels = self.kernels(logarithms, present)
        numbers, terms, real = self.numbers[ccd], self.terms[ccd], self.real[ccd]
        transposed_terms = terms.transpose(0, 2, 1)
        count, common = numbers.shape[2], kernels[:, _NOISE]
        trend = trend_variances(kernels, terms.shape[2], self.colour_count)
        # What fills stars up has a variance of 1: it adds 1 each to traces, and nothing to logarithms.
        variance = np.where(real, self.noise[ccd] + common[:, None], 1.0)
        filling = (~real).sum(axis=1)
        slope, (expected, observed) = np.zeros(kernels.shape), np.zeros((2, *kernels.shape, kernels.shape[1]))
        # A change dC of the covariance changes the value by half the sum of count C^-1 - C^-1 y y' C^-1 times dC. The
        # second derivative by two of them has the expected part count/2 tr(C^-1 dC C^-1 dC'), and without what the
        # values are expected to be y' C^-1 dC C^-1 dC' C^-1 y less that.
        if present[0, 0]:
            ratio = self.distance[ccd] / kernels[:, LENGTH, None, None]
            changes = np.empty((len(kernels), 2, *ratio.shape[1:]))  # by the variance and by the length
            decay = np.multiply(kernels[:, 0, None, None], np.exp(-ratio), out=changes[:, 0])
            np.multiply(decay, ratio, out=changes[:, 1])
            covariance = decay + (terms * trend[:, None]) @ transposed_terms
            _diagonals(covariance)[:] += variance
            inverse, log_determinant = _inverses(covariance)
            inverse_values = inverse @ self.values_and_terms[ccd]
            precision, square = np.diagonal(inverse, axis1=1, axis2=2), np.einsum("mij,mij->m", inverse, inverse)
            solved, inverse_terms = inverse_values[:, :, :count], inverse_values[:, :, count:]
            again = inverse @ solved
            surprise = count * inverse - solved @ solved.transpose(0, 2, 1)
            relative = inverse[:, None] @ changes
            changed = changes @ inverse_values[:, None]
            back = inverse[:, None] @ changed[..., :count]
            slope[:, :2] = np.einsum("mij,mpij->mp", surprise, changes)
            bend = np.einsum("mij,mij->m", surprise * ratio, changes[:, 1]) - slope[:, LENGTH]
            expected[:, :2, :2] = np.einsum("mpij,mqji->mpq", relative, relative)
            expected[:, :2, _NOISE] = common[:, None] * np.einsum("mpij,mij->mp", relative, inverse)
            of_terms = np.einsum("mna,mpna->mpa", inverse_terms, changed[..., count:])
            expected[:, :2] += (trend[:, None] * of_terms) @ self.to_columns
            observed[:, :2, :2] = np.einsum("mpnk,mqnk->mpq", changed[..., :count], back)
            observed[:, :2, _NOISE] = common[:, None] * np.einsum("mnk,mpnk->mp", solved, back)
            of_terms = np.einsum("mpak,mak->mpa", transposed_terms[:, None] @ back, transposed_terms @ solved)
            observed[:, :2] += (trend[:, None] * of_terms) @ self.to_columns
        else:
            smooth = SmoothCovariance.of(terms, variance, trend)
            inverse_values, log_determinant = smooth.solve(self.values_and_terms[ccd]), smooth.log_determinant
            precision, square = smooth.precision, smooth.square
            solved, inverse_terms = inverse_values[:, :, :count], inverse_values[:, :, count:]
            again, bend = smooth.solve(solved), 0.0
        away = np.where(present, (logarithms - self.middle) / self.width, 0.0)
        value = 0.5 * (
            np.einsum("mnk,mnk->m", solved, numbers) + count * log_determinant + np.einsum("mc,mc->m", away, away)
        )
        slope[:, _NOISE] = common * (
            count * (precision.sum(axis=1) - filling) - np.einsum("mnk,mnk->m", solved, solved)
        )
        transposed = transposed_terms @ inverse_values
        of_values, between = transposed[:, :, :count], transposed[:, :, count:]
        products = of_values @ of_values.transpose(0, 2, 1)
        change = np.diagonal(count * between - products, axis1=1, axis2=2)
        slope += (trend * change) @ self.to_columns
        slope *= 0.5
        expected[:, _NOISE, _NOISE] = common**2 * (square - filling)
        observed[:, _NOISE, _NOISE] = common**2 * np.einsum("mnk,mnk->m", solved, again)
        of_noise = common[:, None] * trend
        of_terms = np.einsum("mna,mna->ma", inverse_terms, inverse_terms)
        expected[:, _NOISE] += (of_noise * of_terms) @ self.to_columns
        of_terms = np.einsum("mak,mak->ma", transposed_terms @ again, of_values)
        observed[:, _NOISE] += (of_noise * of_terms) @ self.to_columns
        trends = trend[:, :, None] * trend[:, None] * between
        expected += self.to_columns.T @ (trends * between) @ self.to_columns
        observed += self.to_columns.T @ (trends * products) @ self.to_columns
        expected *= 0.5 * count
        curvature = observed - expected
        # Of logarithms the second derivative has the first one besides.
        _diagonals(curvature)[:] += slope
        curvature[:, LENGTH, LENGTH] += 0.5 * bend - slope[:, LENGTH]
        curvature[:, 0, LENGTH] += slope[:, LENGTH]
        prior = np.where(present, self.width**-2.0, 0.0)
        lower = np.tri(len(self.middle), k=-1, dtype=bool)
        for matrix in (expected, curvature):
            _diagonals(matrix)[:] += prior
            np.copyto(matrix, matrix.transpose(0, 2, 1).copy(), where=lower)
        return SecondOrder(value, slope + away / self.width, curvature, expected)

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
        stay above `largest`.
        """
        low, high = self.middle - _REACH, self.middle + _REACH
        varied = present & ~(fixed_length & (np.arange(present.shape[1]) == LENGTH))
        logarithms = np.where(varied, np.clip(starts, low, high), starts)
        best = self.negative_log_posterior(logarithms, present, ccd)
        damping, moving = np.zeros(len(starts)), np.arange(len(starts))
        most = np.broadcast_to(largest, damping.shape)
        for _ in range(_MOST_STEPS):
            at, here = logarithms[moving], best.of_forms(moving)
            free = varied[moving] & ~((at <= low) & (here.slope > 0.0)) & ~((at >= high) & (here.slope < 0.0))
            step = here.step(free, damping[moving])
            gain = -0.5 * (here.slope * step).sum(axis=1)
            going = (gain > _LEAST_GAIN) & (damping[moving] < _MOST_DAMPING)
            going &= here.value - _SURE * gain < most[moving]
            moving, at, step = moving[going], at[going], step[going]
            if not len(moving):
                break
            step *= np.minimum(1.0, _LONGEST_STEP / np.abs(step).max(axis=1, keepdims=True))
            at = np.where(varied[moving], np.clip(at + step, low, high), at)
            there = self.negative_log_posterior(at, present[moving], ccd[moving])
            better = there.value < best.value[moving]
            logarithms[moving[better]] = at[better]
            best.replace(moving[better], there.of_forms(better))
            lower = np.where(damping[moving] > _DAMPING, damping[moving] / _DAMPING_FACTOR, 0.0)
            damping[moving] = np.where(better, lower, np.maximum(_DAMPING_FACTOR * damping[moving], _DAMPING))
        return logarithms, best.value


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
