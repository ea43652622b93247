"""Plot of a camera: its CCDs with their names, on the focal plane."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...core.number_text import counted
from ...core.plotting import new_figure, plain_text, styled
from ...measure.focal_plane_axes import ccd_corners, draw_outlines, frame_axes
from ...models.camera.camera import Camera

# Fraction of the width of a CCD that its name fills.
_FILLED = 0.8
# Width of a letter over its height.
_LETTER = 0.62
# Width of the plot [inch].
_WIDTH = 8.6
# Height of the plot [inch].
_HEIGHT = 8.2


def camera_plot(camera: Camera) -> Figure:
    """Draw the outlines of all CCDs with their names; a dot marks the corner of the first pixel of each."""
    edge = 1.04e3 * camera.reach
    indices = range(len(camera))
    corners = ccd_corners(camera, indices)
    # Points to a millimetre: the axes are about 0.85 of the figure wide.
    scale = 0.85 * _WIDTH * 72.0 / (2.0 * edge)
    width = float(np.ptp(corners[:, :, 0], axis=1).min()) * scale
    size = min(_FILLED * width / (_LETTER * max(map(len, camera.ccd_names))), 11.0)
    with styled():
        figure = new_figure(_WIDTH, _HEIGHT)
        axes = figure.add_subplot()
        draw_outlines(axes, camera, indices, "0.3", 0.8)
        centers = camera.centers * 1e3
        for name, center, first in zip(camera.ccd_names, centers, corners[:, 0], strict=True):
            axes.annotate(name, center, ha="center", va="center", fontsize=size, color="0.15")
            at = first + 0.06 * (center - first)
            axes.plot(*at, "o", color="0.3", markersize=max(0.03 * width, 0.6))
        frame_axes(axes, (-edge, edge, -edge, edge))
        pixel = f"pixels of {camera.pixel_size * 1e6:g} um"
        axes.set_title(plain_text(f"{camera.name}: {counted(len(camera), 'CCD')}, {pixel}; dots: first pixels"))
        return figure
