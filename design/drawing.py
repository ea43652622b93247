"""Shared parts of the plots of design studies: field labels and colours, panels, scale bars, maps over the field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.plotting import figure_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import TriMesh
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.legend import Legend
    from numpy.typing import ArrayLike

#: Red, green, blue and opacity, 0 to 1.
Color = tuple[float, float, float, float]
#: Style of a line: its name, or an offset and the lengths of dashes and gaps [points].
LineStyle = str | tuple[float, tuple[float, ...]]
#: Fields that a legend or a row of panels can hold; a plot of more is drawn against the distance from the axis.
FEW = 12


def field_text(field: np.ndarray) -> str:
    """Return a field point [rad] as text in degrees: one number where it lies on the +y axis, else both."""
    x, y = np.rad2deg(field)
    if abs(x) < 1e-9 and y > -1e-9:
        return f"{abs(y):.4g}°"
    return f"({x:.4g}°, {y:.4g}°)"


def field_colors(count: int) -> list[Color]:
    """Return a colour for each field of a list, from dark at the axis to bright at the edge."""
    return _colors("plasma", 0.05, 0.78, count)


def wavelength_colors(wavelengths: ArrayLike) -> list[Color]:
    """Return a colour for each wavelength of a list in any order, the shortest blue, the longest red; one is blue."""
    values = np.asarray(wavelengths)
    colors = _colors("turbo", 0.12, 0.76, len(values))
    return [colors[rank] for rank in np.argsort(np.argsort(values, kind="stable"))]


def _colors(name: str, first: float, span: float, count: int) -> list[Color]:
    from matplotlib import colormaps

    return [colormaps[name](first + span * i / max(count - 1, 1)) for i in range(count)]


def grid_shape(count: int, most: int = 5) -> tuple[int, int]:
    """Return rows of about equal length, and columns, for a number of panels, at most `most` in a row."""
    columns = math.ceil(count / math.ceil(count / most))
    return math.ceil(count / columns), columns


def panels_of(parent: Figure | SubFigure, count: int, rows: int, columns: int, **options: Any) -> list[Axes]:
    """Return `count` panels in rows and columns of a figure; the others stay empty."""
    panels = parent.subplots(rows, columns, squeeze=False, **options).ravel()
    for axes in panels[count:]:
        axes.set_axis_off()
    return list(panels[:count])


def panel_grid(ax: Axes | Figure | None, count: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure, new or at ``ax``, with panels of a size [inches], and the axes in use."""
    rows, columns = grid_shape(count)
    figure = figure_at(ax, max(columns * width, 4.5), rows * height + 0.6)
    return figure, panels_of(figure, count, rows, columns)


def legend_below(figure: Figure, axes: Axes, most: int = 7, **style: Any) -> Legend:
    """Draw the legend of a panel below all panels of a figure, at most `most` labels in a row."""
    handles, labels = axes.get_legend_handles_labels()
    return figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), most), **style)


def finish_axes(axes: Axes, **properties: Any) -> None:
    """Set labels, limits and other properties of axes over a light grid."""
    axes.set(**properties)
    axes.grid(True, color="0.92", linewidth=0.6)


def draw_scale_bar(axes: Axes, length: float, label: str) -> None:
    """Draw a bar of a length in data units with its label at the lower left, after the limits are set."""
    x_low, x_high = axes.get_xlim()
    y_low, y_high = axes.get_ylim()
    x, y = x_low + 0.05 * (x_high - x_low), y_low + 0.05 * (y_high - y_low)
    axes.plot([x, x + length], [y, y], color="black", linewidth=1.8, solid_capstyle="butt")
    axes.annotate(label, (x, y), xytext=(0, 3), textcoords="offset points", fontsize=7.5, va="bottom")


def second_scale(axes: Axes, factor: float, label: str) -> None:
    """Draw a second horizontal axis above, in units of which `factor` make one of the axis below."""

    def convert(x: Any) -> Any:
        return x * factor

    def back(x: Any) -> Any:
        return x / factor

    axes.secondary_xaxis("top", functions=(convert, back)).set_xlabel(label, fontsize=8)


def draw_circle(
    axes: Axes, radius: float, color: str = "0.3", style: LineStyle = "-", label: str | None = None
) -> None:
    """Draw a circle about the origin."""
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0.0, 0.0), radius, fill=False, edgecolor=color, linewidth=0.8, linestyle=style, label=label))


def bare_frame(axes: Axes, half: float) -> None:
    """Set a square of a half-width about the origin, equal scales, a thin frame and no ticks."""
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("0.8")


def spread_in_field(fields: np.ndarray) -> bool:
    """Return whether field points suffice for a map: many, and not on a line."""
    centered = fields - fields.mean(axis=0)
    strengths = np.linalg.svd(centered, compute_uv=False)
    return len(fields) > FEW and bool(strengths[-1] > 1e-3 * strengths[0])


def draw_field_map(axes: Axes, places: np.ndarray, values: np.ndarray, **style: Any) -> TriMesh:
    """Draw values at places [n, 2] as a smooth map, and return the image for a colour bar."""
    from matplotlib.tri import Triangulation

    x, y = places.T
    finite = np.isfinite(values)
    image = axes.tripcolor(Triangulation(x[finite], y[finite]), values[finite], shading="gouraud", **style)
    axes.set_aspect("equal")
    return image
