"""Search for the covariances that the stars of a CCD show (:mod:`~.psf_model.covariance`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from ..gaussian_field import inverse_from_cholesky
from .covariance import (
    COLUMNS,
    LENGTH,
    PROCESS_COLUMNS,
    Covariances,
    SmoothCovariance,
    columns_of_terms,
    order_of,
    pair_distances,
    trend_variances,
    with_trend_and_noise,
)

# Prior mean and standard deviation of the logarithms of variance and length of the process, and of the noise that all
# stars have. Forty stars hardly determine the length. A common noise would take the place of a faint process; that of
# the stars is known, so that little is expected.
_PRIOR = np.array([(-1.0, 1.5), (math.log(0.7), 0.7), (-8.0, 1.5)])
# Prior standard deviation of the logarithms of the trend's variances.
_TREND_WIDTH = 2.0
# Prior mean of the logarithm of the variance of the colour terms, with the same width, and where the search starts.
_COLOUR_PRIOR = 0.0
# The search ends so far from the prior mean: stars without noise have variances of 10^6 in units of theirs.
_REACH = 24.0
# Prior means of the logarithms: of degree 1 and 2 the variance falls by e each; nothing is expected of higher degrees,
# e^-3 less each, so that they cost nothing where the stars show nothing.
_FIRST_HIGH_DEGREE = 3
# Highest degree of a trend without a process: fields of more structure have one.
_MOST_SMOOTH_DEGREE = 2
# Minus the logarithm of the prior probability of a form for each variance that it has: its maximum fits noise better
# by about 1. A process pays for degree 1 alone: its two trends are equally probable.
_VARIANCE_COST = 1.5
# Logarithm of the prior odds of the constant, which is a form of its own rather than a limit of the others.
_CONSTANT_BONUS = 1.0
# Forms of smaller probability are left out of the mean.
_LEAST_PROBABILITY = 1e-3
# Logarithms of the variance of the process and of the common noise where the search starts: nearly all process, and
# nearly all trend.
_PROCESS_START = (0.0, -4.0)
_TREND_START = (-4.0, -4.0)
# The same of the trend's variance of degree 1, and its fall by degree: degrees 1 and 2, and every degree.
_LOW_DEGREES = (1.0, 1.0)
_ALL_DEGREES = (2.5, 0.5)
# More stars than this add little to the covariance, and cost their cube; the brightest are taken.
_MOST_STARS = 300
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


def fit_covariances(
    points: np.ndarray,
    numbers: np.ndarray,
    noise: np.ndarray,
    terms: np.ndarray,
    *,
    colour_count: int = 0,
) -> Covariances:
    """Return the forms that are probable for shape numbers [n, 3], each with its most probable kernel.

    They are: trends of degree 0, 1 and 2 without a process, and a process on the linear trend and on that of all
    degrees, as far as the terms reach; where there are colour terms, each without and with them. `points` [n, 2] are
    mapped to [-1, 1], `noise` [n, 3] are the variances of the numbers, `terms` [n, n_terms] those of the trend, the
    last `colour_count` of which are colour terms.
    """
    unit = np.median(noise, axis=0)
    brightest = np.sort(np.argsort(noise.sum(axis=1), kind="stable")[:_MOST_STARS])
    order = order_of(terms.shape[1] - colour_count)
    degrees = np.arange(1, max(order, COLUMNS - PROCESS_COLUMNS) + 1)
    expected = np.where(degrees < _FIRST_HIGH_DEGREE, 1.0 - degrees, 3.0 - 3.0 * degrees)
    colour_prior = [_COLOUR_PRIOR] * (colour_count > 0)
    middle = np.concatenate([_PRIOR[:, 0], expected, colour_prior])
    posterior = Posterior(
        pair_distances(points[brightest], points[brightest]),
        numbers[brightest] / np.sqrt(unit),
        (noise[brightest] / unit).mean(axis=1),
        terms[brightest],
        middle,
        np.concatenate([_PRIOR[:, 1], np.full(len(middle) - len(_PRIOR), _TREND_WIDTH)]),
        colour_count,
    )
    low_degrees, all_degrees = (first - fall * (degrees - 1) for first, fall in (_LOW_DEGREES, _ALL_DEGREES))
    low_degrees = np.where(degrees < _FIRST_HIGH_DEGREE, low_degrees, expected)

    def start_at(variances: tuple[float, float], trend: np.ndarray) -> np.ndarray:
        process, common_noise = variances
        return np.concatenate([[process, _PRIOR[LENGTH, 0], common_noise], trend, colour_prior])

    colour_kinds = [False, True] if colour_count else [False]
    smooth_degrees = range(min(order, _MOST_SMOOTH_DEGREE) + 1)

    def columns(process: bool, degree: int, colour: bool) -> np.ndarray:
        shared = np.array([process, process, True])
        return np.concatenate([shared, degrees <= degree, np.full(len(colour_prior), colour)])

    starts = [start_at(_PROCESS_START, low_degrees), start_at(_TREND_START, low_degrees)]
    if order >= _FIRST_HIGH_DEGREE:
        starts.append(start_at(_TREND_START, all_degrees))
    with_process = np.stack([columns(True, order, colour) for colour in colour_kinds])
    ends, costs = posterior.minimize(
        np.tile(np.stack(starts), (len(colour_kinds), 1)), np.repeat(with_process, len(starts), axis=0)
    )
    best = costs.reshape(-1, len(starts)).argmin(axis=1) + len(starts) * np.arange(len(colour_kinds))
    # One length for all, so that the mean of all forms has one process.
    length = ends[best[costs[best].argmin()], LENGTH]
    of_process = ends[best]
    of_process[:, LENGTH] = length
    linear = np.stack([columns(True, 1, colour) for colour in colour_kinds])
    process_forms = [linear, with_process] if order > 1 else [with_process]
    present = np.concatenate(process_forms)
    optima, values = posterior.minimize(np.tile(of_process, (len(process_forms), 1)), present, fixed_length=True)
    smooth = np.stack([columns(False, degree, colour) for colour in colour_kinds for degree in smooth_degrees])
    # A form that is improbable beside these is left out anyway.
    largest = (values + _prior_costs(present, colour_count)).min() - math.log(0.1 * _LEAST_PROBABILITY)
    smooth_optima, smooth_values = posterior.minimize(
        np.tile(start_at(_TREND_START, low_degrees), (len(smooth), 1)),
        smooth,
        largest=largest - _prior_costs(smooth, colour_count),
    )
    present, optima = np.concatenate([present, smooth]), np.concatenate([optima, smooth_optima])
    form_costs = np.concatenate([values, smooth_values]) + _prior_costs(present, colour_count)
    probabilities = np.exp(form_costs.min() - form_costs)
    probabilities /= probabilities.sum()
    coloured = present[:, -1] & (colour_count > 0)
    by_name = np.lexsort([present[:, 0], coloured])  # smooth ones first
    probable = by_name[probabilities[by_name] >= _LEAST_PROBABILITY]
    kernels = posterior.kernels(optima, present)
    kernels[:, LENGTH] = math.exp(length)
    return Covariances(
        kernels[probable], probabilities[probable] / probabilities[probable].sum(), coloured=colour_count > 0
    )


def _prior_costs(present: np.ndarray, colour_count: int) -> np.ndarray:
    """Return minus the logarithms of the prior probability of forms with columns `present` [n_forms, n_columns].

    They pay for the variances that they have: of the process, of degrees 1 and 2, and of colours.
    """
    coloured = present[:, -1] & (colour_count > 0)
    degrees = present[:, PROCESS_COLUMNS : present.shape[1] - (colour_count > 0)].sum(axis=1)
    count = np.where(present[:, 0], 1 + np.minimum(degrees, 1), degrees) + coloured
    constant = ~present[:, 0] & (degrees == 0)
    return np.asarray(_VARIANCE_COST * count - _CONSTANT_BONUS * constant)


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
    """Posterior probability of the logarithms of kernels' columns, for numbers in units of the noise."""

    distance: np.ndarray  #: between stars, [n, n]
    numbers: np.ndarray  #: of the stars, [n, 3]
    noise: np.ndarray  #: their variance, [n]
    terms: np.ndarray  #: of the trend, [n, n_terms]
    middle: np.ndarray  #: mean of the prior, [n_columns]
    width: np.ndarray  #: its standard deviation, [n_columns]
    colour_count: int = 0  #: terms at the end that are of the colours

    def kernels(self, logarithms: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return the columns [..., n_columns], those that are not present as 0."""
        return np.where(present, np.exp(logarithms), 0.0)

    def negative_log_posterior(self, logarithms: np.ndarray, present: np.ndarray) -> SecondOrder:
        """Return minus the logarithms of the posterior of forms, but for a constant, to second order.

        `logarithms` are those of the columns, `present` which there are, both [n_forms, n_columns]; all forms have a
        process, or none has.
        """
        kernels = self.kernels(logarithms, present)
        trend = trend_variances(kernels, self.terms.shape[1], self.colour_count)
        # A change dC of the covariance changes the value by half the sum of count C^-1 - C^-1 y y' C^-1 times dC. The
        # second derivative by two of them has the expected part count/2 tr(C^-1 dC C^-1 dC'), and without what the
        # values are expected to be y' C^-1 dC C^-1 dC' C^-1 y less that.
        changes = self._changes_with_process(kernels) if present[0, 0] else self._changes(kernels, trend)
        count, first = self.numbers.shape[1], PROCESS_COLUMNS - changes.slope.shape[1]
        before_trend = slice(first, PROCESS_COLUMNS)
        between = self.values_and_terms.T @ changes.solved
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
        with_trend = trend[:, None] * np.stack([changes.expected_with_terms, observed_with_trend])
        rows = with_trend @ self.to_columns
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

    def _changes_with_process(self, kernels: np.ndarray) -> _Changes:
        """Return what changes by the first three columns of kernels with a process: its variance, length, and noise."""
        count, common = self.numbers.shape[1], kernels[:, _NOISE]
        ratio = self.distance / kernels[:, LENGTH, None, None]
        # By the length for the second time, by the variance, by the length.
        changes = np.empty((len(kernels), 3, *self.distance.shape))
        decay = np.multiply(kernels[:, 0, None, None], np.exp(-ratio), out=changes[:, 1])
        np.multiply(decay, ratio, out=changes[:, 2])
        np.multiply(changes[:, 2], ratio, out=changes[:, 0])
        beside_process = (kernels @ self.covariance_by_columns).reshape(decay.shape)
        inverse, log_determinant = _inverses(decay + beside_process + self.fixed_covariance)
        solved = inverse @ self.values_and_terms
        changed = np.empty((len(kernels), 4, *self.values_and_terms.shape))
        np.matmul(changes, solved[:, None], out=changed[:, :3])
        np.multiply(common[:, None, None], solved, out=changed[:, 3])
        squares = np.einsum("mna,mpna->mpa", solved, changed)
        traces = np.einsum("mij,mpij->mp", inverse, changes)
        trace_of_noise = common * np.einsum("mii->m", inverse)
        slope = count * np.column_stack([traces, trace_of_noise]) - squares[:, :, :count].sum(axis=2)
        relative = np.empty((len(kernels), 3, *self.distance.shape))
        np.matmul(inverse[:, None], changes[:, 1:], out=relative[:, :2])
        np.multiply(common[:, None, None], inverse, out=relative[:, 2])
        of_values = changed[:, 1:, :, :count]
        return _Changes(
            solved,
            log_determinant,
            slope[:, 1:],
            np.einsum("mpij,mqji->mpq", relative, relative),
            np.einsum("mpnk,mqnk->mpq", of_values, inverse[:, None] @ of_values),
            squares[:, 1:, count:],
            solved[:, None, :, count:].swapaxes(2, 3) @ of_values,
            slope[:, 0],
        )

    def _changes(self, kernels: np.ndarray, trend: np.ndarray) -> _Changes:
        """Return what changes by the noise that all stars have, of kernels without a process."""
        count, common = self.numbers.shape[1], kernels[:, _NOISE, None, None]
        smooth = SmoothCovariance.of(kernels, self.terms, self.noise, trend)
        solved = smooth.solve(self.values_and_terms)
        of_values, of_terms = solved[:, :, :count], solved[:, :, count:]
        squares = np.einsum("mna,mna->ma", solved, solved)[:, None]
        trace, square_trace = smooth.precision.sum(axis=1), smooth.square
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

    @cached_property
    def values_and_terms(self) -> np.ndarray:
        """Numbers of the stars and terms of the trend side by side, [n, 3 + n_terms]."""
        return np.hstack([self.numbers, self.terms])

    @cached_property
    def fixed_covariance(self) -> np.ndarray:
        """Covariance that does not depend on kernels, of the constant and the noise of the stars, [n, n]."""
        none = np.zeros(len(self.middle))
        trend = trend_variances(none, self.terms.shape[1], self.colour_count)
        return with_trend_and_noise(np.zeros(self.distance.shape), none, self.terms, self.noise, trend)

    @cached_property
    def covariance_by_columns(self) -> np.ndarray:
        """Covariance for a unit of each column of a kernel, but for those of the process, [n_columns, n n]."""
        by_columns = (self.terms * self.to_columns.T[:, None]) @ self.terms.T
        by_columns[_NOISE] = np.eye(len(self.noise))
        return by_columns.reshape(len(by_columns), -1)

    @cached_property
    def to_columns(self) -> np.ndarray:
        """Which column of a kernel is the variance of each term, 1 or 0, [n_terms, n_columns]."""
        columns = columns_of_terms(self.terms.shape[1], self.colour_count)
        places = np.where(columns < 0, len(self.middle) - 1, columns + _NOISE)
        return np.asarray((places[:, None] == np.arange(len(self.middle))) & (columns != 0)[:, None], dtype=float)

    def minimize(
        self,
        starts: np.ndarray,
        present: np.ndarray,
        *,
        fixed_length: bool = False,
        largest: np.ndarray | float = np.inf,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the most probable logarithms of forms, [n_forms, n_columns], and the values there, [n_forms].

        From starts by Newton's steps, with the expected second derivatives where the surface is no bowl (Fisher's
        scoring), and damped where a step gains nothing (Marquardt 1963); all forms at once. Columns that are not
        present stay as they were. The search for a form ends, too, where its value will stay above `largest`, or where
        one from another start has been.
        """
        low, high = self.middle - _REACH, self.middle + _REACH
        varied = present & ~(fixed_length & (np.arange(present.shape[1]) == LENGTH))
        at = np.where(varied, np.clip(starts, low, high), starts)
        here, damping, searches = self.negative_log_posterior(at, present), np.zeros(len(at)), np.arange(len(at))
        logarithms, values, most = at.copy(), here.value.copy(), np.broadcast_to(largest, len(at))
        same_form = (present[:, None] == present).all(axis=2) & ~np.eye(len(at), dtype=bool)
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
                same_form = same_form[going]
            step *= np.minimum(1.0, _LONGEST_STEP / np.abs(step).max(axis=1, keepdims=True))
            next_at = np.minimum(np.maximum(at + step, low), high)
            there = self.negative_log_posterior(next_at, present)
            better = there.value < here.value
            if better.all():
                at, here = next_at, there
            else:
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
