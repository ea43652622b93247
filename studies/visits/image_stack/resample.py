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

#: Pixels between nodes of the mapping: the first that leaves less than the tolerance [pixel] halfway between them. For
#: the LSST, whose scale changes by 1e-7 of itself from pixel to pixel, that is 64, and leaves 1e-4.
_STEPS = (64, 32, 16, 8)
_TOLERANCE = 1e-3


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
    overlap = _overlap(tile, frame, window, wcs)
    if overlap is None:
        return
    step, nodes = _mapping_nodes(tile, frame, overlap, window, wcs)
    inputs = [
        warp_array(exposed.image, wp.float32),
        warp_array(exposed.variance, wp.float32),
        warp_array(exposed.mask, wp.int16),
        warp_array(nodes),
        step,
        overlap.x,
        overlap.y,
        overlap.width,
        warp_array(sums.data, wp.float32),
        warp_array(sums.variance, wp.float32),
        warp_array(sums.count, wp.int16),
    ]
    launch(add_rows, overlap.height, inputs, threads=threads)


def _overlap(tile: Tile, frame: StackFrame, window: Window, wcs: SkyPixels) -> Window | None:
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


def _mapping_nodes(
    tile: Tile, frame: StackFrame, part: Window, window: Window, wcs: SkyPixels
) -> tuple[int, np.ndarray]:
    """Return the pixels between nodes of a part of a tile, and x, y in the window and area of a pixel at them."""
    to_sky = np.linalg.inv(frame.matrix)
    inside = Window(0, 0, window.width, window.height)
    for step in _STEPS:
        # Nodes and, between them, places where the mapping is checked.
        counts = [2 * -(-n // step) + 1 for n in (part.width, part.height)]
        x, y = (0.5 * step * np.arange(n) + start for n, start in zip(counts, (part.x, part.y), strict=True))
        pixels = wcs.to_pixel((np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + tile.first) @ to_sky.T)
        area = np.abs(np.linalg.det(wcs.jacobians(pixels) @ to_sky))
        found = np.column_stack([pixels - (window.x, window.y), area]).reshape(len(y), len(x), 3)
        nodes, between = found[::2, ::2].copy(), found[1::2, 1::2, :2]
        linear = 0.25 * (nodes[:-1, :-1] + nodes[:-1, 1:] + nodes[1:, :-1] + nodes[1:, 1:])[..., :2]
        # Polynomials hold on the CCD only.
        on_ccd = inside.contains(between.reshape(-1, 2)).reshape(between.shape[:2])
        if not on_ccd.any() or np.abs(linear - between)[on_ccd].max() < _TOLERANCE:
            break
    return step, nodes
