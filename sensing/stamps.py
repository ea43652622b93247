"""Pixels of stamps: smoothing, sums, and the search for donuts by their template."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtri

#: Rms of the Gaussian before sampling, in new pixels.
_SMOOTHING = 1.0
#: Weight of the Gaussian on used pixels from which on their mean is a value of its centre.
_MOSTLY_USED = 0.9
#: The same where the used pixels lie all around the centre, as between scattered bad ones.
_HALF_USED = 0.5
#: Distance of the mean of such pixels from the centre [new pixels]: at straight edges it is 0.3 at a weight of 0.8.
_OFF_CENTRE = 0.1
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

    @property
    def independent(self) -> float:
        """Mean square of white noise over the variance: 1 but for smoothed pixels."""
        # Sums of squares of the weights of a Gaussian of the squares of the new side.
        return (self.side / self.blur) ** 2 / (4.0 * math.pi) if self.blur else 1.0

    def central(self, shape: tuple[int, int]) -> Pixels:
        """Return the pixels [ny, nx] about the middle, of sides that differ from those of all by even numbers."""
        rows, columns = central_slices(self.image.shape, shape)
        image, variance, used = (v[rows, columns] for v in (self.image, self.variance, self.used))
        return replace(self, image=image, variance=variance, used=used)

    def smoothed(self, side: int) -> Pixels:
        """Return the image smoothed by a Gaussian and sampled at every so many pixels, for a quick first fit.

        Values are those of squares of the new side. So is the variance: the noise of the new pixels is smaller and
        correlated, and sums of the squares of smooth signals over the variance come out the same.
        """
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
        if not self.used.all() and min(weight.shape) > 1:
            # The mean place of a Gaussian's weight goes with the gradient of that weight.
            slopes = np.gradient(weight)
            used |= (weight > _HALF_USED) & (_SMOOTHING**2 * np.hypot(*slopes) < _OFF_CENTRE * weight)
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


def central_slices(shape: tuple[int, ...], inner: tuple[int, ...]) -> tuple[slice, slice]:
    """Return rows and columns of the middle of an image, of sides that differ from its own by even numbers."""
    rows, columns = (slice((n - m) // 2, (n + m) // 2) for n, m in zip(shape, inner, strict=True))
    return rows, columns


def plane_basis(used: np.ndarray) -> np.ndarray:
    """Return orthonormal planes over the used pixels of an image, zero elsewhere, shape [3, ny, nx]."""
    ny, nx = used.shape
    y, x = np.meshgrid(np.linspace(-1.0, 1.0, ny), np.linspace(-1.0, 1.0, nx), indexing="ij")
    basis = np.zeros((3, ny, nx))
    if used.sum() >= len(basis):
        basis[:, used] = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=-1)[used])[0].T
    return basis


@dataclass(frozen=True)
class Match:
    """Place where a template fits best above a plane.

    Attributes
    ----------
    x, y : float
        Offset of the template [pixels].
    flux : float
        Its flux [electrons].
    significance : float
        Signal over noise.
    plane : ndarray, shape [3]
        Level at the middle of the image, and slopes along x and y [electrons a pixel, and per pixel].
    """

    x: float
    y: float
    flux: float
    significance: float
    plane: np.ndarray


def match_template(
    image: np.ndarray,
    used: np.ndarray,
    variance: np.ndarray,
    template: np.ndarray,
    measured: float = 0.0,
    least_on_stamp: float = _ON_STAMP,
) -> Match:
    """Return the whole-pixel place of a template of unit flux, its flux and the plane under it by least squares.

    Parameters
    ----------
    image, used, variance, template : ndarray, shape [ny, nx]
        Pixels, those that count, the variance claimed for them [electron^2], and the template in the middle.
    measured : float
        Variance of a pixel by the image itself [electron^2], which counts where it is the larger one.
    least_on_stamp : float
        Least part of the squared template on used pixels.
    """
    nothing = Match(0.0, 0.0, 0.0, 0.0, np.zeros(3))
    if not used.any():
        return nothing
    mirrored, basis = template[::-1, ::-1], plane_basis(used)
    whole = float((template**2).sum())
    pixels = np.where(used, image, 0.0)
    residual = pixels - np.tensordot(np.tensordot(basis, pixels, 2), basis, 1)
    # What of the template is no plane tells it from the background.
    (on_used,) = _convolved([used], mirrored**2)
    *on_planes, product = _convolved([*basis, residual], mirrored)
    contrast = on_used - sum(on_plane**2 for on_plane in on_planes)
    enough = contrast > least_on_stamp * whole
    if not enough.any():
        return nothing
    contrast = np.where(enough, contrast, 1.0)
    score = np.where(enough, product / np.sqrt(contrast), -np.inf)
    ny, nx = image.shape
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    flux = float(product[row, column] / contrast[row, column])
    place = (int(row) - ny + 1, int(column) - nx + 1)
    # Of the sky and of the star's own light, by the pixels of the template; an image without either has none.
    photons = max(flux, 0.0) * float((template**2).sum() / template.sum())
    noise = np.sqrt(max(float(np.mean(variance)) + photons, measured, _LEAST_VARIANCE))
    background = _plane_of(np.tensordot(basis, pixels - flux * moved(template, *place) * used, 2), basis, used)
    return Match(float(place[1]), float(place[0]), flux, float(score[row, column] / noise), background)


def _convolved(images: Sequence[np.ndarray], kernel: np.ndarray) -> np.ndarray:
    """Return the full convolutions of images by a kernel of their shape [n, ny, nx], in single precision."""
    ny, nx = (2 * n - 1 for n in kernel.shape)
    size = [fft.next_fast_len(n, real=True) for n in (ny, nx)]
    *spectra, by = fft.rfft2(np.array([*images, kernel], dtype=np.float32), s=size)
    return np.asarray(fft.irfft2(np.array(spectra) * by, s=size)[:, :ny, :nx])


def moved(image: np.ndarray, down: int, right: int) -> np.ndarray:
    """Return an image moved by whole pixels, zero where nothing comes from."""
    out = np.zeros_like(image)
    (to_y, from_y), (to_x, from_x) = (
        (slice(max(step, 0), n + min(step, 0)), slice(max(-step, 0), n - max(step, 0)))
        for step, n in zip((down, right), image.shape, strict=True)
    )
    out[to_y, to_x] = image[from_y, from_x]
    return out


def _plane_of(components: np.ndarray, basis: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return level in the middle of an image, and slopes a pixel, of a plane by components on a basis."""
    values = np.tensordot(components, basis, 1)[used]
    y, x = np.nonzero(used)
    middle_y, middle_x = (0.5 * (n - 1) for n in used.shape)
    columns = np.stack([np.ones(len(x)), x - middle_x, y - middle_y], axis=-1)
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0])


def measured_variance(pixels: Pixels, percentile: float = 50.0) -> float:
    """Return the variance of a pixel [electron^2] by differences of neighbours, in which smooth light cancels.

    Their median is that of the sky where a donut covers less than half of the stamp; a lower percentile bears more
    bright and bad pixels.
    """
    steps = np.abs(np.diff(pixels.image, axis=1))[pixels.used[:, 1:] & pixels.used[:, :-1]]
    of_normal = math.sqrt(2.0) * float(ndtri(0.5 + 0.005 * percentile))
    return float((np.percentile(steps, percentile) / of_normal) ** 2) if steps.size else 0.0
