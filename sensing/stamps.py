"""Pixels of stamps: smoothing, cosmic rays on donuts, and the search for donuts by their template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter, median_filter, minimum_filter
from scipy.signal import fftconvolve

from ..core.statistics import RMS_PER_MAD

#: A pixel this many standard deviations above its neighbours is no part of a donut, if it is as much brighter, too.
_SIGMA = 8.0
#: Least excess of such a pixel over the light of its neighbours.
_CONTRAST = 1.0
#: Rms of the Gaussian before sampling, in new pixels.
_SMOOTHING = 1.0
#: Least part of its weight on used pixels.
_MOSTLY_USED = 0.9
#: Least part of the squared template that must lie on the stamp.
_ON_STAMP = 0.1
#: Least variance of a pixel [electron^2] in the search for donuts: pixels without any noise are not real.
_LEAST_VARIANCE = 1.0


@dataclass(frozen=True)
class Pixels:
    """Pixels of one stamp.

    Attributes
    ----------
    image : ndarray, shape [ny, nx]
        Electrons; zero where not used.
    variance : ndarray, shape [ny, nx]
        Variance of sky and readout [electron^2].
    used : ndarray of bool, shape [ny, nx]
        Pixels that count.
    side : int
        Distance between pixels, in those of the detector.
    width : int
        Side of the squares that they are integrals over, in pixels of the detector.
    blur : float
        Rms of the Gaussian that they were smoothed with, in pixels of the detector.
    offset : tuple of float
        Place (x, y) of the centre of the detector's stamp from that of this one, in its own pixels.
    """

    image: np.ndarray
    variance: np.ndarray
    used: np.ndarray
    side: int = 1
    width: int = 1
    blur: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)

    def smoothed(self, side: int) -> Pixels:
        """Return the image smoothed by a Gaussian and sampled at every so many pixels, for a quick first fit.

        Values are those of squares of the new side. So is the variance: the noise of the new pixels is smaller and
        correlated, and sums of the squares of smooth signals over the variance come out the same.
        """
        if side == 1:
            return self
        blur = _SMOOTHING * side
        count = [(n - 1) // side + 1 for n in self.image.shape]
        first = [(n - 1 - (m - 1) * side) // 2 for n, m in zip(self.image.shape, count, strict=True)]
        rows, columns = (slice(a, a + (m - 1) * side + 1, side) for a, m in zip(first, count, strict=True))

        def sampled(values: np.ndarray) -> np.ndarray:
            along_y = gaussian_filter1d(np.where(self.used, values, 0.0), blur, axis=0, mode="constant")[rows]
            return np.asarray(gaussian_filter1d(along_y, blur, axis=1, mode="constant")[:, columns])

        weight = sampled(np.ones_like(self.image))
        scale = side**2 / np.maximum(weight, 1e-12)
        lost = [
            (0.5 * (n - 1) - a) / side - 0.5 * (m - 1) for n, a, m in zip(self.image.shape, first, count, strict=True)
        ]
        # Near the edges of the stamp and of masked regions values are those of places farther in.
        used = weight > _MOSTLY_USED
        offset = (lost[1], lost[0])
        even = bool((self.variance == self.variance[0, 0]).all())
        variance = self.variance[0, 0] * weight if even else sampled(self.variance)
        return Pixels(scale * sampled(self.image), scale * variance, used, side, 1, blur, offset)

    def binned(self, side: int) -> Pixels:
        """Return sums over squares of so many pixels; a square with an unused pixel is unused."""
        if side == 1:
            return self
        ny, nx = (n // side for n in self.image.shape)
        image, variance, unused = (
            v[: ny * side, : nx * side].reshape(ny, side, nx, side).sum(axis=(1, 3))
            for v in (self.image, self.variance, (~self.used).astype(np.int64))
        )
        # Pixels that are left over at the end move the centre.
        offset = tuple(0.5 * (n % side) / side for n in self.image.shape[::-1])
        return Pixels(image, variance, unused == 0, side, side, 0.0, (offset[0], offset[1]))


def without_cosmic_rays(pixels: Pixels) -> Pixels:
    """Return the pixels of a donut without those far above all of their neighbourhood."""
    # A median is no less than the least value: where nothing stands out beyond that, there is no cosmic ray.
    least = np.maximum(maximum_filter(minimum_filter(pixels.image, 5, mode="nearest"), 5), 0.0)
    if not (pixels.image > (1.0 + _CONTRAST) * least + _SIGMA * np.sqrt(least + pixels.variance)).any():
        return pixels
    middle = median_filter(pixels.image, 5, mode="nearest")
    # A donut is as bright nearby as here; a median over its edge is fainter.
    level = np.maximum(maximum_filter(middle, 5), 0.0)
    noise = np.sqrt(level + pixels.variance)
    high = pixels.image > (1.0 + _CONTRAST) * level + _SIGMA * noise
    used = pixels.used & ~maximum_filter(high, 3)
    return Pixels(np.where(used, pixels.image, 0.0), pixels.variance, used)


@dataclass(frozen=True)
class Match:
    """Place where a template fits best: offset (x, y) [pixels], flux [electrons] and signal over noise."""

    x: float
    y: float
    flux: float
    significance: float


def match_template(image: np.ndarray, used: np.ndarray, variance: np.ndarray, template: np.ndarray) -> Match:
    """Return the whole-pixel place of a template of unit flux on an image, and its flux by least squares."""
    mirrored = template[::-1, ::-1]
    overlap = fftconvolve(used.astype(np.float64), mirrored**2)
    product = fftconvolve(np.where(used, image, 0.0), mirrored)
    enough = overlap > _ON_STAMP * float((template**2).sum())
    if not enough.any():
        return Match(0.0, 0.0, 0.0, 0.0)
    score = np.where(enough, product / np.sqrt(np.where(enough, overlap, 1.0)), -np.inf)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    flux = float(product[row, column] / overlap[row, column])
    # Of the sky and of the star's own light, by the pixels of the template; an image without either has none.
    photons = max(flux, 0.0) * float((template**2).sum() / template.sum())
    noise = np.sqrt(max(float(np.mean(variance)) + photons, 1e-30))
    ny, nx = image.shape
    return Match(float(column - nx + 1), float(row - ny + 1), flux, float(score[row, column] / noise))


def measured_variance(pixels: Pixels) -> float:
    """Return the variance of a pixel [electron^2] by differences of neighbours, in which smooth light cancels.

    Their median is that of the sky where a donut covers less than half of the stamp.
    """
    steps = np.abs(np.diff(pixels.image, axis=1))[pixels.used[:, 1:] & pixels.used[:, :-1]]
    return float((RMS_PER_MAD * np.median(steps)) ** 2 / 2.0) if steps.size else 0.0


def significance_above_sky(
    image: np.ndarray, used: np.ndarray, variance: np.ndarray, template: np.ndarray, measured: float
) -> float:
    """Return the signal over noise of a template where it stands out most from a uniform background of any level.

    Least squares of template and background at every whole-pixel place; :func:`match_template` takes sky that was
    left in for light of the star. The variance of a pixel is that claimed, or the measured one where that is larger.
    """
    mirrored, count = template[::-1, ::-1], int(used.sum())
    if not count:
        return 0.0
    pixels = np.where(used, image - image[used].mean(), 0.0)
    squared, area = (fftconvolve(used.astype(np.float64), mirrored**power) for power in (2, 1))
    contrast = squared - area**2 / count
    enough = np.minimum(squared, contrast) > _ON_STAMP * float((template**2).sum())
    product = np.where(enough, fftconvolve(pixels, mirrored), 0.0)
    contrast = np.where(enough, contrast, 1.0)
    score = product / np.sqrt(contrast)
    best = int(np.argmax(score))
    flux = max(float(product.ravel()[best] / contrast.ravel()[best]), 0.0)
    photons = flux * float((template**2).sum() / template.sum())
    claimed = float(np.mean(variance)) + photons
    return float(score.ravel()[best] / np.sqrt(max(claimed, measured, _LEAST_VARIANCE)))
