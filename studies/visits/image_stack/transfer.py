"""Transfer function of the resampling, which broadens stars of stacked images against PSFs centred on pixels.

Cubic convolution of an image at a fraction s of a pixel multiplies its component of frequency k by
T(k) = sum over j of w_j(s) exp(2 pi i k (j - 1 - s)), w_j being the weights of the four neighbours j = 0 to 3. T is 1
where s is 0, as in the middle of the stamps of PSFs. Its mean over all s is the Fourier transform of the kernel, which
falls as 1 - O(k^4): peaks become lower, second moments stay.

The noise of resampled pixels x and x' is correlated by the sum over the pixels p of the image of K(x - p) K(x' - p),
with the kernel K of cubic convolution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import fft

from ....imaging.draw import SkyPixels, Window
from ..psf_visit import StackFrame
from .tiles import Tile

#: Pixels along a side of a tile at which fractions of pixels are looked up.
_NODES = 10
#: Pixels along a side of the grid on which PSFs are broadened.
GRID = 48
#: Farthest distance of correlated pixels of a tile along its axes: kernels of +-2 pixels, at 45 degrees to the axes.
CORRELATION_REACH = 5


def mean_transfer(tile: Tile, frame: StackFrame, images: Sequence[SkyPixels]) -> np.ndarray:
    """Return the mean transfer function over a tile and the images that it is made of.

    Parameters
    ----------
    tile : Tile
        Tile.
    frame : StackFrame
        Common frame.
    images : sequence of SkyPixels
        World coordinates of every CCD in every visit.

    Returns
    -------
    ndarray of complex64, shape [GRID, GRID // 2 + 1]
        At the frequencies of ``rfft2``.
    """
    frequency = np.stack(np.meshgrid(np.fft.rfftfreq(GRID), np.fft.fftfreq(GRID)), axis=-1).reshape(-1, 2)
    total, count = np.zeros(len(frequency), dtype=np.complex128), 0
    for pixels, to_image in _nodes_on(tile, frame, images):
        along = frequency @ np.linalg.inv(to_image)
        s = pixels - np.floor(pixels)
        total += (_fraction_transfer(along[:, 0], s[:, 0]) * _fraction_transfer(along[:, 1], s[:, 1])).sum(axis=0)
        count += len(pixels)
    return (total / max(count, 1)).reshape(GRID, GRID // 2 + 1).astype(np.complex64)


def mean_noise_correlation(tile: Tile, frame: StackFrame, images: Sequence[SkyPixels]) -> np.ndarray:
    """Return the mean correlation of the noise of pixels of a tile by their distance, [m, m] with m odd.

    Parameters
    ----------
    tile, frame, images
        As of :func:`mean_transfer`.
    """
    line = np.arange(-CORRELATION_REACH, CORRELATION_REACH + 1)
    distance = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    total = np.zeros(len(distance))
    for pixels, to_image in _nodes_on(tile, frame, images):
        neighbours = np.floor(pixels)[:, None] + np.arange(-1, 3)[:, None]  # [nodes, 4, axes]
        at_node = _keys(pixels[:, None] - neighbours)
        moved = pixels[:, None] + distance @ to_image.T  # [nodes, distances, axes]
        at_moved = _keys(moved[:, :, None] - neighbours[:, None])
        total += (at_node[:, None] * at_moved).sum(axis=2).prod(axis=2).sum(axis=0)
    covariance = total.reshape(len(line), len(line))
    covariance = covariance + covariance[::-1, ::-1]
    variance = covariance[CORRELATION_REACH, CORRELATION_REACH]
    if variance == 0.0:
        return np.ones((1, 1))
    return np.asarray(covariance / variance)


def _nodes_on(tile: Tile, frame: StackFrame, images: Sequence[SkyPixels]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the places of nodes of a tile on each image that has any [n, 2], and d(pixels)/d(pixels of the tile)."""
    # Nodes of the middle of a step, so that they fall on all fractions where scales differ by little.
    line = np.floor((np.arange(_NODES) + 0.5) * tile.side / _NODES)
    to_sky = np.linalg.inv(frame.matrix)
    sky = (np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) + tile.first) @ to_sky.T
    for wcs in images:
        pixels = wcs.to_pixel(sky)
        pixels = pixels[Window(0, 0, wcs.shape[1], wcs.shape[0]).contains(pixels)]
        if len(pixels):
            yield pixels, wcs.jacobians(pixels[:1])[0] @ to_sky


def broadened(psfs: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """Return PSFs of unit sum [n, m, m] times a transfer function of :func:`mean_transfer`, of unit sum again."""
    wide = fft.rfft2(psfs, s=(GRID, GRID), workers=1) * transfer
    side = psfs.shape[-1]
    images = fft.irfft2(wide, s=(GRID, GRID), workers=1)[:, :side, :side].astype(np.float32)
    return np.asarray(images / images.sum(axis=(1, 2), keepdims=True, dtype=np.float64).astype(np.float32))


def _fraction_transfer(frequency: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the transfer functions along one axis at fractions s of a pixel, shape [len(s), len(frequency)]."""
    t = s[:, None]
    weights = (
        -0.5 * t * (1.0 - t) ** 2,
        1.0 + t * t * (1.5 * t - 2.5),
        0.5 * t * (1.0 + t * (4.0 - 3.0 * t)),
        0.5 * t * t * (t - 1.0),
    )
    terms = (w * np.exp(2j * np.pi * frequency * (j - 1 - t)) for j, w in enumerate(weights))
    return np.asarray(sum(terms))


def _keys(s: np.ndarray) -> np.ndarray:
    """Return the kernel of cubic convolution at distances [pixel] (Keys 1981, a = -1/2)."""
    a = np.abs(s)
    inner = 1.0 + a**2 * (1.5 * a - 2.5)
    outer = 2.0 + a * (-4.0 + a * (2.5 - 0.5 * a))
    return np.where(a < 1.0, inner, np.where(a < 2.0, outer, 0.0))
