"""Search for the covariances that the stars of a CCD show (:mod:`~.psf_model.covariance`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .covariance import COLUMNS, LENGTH, PROCESS_COLUMNS, Covariances, order_of, pair_distances
from .covariance_posterior import Posterior, StarNumbers

# Prior mean and standard deviation of the logarithms of variance and length of the process, and of the noise that all
# stars have. Forty stars hardly determine the length. A common noise would take the place of a faint process; that of
# the stars is known, so that little is expected.
_PRIOR = np.array([(-1.0, 1.5), (math.log(0.7), 0.7), (-8.0, 1.5)])
# Prior standard deviation of the logarithms of the trend's variances.
_TREND_WIDTH = 2.0
# Prior mean of the logarithm of the variance of the colour terms, with the same width, and where the search starts.
_COLOUR_PRIOR = 0.0
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


class ShapeSample(NamedTuple):
    """Shape numbers of the stars of a CCD, of which covariances are learnt."""

    points: np.ndarray  #: places mapped to [-1, 1], [n, 2]
    numbers: np.ndarray  #: [n, 3]
    noise: np.ndarray  #: variances of the numbers, [n, 3]
    terms: np.ndarray  #: of the trend, [n, n_terms]
    colour_count: int = 0  #: the last so many terms are of colours

    def brightest(self) -> StarNumbers:
        """Return the brightest stars in units of the middle one's noise."""
        unit = np.median(self.noise, axis=0)
        stars = np.sort(np.argsort(self.noise.sum(axis=1), kind="stable")[:_MOST_STARS])
        places = self.points[stars]
        return StarNumbers(
            pair_distances(places, places),
            self.numbers[stars] / np.sqrt(unit),
            (self.noise[stars] / unit).mean(axis=1),
            self.terms[stars],
        )


def fit_covariances(ccds: Sequence[ShapeSample]) -> list[Covariances]:
    """Return the forms that are probable for the stars of each CCD, each with its most probable kernel.

    They are: trends of degree 0, 1 and 2 without a process, and a process on the linear trend and on that of all
    degrees, as far as the terms reach; where there are colour terms, each without and with them. CCDs are searched
    together, in a third of the time; none changes a byte of another.
    """
    stars = [ccd.brightest() for ccd in ccds]
    alike: dict[tuple[int, int, int], list[int]] = {}
    for index, (ccd, numbers) in enumerate(zip(ccds, stars, strict=True)):
        alike.setdefault((numbers.filled_count, ccd.terms.shape[1], ccd.colour_count), []).append(index)
    covariances: dict[int, Covariances] = {}
    for (_, _, colour_count), group in alike.items():
        group_covariances = _fit_alike([stars[index] for index in group], colour_count)
        covariances.update(zip(group, group_covariances, strict=True))
    return [covariances[index] for index in range(len(ccds))]


def _fit_alike(stars: Sequence[StarNumbers], colour_count: int) -> list[Covariances]:
    """Return covariances of CCDs of the same numbers of stars, once filled up, and of terms."""
    order = order_of(stars[0].terms.shape[1] - colour_count)
    degrees = np.arange(1, max(order, COLUMNS - PROCESS_COLUMNS) + 1)
    expected = np.where(degrees < _FIRST_HIGH_DEGREE, 1.0 - degrees, 3.0 - 3.0 * degrees)
    colour_prior = [_COLOUR_PRIOR] * (colour_count > 0)
    middle = np.concatenate([_PRIOR[:, 0], expected, colour_prior])
    width = np.concatenate([_PRIOR[:, 1], np.full(len(middle) - len(_PRIOR), _TREND_WIDTH)])
    posterior = Posterior.of(stars, middle, width, colour_count)
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

    def minimize(
        starts: np.ndarray, present: np.ndarray, *, fixed_length: bool = False, largest: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ends [n_ccd, n_forms, n_columns] and costs [n_ccd, n_forms] of forms that all CCDs have."""
        shape = (len(stars), len(present))
        ends, costs = posterior.minimize(
            np.broadcast_to(starts, (*shape, starts.shape[-1])).reshape(-1, starts.shape[-1]),
            np.tile(present, (len(stars), 1)),
            np.repeat(np.arange(len(stars)), len(present)),
            fixed_length=fixed_length,
            largest=np.inf if largest is None else largest.ravel(),
        )
        return ends.reshape(*shape, -1), costs.reshape(shape)

    starts = [start_at(_PROCESS_START, low_degrees), start_at(_TREND_START, low_degrees)]
    if order >= _FIRST_HIGH_DEGREE:
        starts.append(start_at(_TREND_START, all_degrees))
    with_process = np.stack([columns(True, order, colour) for colour in colour_kinds])
    ends, costs = minimize(
        np.tile(np.stack(starts), (len(colour_kinds), 1)), np.repeat(with_process, len(starts), axis=0)
    )
    best = costs.reshape(len(stars), -1, len(starts)).argmin(axis=2) + len(starts) * np.arange(len(colour_kinds))
    of_process = np.take_along_axis(ends, best[:, :, None], axis=1)
    # One length for all, so that the mean of all forms has one process.
    cheapest = np.take_along_axis(costs, best, axis=1).argmin(axis=1)
    lengths = of_process[np.arange(len(stars)), cheapest, LENGTH]
    of_process[:, :, LENGTH] = lengths[:, None]
    linear = np.stack([columns(True, 1, colour) for colour in colour_kinds])
    process_forms = [linear, with_process] if order > 1 else [with_process]
    present = np.concatenate(process_forms)
    optima, values = minimize(np.tile(of_process, (1, len(process_forms), 1)), present, fixed_length=True)
    smooth = np.stack([columns(False, degree, colour) for colour in colour_kinds for degree in smooth_degrees])
    # A form that is improbable beside these is left out anyway.
    largest = (values + _prior_costs(present, colour_count)).min(axis=1) - math.log(0.1 * _LEAST_PROBABILITY)
    smooth_optima, smooth_values = minimize(
        start_at(_TREND_START, low_degrees), smooth, largest=largest[:, None] - _prior_costs(smooth, colour_count)
    )
    present, optima = np.concatenate([present, smooth]), np.concatenate([optima, smooth_optima], axis=1)
    form_costs = np.concatenate([values, smooth_values], axis=1) + _prior_costs(present, colour_count)
    probabilities = np.exp(form_costs.min(axis=1, keepdims=True) - form_costs)
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    coloured = present[:, -1] & (colour_count > 0)
    by_name = np.lexsort([present[:, 0], coloured])  # smooth ones first
    kernels = posterior.kernels(optima, present)
    kernels[:, :, LENGTH] = np.exp(lengths)[:, None]
    covariances = []
    for of_forms, probability in zip(kernels, probabilities, strict=True):
        probable = by_name[probability[by_name] >= _LEAST_PROBABILITY]
        shares = probability[probable] / probability[probable].sum()
        covariances.append(Covariances(of_forms[probable], shares, coloured=colour_count > 0))
    return covariances


def _prior_costs(present: np.ndarray, colour_count: int) -> np.ndarray:
    """Return minus the logarithms of the prior probability of forms with columns `present` [n_forms, n_columns].

    They pay for the variances that they have: of the process, of degrees 1 and 2, and of colours.
    """
    coloured = present[:, -1] & (colour_count > 0)
    degrees = present[:, PROCESS_COLUMNS : present.shape[1] - (colour_count > 0)].sum(axis=1)
    count = np.where(present[:, 0], 1 + np.minimum(degrees, 1), degrees) + coloured
    constant = ~present[:, 0] & (degrees == 0)
    return np.asarray(_VARIANCE_COST * count - _CONSTANT_BONUS * constant)
