"""Picture of shims: heights of focal planes side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ...core.plotting import figure_at, styled
from ...measure.focal_plane_axes import draw_outlines, frame_axes
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.report.focal_plane_plots import draw_heights

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_shims(ax: Axes | Figure | None, planes: Mapping[str, FocalPlane]) -> Figure:
    """Draw focal planes of one camera by name, on the scale of the first."""
    first = next(iter(planes.values()))
    camera = first.camera
    edge = 1.04e3 * camera.reach
    limits = (-edge, edge, -edge, edge)
    bounds = 3e6 * float(np.std(first.height(*camera.centers.T))) or 1.0
    with styled():
        figure = figure_at(ax, 13.0, 4.6)
        panels = figure.subplots(1, len(planes))
        for i, (axes, (title, plane)) in enumerate(zip(panels, planes.items(), strict=True)):
            image = draw_heights(axes, plane, limits, 350, bounds=bounds)
            draw_outlines(axes, camera, range(len(camera)), "0.55", 0.3)
            frame_axes(axes, limits, y_label=i == 0)
            axes.set_title(title)
        figure.colorbar(image, ax=list(panels), fraction=0.02, pad=0.01, extend="both", label="height [µm]")
        return figure
