"""Elements of plots over the focal plane: whiskers, CCD outlines, colours of the quantities.

Plots are in the detector's frame as the telescope's frame has it: x to the right, y up, in millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from ..core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, figure_of
from ..models.camera.camera import Camera

#: Colour of noise-free PSFs in every plot.
TRUTH = GREY
#: Colour of observed stars, as in Jee & Tyson 2011.
OBSERVED = BLUE
#: Colour of residuals at the stars, as in Jee & Tyson 2011.
RESIDUAL = RED
#: Colour of residuals at holdout positions.
AWAY = ORANGE
#: Colour of residuals at stars that are left out of the fit.
LEFT_OUT = PURPLE
#: Residuals of the CCDs' own models, beside those of a focal-plane model.
CCD_MODEL = GREY
#: Most whiskers of a panel.
_MOST_WHISKERS = 2500
#: Fraction of the radius of the field of view from which limits of axes are near its edge, and moved beyond it.
_NEAR = 0.65
#: Where limits near the edge are moved to, as a fraction of that radius: the circle is then within the axes.
_MARGIN = 1.02
#: Place of the arrows to north and east, along x and y, as a fraction of the axes.
_COMPASS_PLACE = 0.11
#: Length of the arrows, as a fraction of the axes.
_COMPASS_LENGTH = 0.06
RESIDUAL_TITLES = {
    "residual": "at the stars: observed - model",
    "left_out": "at stars left out: observed - model",
    "away": "holdout positions: noise-free - model",
}


def ccd_corners(camera: Camera, indices: Iterable[int]) -> np.ndarray:
    """Return the corners of CCDs [mm], shape [n, 4, 2]."""
    return camera.corners(indices) * 1e3


def draw_outlines(axes: Axes, camera: Camera, indices: Iterable[int], color: str = "0.6", width: float = 0.5) -> None:
    """Draw the outlines of CCDs."""
    axes.add_collection(
        PolyCollection(list(ccd_corners(camera, indices)), facecolors="none", edgecolors=color, linewidths=width)
    )


def draw_field_circle(axes: Axes, radius_mm: float) -> None:
    """Draw the edge of the field of view."""
    axes.add_patch(Circle((0.0, 0.0), radius_mm, fill=False, edgecolor="0.35", linewidth=0.8, linestyle=(0, (5, 3))))


def around_field_circle(
    limits: tuple[float, float, float, float], radius_mm: float
) -> tuple[float, float, float, float]:
    """Return limits [mm], of x and then of y, with those that are near the edge of the field of view outside of it."""
    x_low, x_high, y_low, y_high = (
        sign * max(sign * limit, _MARGIN * radius_mm) if sign * limit > _NEAR * radius_mm else limit
        for sign, limit in zip((-1, 1, -1, 1), limits, strict=True)
    )
    return x_low, x_high, y_low, y_high


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


def draw_compass(axes: Axes, north: np.ndarray, east: np.ndarray) -> None:
    """Draw arrows to north and east, unit vectors along the axes [2], in the lower left corner; scales are equal.

    Directions that are not finite are unknown, and none is drawn.
    """
    if not np.isfinite([north, east]).all():
        return
    center = (_COMPASS_PLACE, _COMPASS_PLACE)
    for name, (x, y) in (("N", north), ("E", east)):
        tip, label = (
            (_COMPASS_PLACE + length * x, _COMPASS_PLACE + length * y)
            for length in (_COMPASS_LENGTH, 1.45 * _COMPASS_LENGTH)
        )
        arrow = {"arrowstyle": "-|>", "color": RED, "linewidth": 1.0, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", tip, xytext=center, xycoords="axes fraction", textcoords="axes fraction", arrowprops=arrow)
        axes.text(label[0], label[1], name, transform=axes.transAxes, ha="center", va="center", fontsize=8, color=RED)


def key_ellipticity(values: np.ndarray) -> float:
    """Return a round ellipticity near the larger ones of a set, for a key whisker."""
    finite = values[np.isfinite(values)]
    typical = float(np.quantile(finite, 0.9)) if finite.size else 0.01
    rounds = np.array([0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5])
    return float(rounds[np.argmin(np.abs(np.log(rounds / max(typical, 1e-4))))])


def draw_whisker_panels(
    panel_axes: Iterable[Axes],
    x: np.ndarray,
    y: np.ndarray,
    panels: Mapping[str, tuple[np.ndarray, np.ndarray]],
    labels: tuple[str, str],
) -> None:
    """Draw whiskers of several ellipticities, by title, at the same places [n], on the scale of the first panel."""
    key = key_ellipticity(np.hypot(*next(iter(panels.values()))))
    middle = 0.5 * (np.max(x) + np.min(x)), 0.5 * (np.max(y) + np.min(y))
    half = 0.55 * max(float(np.ptp(x)), float(np.ptp(y))) or 1.0
    scale = 0.12 * half / key
    drawn_rows = np.s_[:: max(1, len(x) // _MOST_WHISKERS)]
    for column, (axes, (title, (e1, e2))) in enumerate(zip(panel_axes, panels.items(), strict=True)):
        draw_whiskers(axes, whiskers(x[drawn_rows], y[drawn_rows], e1[drawn_rows], e2[drawn_rows], scale), "black", 0.6)
        axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
        axes.set(xlabel=labels[0], ylabel="" if column else labels[1])
        finite = np.isfinite(e1) & np.isfinite(e2)
        rms = float(np.sqrt(np.mean((e1**2 + e2**2)[finite]))) if finite.any() else float("nan")
        axes.set_title(f"{title}: rms |e| {rms:.1e}", loc="left")
        draw_key_whisker(axes, key, scale, 1.0)


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
