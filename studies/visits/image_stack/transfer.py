"""Transfer function of the resampling, which broadens stars of stacked images against PSFs centred on pixels.

Cubic convolution of an image at a fraction s of a pixel multiplies its component of frequency k by
T(k) = sum over j of w_j(s) exp(2 pi i k (j - 1 - s)), w_j being the weights of the four neighbours j = 0 to 3. T is 1
where s is 0, as in the middle of the stamps of PSFs. Its mean over all s is the Fourier transform of the kernel, which
falls as 1 - O(k^4): peaks become lower, second moments stay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from ....imaging.draw import SkyPixels, Window
from ..psf_visit import StackFrame
from .tiles import Tile

#: Pixels along a side of a tile at which fractions of pixels are looked up.
_NODES = 10
#: Pixels along a side of the grid on which PSFs are broadened.
GRID = 48


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
    # Nodes of the middle of a step, so that they fall on all fractions where scales differ by little.
    line = np.floor((np.arange(_NODES) + 0.5) * tile.side / _NODES)
    to_sky = np.linalg.inv(frame.matrix)
    sky = (np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) + tile.first) @ to_sky.T
    frequency = np.stack(np.meshgrid(np.fft.rfftfreq(GRID), np.fft.fftfreq(GRID)), axis=-1).reshape(-1, 2)
    total, count = np.zeros(len(frequency), dtype=np.complex128), 0
    for wcs in images:
        pixels = wcs.to_pixel(sky)
        pixels = pixels[Window(0, 0, wcs.shape[1], wcs.shape[0]).contains(pixels)]
        if not len(pixels):
            continue
        to_frame = np.linalg.inv(wcs.jacobians(pixels[:1])[0] @ to_sky)
        along = frequency @ to_frame
        s = pixels - np.floor(pixels)
        total += (_fraction_transfer(along[:, 0], s[:, 0]) * _fraction_transfer(along[:, 1], s[:, 1])).sum(axis=0)
        count += len(pixels)
    return (total / max(count, 1)).reshape(GRID, GRID // 2 + 1).astype(np.complex64)


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
