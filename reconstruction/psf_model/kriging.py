"""Kriging of the PSF over a CCD, with the noise of each star.

Stars are interpolated by linear rules, the best ones for Gaussian fields with the covariances of
:mod:`~.psf_model.covariance`: a polynomial trend and an exponential process, each as far as the stars show it. What
counts is the shape, so these are learnt from three numbers of each star, linear in its pixels: the two components of
the ellipticity and the size. The pixels follow these numbers, and vary by what they show besides
(:mod:`~.psf_model.pixel_fields`). The noise of a star is that of its outer pixels and of its photons.

Nothing is left to choose: on constant, linear and quadratic fields this comes near to the best of the polynomials, with
the best weights, and on turbulent ones it is better (docs/howto/psf_models.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError, PachonError, attempt
from ...core.memory import require_bytes
from ...core.statistics import RMS_PER_MAD, finite_row_medians, row_medians
from ...core.threads import one_blas_thread
from .colour import FittedColour
from .covariance import (
    COLUMNS,
    Covariances,
    differences_left_out,
    inverse_covariance,
    krige,
    krige_mean,
    predict,
)
from .covariance_search import ShapeSample, fit_covariances
from .file_parts import ModelParts
from .interpolation import FittedInterpolation, Interpolation, StarField
from .pixel_fields import PixelFields, SignalCovariance, fit_pixel_fields, krige_residuals, residuals_left_out
from .polynomial import MOST_ORDER, mapped

#: Degree of the trend by default.
ORDER = 4
# Variance of a second weight under which pixels keep the shape of the model, over that of the first: near to the
# weights of adaptive moments and of the paper, while the first, wide one has the least noise of all fields.
_NARROW = 0.4
# Light of the core is above the noise by so many standard deviations.
_CORE_NOISE = 5.0
# Least mean square of the core [pixel^2]: a star may be one pixel.
_LEAST_CORE = 0.25
# Distance from the centre beyond which a stamp is sky, as a fraction of its side.
_SKY = 0.35
# Passes after which the noise of the sky, and the mean of stars that are weighted by it, change no more.
_SKY_PASSES = 3
# Least part of a star's deviation from that mean that is its own.
_LEAST_OWN = 0.05
# Least noise over that of the faintest star.
_LEAST_SKY = 1e-12
# Lags of pixels whose noise may be correlated, as by resampling; one of each pair of opposite ones.
_LAGS = [(dy, dx) for dy in range(3) for dx in range(-2, 3) if (dy, dx) > (0, 0)]
# Standard errors of a correlation that counts: by chance none of the twelve lags of a CCD in a thousand.
_SIGNIFICANT = 5.0
# Standard deviations of sky pixels that tell the correlation.
_CLIP = 4.0
# Least variance over that without correlation.
_LEAST_FACTOR = 0.1
# Variance of a star's noise over that of its shape, at least: stars without noise would make the covariance singular.
_LEAST_NOISE = 1e-6
#: Stars of fewer photons are not in electrons.
FEWEST_ELECTRONS = 100.0
# Numbers of all pairs of stars that are in memory at a time: 1.5 GB for 5000 stars.
_NUMBERS_PER_PAIR = 8


@check_arguments
@dataclass(frozen=True)
class Kriging(Interpolation):
    """One covariance over the CCD for all components, learnt from the shapes of the stars, with the noise of each."""

    name = "kriging"
    label = "kriging"
    words = "kriging over "

    order: int | Literal["auto"] = ORDER

    def fit(self, stars: StarField) -> FittedKriging:
        """Krige the coefficients of stars by the covariances of their shapes."""
        shapes = _StarShapes.of(stars)
        return shapes.krige(fit_covariances([shapes.sample])[0])

    def fit_each(self, ccds: Sequence[StarField]) -> list[FittedInterpolation | PachonError]:
        """Krige the coefficients of stars of several CCDs, whose covariances are searched together."""
        shapes = [attempt(_StarShapes.of, stars) for stars in ccds]
        samples = [ccd.sample for ccd in shapes if not isinstance(ccd, PachonError)]
        covariances = iter(fit_covariances(samples))
        return [ccd if isinstance(ccd, PachonError) else attempt(ccd.krige, next(covariances)) for ccd in shapes]


@dataclass(frozen=True, eq=False)
class _StarShapes:
    """Shape numbers of the stars of a CCD with their noise."""

    stars: StarField
    deviations: np.ndarray  #: of the stars from the mean, [n, n_pixels]
    filters: np.ndarray  #: of the shape numbers, [3, n_pixels]
    sky: np.ndarray  #: variance of a pixel of sky, [n]
    sample: ShapeSample

    @classmethod
    def of(cls, stars: StarField) -> _StarShapes:
        """Measure the shape numbers of stars."""
        mean = stars.basis.mean
        deviations = stars.basis.deviations(stars.coefficients)
        numbers, filters = shape_numbers(mean, deviations)
        sky = sky_of_stars(deviations, mean.shape, stars.masked)
        noise = star_noise(stars.electrons, deviations, mean, filters, stars.masked, sky=sky)
        noise = np.maximum(noise, _LEAST_NOISE * (numbers**2).mean(axis=0) + np.finfo(float).tiny)
        places = mapped(stars.positions, stars.extent)
        sample = ShapeSample(places, numbers, noise, stars.with_colour_terms(), stars.colour_terms.shape[1])
        return cls(stars, deviations, filters, sky, sample)

    def krige(self, covariances: Covariances) -> FittedKriging:
        """Krige the coefficients of the stars by covariances."""
        stars, mean = self.stars, self.stars.basis.mean
        places, _, noise, terms, colour_count = self.sample
        of_stars = (noise / np.median(noise, axis=0)).mean(axis=1)
        fields, count = None, stars.terms.shape[1]
        if stars.basis.kind.has_components:
            trend, alpha = krige_mean(
                places, stars.coefficients, terms, covariances, of_stars, colour_count=colour_count
            )
        else:
            count_text = f"kriging of {len(places)} stars (recipe 'paper' has no matrix of them)"
            require_bytes(8 * _NUMBERS_PER_PAIR * len(places) ** 2, count_text)
            narrow_filters = shape_numbers(mean, self.deviations, _NARROW * core_variance(mean))[1]
            all_filters = np.concatenate([self.filters, narrow_filters])
            shapes = self.deviations @ all_filters.T
            shape_trend, dual = krige_mean(places, shapes, terms, covariances, of_stars, colour_count=colour_count)
            signal = SignalCovariance.of(covariances.kernel, places, terms, colour_count)
            at_stars = terms @ shape_trend + predict(places, places, covariances.kernel, dual)
            pixel_noise = middle_star_noise(stars.electrons, self.sky, mean, of_stars)
            fields = fit_pixel_fields(mean, self.deviations, all_filters, of_stars, pixel_noise, at_stars, signal)
            residuals = fields.split(self.deviations)[1]
            residual_trend, residual_dual = krige_residuals(residuals, fields, signal, of_stars)
            trend, alpha = shape_trend @ fields.response + residual_trend, dual @ fields.response + residual_dual
        return FittedKriging(
            stars.positions,
            stars.extent,
            stars.order,
            trend[:count],
            1.0 / of_stars,
            covariances,
            alpha,
            fields,
            colour=stars.fitted_colour(trend[count:], covariances.colour_probability),
        )


@dataclass(frozen=True, eq=False)
class FittedKriging(FittedInterpolation, kind=Kriging):
    """A trend and a process, the mean of those of all probable covariances."""

    kernel_columns = range(COLUMNS, COLUMNS + MOST_ORDER + 1)

    covariances: Covariances  #: learnt from the stars
    alpha: np.ndarray  #: dual coefficients of the process of mean variance, [n, k]
    fields: PixelFields | None = None  #: of pixels; None where components are kriged each by the same covariance

    @property
    def kernel(self) -> np.ndarray:
        """Mean of the kernels of the covariances: :data:`~.covariance.COLUMNS`."""
        return self.covariances.kernel

    @property
    def smoothness(self) -> dict[str, float]:
        """Probability of each form of the field, such as ``constant`` or ``linear, process``."""
        return self.covariances.forms()

    def at(self, positions: Any) -> np.ndarray:
        """Evaluate the coefficients at positions [m, 2], [m, k]; no batch size matters."""
        points, places = (mapped(p, self.extent) for p in (self.positions, positions))
        return super().at(positions) + predict(points, places, self.kernel, self.alpha)

    def leave_one_out(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients [n, k] of the stars less their prediction by the others under the same covariances."""
        points = mapped(self.positions, self.extent)
        noise = 1.0 / (np.ones(len(points)) if self.weights is None else self.weights)
        terms, colour_count = self.terms(), 0 if self.colour is None else len(self.colour.slope)

        def differences(values: np.ndarray) -> np.ndarray:
            by_form = (
                probability * krige(points, values, terms, kernel, noise, colour_count=colour_count)[2]
                for kernel, probability in self.covariances.weighted()
            )
            return np.asarray(sum(by_form))

        with one_blas_thread():
            if self.fields is None:
                return differences(coefficients)
            numbers, residuals = self.fields.split(coefficients)
            signal = SignalCovariance.of(self.kernel, points, terms, colour_count)
            shape_differences = differences(numbers) @ self.fields.response
            return shape_differences + residuals_left_out(residuals, self.fields, signal, noise)

    @property
    def predicts_left_out(self) -> bool:
        """Whether the components are pixels: principal ones hold the stars that are left out."""
        return self.fields is not None and self.weights is not None

    def left_out(self, parts: list[np.ndarray], coefficients: np.ndarray) -> np.ndarray:
        """Return predictions of all stars, each part of them by the others; arguments as those of the base class.

        Covariances, the response of the pixels to the shape, and the noise are those of all stars, as in
        :meth:`leave_one_out`; the search for them is most of a fit's time.
        """
        assert self.fields is not None
        assert self.weights is not None
        points = mapped(self.positions, self.extent)
        noise, terms = 1.0 / self.weights, self.terms()
        colour_count = 0 if self.colour is None else len(self.colour.slope)
        predictions = np.empty(coefficients.shape)
        with one_blas_thread():
            numbers, residuals = self.fields.split(coefficients)
            shapes = np.zeros(numbers.shape)
            for kernel, probability in self.covariances.weighted():
                inverse = inverse_covariance(points, terms, kernel, noise, colour_count)
                shapes += probability * (numbers - differences_left_out(inverse, inverse @ numbers, parts))
            signal = SignalCovariance.of(self.kernel, points, terms, colour_count)
            for part in parts:
                others = np.setdiff1d(np.arange(len(points)), part)
                trend, dual = krige_residuals(residuals[others], self.fields, signal.of_stars(others), noise[others])
                predictions[part] = trend[0] + signal.covariance[np.ix_(part, others)] @ dual
            predictions += shapes @ self.fields.response
        return predictions

    def truncated(self, count: int) -> Self:
        """Return the interpolation of the first components only."""
        return replace(super().truncated(count), alpha=self.alpha[:, :count])

    def parts(self) -> ModelParts:
        """Return what the interpolation has in a FITS file, the covariance once for each component."""
        images = {"KERNEL": np.tile(self.kernel, (self.polynomial.shape[1], 1))}
        if len(self.covariances.kernels) > 1:
            images["FORMS"] = np.column_stack([self.covariances.probabilities, self.covariances.kernels])
        if self.fields is not None:
            images["FIELDS"] = self.fields.rows()
        return super().parts().extended(images, {"pull": self.alpha})

    @classmethod
    def _fields_of(cls, parts: ModelParts) -> dict[str, Any]:
        forms = parts.images.get("FORMS")
        if forms is None:
            forms = np.concatenate([[1.0], parts.image("KERNEL")[0]])[None]
        rows, coloured = parts.images.get("FIELDS"), FittedColour.in_parts(parts) is not None
        fields = None if rows is None else PixelFields.of_rows(rows)
        covariances = Covariances(forms[:, 1:], forms[:, 0], coloured)
        return {"covariances": covariances, "alpha": parts.columns["pull"], "fields": fields}


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
        variance = core_variance(mean)
    weight = np.exp(-0.5 * square / variance)
    light = (weight * mean).sum()
    size = (weight * square * mean).sum() / light
    filters = np.stack([x * x - y * y, 2.0 * x * y, square - size]).reshape(3, -1) * (weight.ravel() / (size * light))
    return deviations @ filters.T, filters


def core_variance(mean: np.ndarray) -> float:
    """Return the mean square of the distance from the centre of a PSF's light above a tenth of its peak [pixel^2].

    Of the mean of faint stars it is the light above the noise, at most above half of the peak.
    """
    y, x = np.indices(mean.shape) - np.array(mean.shape)[:, None, None] // 2
    # Wings and noise of the outer pixels would make it that of the stamp.
    negative, peak = mean[mean < 0.0], mean.max()
    noise = np.sqrt((negative**2).mean()) if len(negative) else 0.0
    core = np.where(mean > np.clip(_CORE_NOISE * noise, 0.1 * peak, 0.5 * peak), mean, 0.0)
    return max(float((core * (x * x + y * y)).sum() / core.sum()), _LEAST_CORE)


def star_noise(
    electrons: np.ndarray | None,
    deviations: np.ndarray,
    mean: np.ndarray,
    filters: np.ndarray,
    masked: np.ndarray | None = None,
    *,
    sky: np.ndarray | None = None,
) -> np.ndarray:
    """Return the variance of the noise of the shape numbers of each star, [n, 3].

    `electrons` are those of the stars [n], `deviations` [n, n_pixels] those of the stamps of unit sum from the mean
    [ny, nx]. Without electrons there is no photon noise. Pixels in `masked` [n, ny, nx], which are filled and have no
    noise of their own, are left out of the scatter of the sky; `sky` is that of :func:`sky_of_stars`, if known.
    """
    sky_variance = sky_of_stars(deviations, mean.shape, masked) if sky is None else sky
    correlations = _noise_correlations(deviations.reshape(-1, *mean.shape), sky_variance, masked)
    sky_noise = (filters**2).sum(axis=1) * _correlation_factors(correlations, filters, mean.shape)
    noise = sky_variance[:, None] * sky_noise
    if electrons is not None:
        light = np.maximum(mean.ravel(), 0.0)
        photon_noise = (filters**2 @ light) * _correlation_factors(correlations, filters * np.sqrt(light), mean.shape)
        noise = noise + photon_noise / electrons[:, None]
    return noise


def require_electrons(electrons: np.ndarray, gain: float) -> None:
    """Raise DomainError for stars [n] of fewer electrons than photon noise is known of."""
    if np.median(electrons) < FEWEST_ELECTRONS:
        raise DomainError(
            f"gain = {gain:g}: the middle star has {np.median(electrons):.3g} electrons; expected stamps in "
            "electrons, gain in electrons a unit, or gain = None for no photon noise"
        )


def middle_star_noise(electrons: np.ndarray | None, sky: np.ndarray, mean: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the variance of the noise of pixels, [n_pixels], of the star of middle `noise` [n].

    `sky` [n] is that of :func:`sky_of_stars`.
    """
    star = int(np.argsort(noise, kind="stable")[len(noise) // 2])
    photons = 0.0 if electrons is None else np.maximum(mean.ravel(), 0.0) / electrons[star]
    return np.asarray(sky[star] + photons + np.zeros(mean.size))


def _sky_pixels(shape: tuple[int, ...]) -> np.ndarray:
    """Return the pixels of a stamp that are sky, bool [n_pixels]."""
    y, x = np.indices(shape) - np.array(shape)[:, None, None] // 2
    return np.asarray(np.hypot(x, y) > _SKY * min(shape)).ravel()


def sky_of_stars(deviations: np.ndarray, shape: tuple[int, ...], masked: np.ndarray | None) -> np.ndarray:
    """Return the variance of a pixel of sky of each star, [n], from deviations [n, n_pixels]."""
    sky = _sky_pixels(shape)
    # In single precision, whose medians take half of the time: noise is known to some per cent.
    outer = None if masked is None else masked.reshape(len(deviations), -1)[:, sky]
    return _sky_variance(deviations[:, sky].astype(np.float32), outer)


def _noise_correlations(
    deviations: np.ndarray, sky_variance: np.ndarray, masked: np.ndarray | None
) -> dict[tuple[int, int], float]:
    """Return the correlation of the noise of pixels by their lag (rows, columns), where it is significant.

    It is that of pixels of sky of all stars together, deviations [n, ny, nx], as resampling leaves. `sky_variance` [n]
    is that of a pixel of each star.
    """
    if not sky_variance.max() > 0.0:
        return {}
    ny, nx = deviations.shape[1:]
    sky = _sky_pixels((ny, nx)).reshape(ny, nx)
    # A mean of stars keeps the correlation, their median does not.
    weights = 1.0 / np.maximum(sky_variance, _LEAST_SKY * sky_variance.max())
    deviations = deviations.astype(np.float32)
    pixels = deviations - np.tensordot((weights / weights.sum()).astype(np.float32), deviations, axes=1)
    pixels /= np.maximum(RMS_PER_MAD * row_medians(np.abs(pixels[:, sky])), np.finfo(np.float32).tiny)[:, None, None]
    # Cosmic rays and neighbours would correlate.
    used = (np.abs(pixels) < _CLIP) & sky & (True if masked is None else ~masked)
    # In rows with so many dark pixels behind them that no lag leads into the light of another one.
    room = ((0, 0), (0, max(dy for dy, _ in _LAGS)), (0, max(dx for _, dx in _LAGS)))
    flags = np.pad(used.astype(np.float32), room)
    flags, light = flags.ravel(), np.pad(np.where(used, pixels, 0.0), room).ravel()
    square = (light @ light) / max(used.sum(), 1)
    correlations = {}
    for dy, dx in _LAGS if square > 0.0 else ():
        shift = dy * (nx + room[2][1]) + dx
        count = max(flags[:-shift] @ flags[shift:], 1.0)
        correlation = float((light[:-shift] @ light[shift:]) / (count * square))
        if abs(correlation) > _SIGNIFICANT / math.sqrt(count):
            correlations[dy, dx] = correlation
    return correlations


def _correlation_factors(
    correlations: dict[tuple[int, int], float], filters: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Return the variances of filtered noise, filters [3, n_pixels], over those without correlation of pixels, [3]."""
    images = filters.reshape(-1, *shape)
    factors = np.ones(len(images))
    for lag, correlation in correlations.items():
        first, second = _lagged(images.shape[1], images.shape[2], *lag)
        overlap = (images[:, *first] * images[:, *second]).sum(axis=(1, 2))
        factors += 2.0 * correlation * overlap / (images**2).sum(axis=(1, 2))
    return np.maximum(factors, _LEAST_FACTOR)


def _lagged(ny: int, nx: int, dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return pixels of an image, and those that are dy rows and dx columns on."""
    first = slice(0, ny - dy), slice(max(0, -dx), nx - max(0, dx))
    return first, (slice(dy, ny), slice(max(0, dx), nx + min(0, dx)))


def _sky_variance(outer: np.ndarray, masked: np.ndarray | None = None) -> np.ndarray:
    """Return the variance of a pixel of sky of each star, [n], from the deviations of outer pixels [n, n_outer].

    Masked ones [n, n_outer] do not count, but in stars without any other.

    About a mean with equal weights bright stars would have the noise of the faint ones.
    """
    variance = np.ones(len(outer))
    median: Any = row_medians if masked is None else finite_row_medians
    for _ in range(_SKY_PASSES):
        weights = 1.0 / np.maximum(variance, _LEAST_SKY * variance.max())
        weights /= weights.sum()
        sky_pixels = outer - weights.astype(outer.dtype) @ outer
        if masked is not None:
            sky_pixels = np.where(masked & ~masked.all(axis=1, keepdims=True), np.nan, sky_pixels)
        rms = RMS_PER_MAD * median(np.abs(sky_pixels - median(sky_pixels)[:, None]))
        # A star takes part in the mean that is subtracted from it.
        variance = rms**2 / np.maximum(1.0 - weights, _LEAST_OWN)
        if not variance.any():  # without noise
            break
    return variance
