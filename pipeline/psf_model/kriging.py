r"""Kriging with the noise of each star: how smooth the PSF is over the CCD is learnt from the stars themselves.

Every pixel of the stamps is interpolated by one linear rule, the best one for a Gaussian field with the covariance

.. math::
    C_{ij} = s^2 e^{-|x_i - x_j|/L} + \sum_d t_d^2 \sum_{l+m=d} P_{lm}(x_i) P_{lm}(x_j) + (N_i + g)\,\delta_{ij}

of an exponential process, such as turbulence leaves, and a polynomial trend, whose terms of degree d are
shrunk to nothing where the stars show none. :math:`N_i` is the noise of star i, from the scatter of its outer pixels
and its photons; :math:`g` what is left. What counts is the shape, so :math:`s, L, t_d, g` are those of the largest
posterior probability of three numbers of each star, linear in its pixels: the two components of the ellipticity and the
size. Most pixels have no signal, and would say little. Nothing is left to choose: on fields that the polynomials of a
CCD describe this comes near to the best of them, with the best weights, and on turbulent ones it is better
(docs/psf_models.md).

Variances are in units of the noise of the middle star.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
import scipy.optimize

from ...core.errors import DomainError

#: Degree of the trend by default.
ORDER = 4
#: Fewest columns of the kernel: variance and length of the process, noise that all stars have, variances of the
#: trend's terms of degree 1 and 2, and so on to its order. Lengths where the extent is 2 wide.
COLUMNS = 5
# Mean and standard deviation of the logarithms of these before the stars are seen: wide but for the length, which
# forty stars hardly determine. Variances of the trend fall with the degree: nothing is expected of degrees 3 and 4, so
# that they cost nothing where the stars show nothing.
_PRIOR = np.array([(-2.0, 2.0), (math.log(0.7), 0.7), (-4.0, 1.5)])
_TREND_WIDTH = 4.0
# Where the search starts: nearly all trend of degree 2, nearly all process, all trend of every degree. The logarithms
# of the trend's variances start, up to the degree given, at the second number for degree 1 and fall by the third for
# each degree more; beyond, where they are expected.
_TREND, _PROCESS = (-4.0, math.log(0.7), -4.0), (0.0, math.log(0.7), -4.0)
_STARTS = ((_TREND, 2, 2.0, 1.0), (_PROCESS, 2, 1.0, 2.0), (_TREND, math.inf, 3.0, 0.5))
# Variance of the trend's constant: as good as unknown.
_CONSTANT = 1e4
# More stars than this add little to the covariance, and cost their cube; the brightest are taken.
_MOST_STARS = 300
# Distance from the centre beyond which a stamp is sky, as a fraction of its side.
_SKY = 0.35
#: Stars of fewer photons are not in electrons.
FEWEST_ELECTRONS = 100.0


def shape_numbers(
    mean: np.ndarray, deviations: np.ndarray, variance: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return three shape numbers [n, 3] of deviations [n, n_pixels] from a mean PSF, and their filters [3, n_pixels].

    They are, to first order in the deviations, twice the changes of e1, of e2 and of the logarithm of the size by the
    weighted moments of Jee & Tyson 2011, eq. 5. `mean` is [ny, nx]; the weight has a variance along each axis
    [pixel^2], by default that of the core.
    """
    y, x = np.indices(mean.shape) - np.array(mean.shape)[:, None, None] // 2
    square = x * x + y * y
    if variance is None:
        # Wings and noise of the outer pixels would make it that of the stamp.
        core = np.where(mean > 0.1 * mean.max(), mean, 0.0)
        variance = (core * square).sum() / core.sum()
    weight = np.exp(-0.5 * square / variance)
    light = (weight * mean).sum()
    size = (weight * square * mean).sum() / light
    filters = np.stack([x * x - y * y, 2.0 * x * y, square - size]).reshape(3, -1) * (weight.ravel() / (size * light))
    return deviations @ filters.T, filters


def star_noise(
    images: np.ndarray, deviations: np.ndarray, mean: np.ndarray, filters: np.ndarray, gain: float | None
) -> np.ndarray:
    """Return the variance of the noise of the shape numbers of each star, [n, 3].

    `images` [n, ny, nx] are in units of `gain` electrons, `deviations` [n, n_pixels] those of the stamps of unit sum
    from the mean [ny, nx]. Without gain there is no photon noise.
    """
    y, x = np.indices(mean.shape) - np.array(mean.shape)[:, None, None] // 2
    sky = (np.hypot(x, y) > _SKY * min(mean.shape)).ravel()
    outer = deviations[:, sky]
    rms = 1.4826 * np.median(np.abs(outer - np.median(outer, axis=1)[:, None]), axis=1)
    noise = rms[:, None] ** 2 * (filters**2).sum(axis=1)
    if gain is not None:
        electrons = images.sum(axis=(1, 2)) * gain
        if np.median(electrons) < FEWEST_ELECTRONS:
            raise DomainError(
                f"gain = {gain:g}: the middle star has {np.median(electrons):.3g} electrons; expected stamps in "
                "electrons, gain in electrons a unit, or gain = None for no photon noise"
            )
        noise = noise + (filters**2 @ np.maximum(mean.ravel(), 0.0)) / electrons[:, None]
    return noise


def fit_kernel(points: np.ndarray, numbers: np.ndarray, noise: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return the covariance, columns as in :data:`COLUMNS`, most probable for shape numbers [n, 3].

    `points` [n, 2] are mapped to [-1, 1], `noise` [n, 3] are the variances of the numbers, `terms` [n, n_terms] those
    of the trend.
    """
    unit = np.median(noise, axis=0)
    chosen = np.sort(np.argsort(noise.sum(axis=1), kind="stable")[:_MOST_STARS])
    distance = _distances(points[chosen], points[chosen])
    degrees = np.arange(1, max(order_of(terms.shape[1]), COLUMNS - 3) + 1)
    expected = np.where(degrees < 3, 1.0 - degrees, 3.0 - 3.0 * degrees)
    middle = np.concatenate([_PRIOR[:, 0], expected])
    width = np.concatenate([_PRIOR[:, 1], np.full(len(degrees), _TREND_WIDTH)])
    values, own = numbers[chosen] / np.sqrt(unit), (noise[chosen] / unit).mean(axis=1)

    def surprise(logarithms: np.ndarray) -> float:
        covariance = _covariance(np.exp(logarithms), distance, terms[chosen], own)
        try:
            root = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return 1e12
        whitened = scipy.linalg.solve_triangular(root, values, lower=True, check_finite=False)
        likelihood = 0.5 * (whitened**2).sum() + values.shape[1] * np.log(np.diagonal(root)).sum()
        return float(likelihood + 0.5 * (((logarithms - middle) / width) ** 2).sum())

    found = []
    for process, last, first, fall in _STARTS if len(degrees) > 2 else _STARTS[:2]:
        start = np.concatenate([process, np.where(degrees <= last, first - fall * (degrees - 1), expected)])
        simplex = start + 1.5 * np.vstack([np.zeros(len(start)), np.eye(len(start))])
        options = {"maxfev": 60 * len(start), "xatol": 0.1, "fatol": 0.02, "initial_simplex": simplex}
        found.append(scipy.optimize.minimize(surprise, start, method="Nelder-Mead", options=options))
    return np.exp(min(found, key=lambda each: each.fun).x)


def krige(
    points: np.ndarray, values: np.ndarray, terms: np.ndarray, kernel: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for trend and process of values [n, k] under one covariance, and predict each star from the others.

    Returns the coefficients of the terms [n_terms, k]; the inverse covariance times the values [n, k], the weights of
    :func:`predict`; and each value minus its prediction by the others [n, k]. `noise` [n] is in units of the middle
    star's.
    """
    covariance = _covariance(kernel, _distances(points, points), terms, noise)
    inverse = scipy.linalg.inv(covariance, check_finite=False)
    weights = inverse @ values
    trend = _trend_variances(kernel, terms.shape[1])[:, None] * (terms.T @ weights)
    return trend, weights, weights / np.diagonal(inverse)[:, None]


def predict(points: np.ndarray, at: np.ndarray, kernel: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the process, without its trend, at places [m, 2] mapped like the points: [m, k].

    Each place on its own, star after star: no batch size matters.
    """
    result = np.zeros((len(at), weights.shape[1]))
    for point, alpha in zip(points, weights, strict=True):
        near = kernel[0] * np.exp(-np.hypot(*(at - point).T) / kernel[1])
        result += near[:, None] * alpha
    return result


def _covariance(kernel: np.ndarray, distance: np.ndarray, terms: np.ndarray, noise: np.ndarray) -> np.ndarray:
    variance, length, floor = kernel[:3]
    covariance = variance * np.exp(-distance / length)
    covariance += (terms * _trend_variances(kernel, terms.shape[1])) @ terms.T
    covariance[np.diag_indices(len(noise))] += noise + floor
    return covariance


def _trend_variances(kernel: np.ndarray, count: int) -> np.ndarray:
    """Return the variance of each term of the trend, [n_terms]: terms stand by degree, d + 1 of degree d."""
    order = order_of(count)
    return np.repeat([_CONSTANT, *kernel[3 : 3 + order]], np.arange(1, order + 2))


def order_of(count: int) -> int:
    """Return the order of polynomials of so many terms."""
    return math.isqrt(8 * count + 1) // 2 - 1


def _distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.hypot(*np.moveaxis(one[:, None] - other, -1, 0))
