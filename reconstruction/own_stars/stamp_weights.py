"""Weights, variances and mask planes of star stamps in files: pixels without weight become NaN."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ProductError, shown
from ...measure.pixel_masks import bad_pixels

#: Mask planes of LSST and HSC files whose pixels are no data; others, such as DETECTED, say nothing of their quality.
BAD_PLANES = (
    "BAD",
    "CLIPPED",
    "CR",
    "CROSSTALK",
    "EDGE",
    "INTRP",
    "ITL_DIP",
    "NO_DATA",
    "REJECTED",
    "SAT",
    "SENSOR_EDGE",
    "SPIKE",
    "STREAK",
    "SUSPECT",
    "UNMASKEDNAN",
    "VIGNETTED",
)
# Start of the cards that name mask planes; their value is the number of the bit.
_PLANE_CARD = "MP_"
# Bits of a mask of whole numbers of 64 bits, without that of the sign.
_MOST_BITS = 63


def without_weightless(
    stamps: np.ndarray,
    weights: np.ndarray | None,
    masks: np.ndarray | None,
    header: Mapping[str, Any],
    path: Path,
    *,
    variances: np.ndarray | None = None,
    names: tuple[str, str] = ("weight", "mask"),
) -> np.ndarray:
    """Return stamps [n, ny, nx] with NaN in pixels that are bad, masked, or of weight zero.

    Parameters
    ----------
    stamps : array
        [n, ny, nx].
    weights, variances, masks : array or None
        As the stamps: inverse variances; variances, of which zero, negative and not finite ones are no weight; bits, of
        which all are bad, or those of :data:`BAD_PLANES` where the header names planes (``MP_BAD``).
    header : mapping
        Header of the masks.
    path : Path
        Of the file, for errors.
    names : tuple of str
        Columns or extensions of weights and masks, for errors.

    Raises
    ------
    ProductError
        If shapes differ, weights are negative, or no pixel has weight.
    """
    for name, values in zip((*names, "variance"), (weights, masks, variances), strict=True):
        if values is not None and values.shape != stamps.shape:
            raise ProductError(
                f"{name} has shape {values.shape}: expected {stamps.shape}, that of the stamps", file=path
            )
    bad = bad_pixels(stamps)
    if weights is not None:
        least = np.nanmin(weights, initial=0.0)
        if least < 0.0 and least > -1e29:
            raise ProductError(f"{names[0]} holds {least:.4g}: expected weights of zero or more", file=path)
        bad |= ~(np.isfinite(weights) & (weights > 0.0))
    if variances is not None:
        bad |= ~(np.isfinite(variances) & (variances > 0.0))
    if masks is not None:
        bad |= (masks.astype(np.int64) & _bad_bits(header, path)) != 0
    if bad.size and bad.all():
        raise ProductError(
            f"no pixel of its {len(stamps)} stamps has weight: {names[0]} is zero, {names[1]} is set, or all are NaN",
            file=path,
        )
    return np.where(bad, np.nan, stamps)


def _bad_bits(header: Mapping[str, Any], path: Path) -> np.int64:
    """Return the bits of bad planes; all of them where the header names none."""
    planes = {str(key)[len(_PLANE_CARD) :]: header[key] for key in header if str(key).startswith(_PLANE_CARD)}
    if not planes:
        return np.int64(-1)
    bits = 0
    for name, bit in planes.items():
        if isinstance(bit, bool) or not isinstance(bit, int) or not 0 <= bit < _MOST_BITS:
            raise ProductError(
                f"{_PLANE_CARD}{name} = {shown(bit)}: expected the number of a bit of the mask, 0 to {_MOST_BITS - 1}",
                file=path,
                key=f"{_PLANE_CARD}{name}",
            )
        bits |= (1 << bit) * (name in BAD_PLANES)
    return np.int64(bits)
