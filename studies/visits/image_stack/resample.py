"""Bicubic resampling of images of CCDs onto tiles, by the kernel that resamples the PSFs of visits."""

from __future__ import annotations

import numpy as np
import warp as wp

from ....core.launch import launch
from ....core.warp_arrays import warp_array
from ....imaging.draw import SkyPixels, Window
from ....imaging.exposure import ExposedImage
from ..psf_visit import StackFrame
from .resample_kernels import add_rows
from .tiles import Tile, TileSums

#: Pixels between nodes of the mapping. It is linear between them to 1e-4 pixel, as the scale of the LSST changes by
#: 1e-7 of itself from pixel to pixel.
_STEP = 64


def add_resampled(
    sums: TileSums,
    tile: Tile,
    frame: StackFrame,
    exposed: ExposedImage,
    window: Window,
    wcs: SkyPixels,
    *,
    threads: int | None = None,
) -> None:
    """Add an image to the sums of a tile, resampled by cubic convolution (Keys 1981, a = -1/2), flux conserved.

    Parameters
    ----------
    sums : TileSums
        Sums, changed in place.
    tile : Tile
        Tile.
    frame : StackFrame
        Common frame.
    exposed : ExposedImage
        Image of the window; masked pixels spoil those of the tile that they contribute to.
    window : Window
        Part of the CCD.
    wcs : SkyPixels
        World coordinates of the CCD.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    """
    part = _touched(tile, frame, window, wcs)
    if part is None:
        return
    nodes = _nodes(tile, frame, part, window, wcs)
    inputs = [
        warp_array(exposed.image, wp.float32),
        warp_array(exposed.variance, wp.float32),
        warp_array(exposed.mask, wp.int16),
        warp_array(nodes),
        _STEP,
        part.x,
        part.y,
        part.width,
        warp_array(sums.data, wp.float32),
        warp_array(sums.variance, wp.float32),
        warp_array(sums.count, wp.int16),
    ]
    launch(add_rows, part.height, inputs, threads=threads)


def _touched(tile: Tile, frame: StackFrame, window: Window, wcs: SkyPixels) -> Window | None:
    """Return the rectangle of pixels of a tile that a window of a CCD touches; None if there is none."""
    # The edges of the window are straight on the sky to a fraction of a pixel, and its rim of two pixels is not used.
    x, y = (start + np.linspace(-0.5, n - 0.5, 9) for start, n in ((window.x, window.width), (window.y, window.height)))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    places = wcs.to_sky(grid) @ frame.matrix.T - tile.first
    low = np.maximum(np.floor(places.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(places.max(axis=0)).astype(int) + 1, tile.side)
    if (low >= high).any():
        return None
    return Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def _nodes(tile: Tile, frame: StackFrame, part: Window, window: Window, wcs: SkyPixels) -> np.ndarray:
    """Return x, y in the window, and area of a pixel of the tile, at nodes of a part of it, [ny, nx, 3]."""
    x, y = (_STEP * np.arange(-(-n // _STEP) + 1) + start for n, start in ((part.width, part.x), (part.height, part.y)))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + tile.first
    to_sky = np.linalg.inv(frame.matrix)
    pixels = wcs.to_pixel(places @ to_sky.T)
    area = np.abs(np.linalg.det(wcs.jacobians(pixels) @ to_sky))
    found = np.column_stack([pixels - (window.x, window.y), area])
    return found.reshape(len(y), len(x), 3)
