"""Variance of the pixels of an image: of its own plane, of a map of weights, or measured on the image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import sep
from scipy import ndimage

from ...core.errors import ProductError
from ...core.noise_planes import NoiseKind
from ...core.quantization import dithered
from ...core.statistics import RMS_PER_MAD

#: Side of the cells in which sky and noise are measured [pixel], as of the detection.
_CELL = 64
#: Blur of an image in which objects are told from the sky, rms [pixel].
_OBJECT_BLUR = 1.5
#: Level of objects there [rms of a pixel of the sky]: four standard deviations of the blurred noise.
_OBJECT_LEVEL = 0.75
#: Pixels around them that count as theirs.
_OBJECT_MARGIN = 4
#: Largest part of an image that they may hide.
_MOST_OBJECTS = 0.7
#: Standard deviations above the sky from which on light shows in the variance whether it holds photon noise.
_BRIGHT = 10.0
#: Fewest such pixels.
_FEWEST_BRIGHT = 200
#: Part of the photon noise from which on the variance counts as that of the light as well.
_WITH_PHOTONS = 0.5
#: Scatter of the slope, over the slope, below which the variance follows the light.
_STEADY = 0.5
#: Variances so many times that of half of the pixels stand for no weight, as 1e30 of SExtractor does: no light of a
#: pixel has so much noise.
_MOST_NOISE = 1e8
#: Blur of faint light of which the photon noise is taken, rms [pixel]: that of single pixels would follow their noise,
#: and bright ones count too little.
_BLUR = 1.0
#: Weights whose noise is further than this factor from that of the image are relative ones, as SExtractor takes them.
_RELATIVE = 2.0


class BlankImageError(ProductError):
    """No pixel of an image is good, or none has noise: that of a CCD which is out of order."""


@dataclass(frozen=True, eq=False)
class Sky:
    """Sky of an image: level [ny, nx] and rms noise [ny, nx] of pixels without objects."""

    level: np.ndarray
    rms: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, bad: np.ndarray, path: Path) -> Sky:
        """Measure the sky in cells; BlankImageError where no noise is left."""
        pixels = dithered(np.where(bad, 0.0, image), bad)
        data = np.ascontiguousarray(pixels.values, dtype=np.float64)
        background = sep.Background(data, mask=bad, bw=_CELL, bh=_CELL)
        # Again without objects, whose wings are noise to the first one.
        blurred = ndimage.gaussian_filter(np.where(bad, 0.0, data - background.back()), _OBJECT_BLUR)
        objects = ndimage.binary_dilation(blurred > _OBJECT_LEVEL * background.rms(), iterations=_OBJECT_MARGIN)
        if (objects | bad).mean() < _MOST_OBJECTS:
            background = sep.Background(data, mask=objects | bad, bw=_CELL, bh=_CELL)
        rms = pixels.noise(background.rms())
        if not (np.isfinite(rms).all() and (rms > 0.0).all()):
            raise BlankImageError("its pixels have no noise: expected an image with a sky, or its variance", file=path)
        return cls(background.back(), rms)


class PhotonSlope(NamedTuple):
    """Slope of the variance of bright pixels against their light, and its scatter from pixel to pixel."""

    value: float
    scatter: float

    @property
    def gain(self) -> float | None:
        """Gain of a variance that follows the light; None of one that does not."""
        return 1.0 / self.value if self.scatter < _STEADY * self.value else None

    def lacks_photons(self, gain: float) -> bool:
        """Whether the variance is that of the sky alone."""
        return self.value * gain < _WITH_PHOTONS


@dataclass(frozen=True, eq=False)
class PixelVariance:
    """Variance [ny, nx] in the square of the unit of the image, where it came from, and pixels that have none."""

    values: np.ndarray
    source: str
    without: np.ndarray


def variance_of_plane(plane: np.ndarray, kind: NoiseKind, name: str) -> PixelVariance:
    """Return the variance of a plane of weights, variances or rms; pixels of next to no weight have none."""
    values = plane.astype(np.float64)
    good = np.isfinite(values) & (values > 0.0)
    values = np.where(good, values, 1.0)
    if kind is NoiseKind.WEIGHT:
        values = 1.0 / values
    elif kind is NoiseKind.RMS:
        values = values**2
    if good.any():
        good &= values <= _MOST_NOISE * float(np.median(values[good]))
        values = np.where(good, values, 1.0)
    return PixelVariance(values, f"{name} ({kind.value})", ~good)


def scaled_to_sky(variance: PixelVariance, sky: Sky, bad: np.ndarray) -> PixelVariance:
    """Return a variance by weights on the scale of the noise of the image, where they are on another scale."""
    good = ~(bad | variance.without)
    factor = float(np.median(sky.rms[good] ** 2 / variance.values[good]))
    if 1.0 / _RELATIVE <= factor <= _RELATIVE:
        return variance
    source = f"{variance.source}, scaled to the noise of the sky by {factor:.4g}"
    return PixelVariance(variance.values * factor, source, variance.without)


def photon_slope(variance: PixelVariance, light: np.ndarray, bad: np.ndarray, rms: np.ndarray) -> PhotonSlope | None:
    """Return d(variance)/d(light) of bright pixels, the inverse gain of a variance with photon noise; None of few."""
    good = ~(bad | variance.without)
    bright = good & (light > _BRIGHT * rms)
    if bright.sum() < _FEWEST_BRIGHT:
        return None
    slopes = (variance.values[bright] - np.median(variance.values[good & ~bright])) / light[bright]
    slope = float(np.median(slopes))
    return PhotonSlope(slope, RMS_PER_MAD * float(np.median(np.abs(slopes - slope))))


def with_photons(variance: PixelVariance, light: np.ndarray, gain: float) -> PixelVariance:
    """Return a variance of the sky with the photon noise of the light [unit of the image] added."""
    rms = np.sqrt(variance.values)
    smooth = np.where(light > _BRIGHT * rms, light, ndimage.gaussian_filter(light, _BLUR))
    photons = np.maximum(smooth, 0.0) / gain
    return PixelVariance(variance.values + photons, f"{variance.source} and photons", variance.without)


def measured_variance(sky: Sky) -> PixelVariance:
    """Return the variance of the sky that an image itself shows."""
    return PixelVariance(sky.rms**2, "noise of the sky", np.zeros(sky.rms.shape, dtype=bool))
