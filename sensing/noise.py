"""Noise of the pixels of a donut, measured from its own image: variance of the sky, and of light over its amount.

Differences across squares of two by two pixels have no plane in them, and little of smooth light: their variance is
that of the noise of a pixel. Against the brightness of the star it is a straight line, whose value without a star is
the variance of sky and readout and whose slope is the unit of the image in electrons: 1 for counted electrons, the
inverse of the gain for counts. Noise that is correlated from pixel to pixel, as that of resampled images is, has less
of such differences; how much less, the pixels beside the star tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ..core.statistics import RMS_PER_MAD

#: Least and largest variance of light over its amount [units of the image as it came].
_PHOTON_LIMITS = (0.1, 1e4)
#: The same over the whole variance of the brightest pixels over their light, for images in units far from electrons.
_PHOTON_PARTS = (0.1, 2.0)
#: Groups of pixels of like brightness, of a thousand squares at most in the first.
_GROUPS = 12
#: Least number of squares in a group.
_FEWEST = 30
#: Rms of the Gaussian that smooths an image to its local brightness [pixels].
_SMOOTHING = 2.0
#: The same of what is no noise beside a star [pixels].
_SMOOTH = 6.0
#: Deviations beyond which differences are no noise.
_OUTLYING = 4.0
#: Fraction of the differences that are no outliers, whatever their distribution.
_COMMON = 0.98
#: Ratio of the variance of pixels beside the star to that by differences, from which on noise is correlated.
_CORRELATED = 1.2
#: Variance over the largest one below which a group weighs no more: single electrons have no normal distribution.
_FAINTEST = 1e-2
#: Level over its own noise from which on it is that of a sky, of more than ten electrons.
_SKY_LEFT_IN = 3.0
#: Faintest fraction of the pixels: they lie beside the star.
_BESIDE = 0.25


@dataclass(frozen=True)
class PixelNoise:
    """Noise of the pixels of an image.

    Attributes
    ----------
    sky : float
        Variance of a pixel without light of the star [squared units of the image].
    photon : float
        Variance of the light of the star over its amount [units of the image].
    """

    sky: float
    photon: float

    def variance(self, light: float) -> float:
        """Return the variance of a pixel of so much light of the star [squared units of the image]."""
        return self.sky + self.photon * light


@dataclass(frozen=True)
class AssumedElectron:
    """What is taken for an electron in an image whose noise is not known.

    Attributes
    ----------
    size : float
        Its light [units of the image].
    sky_level : float
        Light of the sky that was taken off [of these electrons].
    """

    size: float
    sky_level: float


def measured_noise(
    residual: np.ndarray,
    brightness: np.ndarray,
    used: np.ndarray,
    sky_level: float,
    *,
    correlated: bool = False,
    unit: float = 1.0,
) -> PixelNoise:
    """Return the noise of the pixels of an image, of electrons or any other unit.

    Parameters
    ----------
    residual : ndarray, shape [ny, nx]
        The image, or what a fit of the star and its background leaves of it; finite where it is used.
    brightness : ndarray, shape [ny, nx]
        Light of the star.
    used : ndarray of bool, shape [ny, nx]
        Pixels that count.
    sky_level : float
        Light of the sky that is left in the image, if it is above zero.
    correlated : bool
        Whether noise may be correlated from pixel to pixel, which only the residuals of a fit tell from light.
    unit : float
        Unit of all arguments and of the noise over that of the image as it came.
    """
    differences, light = _differences(residual, used), _means(brightness)
    counted = np.isfinite(differences)
    differences, light = differences[counted], light[counted]
    if differences.size < 2 * _FEWEST:
        return PixelNoise(0.0, 1.0)
    order = np.argsort(light, kind="stable")
    size = max(differences.size // _GROUPS, _FEWEST)
    groups = [order[first : first + size] for first in range(0, differences.size - size + 1, size)]
    level = np.array([light[group].mean() for group in groups])
    variance = np.array([_variance(differences[group]) for group in groups])
    if not variance.max() > 0.0:
        return PixelNoise(0.0, 1.0)
    faint = slice(max(len(groups) // 4, 1))
    sky, slope = variance[faint].mean(), 1.0
    growth = _correlation(residual, used, brightness, float(variance[0])) if correlated else 1.0
    # Weights by the variance of a smooth line, since that of a group has an error itself.
    for _ in range(3):
        weight = 1.0 / np.maximum(sky + slope * np.maximum(level, 0.0), _FAINTEST * variance.max()) ** 2
        sky, slope = _line(np.maximum(level, 0.0), variance, weight)
    # Light of a sky that is left in has noise too, and no more than all that of the sky.
    of_sky = float(variance[faint].mean())
    if sky_level > _SKY_LEFT_IN * np.sqrt(of_sky):
        slope = min(slope, of_sky / sky_level)
        sky = max(float((variance - slope * level)[faint].mean()), 0.0)
    least, largest = _PHOTON_LIMITS
    if level[-1] > 0.0 and variance[-1] > 0.0:
        ratio = growth * unit * variance[-1] / level[-1]
        least, largest = min(least, _PHOTON_PARTS[0] * ratio), max(largest, _PHOTON_PARTS[1] * ratio)
    slope = float(np.clip(growth * slope * unit, least, largest)) / unit
    return PixelNoise(growth * sky, slope)


def smoothed(image: np.ndarray, used: np.ndarray, rms: float = _SMOOTHING) -> np.ndarray:
    """Return an image that is smoothed over its used pixels by a Gaussian of that rms [pixels]."""
    weight = gaussian_filter(used.astype(np.float64), rms)
    return np.asarray(gaussian_filter(np.where(used, image, 0.0), rms) / np.maximum(weight, 1e-12))


def faint_level(smooth: np.ndarray, used: np.ndarray) -> float:
    """Return the level of a smoothed image beside its star."""
    return float(np.quantile(smooth[used], _BESIDE)) if used.any() else 0.0


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return value at zero and slope of a straight line, both from zero."""
    mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
    spread = float(np.average((x - mean_x) ** 2, weights=weight))
    slope = float(np.average((x - mean_x) * (y - mean_y), weights=weight)) / spread if spread > 0.0 else 1.0
    constant = mean_y - slope * mean_x
    if constant < 0.0:
        return 0.0, float(np.average(x * y, weights=weight) / max(np.average(x * x, weights=weight), 1e-300))
    return float(constant), max(slope, 0.0)


def _differences(image: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return differences across squares of two by two pixels, of the variance of one; NaN without all four."""
    values = np.where(used, image, np.nan)
    return np.asarray(0.5 * (values[:-1, :-1] - values[1:, :-1] - values[:-1, 1:] + values[1:, 1:]))


def _means(image: np.ndarray) -> np.ndarray:
    """Return means over squares of two by two pixels."""
    return np.asarray(0.25 * (image[:-1, :-1] + image[1:, :-1] + image[:-1, 1:] + image[1:, 1:]))


def _variance(values: np.ndarray) -> float:
    """Return the variance of differences; those far from zero count as if they were less far."""
    sizes = np.abs(values)
    # Where there is hardly any light most differences are of nothing, and their median is zero.
    most = max(_OUTLYING * RMS_PER_MAD * float(np.median(sizes)), float(np.quantile(sizes, _COMMON)))
    return float(np.mean(np.minimum(sizes, most) ** 2))


def _correlation(residual: np.ndarray, used: np.ndarray, brightness: np.ndarray, by_differences: float) -> float:
    """Return the variance of pixels beside the star over that by differences: 1 where it is much the same."""
    # Wings and gradients that a fit leaves are smooth.
    pixels = (residual - smoothed(residual, used, _SMOOTH))[used]
    beside = pixels[brightness[used] <= np.quantile(brightness[used], _BESIDE)]
    variance = (RMS_PER_MAD * float(np.median(np.abs(beside - np.median(beside))))) ** 2
    ratio = variance / by_differences if by_differences > 0.0 else 1.0
    return ratio if ratio > _CORRELATED else 1.0
