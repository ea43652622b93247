"""Plot of the CCDs of a camera."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...core.plotting import new_figure, plain_text, styled
from ...models.camera.camera import Camera
from .focal_plane_axes import ccd_corners, draw_outlines, frame_axes

#: Most CCDs that are named in the plot.
_NAMED = 30


def camera_plot(camera: Camera) -> Figure:
    """Return a plot of the outlines of the CCDs, named where they are few."""
    corners = ccd_corners(camera, range(len(camera)))
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    rim = 0.03 * float(np.max(high - low))
    with styled():
        figure = new_figure(5.4, 5.4)
        axes = figure.add_subplot()
        draw_outlines(axes, camera, range(len(camera)), "0.3", 0.8)
        if len(camera) <= _NAMED:
            for name, (x, y) in zip(camera.ccd_names, corners.mean(axis=1), strict=True):
                axes.text(x, y, plain_text(name), ha="center", va="center", fontsize=7)
        frame_axes(axes, (low[0] - rim, high[0] + rim, low[1] - rim, high[1] + rim))
        axes.set_title(plain_text(f"{camera.name}: {len(camera)} CCDs"))
        return figure
