"""Pixels of a donut that are no light: cosmic rays, hot and dead pixels, bad columns, what lies beside a CCD."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_opening, label, maximum_filter, median_filter, minimum_filter

from .stamps import Pixels, measured_variance

#: Pixels, as a fraction of the stamp, from which on those of one greatest value are saturated, and saturated ones the
#: reason why there is no result.
SEVERAL = 0.002
#: Electrons up to which pixels of equal value are no sign of saturation.
_FAINT = 100.0
#: A pixel this many standard deviations off its neighbours is no part of a donut, if it is as far off by contrast, too.
_SIGMA = 8.0
#: Least difference of such a pixel from its neighbours over their light.
_CONTRAST = 1.0
#: The same of pixels that are too dark.
_DARK_CONTRAST = 0.5
#: Side of the squares of neighbours [pixels].
_NEIGHBOURS = 5
#: Part of the pixels beside a line of equal ones that have its value, from which on these are no gap in the image.
_SAME = 0.5
#: Percentile of the differences of neighbours that stands for the noise: bright and bad pixels have larger ones.
_QUIET = 20.0
#: Percentile of the pixels that stands for the background.
_BACKGROUND = 30.0
#: Part of a stamp up to which pixels beside bad ones are left out, too: of scattered ones nothing would remain.
_FEW = 0.1
#: Pixels of bad ones and those beside them over the bad ones, up to which these are lines and patches.
_COMPACT = 3.0
#: Distance by which rims of telescopes differ from their models [pixels].
_RIM_SHIFT = 3
#: The same of folds of bright light by terms of higher orders that a model lacks [pixels].
_FOLD_SHIFT = 1
#: Connected pixels from which on they may be a strip along a rim.
_STRIP = 12
#: Part of them that a rim at another place would explain.
_MOSTLY = 0.7
#: Widest line of bad pixels [pixels].
_LINE = 3
#: Side of the smallest square of unused pixels that is a region, and no scattered pixels or lines [pixels].
_REGION = 6


def grown(bad: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return bad pixels with those beside them, unless they are scattered and many."""
    wider = maximum_filter(bad, 3)
    scattered = ~used & ~unused_regions(used)
    return wider if (wider | scattered).mean() < _FEW or wider.sum() < _COMPACT * bad.sum() else bad


def saturated_pixels(image: np.ndarray, masked: np.ndarray, level: float | None) -> np.ndarray:
    """Return the saturated pixels: from a level on, or without one those of the greatest value where many have it.

    Pixels with noise hardly agree unless they are saturated.
    """
    if level is not None:
        high = (image >= level) & ~masked
        if high.any():
            return high
    top = image.max(initial=0.0, where=~masked)
    plateau = (image == top) & ~masked
    return plateau if top > _FAINT and plateau.sum() > max(SEVERAL * image.size, 1.0) else np.zeros_like(masked)


def without_bad_pixels(pixels: Pixels) -> Pixels:
    """Return the pixels of a donut without gaps of one value and pixels that stand out of their neighbourhood."""
    pixels = _without(pixels, _gaps(pixels.image, pixels.used))
    if not pixels.used.any():
        return pixels
    background = float(np.percentile(pixels.image[pixels.used], _BACKGROUND))
    image = pixels.image - background * pixels.used
    # Sky that was left in has noise, and so have images for which none is claimed.
    variance = np.maximum(pixels.variance + max(background, 0.0), measured_variance(pixels, _QUIET))
    # A median is no less than the least value, and no more than the greatest: without a pixel beyond these by far
    # there is no median beyond which one is.
    least, most = minimum_filter(image, _NEIGHBOURS, mode="nearest"), maximum_filter(image, _NEIGHBOURS, mode="nearest")
    bright, dark = _outstanding(image, variance, least, most)
    if not (bright | dark).any():
        return pixels
    middle = median_filter(image, _NEIGHBOURS, mode="nearest")
    bright, dark = _outstanding(image, variance, middle, middle)
    return _without(pixels, grown((bright | dark) & pixels.used, pixels.used))


def _outstanding(
    image: np.ndarray, variance: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels far above the light of bright ones near them, and those far below that of dark ones."""
    # A donut is as bright nearby as here; a median over its edge is fainter.
    top = np.maximum(maximum_filter(low, _NEIGHBOURS), 0.0)
    bottom = np.maximum(minimum_filter(high, _NEIGHBOURS), 0.0)
    bright = image > (1.0 + _CONTRAST) * top + _SIGMA * np.sqrt(top + variance)
    dark = image < (1.0 - _DARK_CONTRAST) * bottom - _SIGMA * np.sqrt(bottom + variance)
    return bright, dark


def _without(pixels: Pixels, bad: np.ndarray) -> Pixels:
    """Return pixels of which bad ones are not used."""
    used = pixels.used & ~bad
    return (
        replace(pixels, image=np.where(used, pixels.image, 0.0), used=used) if (used != pixels.used).any() else pixels
    )


def _gaps(image: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return whole rows and columns of one value, such as zeros beside a CCD, next to pixels with noise."""
    columns = _equal_columns(image, used)
    rows = _equal_columns(image.T, used.T)
    return columns[None] | rows[:, None]


def _equal_columns(image: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return which columns have one value, unless those beside them have the same."""
    high = np.where(used, image, -np.inf).max(axis=0)
    equal = (high == np.where(used, image, np.inf).min(axis=0)) & used.any(axis=0)
    gaps = np.zeros_like(equal)
    runs, count = label(equal)
    for run in range(1, count + 1):
        at = np.flatnonzero(runs == run)
        beside = [column for column in (at[0] - 1, at[-1] + 1) if 0 <= column < len(equal)]
        # Images without noise have light that ends somewhere.
        if beside and len(set(high[at])) == 1:
            gaps[at] = all((image[:, c] == high[at[0]])[used[:, c]].mean() < _SAME for c in beside if used[:, c].any())
    return gaps


def without_outliers(
    pulls: np.ndarray,
    image: np.ndarray,
    model: np.ndarray,
    used: np.ndarray,
    limit: float,
    *,
    lines_only: bool = False,
    folds: bool = False,
) -> np.ndarray:
    """Return the used pixels without those whose pull is beyond a limit, and those beside them.

    Strips of pixels along rims of the model are no outliers: their light is that of a rim at another place, for which
    it is the only evidence. Nor are patches of pixels where a model still lacks neighbours, with ``lines_only``, nor
    pixels with light that the model has next to them, with ``folds``: a fold of the wavefront, once rims are found.
    """
    far = used & (np.abs(pulls) > limit)
    if lines_only:
        far &= ~binary_opening(far, np.ones((_LINE + 1, _LINE + 1)))
    if not far.any():
        return used
    noise = limit * np.abs(image - model) / np.maximum(np.abs(pulls), 1e-12)
    at_rim = _as_nearby(image, model, noise, _RIM_SHIFT)
    components, count = label(far, np.ones((3, 3)))
    sizes = np.bincount(components.ravel(), minlength=count + 1)
    along_rim = np.bincount(components.ravel(), weights=at_rim.ravel(), minlength=count + 1)
    strips = (sizes >= _STRIP) & (along_rim > _MOSTLY * sizes)
    far &= ~strips[components]
    if folds:
        far &= ~_as_nearby(image, model, noise, _FOLD_SHIFT)
    return used & ~grown(far, used)


def _as_nearby(image: np.ndarray, model: np.ndarray, noise: np.ndarray, pixels: int) -> np.ndarray:
    """Return which values of an image the model has, within the noise, up to a number of pixels from there."""
    side = 2 * pixels + 1
    return np.asarray((image < maximum_filter(model, side) + noise) & (image > minimum_filter(model, side) - noise))


def unused_regions(used: np.ndarray) -> np.ndarray:
    """Return the unused pixels that lie together, as beside a CCD; not scattered ones or lines."""
    square = np.ones((_REGION, _REGION), dtype=bool)
    # Beside the stamp there is nothing either.
    padded = np.pad(~used, _REGION, constant_values=True)
    return np.asarray(binary_opening(padded, square)[_REGION:-_REGION, _REGION:-_REGION])
