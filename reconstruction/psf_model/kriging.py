r"""Kriging with the noise of each star, and a covariance over the CCD that is fitted to the stars themselves.

Every pixel of the stamps is interpolated by one linear rule, the best one for a Gaussian field with the covariance

.. math::
    C_{ij} = s^2 e^{-|x_i - x_j|/L} + \sum_d t_d^2 \sum_{l+m=d} P_{lm}(x_i) P_{lm}(x_j) + (N_i + g)\,\delta_{ij}

of an exponential process, such as turbulence leaves, and a polynomial trend, whose terms of degree d are
shrunk to nothing where the stars show none; those of degree 3 and 4 are left out unless the stars show them.
:math:`N_i` is the noise of star i, from the scatter of its outer pixels and its photons; :math:`g` what is left. What
counts is the shape, so :math:`s, L, t_d, g` are those of the largest posterior probability of three numbers of each
star, linear in its pixels: the two components of the ellipticity and the size. Most pixels have no signal, and hardly
constrain it. Nothing is left to choose: on fields that the polynomials of a CCD describe this comes near to the best of
them, with the best weights, and on turbulent ones it is better (docs/psf_models.md).

Variances are in units of the noise of the middle star.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import scipy.linalg

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.statistics import RMS_PER_MAD
from ...core.threads import one_blas_thread
from ..gaussian_field import inverse_from_cholesky, leave_one_out_residuals
from .file_parts import ModelParts
from .interpolation import FittedInterpolation, Interpolation, StarField
from .polynomial import MOST_ORDER, mapped, term_count

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

#: Degree of the trend by default.
ORDER = 4
#: Fewest columns of the kernel: variance and length of the process, noise that all stars have, variances of the
#: trend's terms of degree 1 and 2, and so on to its order. Lengths where the extent is 2 wide.
COLUMNS = 5
# Prior mean and standard deviation of the logarithms of these: wide but for the length, which
# forty stars hardly determine. Variances of the trend fall with the degree: nothing is expected of degrees 3 and 4, so
# that they cost nothing where the stars show nothing.
_PRIOR = np.array([(-5.0, 3.0), (math.log(0.7), 0.7), (-6.0, 2.0)])
_TREND_WIDTH = 4.0
# A degree of the trend above the second is kept if the posterior's logarithm falls by this much without it: of the
# prior of such a variance about a seventh, e^-2, lies where noise alone may put a maximum. The process always stays:
# turbulence causes one, and forty stars of S/N 30 predict others worse by 3 % without it.
_EVIDENCE = 2.0
_FIRST_OPTIONAL_DEGREE = 3
# Where the search starts: nearly all trend of degree 2, nearly all process, all trend of every degree. The logarithms
# of the trend's variances start, up to the degree given, at the second number for degree 1 and fall by the third for
# each degree more; beyond, where they are expected.
_TREND = (-4.0, math.log(0.7), -4.0)
_PROCESS = (0.0, math.log(0.7), -4.0)
_STARTS = ((_TREND, 2, 2.0, 1.0), (_PROCESS, 2, 1.0, 2.0), (_TREND, math.inf, 3.0, 0.5))
# Variance of the trend's constant: as good as unknown.
_CONSTANT = 1e4
# More stars than this add little to the covariance, and cost their cube; the brightest are taken.
_MOST_STARS = 300
# Distance from the centre beyond which a stamp is sky, as a fraction of its side.
_SKY = 0.35
# Passes after which the noise of the sky, and the mean of stars that are weighted by it, change no more.
_SKY_PASSES = 3
# Least part of a star's deviation from that mean that is its own.
_LEAST_OWN = 0.05
# Least noise over that of the faintest star.
_LEAST_SKY = 1e-12
# Variance of a star's noise over that of its shape, at least: stars without noise would make the covariance singular.
_LEAST_NOISE = 1e-6
#: Stars of fewer photons are not in electrons.
FEWEST_ELECTRONS = 100.0


@check_arguments
@dataclass(frozen=True)
class Kriging(Interpolation):
    """One covariance over the CCD for all components, learnt from the shapes of the stars, with the noise of each."""

    name = "kriging"
    label = "kriging"
    words = "kriging over "

    order: int | Literal["auto"] = ORDER

    def fit(self, stars: StarField) -> FittedKriging:
        """Krige the coefficients of stars by the covariance of their shapes."""
        mean = stars.basis.mean
        deviations = stars.basis.deviations(stars.coefficients)
        numbers, filters = shape_numbers(mean, deviations)
        noise = star_noise(stars.images, deviations, mean, filters, stars.gain, stars.masked)
        noise = np.maximum(noise, _LEAST_NOISE * (numbers**2).mean(axis=0) + np.finfo(float).tiny)
        places = mapped(stars.positions, stars.extent)
        kernel = fit_kernel(places, numbers, noise, stars.terms)
        of_stars = (noise / np.median(noise, axis=0)).mean(axis=1)
        polynomial, alpha, _ = krige(places, stars.coefficients, stars.terms, kernel, of_stars)
        return FittedKriging(stars.positions, stars.extent, stars.order, polynomial, 1.0 / of_stars, kernel, alpha)


@dataclass(frozen=True, eq=False)
class FittedKriging(FittedInterpolation, kind=Kriging):
    """A trend and a process of one covariance."""

    kernel_columns = range(COLUMNS, COLUMNS + MOST_ORDER)

    kernel: np.ndarray  #: of the covariance: :data:`COLUMNS`
    alpha: np.ndarray  #: dual coefficients: inverse covariance times coefficients, [n, k]

    def at(self, positions: Any) -> np.ndarray:
        """Evaluate the coefficients at positions [m, 2], [m, k]; no batch size matters."""
        points, places = (mapped(p, self.extent) for p in (self.positions, positions))
        return super().at(positions) + predict(points, places, self.kernel, self.alpha)

    def leave_one_out(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients [n, k] of the stars less their prediction by the others under the same covariance."""
        points = mapped(self.positions, self.extent)
        noise = 1.0 / (np.ones(len(points)) if self.weights is None else self.weights)
        with one_blas_thread():
            return krige(points, coefficients, self.terms(), self.kernel, noise)[2]

    def truncated(self, count: int) -> Self:
        """Return the interpolation of the first components only."""
        return replace(super().truncated(count), alpha=self.alpha[:, :count])

    def parts(self) -> ModelParts:
        """Return what the interpolation has in a FITS file, the covariance once for each component."""
        kernels = np.tile(self.kernel, (self.polynomial.shape[1], 1))
        return super().parts().extended({"KERNEL": kernels}, {"pull": self.alpha})

    @classmethod
    def _fields_of(cls, parts: ModelParts) -> dict[str, Any]:
        return {"kernel": parts.image("KERNEL")[0], "alpha": parts.columns["pull"]}


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
    images: np.ndarray,
    deviations: np.ndarray,
    mean: np.ndarray,
    filters: np.ndarray,
    gain: float | None,
    masked: np.ndarray | None = None,
) -> np.ndarray:
    """Return the variance of the noise of the shape numbers of each star, [n, 3].

    `images` [n, ny, nx] are in units of `gain` electrons, `deviations` [n, n_pixels] those of the stamps of unit sum
    from the mean [ny, nx]. Without gain there is no photon noise. Pixels in `masked` [n, ny, nx], which are filled and
    have no noise of their own, are left out of the scatter of the sky.
    """
    y, x = np.indices(mean.shape) - np.array(mean.shape)[:, None, None] // 2
    sky = (np.hypot(x, y) > _SKY * min(mean.shape)).ravel()
    outer = None if masked is None else masked.reshape(len(images), -1)[:, sky]
    noise = _sky_variance(deviations[:, sky], outer)[:, None] * (filters**2).sum(axis=1)
    if gain is not None:
        electrons = images.sum(axis=(1, 2)) * gain
        if np.median(electrons) < FEWEST_ELECTRONS:
            raise DomainError(
                f"gain = {gain:g}: the middle star has {np.median(electrons):.3g} electrons; expected stamps in "
                "electrons, gain in electrons a unit, or gain = None for no photon noise"
            )
        noise = noise + (filters**2 @ np.maximum(mean.ravel(), 0.0)) / electrons[:, None]
    return noise


def _sky_variance(outer: np.ndarray, masked: np.ndarray | None = None) -> np.ndarray:
    """Return the variance of a pixel of sky of each star, [n], from the deviations of outer pixels [n, n_outer].

    Masked ones [n, n_outer] do not count, but in stars without any other.

    About a mean with equal weights bright stars would have the noise of the faint ones.
    """
    variance = np.ones(len(outer))
    median: Any = np.median if masked is None else np.nanmedian
    for _ in range(_SKY_PASSES):
        weights = 1.0 / np.maximum(variance, _LEAST_SKY * variance.max())
        weights /= weights.sum()
        sky_pixels = outer - weights @ outer
        if masked is not None:
            sky_pixels = np.where(masked & ~masked.all(axis=1, keepdims=True), np.nan, sky_pixels)
        rms = RMS_PER_MAD * median(np.abs(sky_pixels - median(sky_pixels, axis=1)[:, None]), axis=1)
        # A star takes part in the mean that is subtracted from it.
        variance = rms**2 / np.maximum(1.0 - weights, _LEAST_OWN)
        if not variance.any():  # without noise
            break
    return variance


def fit_kernel(points: np.ndarray, numbers: np.ndarray, noise: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return the covariance, columns as in :data:`COLUMNS`, most probable for shape numbers [n, 3].

    Degrees of the trend above the second have the variance 0 unless the stars show them. `points` [n, 2] are mapped
    to [-1, 1], `noise` [n, 3] are the variances of the numbers, `terms` [n, n_terms] those of the trend.
    """
    unit = np.median(noise, axis=0)
    brightest = np.sort(np.argsort(noise.sum(axis=1), kind="stable")[:_MOST_STARS])
    degrees = np.arange(1, max(order_of(terms.shape[1]), COLUMNS - 3) + 1)
    expected = np.where(degrees < 3, 1.0 - degrees, 3.0 - 3.0 * degrees)
    posterior = Posterior(
        _pair_distances(points[brightest], points[brightest]),
        numbers[brightest] / np.sqrt(unit),
        (noise[brightest] / unit).mean(axis=1),
        terms[brightest],
        np.concatenate([_PRIOR[:, 0], expected]),
        np.concatenate([_PRIOR[:, 1], np.full(len(degrees), _TREND_WIDTH)]),
    )
    all_columns = np.ones(3 + len(degrees), dtype=bool)
    optima = []
    for process, last, first, fall in _STARTS if len(degrees) > 2 else _STARTS[:2]:
        start = np.concatenate([process, np.where(degrees <= last, first - fall * (degrees - 1), expected)])
        optima.append(posterior.minimize(start, all_columns))
    best, best_columns = min(optima, key=lambda each: each.fun), all_columns
    for column in range(len(all_columns) - 1, 1 + _FIRST_OPTIONAL_DEGREE, -1):
        fewer = best_columns & (np.arange(len(best_columns)) != column)
        without = posterior.minimize(best.x, fewer)
        if without.fun < best.fun + _EVIDENCE:
            best, best_columns = without, fewer
    return posterior.kernel(best.x, best_columns)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior probability of the logarithms of the kernel's columns, for numbers in units of the noise."""

    distance: np.ndarray  #: between stars, [n, n]
    numbers: np.ndarray  #: of the stars, [n, 3]
    noise: np.ndarray  #: their variance, [n]
    terms: np.ndarray  #: of the trend, [n, n_terms]
    middle: np.ndarray  #: mean of the prior, [n_columns]
    width: np.ndarray  #: its standard deviation, [n_columns]

    def kernel(self, logarithms: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the columns, those that are not kept as 0 but for the length."""
        return np.where(kept | (np.arange(len(kept)) == 1), np.exp(logarithms), 0.0)

    def negative_log_posterior(self, logarithms: np.ndarray, kept: np.ndarray) -> tuple[float, np.ndarray]:
        """Return minus the logarithm of the posterior, but for a constant, and its derivatives [n_columns]."""
        kernel = self.kernel(logarithms, kept)
        try:
            root = np.linalg.cholesky(_kernel_covariance(kernel, self.distance, self.terms, self.noise))
        except np.linalg.LinAlgError:
            return 1e12, np.zeros(len(kept))
        inverse = inverse_from_cholesky(root)
        solved = inverse @ self.numbers
        count = self.numbers.shape[1]
        value = 0.5 * (solved * self.numbers).sum() + count * np.log(np.diagonal(root)).sum()
        # A change dC of the covariance changes the value by half the sum of `change` times dC.
        change = count * inverse - solved @ solved.T
        process = change * (kernel[0] * np.exp(-self.distance / kernel[1]))
        variances = _trend_variances(kernel, self.terms.shape[1])
        trend = variances * ((change @ self.terms) * self.terms).sum(axis=0)
        slope = np.zeros(len(kept))
        slope[0] = process.sum()
        slope[1] = (process * self.distance).sum() / kernel[1]
        slope[2] = kernel[2] * np.trace(change)
        for degree in range(1, order_of(len(trend)) + 1):
            slope[2 + degree] = trend[term_count(degree - 1) : term_count(degree)].sum()
        away = np.where(kept, (logarithms - self.middle) / self.width, 0.0)
        return float(value + 0.5 * (away @ away)), 0.5 * slope + away / self.width

    def minimize(self, start: np.ndarray, kept: np.ndarray) -> OptimizeResult:
        """Return the most probable logarithms from a start, those that are not kept as they were."""
        from scipy.optimize import minimize  # a fifth of a second

        reach = 8.0 * self.width
        return minimize(
            self.negative_log_posterior,
            start,
            args=(kept,),
            jac=True,
            method="L-BFGS-B",
            bounds=np.stack([self.middle - reach, self.middle + reach], axis=1),
            options={"maxiter": 60, "ftol": 1e-7},
        )


def krige(
    points: np.ndarray, values: np.ndarray, terms: np.ndarray, kernel: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for trend and process of values [n, k] under one covariance, and predict each star from the others.

    Returns the coefficients of the terms [n_terms, k]; the inverse covariance times the values [n, k], the weights of
    :func:`predict`; and each value minus its prediction by the others [n, k]. `noise` [n] is in units of the middle
    star's.
    """
    covariance = _kernel_covariance(kernel, _pair_distances(points, points), terms, noise)
    inverse = scipy.linalg.inv(covariance, check_finite=False)
    weights = inverse @ values
    trend = _trend_variances(kernel, terms.shape[1])[:, None] * (terms.T @ weights)
    return trend, weights, leave_one_out_residuals(weights, inverse)


def predict(points: np.ndarray, at: np.ndarray, kernel: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the process, without its trend, at places [m, 2] mapped like the points: [m, k].

    Each place on its own, star after star: no batch size matters.
    """
    result = np.zeros((len(at), weights.shape[1]))
    for point, alpha in zip(points, weights, strict=True):
        near = kernel[0] * np.exp(-np.hypot(*(at - point).T) / kernel[1])
        result += near[:, None] * alpha
    return result


def _kernel_covariance(kernel: np.ndarray, distance: np.ndarray, terms: np.ndarray, noise: np.ndarray) -> np.ndarray:
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


def _pair_distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.hypot(*np.moveaxis(one[:, None] - other, -1, 0))
