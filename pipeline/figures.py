"""What all figures share: drawing without global state, whiskers, CCD outlines, the bytes of a PNG.

Figures are in the detector's frame as the telescope's frame has it: x to the right, y up, in millimetres.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterable
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from ..models.camera import Camera

#: One colour for one thing, in every figure: blue and red for observed and residual are the paper's.
TRUTH, OBSERVED, RESIDUAL, AWAY = "#3a3a3a", "#1f6fbf", "#c8322b", "#e08a00"
LEFT_OUT = "#7a4fb5"
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.7,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "image.origin": "lower",
    "image.interpolation": "nearest",
    "text.usetex": False,
    "svg.hashsalt": "pachon",
}
_DPI = 150
# Matplotlib announces the building of its font cache, which no astronomer asked about.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)


def styled() -> Any:
    """Return the context in which figures are drawn: our style on top of matplotlib's own, not the user's."""
    return matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE, "backend": "agg"})


def new_figure(width: float, height: float, layout: Literal["constrained", "compressed"] = "constrained") -> Figure:
    """Return an empty figure of a size in inches that belongs to no window and no global state."""
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG, without the date and the version of what drew it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def ccd_corners(camera: Camera, indices: Iterable[int]) -> np.ndarray:
    """Return the corners of CCDs [mm], shape [n, 4, 2]."""
    half = camera.half_size * 1e3
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half
    return camera.centers[list(indices), None, :] * 1e3 + square


def draw_outlines(axes: Axes, camera: Camera, indices: Iterable[int], color: str = "0.6", width: float = 0.5) -> None:
    """Draw the outlines of CCDs."""
    axes.add_collection(
        PolyCollection(list(ccd_corners(camera, indices)), facecolors="none", edgecolors=color, linewidths=width)
    )


def draw_field_circle(axes: Axes, radius_mm: float, label: str) -> None:
    """Draw the edge of the field of view."""
    axes.add_patch(Circle((0.0, 0.0), radius_mm, fill=False, edgecolor="0.35", linewidth=0.8, linestyle=(0, (5, 3))))
    axes.annotate(
        label,
        (0.0, -radius_mm),
        xytext=(0, -3),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=8,
        color="0.35",
    )


def whiskers(x: np.ndarray, y: np.ndarray, e1: np.ndarray, e2: np.ndarray, scale: float) -> np.ndarray:
    """Return the ends of whiskers of length |e| times scale along the elongation, shape [n, 2, 2]; NaN are left out."""
    magnitude, angle = np.hypot(e1, e2), 0.5 * np.arctan2(e2, e1)
    half = 0.5 * scale * magnitude[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    center = np.stack([x, y], axis=-1)
    ends = np.stack([center - half, center + half], axis=1)
    return ends[np.isfinite(ends).all(axis=(1, 2))]


def draw_whiskers(axes: Axes, ends: np.ndarray, color: str, width: float) -> None:
    """Draw whiskers."""
    axes.add_collection(LineCollection(list(ends), colors=color, linewidths=width, capstyle="round"))


def draw_key_whisker(axes: Axes, ellipticity: float, scale: float, width: float) -> None:
    """Draw a whisker of a given ellipticity, with its value, above the upper right corner; limits are set by then."""
    right = axes.get_xlim()[1]
    above = blended_transform_factory(axes.transData, axes.transAxes) + ScaledTranslation(
        0.0, 7.0 / 72.0, figure_of(axes).dpi_scale_trans
    )
    line = Line2D(
        [right - ellipticity * scale, right], [1.0, 1.0], transform=above, color="black", linewidth=1.5 * width
    )
    line.set_clip_on(False)
    axes.add_line(line)
    axes.annotate(
        f"{100 * ellipticity:g} %",
        (right - ellipticity * scale, 1.0),
        xycoords=above,
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=8,
    )


def figure_of(axes: Axes) -> Figure:
    """Return the figure that axes belong to."""
    figure = axes.get_figure(root=True)
    assert isinstance(figure, Figure)
    return figure


def key_ellipticity(values: np.ndarray) -> float:
    """Return a round ellipticity near the larger ones of a set, for a key whisker."""
    finite = values[np.isfinite(values)]
    typical = float(np.quantile(finite, 0.9)) if finite.size else 0.01
    rounds = np.array([0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5])
    return float(rounds[np.argmin(np.abs(np.log(rounds / max(typical, 1e-4))))])


def frame_axes(
    axes: Axes, limits: tuple[float, float, float, float], x_label: bool = True, y_label: bool = True
) -> None:
    """Set limits [mm] with equal scales on both axes, and name the axes."""
    axes.set_xlim(limits[0], limits[1])
    axes.set_ylim(limits[2], limits[3])
    axes.set_aspect("equal")
    if x_label:
        axes.set_xlabel("detector x [mm]")
    if y_label:
        axes.set_ylabel("detector y [mm]")
