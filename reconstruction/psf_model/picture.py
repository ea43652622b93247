"""Table and picture of a PSF model: its stars, mean and first components."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...core.plotting import figure_at, styled
from ...core.result import Result
from .basis import FittedBasis
from .interpolation import FittedInterpolation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Components that are drawn beside the mean.
_SHOWN = 5


class PicturedModel(Result):
    """Base of a PSF model, with the table of its stars and its picture."""

    _table = ("positions", "coefficients", "unexplained", "rejected")

    basis: FittedBasis
    interpolation: FittedInterpolation

    @property
    def n_components(self) -> int:
        """Number of components kept."""
        return len(self.basis.components)

    @property
    def n_stars(self) -> int:
        """Number of stars of the fit."""
        return len(self.interpolation.positions)

    def _label(self) -> str:
        ny, nx = self.basis.mean.shape
        components, order = f"{self.n_components} components ({self.basis.name})", self.interpolation.order
        return f"{components}, order {order}, {self.n_stars} stars, stamps {nx} x {ny}"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the mean PSF and the first components, each over its largest magnitude."""
        images = self.basis.components[: _SHOWN if self.basis.kind.has_components else 0]
        with styled():
            figure = figure_at(ax, max(1.9 * (len(images) + 1), 4.0), 2.3)
            row = figure.subplots(1, len(images) + 1, squeeze=False)[0]
            row[0].imshow(np.sqrt(np.maximum(self.basis.mean, 0.0)), cmap="viridis", vmin=0.0)
            row[0].set_title("mean (square root)", fontsize=8.5)
            for k, (axes, image) in enumerate(zip(row[1:], images, strict=True), start=1):
                axes.imshow(image / float(np.abs(image).max()), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
                axes.set_title(f"component {k}", fontsize=8.5)
            for axes in row:
                axes.set(xticks=[], yticks=[])
            return figure
