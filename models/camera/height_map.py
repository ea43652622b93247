"""Map of the heights of a focal plane, and their summary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.number_text import counted
from ...core.plotting import axes_at, figure_of, plain_text, styled
from ...core.result import Result
from .camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points of the map along a side.
_SAMPLES = 400
#: Percentile of |height| at the ends of the scale of the map.
_SCALE = 99.0


class HeightMap(Result):
    """Base of a focal plane, whose heights are drawn and summarised."""

    camera: Camera
    measured: NDArray[np.bool_]
    seed: int | None

    def height(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return heights [m] at positions [m]; NaN beside the CCDs."""
        raise NotImplementedError

    def _label(self) -> str:
        measured = f", heights of {self.measured.sum()} measured" if self.measured.any() else ""
        drawn = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.camera.name}, {counted(len(self.camera), 'CCD')}{measured}{drawn}"

    def _summary(self) -> dict[str, Any]:
        heights = 1e6 * self._sampled()
        return {
            "camera": self.camera.name,
            "ccds": len(self.camera),
            "measured": int(self.measured.sum()),
            "seed": self.seed,
            "mean_height_um": np.nanmean(heights),
            "rms_height_um": np.nanstd(heights),
            "peak_to_valley_um": np.nanmax(heights) - np.nanmin(heights),
        }

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the heights, positive along +z of the telescope."""
        height, edge = 1e6 * self._sampled(), 1e3 * self._edge
        bound = max(float(np.nanpercentile(np.abs(height), _SCALE)), 1e-3)
        with styled():
            figure, axes = axes_at(ax, 6.4, 5.4)
            limits = (-edge, edge, -edge, edge)
            image = axes.imshow(height, extent=limits, cmap="RdBu_r", vmin=-bound, vmax=bound)
            axes.set(xlabel="x [mm]", ylabel="y [mm]", title=plain_text(f"{self.camera.name}: heights"))
            figure_of(axes).colorbar(image, ax=axes, extend="both", label="height along +z [µm]")
            return figure

    @property
    def _edge(self) -> float:
        return 1.03 * float(self.camera.reach)

    def _sampled(self) -> np.ndarray:
        """Return heights [m] on a square lattice over the camera; NaN in gaps."""
        axis = np.linspace(-self._edge, self._edge, _SAMPLES)
        return self.height(*np.meshgrid(axis, axis))
