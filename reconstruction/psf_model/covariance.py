r"""Covariances of the stars of a CCD: how smooth the PSF is, by the evidence of the stars themselves.

The values of star i at :math:`x_i`, mapped to [-1, 1], have the covariance

.. math::
    C_{ij} = s^2 e^{-|x_i - x_j|/L} + \sum_d t_d^2 \sum_{l+m=d} P_{lm}(x_i) P_{lm}(x_j) + (N_i + g)\,\delta_{ij}

of an exponential process, such as turbulence leaves, and of a polynomial trend with one variance for each degree. N is
the noise of the star, g a noise that all stars have. What is not there has the variance 0: a constant has neither
process nor trend, a linear field the degree 1 alone. Each of these forms has the numbers of largest posterior
probability, and predictions are the mean of those of all forms, each by its probability (Bayesian model averaging,
Hoeting et al. 1999).

Where the stars have colours c, of mean 0 and variance 1, each form stands with and without a term of covariance
:math:`t_c^2 c_i c_j`, times polynomials of the position where these vary it.

Variances are in units of the noise of the middle star.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from ..gaussian_field import inverse_from_cholesky
from .pixel_sums import sums_of_products
from .polynomial import term_count

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

#: Fewest columns of a kernel: variance and length of the process, noise that all stars have, variances of the
#: trend's terms of degree 1 and 2, and so on to its order. Lengths where the extent is 2 wide. A last column holds the
#: variance of the colour terms, of stars with colours.
COLUMNS = 5
#: Columns before those of the trend.
PROCESS_COLUMNS = 3
#: Column of the length of the process.
_LENGTH = 1
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
# Variance of the trend's constant: as good as unknown.
_CONSTANT = 1e4
# More stars than this add little to the covariance, and cost their cube; the brightest are taken.
_MOST_STARS = 300
#: Names of trends by their degree.
_TREND_NAMES = ("constant", "linear", "quadratic", "cubic", "quartic")


@dataclass(frozen=True, eq=False)
class Covariances:
    """Forms of the covariance that the stars may have."""

    kernels: np.ndarray  #: columns as in :data:`COLUMNS`, [n_forms, n_columns]
    probabilities: np.ndarray  #: of the forms, of sum 1, [n_forms]
    coloured: bool = False  #: whether kernels have a column of colour terms

    @property
    def colour_probability(self) -> float:
        """Probability that values depend on the colour."""
        return float(self.probabilities[self.kernels[:, -1] > 0.0].sum()) if self.coloured else 0.0

    @property
    def kernel(self) -> np.ndarray:
        """Mean of the kernels by probability, [n_columns], with the length that they share."""
        # Form by form: the rounding of a product of matrices depends on how they lie in memory.
        return np.asarray(sum(probability * kernel for kernel, probability in self.weighted()))

    def weighted(self) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the kernel and the probability of each form."""
        return zip(self.kernels, self.probabilities.tolist(), strict=True)

    def forms(self) -> dict[str, float]:
        """Return the probability of each form by its name, such as ``constant`` or ``linear, process``."""
        names = [form_name(kernel, coloured=self.coloured) for kernel in self.kernels]
        return {name: float(self.probabilities[[n == name for n in names]].sum()) for name in dict.fromkeys(names)}


def form_name(kernel: np.ndarray, *, coloured: bool = False) -> str:
    """Return the name of a kernel's form: that of its trend, and process and colour terms if there are any."""
    columns = kernel[PROCESS_COLUMNS : len(kernel) - coloured]
    degree = int(np.flatnonzero(np.concatenate([[1.0], columns])).max())
    trend = _TREND_NAMES[degree] if degree < len(_TREND_NAMES) else f"order {degree}"
    with_process = f"{trend}, process" if kernel[0] > 0.0 else trend
    return f"{with_process}, colour" if coloured and kernel[-1] > 0.0 else with_process


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
        return np.concatenate([[process, _PRIOR[_LENGTH, 0], common_noise], trend, colour_prior])

    fits: list[tuple[np.ndarray, OptimizeResult]] = []
    costs: list[float] = []
    processes: list[OptimizeResult] = []
    colour_kinds = (False, True) if colour_count else (False,)
    smooth_degrees = range(min(order, _MOST_SMOOTH_DEGREE) + 1)

    def columns(process: bool, degree: int, colour: bool) -> np.ndarray:
        shared = np.array([process, process, True])
        return np.concatenate([shared, degrees <= degree, np.full(len(colour_prior), colour)])

    def add(present: np.ndarray, optimum: OptimizeResult, colour: bool, bonus: float = 0.0) -> None:
        variances = _variance_count(present[: len(present) - (colour_count > 0)]) + colour
        fits.append((present, optimum))
        costs.append(optimum.fun + _VARIANCE_COST * variances - bonus)

    for colour in colour_kinds:
        starts = [start_at(_PROCESS_START, low_degrees), start_at(_TREND_START, low_degrees)]
        if order >= _FIRST_HIGH_DEGREE:
            starts.append(start_at(_TREND_START, all_degrees))
        ends = [posterior.minimize(start, columns(True, order, colour)) for start in starts]
        processes.append(min(ends, key=lambda optimum: optimum.fun))
    # One length for all, so that the mean of all forms has one process.
    length = min(processes, key=lambda optimum: optimum.fun).x[_LENGTH]
    for colour, best in zip(colour_kinds, processes, strict=True):
        for degree in smooth_degrees:
            present = columns(False, degree, colour)
            optimum = posterior.minimize(start_at(_TREND_START, low_degrees), present)
            add(present, optimum, colour, _CONSTANT_BONUS if degree == 0 else 0.0)
        start, present = best.x.copy(), columns(True, order, colour)
        start[_LENGTH] = length
        if order > 1:
            linear = columns(True, 1, colour)
            add(linear, posterior.minimize(start, linear, fixed_length=True), colour)
        if best.x[_LENGTH] != length:
            best = posterior.minimize(start, present, fixed_length=True)
        add(present, best, colour)
    probabilities = np.exp(min(costs) - np.array(costs))
    probabilities /= probabilities.sum()
    probable = probabilities >= _LEAST_PROBABILITY
    kernels = np.stack([posterior.kernel(optimum.x, present) for present, optimum in fits])
    kernels[:, _LENGTH] = math.exp(length)
    return Covariances(
        kernels[probable],
        probabilities[probable] / probabilities[probable].sum(),
        coloured=colour_count > 0,
    )


def _variance_count(present: np.ndarray) -> int:
    """Return the number of variances that a form pays for: of the process, and of degrees 1 and 2."""
    process, degree = bool(present[0]), int(present[PROCESS_COLUMNS:].sum())
    return 1 + min(degree, 1) if process else degree


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior probability of the logarithms of the kernel's columns, for numbers in units of the noise."""

    distance: np.ndarray  #: between stars, [n, n]
    numbers: np.ndarray  #: of the stars, [n, 3]
    noise: np.ndarray  #: their variance, [n]
    terms: np.ndarray  #: of the trend, [n, n_terms]
    middle: np.ndarray  #: mean of the prior, [n_columns]
    width: np.ndarray  #: its standard deviation, [n_columns]
    colour_count: int = 0  #: terms at the end that are of the colours

    def kernel(self, logarithms: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return the columns, those that are not present as 0 but for the length."""
        return np.where(present | (np.arange(len(present)) == _LENGTH), np.exp(logarithms), 0.0)

    def negative_log_posterior(self, logarithms: np.ndarray, present: np.ndarray) -> tuple[float, np.ndarray]:
        """Return minus the logarithm of the posterior, but for a constant, and its derivatives [n_columns]."""
        kernel = self.kernel(logarithms, present)
        count = self.numbers.shape[1]
        slope = np.zeros(len(present))
        # A change dC of the covariance changes the value by half the sum of count C^-1 - C^-1 y y' C^-1 times dC.
        try:
            if kernel[0] > 0.0:
                decay = kernel[0] * np.exp(-self.distance / kernel[1])
                root = np.linalg.cholesky(
                    _with_trend_and_noise(decay, kernel, self.terms, self.noise, self.colour_count)
                )
                inverse = inverse_from_cholesky(root)
                solved, inverse_terms = inverse @ self.numbers, inverse @ self.terms
                precision, log_determinant = np.diagonal(inverse), 2.0 * np.log(np.diagonal(root)).sum()
                process = (count * inverse - solved @ solved.T) * decay
                slope[:2] = process.sum(), (process * self.distance).sum() / kernel[1]
            else:
                smooth = SmoothCovariance.of(kernel, self.terms, self.noise, self.colour_count)
                solved, inverse_terms = smooth.solve(self.numbers), smooth.solve(self.terms)
                precision, log_determinant = smooth.precision, smooth.log_determinant
        except np.linalg.LinAlgError:
            return 1e12, np.zeros(len(present))
        value = 0.5 * ((solved * self.numbers).sum() + count * log_determinant)
        slope[2] = kernel[2] * (count * precision.sum() - (solved**2).sum())
        change = count * (inverse_terms * self.terms).sum(axis=0) - ((solved.T @ self.terms) ** 2).sum(axis=0)
        trend = trend_variances(kernel, self.terms.shape[1], self.colour_count) * change
        for degree in range(1, order_of(len(trend) - self.colour_count) + 1):
            slope[2 + degree] = trend[term_count(degree - 1) : term_count(degree)].sum()
        if self.colour_count:
            slope[-1] = trend[-self.colour_count :].sum()
        away = np.where(present, (logarithms - self.middle) / self.width, 0.0)
        return float(value + 0.5 * (away @ away)), 0.5 * slope + away / self.width

    def minimize(self, start: np.ndarray, present: np.ndarray, *, fixed_length: bool = False) -> OptimizeResult:
        """Return the most probable logarithms from a start, those that are not present as they were."""
        from scipy.optimize import minimize  # a fifth of a second

        low, high = self.middle - _REACH, self.middle + _REACH
        if fixed_length:
            low[_LENGTH] = high[_LENGTH] = start[_LENGTH]
        return minimize(
            self.negative_log_posterior,
            start,
            args=(present,),
            jac=True,
            method="L-BFGS-B",
            bounds=np.stack([low, high], axis=1),
            options={"maxiter": 60, "ftol": 1e-7},
        )


@dataclass(frozen=True, eq=False)
class SmoothCovariance:
    """Inverse of a covariance without a process, D + T T', by the matrix inversion lemma (Woodbury 1950)."""

    variance: np.ndarray  #: of the noise D, [n]
    half: np.ndarray  #: R^-1 T' D^-1 with R R' = 1 + T' D^-1 T, [n_terms, n]
    log_determinant: float

    @classmethod
    def of(cls, kernel: np.ndarray, terms: np.ndarray, noise: np.ndarray, colour_count: int = 0) -> SmoothCovariance:
        """Return it for a kernel, terms of the trend [n, n_terms], the last ones of colours, and noise [n]."""
        variance = noise + kernel[2]
        variances = trend_variances(kernel, terms.shape[1], colour_count)
        scaled = terms[:, variances > 0.0] * np.sqrt(variances[variances > 0.0])
        root = np.linalg.cholesky(np.eye(scaled.shape[1]) + scaled.T @ (scaled / variance[:, None]))
        # The call of scipy.linalg.solve_triangular, without what it checks.
        half = scipy.linalg.lapack.dtrtrs(root.T, (scaled / variance[:, None]).T, lower=0, trans=1)[0]
        return cls(variance, half, float(np.log(variance).sum() + 2.0 * np.log(np.diagonal(root)).sum()))

    def solve(self, values: np.ndarray) -> np.ndarray:
        """Return the inverse covariance times values [n, k]."""
        return np.asarray(values / self.variance[:, None] - self.half.T @ (self.half @ values))

    @property
    def precision(self) -> np.ndarray:
        """Diagonal of the inverse covariance, [n]."""
        return np.asarray(1.0 / self.variance - (self.half**2).sum(axis=0))


def krige(
    points: np.ndarray,
    values: np.ndarray,
    terms: np.ndarray,
    kernel: np.ndarray,
    noise: np.ndarray,
    *,
    colour_count: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for trend and process of values [n, k] under one covariance, and predict each star from the others.

    Returns the coefficients of the terms [n_terms, k]; the inverse covariance times the values [n, k], the weights of
    :func:`predict`; and each value minus its prediction by the others [n, k] (Dubrule 1983). `noise` [n] is in units of
    the middle star's. The last `colour_count` of the terms are of colours.
    """
    if kernel[0] > 0.0:
        covariance = kernel_covariance(kernel, pair_distances(points, points), terms, noise, colour_count)
        inverse = scipy.linalg.inv(covariance, check_finite=False)
        weights, precision = inverse @ values, np.diagonal(inverse)
    else:
        smooth = SmoothCovariance.of(kernel, terms, noise, colour_count)
        weights, precision = smooth.solve(values), smooth.precision
    trend = trend_variances(kernel, terms.shape[1], colour_count)[:, None] * (terms.T @ weights)
    return trend, weights, weights / precision[:, None]


def inverse_covariance(
    points: np.ndarray, terms: np.ndarray, kernel: np.ndarray, noise: np.ndarray, colour_count: int = 0
) -> np.ndarray:
    """Return the inverse covariance of the values of stars, [n, n]; arguments as those of :func:`krige`."""
    distances = pair_distances(points, points)
    covariance = kernel_covariance(kernel, distances, terms, noise, colour_count)
    return np.asarray(scipy.linalg.inv(covariance, check_finite=False))


def differences_left_out(inverse: np.ndarray, weights: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Return values less their predictions, [n, k], of each part of the stars by the others (Dubrule 1983).

    `inverse` [n, n] is that of their covariance, `weights` [n, k] its product with the values, `parts` are indices.
    """
    differences = np.empty(weights.shape)
    for part in parts:
        differences[part] = np.linalg.solve(inverse[np.ix_(part, part)], weights[part])
    return differences


def krige_mean(
    points: np.ndarray,
    values: np.ndarray,
    terms: np.ndarray,
    covariances: Covariances,
    noise: np.ndarray,
    *,
    colour_count: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of trend [n_terms, k] and weights [n, k] of :func:`krige` over covariances by probability.

    The weights are those of the process of the mean kernel: of one length, processes add up.
    """
    trend, pull = np.zeros((terms.shape[1], values.shape[1])), np.zeros(values.shape)
    for kernel, probability in covariances.weighted():
        kernel_trend, weights, _ = krige(points, values, terms, kernel, noise, colour_count=colour_count)
        trend += probability * kernel_trend
        pull += probability * kernel[0] * weights
    variance = covariances.kernel[0]
    return trend, pull / variance if variance > 0.0 else pull


def predict(points: np.ndarray, at: np.ndarray, kernel: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the process, without its trend, at places [m, 2] mapped like the points: [m, k].

    Each place on its own, star after star: no batch size matters.
    """
    if kernel[0] == 0.0:
        return np.zeros((len(at), weights.shape[1]))
    near = kernel[0] * np.exp(-pair_distances(at, points) / kernel[1])
    return sums_of_products(near, weights)


def kernel_covariance(
    kernel: np.ndarray, distance: np.ndarray, terms: np.ndarray, noise: np.ndarray, colour_count: int = 0
) -> np.ndarray:
    """Return the covariance [n, n] of values at stars of given distances, terms of the trend and noise."""
    decay = kernel[0] * np.exp(-distance / kernel[1])
    return _with_trend_and_noise(decay, kernel, terms, noise, colour_count)


def _with_trend_and_noise(
    decay: np.ndarray, kernel: np.ndarray, terms: np.ndarray, noise: np.ndarray, colour_count: int
) -> np.ndarray:
    """Return the covariance of a process [n, n] with that of the trend's terms and of the noise added."""
    covariance = decay + (terms * trend_variances(kernel, terms.shape[1], colour_count)) @ terms.T
    covariance.flat[:: len(noise) + 1] += noise + kernel[PROCESS_COLUMNS - 1]
    return np.asarray(covariance)


def trend_variances(kernel: np.ndarray, count: int, colour_count: int = 0) -> np.ndarray:
    """Return the variance of each term of the trend, [n_terms].

    Terms stand by degree, d + 1 of degree d; the last `colour_count` are those of colours.
    """
    variances = np.concatenate([[_CONSTANT], kernel[PROCESS_COLUMNS:]])[_degrees(count - colour_count)]
    return np.concatenate([variances, np.full(colour_count, kernel[-1])]) if colour_count else variances


@lru_cache(maxsize=16)
def _degrees(count: int) -> np.ndarray:
    """Return the degree of each of so many terms of polynomials, [n_terms]."""
    order = order_of(count)
    return np.repeat(np.arange(order + 1), np.arange(1, order + 2))


def order_of(count: int) -> int:
    """Return the order of polynomials of so many terms."""
    return math.isqrt(8 * count + 1) // 2 - 1


def pair_distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the distances between points [n, 2] and others [m, 2], [n, m]."""
    return np.asarray(np.hypot(*np.moveaxis(one[:, None] - other, -1, 0)))
