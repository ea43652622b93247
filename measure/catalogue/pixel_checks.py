"""Checks of images, their variance and their mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import DomainError, shown
from ...core.units import real_array
from ..pixel_masks import bad_pixels


def check_pixels(
    image: ArrayLike,
    variance: ArrayLike,
    mask: ArrayLike | NDArray[np.bool_] | None,
    *,
    axes: str = "[ny, nx]",
    name: str = "image",
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image and variance as float64, and the pixels without weight as bool, all of one shape.

    Those are masked, bad (not finite, or -1e29 or less, as of SExtractor), or of a variance that is not finite: the
    inverse of a weight of zero.

    Raises
    ------
    DomainError
        If shapes differ, or a variance is zero or negative in a pixel that is not masked.
    """
    pixels = real_array(image, f"{name}: expected real numbers {axes}")
    variances = real_array(variance, f"variance: expected real numbers {axes}")
    ignored = flagged(mask, pixels.shape)
    if pixels.ndim != axes.count(",") + 1 or 0 in pixels.shape[-2:]:
        raise DomainError(f"{name} has shape {pixels.shape}: expected {axes}")
    if variances.ndim == 0:
        variances = np.broadcast_to(variances, pixels.shape)
    for array_name, array in (("variance", variances), ("mask", ignored)):
        if array.shape != pixels.shape:
            raise DomainError(f"{array_name} has shape {array.shape}: expected {pixels.shape}, that of the {name}")
    ignored = ignored | bad_pixels(pixels) | ~np.isfinite(variances)
    _require_pixels((variances > 0.0) | ignored, "variance", variances, "positive")
    return pixels, variances, ignored


def flagged(mask: ArrayLike | NDArray[np.bool_] | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return where a mask is not zero, bool; nowhere in an image of a shape without a mask."""
    if mask is None:
        return np.zeros(shape, dtype=bool)
    if hasattr(mask, "unit"):
        raise DomainError(f"mask = {shown(mask)}: expected numbers without a unit")
    return np.asarray(mask) != 0


def _require_pixels(good: np.ndarray, name: str, values: np.ndarray, expected: str) -> None:
    if not good.all():
        at = tuple(int(i) for i in np.unravel_index(np.argmin(good), good.shape))
        raise DomainError(
            f"{name}[{', '.join(map(str, at))}] = {values[at]:.6g}: expected {expected} where the mask is zero"
        )
