"""Square cutouts of an image around positions."""

from __future__ import annotations

import numpy as np


def cut_out(image: np.ndarray, x: np.ndarray, y: np.ndarray, size: int, outside: float) -> np.ndarray:
    """Return the `size` x `size` pixels around each position, [n, size, size], filled with `outside` beyond the image.

    The middle of a cutout, ``(size - 1)/2``, is within half a pixel of the position along x and y.
    """
    rows, columns = (start[:, None] + np.arange(size) for start in (first_pixel(y, size), first_pixel(x, size)))
    ny, nx = image.shape
    within = ((rows >= 0) & (rows < ny))[:, :, None] & ((columns >= 0) & (columns < nx))[:, None, :]
    extended = image[np.clip(rows, 0, ny - 1)[:, :, None], np.clip(columns, 0, nx - 1)[:, None, :]]
    return np.where(within, extended, outside)


def first_pixel(at: np.ndarray, size: int) -> np.ndarray:
    """Return the first pixel of cutouts of a size around positions along one axis, [n] int."""
    return np.floor(at - 0.5 * (size - 1) + 0.5).astype(np.int64)
