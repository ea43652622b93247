"""Weights, variances and mask planes of star stamps in files: pixels without weight become NaN."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ProductError
from ...core.mask_planes import bad_bits
from ...measure.pixel_masks import bad_pixels


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
        which all are bad, but where the header names planes (``MP_BAD``) those of :data:`~.mask_planes.HARMLESS`.
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
        bad |= (masks.astype(np.int64) & bad_bits(header, path)) != 0
    if bad.size and bad.all():
        raise ProductError(
            f"no pixel of its {len(stamps)} stamps has weight: {names[0]} is zero, {names[1]} is set, or all are NaN",
            file=path,
        )
    return np.where(bad, np.nan, stamps)
