"""Stamps of stars side by side in one pair of axes, and the stretch of their light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.plotting import round_length
from ..core.units import ARCSEC

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

#: Value over the peak below which the stretch is linear.
_SOFTENING = 0.02


class StampGallery:
    """Stamps in rows and columns within one pair of axes: axes of their own would take most of the time of a report."""

    def __init__(self, axes: Axes, size: int, pixel_scale: float, shown: float = math.inf, room: float = 0.0) -> None:
        """Show the middle of stamps of a size [pixel], out to an angle [rad] from their centres.

        Between rows there is room for a title, in sides of a stamp.
        """
        self._axes = axes
        self._rim = max(0, round(0.5 * size - shown / pixel_scale)) if math.isfinite(shown) else 0
        self._side = (size - 2 * self._rim) * pixel_scale / ARCSEC
        self._step, self._down = 1.06 * self._side, -(1.06 + room) * self._side

    def show(self, image: np.ndarray, row: int, column: int, title: str = "", **colours: Any) -> AxesImage:
        """Draw a stamp, with a title above it."""
        side, rim, x0, bottom = self._side, self._rim, self._step * column, self._down * row
        self._axes.text(x0 + 0.5 * side, bottom + 1.02 * side, title, ha="center", va="bottom", fontsize=8)
        middle = image[rim : len(image) - rim, rim : len(image) - rim]
        return self._axes.imshow(middle, extent=(x0, x0 + side, bottom, bottom + side), **colours)

    def finish(self, rows: int, columns: int, names: Sequence[str] = ()) -> None:
        """Set limits, names of rows at the left, and a bar of a round number of arcseconds under the first stamp."""
        side, axes, bottom = self._side, self._axes, self._down * (rows - 1)
        for row, name in enumerate(names):
            y = self._down * row + 0.5 * side
            axes.text(-0.06 * side, y, name, rotation=90, ha="right", va="center")
        length = round_length(0.6 * side)
        axes.plot([0.0, length], [bottom - 0.06 * side] * 2, "-", color="0.2", linewidth=1.5)
        axes.text(0.5 * length, bottom - 0.1 * side, f"{length:g} arcsec", ha="center", va="top", fontsize=8)
        axes.set_xlim(-(0.2 if names else 0.02) * side, self._step * columns)
        axes.set_ylim(bottom - 0.25 * side, 1.02 * side)
        axes.set_aspect("equal")
        axes.set_axis_off()


def stretched(values: np.ndarray) -> np.ndarray:
    """Return values over the peak on the asinh scale of pictures, 1 at 1."""
    return np.arcsinh(np.asarray(values) / _SOFTENING) / np.arcsinh(1.0 / _SOFTENING)
