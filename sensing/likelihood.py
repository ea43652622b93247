r"""Likelihood of the pixels of a donut, and its normal equations.

Counts plus sky have the Poisson distribution of the model plus sky: the logarithm of the likelihood is, up to a
constant, :math:`\sum (d + s) \ln(m + s) - (m + s)` with data d, model m and sky variance s. Its gradient is
:math:`\sum A (d - m) / V` with the derivatives A of the model and the variance V = m + s, its expected curvature
:math:`\sum A A^T / V`, Fisher's information.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace

import numpy as np

from .donut_rays import LightRays
from .image_model import FLUX, RATIO, STRENGTH, ImageGrid, LandedLight, X, Y

#: Smallest variance of a pixel [electron^2], where model and sky are next to nothing.
_LEAST_VARIANCE = 1.0
#: Distance that light has moved by since derivatives of the image were computed [pixels of the fit], up to which these
#: hold: they are then a few per cent off, and steps of a search as much, which makes 1 nm of errors of 100.
_STILL = 0.03
#: The same of images that are sharper than their pixels.
_STILL_SHARP = 0.015
#: Relative change of the strength of the turbulence, and of the light of the cells, up to which they do.
_SAME = 0.02
#: The limits of searches in coarse pixels over these.
_COARSE = 4.0


@dataclass(frozen=True)
class Stamp:
    """Pixels of one donut and what they are compared with.

    Attributes
    ----------
    image : ndarray, shape [ny, nx]
        Electrons, sky subtracted.
    variance : ndarray, shape [ny, nx]
        Variance of sky and readout [electron^2].
    used : ndarray of bool, shape [ny, nx]
        Pixels that count.
    grid : ImageGrid
        Model of the image.
    rays : LightRays
        Landing points of the light.
    """

    image: np.ndarray
    variance: np.ndarray
    used: np.ndarray
    grid: ImageGrid
    rays: LightRays

    def forget(self) -> None:
        """Free the derivatives of the last linear model."""
        self.grid.last = self.grid.point = None

    def release(self) -> None:
        """Free what the model can compute again."""
        self.forget()
        self.rays.release()
        if self.grid.rim_light is not None:
            self.grid.rim_light.release()


@dataclass(frozen=True)
class NormalEquations:
    """Curvature and gradient of the logarithm of the likelihood at one point.

    Attributes
    ----------
    curvature : ndarray, shape [n, n]
        Fisher's information of the unknowns of the star and its wavefront.
    gradient : ndarray, shape [n]
        Gradient of the logarithm of the likelihood.
    loss : float
        Twice the negative logarithm of the likelihood over that of a perfect model: nearly chi-square. Infinite where
        the wavefront is so steep that light has no direction or misses the telescope.
    chi2 : float
        Sum of squares of residuals over their variance.
    """

    curvature: np.ndarray
    gradient: np.ndarray
    loss: float
    chi2: float


@dataclass(frozen=True)
class Linearized:
    """Residuals of a stamp and derivatives of its model at one point, over the standard deviation of the noise.

    Attributes
    ----------
    model, variance : ndarray, shape [ny, nx]
        Model of the image [electron] and variance of its noise [electron^2].
    brightness : ndarray, shape [ny, nx]
        Light of the star and its neighbours in the model [electron].
    used : ndarray of bool, shape [ny, nx]
        Pixels that count.
    residual : ndarray, shape [n_pixel]
        Residuals of the pixels in use [electron].
    pulls : ndarray of float32, shape [n_pixel]
        The same over their standard deviations.
    columns : ndarray of float32, shape [n_pixel, n]
        Derivatives with respect to the unknowns of the star and its wavefront, over their scales.
    scales : ndarray, shape [n]
        Scales of the columns.
    """

    model: np.ndarray
    variance: np.ndarray
    brightness: np.ndarray
    used: np.ndarray
    residual: np.ndarray
    pulls: np.ndarray
    columns: np.ndarray
    scales: np.ndarray

    def over_noise(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of all pixels [ny, nx, k] at those in use, over their standard deviations, [n_pixel, k]."""
        return _over_noise(columns, self.variance, self.used)


def _over_noise(columns: np.ndarray, variance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return columns [ny, nx, k] at the pixels in use, over their standard deviations, shape [n_pixel, k]."""
    # A slice where all pixels are used, since that is no copy.
    pixels = used if not used.all() else np.s_[:, :]
    root = (1.0 / np.sqrt(variance[pixels].ravel())).astype(np.float32)
    return np.asarray(columns[pixels].reshape(len(root), -1) * root[:, None])


@dataclass
class _Derivatives:
    """Image at unknowns of a star, its derivatives and their scales, where its light lands, and chi-square a pixel.

    The curvature is that of the derivatives over the noise of a stamp, without their scales, once it was computed.
    """

    rays: LightRays
    unknowns: np.ndarray
    landing: np.ndarray
    weights: np.ndarray
    image: tuple[np.ndarray, np.ndarray, np.ndarray]
    misfit: float
    curvature: tuple[weakref.ref[Stamp], np.ndarray] | None = None

    def holds(self, stamp: Stamp, unknowns: np.ndarray, landing: np.ndarray, weights: np.ndarray) -> bool:
        """Return whether the derivatives are those of light that lands elsewhere, too, but for a few per cent."""
        if self.rays is not stamp.rays or len(unknowns) != len(self.unknowns) or len(landing) != len(self.landing):
            return False
        if not np.array_equal(self.unknowns[RATIO:], unknowns[RATIO:]):
            return False
        grid, (before, after) = stamp.grid, (self.unknowns[STRENGTH], unknowns[STRENGTH])
        moved = landing - self.landing + grid.pixel / grid.scale * (unknowns[[X, Y]] - self.unknowns[[X, Y]])
        distance = float(np.sqrt(np.abs(weights) @ (moved**2).sum(axis=1)))
        # Where residuals are large, their products with what derivatives are off by are, too.
        looser = (_COARSE if grid.coarse else 1.0) / max(self.misfit, 1.0)
        return bool(
            distance <= looser * (_STILL_SHARP if grid.sharp else _STILL) * grid.pixel
            and (abs(after - before) <= looser * _SAME * before or grid.unblurred(max(before, after)))
            and np.abs(weights - self.weights).sum() <= looser * _SAME
        )


@dataclass(frozen=True)
class _Point:
    """The last linear model of a stamp, whose grid has it, and its unknowns: checks of a solution follow each other."""

    stamp: weakref.ref[Stamp]
    unknowns: np.ndarray
    wave: np.ndarray
    linearized: Linearized

    def is_of(self, stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray) -> bool:
        """Return whether it is that of a stamp at unknowns."""
        same = np.array_equal(self.unknowns, unknowns) and np.array_equal(self.wave, wave)
        return self.stamp() is stamp and same


def _derivatives(stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """Return image, derivatives and scales; None where light has no direction or misses the telescope."""
    last, landing = stamp.grid.last, stamp.rays.landing(wave)
    if not np.isfinite(landing).all():
        return None
    weights = stamp.rays.weights(wave)
    if isinstance(last, _Derivatives) and last.holds(stamp, unknowns, landing, weights):
        image = stamp.grid.image(unknowns, _landed(stamp, wave, landing, None))
        return image, last.image[1], stamp.grid.scales(unknowns, len(last.image[2]))
    response = stamp.rays.response(wave)
    light = _landed(stamp, wave, landing, response)
    derivatives = stamp.grid.derivatives(unknowns, light, response, stamp.rays.rates)
    misfit = float((pulls(stamp, derivatives[0])[stamp.used] ** 2).mean()) if stamp.used.any() else 0.0
    stamp.grid.last = _Derivatives(stamp.rays, unknowns.copy(), landing, weights, derivatives, misfit)
    return derivatives


def linearized(stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray) -> Linearized | None:
    """Return the linear model of a stamp about unknowns; None where light has no direction or misses the telescope."""
    last = stamp.grid.point
    if isinstance(last, _Point) and last.is_of(stamp, unknowns, wave):
        return last.linearized
    derivatives = _derivatives(stamp, unknowns, wave)
    if derivatives is None:
        return None
    model, columns, scales = derivatives
    variance = pixel_variance(stamp, model)
    residual = (stamp.image - model)[stamp.used]
    scaled = _over_noise(columns, variance, stamp.used)
    brightness = unknowns[FLUX] * columns[..., FLUX].astype(np.float64)
    over_noise = _over_noise((stamp.image - model).astype(np.float32)[..., None], variance, stamp.used)[:, 0]
    point = Linearized(model, variance, brightness, stamp.used, residual, over_noise, scaled, scales)
    stamp.grid.point = _Point(weakref.ref(stamp), unknowns.copy(), wave.copy(), point)
    return point


def light_columns(
    stamp: Stamp, unknowns: np.ndarray, point: Linearized, light: LandedLight, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives by changes of the light, over the noise, and their scales.

    Parameters
    ----------
    stamp : Stamp
        Pixels and model.
    unknowns : ndarray
        Unknowns of the star.
    point : Linearized
        Linear model there.
    light : LandedLight
        Light that comes and goes.
    rates : ndarray, shape [n, k]
        Its fractions by each change; all other light has as much less in proportion.

    Returns
    -------
    columns, scales : ndarray, shapes [n_pixel, k], [k]
        As those of `point`.
    """
    response = np.zeros((2, len(rates), 0), dtype=np.float32)
    columns, scales = stamp.grid.derivatives(unknowns, light, response, rates)[1:]
    count = rates.shape[1]
    gained = point.over_noise(columns[..., columns.shape[-1] - count :])
    return gained - np.outer(point.columns[:, FLUX], rates.sum(axis=0).astype(np.float32)), scales[-count:]


def wavefront_columns(
    stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray, point: Linearized, rays: LightRays
) -> np.ndarray:
    """Return derivatives by the unknowns that rays respond to, over the noise [per unknown], shape [n_pixel, n_wave].

    They are those at the unknowns of a stamp, with the noise of its linear model there.
    """
    landing, response = rays.landing(wave), rays.response(wave)
    light = _landed(replace(stamp, rays=rays), wave, landing, response)
    columns, scales = stamp.grid.derivatives(unknowns, light, response, rays.rates[:, :0])[1:]
    first = len(unknowns)
    return point.over_noise(columns[..., first:]) * scales[first:].astype(np.float32)


def normal_equations(stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray) -> NormalEquations:
    """Return the normal equations of one star; unknowns are those of the star, then of its wavefront."""
    derivatives = _derivatives(stamp, unknowns, wave)
    if derivatives is None:
        n = len(unknowns) + len(wave)
        return NormalEquations(np.zeros((n, n)), np.zeros(n), np.inf, np.inf)
    model, columns, scales = derivatives
    variance, last = pixel_variance(stamp, model), stamp.grid.last
    assert isinstance(last, _Derivatives)
    pixels = columns.reshape(-1, columns.shape[-1])
    if last.curvature is None or last.curvature[0]() is not stamp:
        root = np.where(stamp.used, 1.0 / np.sqrt(variance), 0.0).astype(np.float32)
        scaled = pixels * root.reshape(-1, 1)
        last.curvature = weakref.ref(stamp), scaled.T @ scaled
    residual = stamp.image - model
    slopes = np.where(stamp.used, residual / variance, 0.0).astype(np.float32)
    gradient = pixels.T @ slopes.ravel() * scales
    residual, variance = residual[stamp.used], variance[stamp.used]
    chi2 = float(residual @ (residual / variance))
    return NormalEquations(last.curvature[1] * np.outer(scales, scales), gradient, _loss(residual, variance), chi2)


def model_image(stamp: Stamp, unknowns: np.ndarray, wave: np.ndarray) -> np.ndarray:
    """Return the model of a stamp [electrons], shape [ny, nx]; NaN where light does not reach the detector."""
    landing = stamp.rays.landing(wave)
    # A wavefront may be so steep that light does not get there.
    if not np.isfinite(landing).all():
        return np.full(stamp.image.shape, np.nan)
    return stamp.grid.image(unknowns, _landed(stamp, wave, landing, None))


def _landed(stamp: Stamp, wave: np.ndarray, landing: np.ndarray, response: np.ndarray | None) -> LandedLight:
    """Return the light on the detector, with the response of its rims where there is one."""
    rim_light = stamp.grid.rim_light
    at_rims = None if rim_light is None else stamp.rays.at_rims(rim_light.rims, landing, response)
    return LandedLight(landing, stamp.rays.weights(wave), stamp.rays.spread(landing), at_rims)


def pulls(stamp: Stamp, model: np.ndarray) -> np.ndarray:
    """Return residuals over their standard deviations, shape [ny, nx]."""
    return np.asarray((stamp.image - model) / np.sqrt(pixel_variance(stamp, model)))


def pixel_variance(stamp: Stamp, model: np.ndarray) -> np.ndarray:
    """Return the variance of the pixels of a model [electron^2], shape [ny, nx]."""
    return np.maximum(model + stamp.variance, np.maximum(_LEAST_VARIANCE, 0.1 * stamp.variance))


def _loss(residual: np.ndarray, variance: np.ndarray) -> float:
    """Return twice the sum of v - c + c ln(c / v) with counts c = v + residual; c < 0 by its expansion at c = v."""
    ratio = residual / variance
    safe = np.maximum(ratio, -0.9)
    deviance = variance * ((1.0 + safe) * np.log1p(safe) - safe)
    # Beyond, on by a parabola with the same value and slope: Poisson counts plus sky come to it through noise alone.
    beyond = ratio - safe
    deviance += variance * (np.log1p(safe) * beyond + 0.5 / (1.0 + safe) * beyond**2)
    return float(2.0 * deviance.sum())
