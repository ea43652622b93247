"""Pixels of star stamps without weight: which they are, and what stands in for them where every pixel is needed.

A pixel has no weight if it is not finite, if it is -1e29 or less, as the pixels are that SExtractor masks (-1e30), or
if its weight is zero. Positive weights are all alike for moments and shifts, as in GalSim's HSM.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from ..core.errors import DomainError
from ..core.units import real_array

# Values at or below this are no light: SExtractor's masked pixels are -1e30.
_MASKED = -1e29
# Standard deviation of the weights of good neighbours [pixel], about the width of a star.
_NEIGHBOURHOOD = 1.5
# Least sum of these weights: a bad pixel without any near starts as sky.
_LEAST_NEIGHBOURS = 1e-3


def bad_pixels(stamps: np.ndarray) -> np.ndarray:
    """Return the pixels that hold no light, bool, shape of the stamps.

    A pixel is bad if it is not finite, or -1e29 or less, as the pixels are that SExtractor masks (-1e30).
    """
    return ~np.isfinite(stamps) | (stamps <= _MASKED)


def weightless_pixels(images: np.ndarray, weights: Any = None) -> np.ndarray:
    """Return the pixels of images without weight, bool [n, ny, nx]: bad ones, and those of weight zero or NaN.

    Parameters
    ----------
    images : array
        [n, ny, nx].
    weights : array, optional
        Inverse variances or masks of good pixels, [n, ny, nx]; [ny, nx] of one image or the same for all.

    Raises
    ------
    DomainError
        If weights have another shape, are negative, or are zero in all pixels.
    """
    bad = bad_pixels(images)
    if weights is None:
        return bad
    numbers = weights.astype(np.float64) if isinstance(weights, np.ndarray) and weights.dtype == bool else weights
    values = real_array(numbers, f"weights: expected real numbers {list(images.shape)}")
    if values.shape not in (images.shape, images.shape[1:]):
        raise DomainError(f"weights have shape {values.shape}: expected {list(images.shape)} as the images")
    if (values < 0.0).any():
        raise DomainError(f"weights hold {np.nanmin(values):.4g}: expected zero or more, as inverse variances are")
    weightless = np.broadcast_to(~(values > 0.0), images.shape)
    if weightless.size and weightless.all():
        raise DomainError("weights are zero in every pixel: expected positive ones where the stars are")
    return bad | weightless


def fill_symmetric(images: np.ndarray, bad: np.ndarray, x: Any = 0.0, y: Any = 0.0) -> np.ndarray:
    """Fill bad pixels by those opposite a centre, or by the mean of good neighbours.

    `images` are background-subtracted [n, ny, nx]; the centres x and y are counted from those of the stamps, [n] or
    one for all [pixel]. NaN counts as zero.
    """
    filled = np.where(bad, 0.0, images)
    count, ny, nx = images.shape
    columns, rows = (np.rint(2.0 * np.nan_to_num(np.broadcast_to(center, (count,)))).astype(int) for center in (x, y))
    for i in np.flatnonzero(bad.any(axis=(1, 2))):
        opposite_row, opposite_column = ny - 1 + rows[i] - np.arange(ny), nx - 1 + columns[i] - np.arange(nx)
        inside = ((opposite_row >= 0) & (opposite_row < ny))[:, None] & (
            (opposite_column >= 0) & (opposite_column < nx)
        )
        at = np.ix_(np.clip(opposite_row, 0, ny - 1), np.clip(opposite_column, 0, nx - 1))
        paired = bad[i] & inside & ~bad[i][at]
        filled[i][paired] = images[i][at][paired]
        alone = bad[i] & ~paired
        if alone.any():
            weight, light = (
                ndimage.gaussian_filter(values, _NEIGHBOURHOOD, mode="constant")
                for values in ((~bad[i]).astype(np.float64), np.where(bad[i], 0.0, images[i]))
            )
            near = alone & (weight > _LEAST_NEIGHBOURS)
            filled[i][near] = light[near] / weight[near]
    return filled
