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

import numpy as np
import scipy.linalg

from ...core.row_sums import sums_of_products

#: Fewest columns of a kernel: variance and length of the process, noise that all stars have, variances of the
#: trend's terms of degree 1 and 2, and so on to its order. Lengths where the extent is 2 wide. A last column holds the
#: variance of the colour terms, of stars with colours.
COLUMNS = 5
#: Columns before those of the trend.
PROCESS_COLUMNS = 3
#: Column of the length of the process.
LENGTH = 1
# Variance of the trend's constant: as good as unknown.
_CONSTANT = 1e4
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


@dataclass(frozen=True, eq=False)
class SmoothCovariance:
    """Inverses of covariances without a process, D + T T', by the matrix inversion lemma (Woodbury 1950).

    Of one kernel, or of several, [n_kernels, ...].
    """

    variance: np.ndarray  #: of the noise D, [..., n]
    half: np.ndarray  #: R^-1 T' D^-1 with R R' = 1 + T' D^-1 T, [..., n_terms, n]
    log_determinant: np.ndarray  #: [...]

    @classmethod
    def of(cls, terms: np.ndarray, variance: np.ndarray, trend: np.ndarray) -> SmoothCovariance:
        """Return it for terms [..., n, n_terms], their variances `trend` [..., n_terms], and the noise's [..., n]."""
        scaled = terms * np.sqrt(trend)[..., None, :]
        over_noise = np.swapaxes(scaled / variance[..., None], -1, -2)
        root = np.linalg.cholesky(np.eye(terms.shape[-1]) + over_noise @ scaled)
        log_root = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        return cls(variance, np.linalg.solve(root, over_noise), np.log(variance).sum(axis=-1) + 2.0 * log_root)

    def solve(self, values: np.ndarray) -> np.ndarray:
        """Return the inverse covariance times values [n, k], [..., n, k]."""
        return np.asarray(values / self.variance[..., None] - np.swapaxes(self.half, -1, -2) @ (self.half @ values))

    @property
    def precision(self) -> np.ndarray:
        """Diagonal of the inverse covariance, [..., n]."""
        return np.asarray(1.0 / self.variance - (self.half**2).sum(axis=-2))

    @property
    def square(self) -> np.ndarray:
        """Sum of the squares of the inverse covariance, [...]."""
        between = self.half @ np.swapaxes(self.half, -1, -2)
        diagonal = self.variance**-2.0 - 2.0 * (self.half**2).sum(axis=-2) / self.variance
        return np.asarray(diagonal.sum(axis=-1) + (between**2).sum(axis=(-1, -2)))


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
        trend_variance = trend_variances(kernel, terms.shape[1], colour_count)
        smooth = SmoothCovariance.of(terms, noise + kernel[PROCESS_COLUMNS - 1], trend_variance)
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
    covariance = kernel[0] * np.exp(-distance / kernel[LENGTH])
    covariance += (terms * trend_variances(kernel, terms.shape[1], colour_count)) @ terms.T
    np.einsum("ii->i", covariance)[:] += noise + kernel[PROCESS_COLUMNS - 1]
    return np.asarray(covariance)


def trend_variances(kernels: np.ndarray, count: int, colour_count: int = 0) -> np.ndarray:
    """Return the variance of each term of the trend, [..., n_terms], for kernels [..., n_columns].

    Terms stand by degree, d + 1 of degree d; the last `colour_count` are those of colours.
    """
    constant = np.full((*kernels.shape[:-1], 1), _CONSTANT)
    return np.concatenate([constant, kernels[..., PROCESS_COLUMNS:]], axis=-1)[
        ..., columns_of_terms(count, colour_count)
    ]


@lru_cache(maxsize=16)
def columns_of_terms(count: int, colour_count: int) -> np.ndarray:
    """Return the column of each of so many terms behind those of process and noise, 0 for the constant, [n_terms].

    The last `colour_count` are terms of colours, whose column is the last one, -1.
    """
    order = order_of(count - colour_count)
    degrees = np.repeat(np.arange(order + 1), np.arange(1, order + 2))
    return np.concatenate([degrees, np.full(colour_count, -1)])


def order_of(count: int) -> int:
    """Return the order of polynomials of so many terms."""
    return math.isqrt(8 * count + 1) // 2 - 1


def pair_distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the distances between points [n, 2] and others [m, 2], [n, m]."""
    return np.asarray(np.hypot(*np.moveaxis(one[:, None] - other, -1, 0)))
