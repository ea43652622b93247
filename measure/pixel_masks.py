"""Pixels of star stamps without weight: which they are, and what stands in for them where every pixel is needed.

A pixel has no weight if it is not finite, if it is -1e29 or less, as the pixels are that SExtractor masks (-1e30), or
if its weight is zero. Positive weights are all alike for moments and shifts, as in GalSim's HSM.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..core.errors import DomainError
from ..core.units import real_array

# Values at or below this are no light: SExtractor's masked pixels are -1e30.
_MASKED = -1e29
# Side of a square of zeros that are no measurements [pixel]: among the zeros of whole numbers there is none.
_EMPTY_SIDE = 16
# Side of squares that the other pixels fill for the most part [pixel]: stamps of objects without noise do not.
_COVERED_SIDE = 64
# Fewest columns side by side that are copies of each other: two may be alike in a symmetric star without noise.
_COPIES = 3
#: Pixels of exactly the greatest value of a star that make it clipped.
_FLAT = 3
#: Most pixels about the centre of a star without noise that have its greatest value.
_EQUAL_BY_SYMMETRY = 4
# Fewest rows of theirs: of whole numbers with a noise of 1 so many agree by chance once in ten thousand stamps.
_COPIED_LENGTH = 12
#: Standard deviation of the weights of good neighbours [pixel], about the width of a star.
NEIGHBOURHOOD = 1.5
# Part of a bad pixel from which on the place opposite is no better.
_OVERLAP = 0.1
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


def clipped_stars(images: np.ndarray, bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the stars whose greatest value is a level of saturation, bool [n].

    Saturated pixels are clipped at one level, which noise does not repeat: three or more pixels of a stamp have exactly
    its greatest value, and that is more than half of the greatest of all stamps. Stars that reach such a level in fewer
    pixels are clipped, too. Where most stars seem so, they are images without noise, whose symmetry makes four pixels
    equal; or most are clipped: at one level, in more pixels than that.
    """
    values = np.where(bad, -np.inf, images)
    greatest = values.max(axis=(1, 2), initial=-np.inf)
    equal = (values == greatest[:, None, None]).sum(axis=(1, 2))
    flat = (equal >= _FLAT) & np.isfinite(greatest) & (greatest > 0.5 * greatest.max(initial=-np.inf))
    if 2 * flat.sum() > len(flat):
        plateaus = flat & (equal > _EQUAL_BY_SYMMETRY) & (2 * equal < values[0].size)
        levels, counts = np.unique(greatest[plateaus], return_counts=True)
        flat = plateaus & np.isin(greatest, levels[2 * counts > flat.sum()])
    return np.isin(greatest, greatest[flat])


def empty_pixels(image: np.ndarray) -> NDArray[np.bool_]:
    """Return the pixels of areas of zeros that no exposure reached, bool [ny, nx].

    Resampled images have them in corners and gaps: squares of exact zeros, and the zeros that are connected with them.
    An image whose zeros are the sky between objects has none.
    """
    zero = image == 0.0
    core = _squares_within(zero, _EMPTY_SIDE)
    if not core.any():
        return core
    labels, count = ndimage.label(zero)
    holds_core = np.zeros(count + 1, dtype=bool)
    holds_core[labels[core]] = True
    empty: NDArray[np.bool_] = holds_core[labels]
    covered = _squares_within(~empty, _COVERED_SIDE)
    for axis in (0, 1):
        covered = ndimage.maximum_filter1d(covered, _COVERED_SIDE, axis=axis, mode="nearest", origin=-1)
    is_sky = 2 * int(covered.sum()) < int((~empty).sum())
    return np.zeros_like(empty) if is_sky or empty.all() else empty


def _squares_within(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Return the middles of squares of an even side that lie within a mask, which goes on beyond its edges."""
    for axis in (0, 1):
        mask = ndimage.minimum_filter1d(mask, side, axis=axis, mode="nearest")
    return mask


def clipped_level(image: np.ndarray, good: NDArray[np.bool_]) -> float | None:
    """Return the greatest value of the good pixels of an image if it is a level of saturation; None otherwise.

    It is one where more pixels side by side have it than symmetry makes equal in a star without noise, and less than
    half of all.
    """
    greatest = image.max(where=good, initial=-np.inf)
    clipped = good & (image == greatest)
    count = int(clipped.sum())
    if count <= _EQUAL_BY_SYMMETRY or 2 * count > int(good.sum()):
        return None
    labels, _ = ndimage.label(clipped, np.ones((3, 3)))
    return float(greatest) if np.bincount(labels.ravel())[1:].max() > _EQUAL_BY_SYMMETRY else None


def copied_pixels(images: np.ndarray) -> np.ndarray:
    """Return the pixels of columns and rows that are copies of their neighbours, bool [n, ny, nx].

    Pipelines fill dead columns by copies of a good one: three or more side by side hold the same values, over twelve
    rows or more. The good one is taken to be the first or last, the one that differs less from the column beyond it.
    Where a line is constant along itself it is no copy.
    """
    across_columns = _copied_columns(images)
    across_rows = _copied_columns(images.transpose(0, 2, 1)).transpose(0, 2, 1)
    return across_columns | across_rows


def _copied_columns(images: np.ndarray) -> np.ndarray:
    """Return the pixels of columns side by side that hold the same values."""
    copied = np.zeros(images.shape, dtype=bool)
    count, ny, nx = images.shape
    if nx < _COPIES or ny < _COPIED_LENGTH:
        return copied
    alike = np.ones((count, ny, nx - _COPIES + 1), dtype=bool)
    for step in range(1, _COPIES):
        alike &= images[:, :, step : nx - _COPIES + 1 + step] == images[:, :, : nx - _COPIES + 1]
    first = images[:, :, : nx - _COPIES + 1]
    constant = np.zeros(alike.shape, dtype=bool)
    constant[:, 1:] = first[:, 1:] == first[:, :-1]
    alike &= ~constant
    for i in np.flatnonzero(alike.sum(axis=1).max(axis=1) >= _COPIED_LENGTH):
        runs = ndimage.binary_opening(alike[i], np.ones((_COPIED_LENGTH, 1)))
        for step in range(_COPIES):
            copied[i, :, step : nx - _COPIES + 1 + step] |= runs
        labels, _ = ndimage.label(copied[i])
        for block in ndimage.find_objects(labels):
            copied[i, block[0], _good_copy(images[i, block[0]], block[1])] = False
    return copied


def _good_copy(rows: np.ndarray, columns: slice) -> int:
    """Return the good one of columns that are copies: the first or the last, by the column beyond it."""
    first, last = columns.start, columns.stop - 1
    steps = [
        np.square(rows[:, at] - rows[:, beyond]).sum() if 0 <= beyond < rows.shape[1] else np.inf
        for at, beyond in ((first, first - 1), (last, last + 1))
    ]
    return int(first if steps[0] <= steps[1] else last)


def fill_symmetric(images: np.ndarray, bad: np.ndarray, x: Any = 0.0, y: Any = 0.0) -> np.ndarray:
    """Fill bad pixels by the image opposite a centre, between pixels by cubic splines, or by good neighbours' mean.

    `images` are background-subtracted [n, ny, nx]; the centres x and y are counted from those of the stamps, [n] or
    one for all [pixel]. NaN counts as zero.
    """
    filled = np.where(bad, 0.0, images)
    count, ny, nx = images.shape
    centers = np.stack([np.broadcast_to(np.nan_to_num(center), (count,)) for center in (y, x)], axis=1)
    masked = np.flatnonzero(bad.any(axis=(1, 2)))
    if not centers.any():
        turned, turned_bad = filled[masked][:, ::-1, ::-1], bad[masked][:, ::-1, ::-1]
        filled[masked] = np.where(bad[masked], turned, filled[masked])
        unpaired = bad[masked] & turned_bad
        alone = unpaired.any(axis=(1, 2))
        masked, unpaired = masked[alone], unpaired[alone]
        near_good = _near_means(np.where(bad[masked], 0.0, images[masked]), bad[masked])
        filled[masked] = np.where(unpaired, near_good, filled[masked])
        return filled
    for i, near_good in zip(masked, _near_means(filled[masked], bad[masked]), strict=True):
        rows, columns = np.nonzero(bad[i])
        opposite = np.stack([ny - 1 + 2.0 * centers[i, 0] - rows, nx - 1 + 2.0 * centers[i, 1] - columns])
        inside = ((opposite >= 0.0) & (opposite <= np.array([[ny - 1], [nx - 1]]))).all(axis=0)
        values = near_good[rows, columns]
        if not inside.any():
            filled[i, rows, columns] = values
            continue
        badness = ndimage.map_coordinates(bad[i].astype(np.float64), opposite, order=1, mode="nearest")
        paired = inside & (badness < _OVERLAP)
        if paired.any():
            at = opposite[:, paired]
            on_pixels = np.array_equal(at, np.rint(at))
            values[paired] = (
                images[i][tuple(at.astype(int))]
                if on_pixels
                else ndimage.map_coordinates(near_good, at, order=3, mode="nearest")
            )
        filled[i, rows, columns] = values
    return filled


def _near_means(images: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return images [n, ny, nx] whose bad pixels hold the mean of good ones near them, zero where there are none."""
    along_both = (0.0, NEIGHBOURHOOD, NEIGHBOURHOOD)
    weight, light = (
        ndimage.gaussian_filter(values, along_both, mode="constant")
        for values in ((~bad).astype(np.float64), np.where(bad, 0.0, images))
    )
    near = bad & (weight > _LEAST_NEIGHBOURS)
    return np.where(near, light / np.where(near, weight, 1.0), np.where(bad, 0.0, images))
