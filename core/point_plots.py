"""Pictures of points: places or other pairs of values, with a third one as their colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .plotting import BLUE, axes_at, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points of one picture, at most: of more, every second one or fewer are drawn.
_MOST = 20_000


def draw_points(
    ax: Axes | Figure | None,
    x: np.ndarray,
    y: np.ndarray,
    labels: tuple[str, str],
    *,
    color: np.ndarray | None = None,
    color_label: str = "",
    equal: bool = False,
    title: str = "",
) -> Figure:
    """Draw points, shape [n] each, in one colour or coloured by values with a colour bar.

    With `equal` the scales of both axes are the same. Values that are not finite are left out.
    """
    thinning = slice(None, None, max(1, -(-len(x) // _MOST)))
    with styled():
        figure, axes = axes_at(ax, 5.4, 4.6)
        if color is None:
            axes.plot(x[thinning], y[thinning], ".", color=BLUE, markersize=3)
        else:
            shown = axes.scatter(x[thinning], y[thinning], c=color[thinning], s=8, cmap="viridis")
            figure.colorbar(shown, ax=axes, label=color_label)
        axes.set(xlabel=labels[0], ylabel=labels[1], title=title)
        if equal:
            axes.set_aspect("equal", adjustable="datalim")
        return figure


def draw_shapes(
    ax: Axes | Figure | None,
    e1: np.ndarray,
    e2: np.ndarray,
    size: np.ndarray,
    size_label: str,
    title: str = "",
    labels: tuple[str, str] = ("e1", "e2"),
) -> Figure:
    """Draw ellipticities in their plane, coloured by the size."""
    return draw_points(ax, e1, e2, labels, color=size, color_label=size_label, equal=True, title=title)


def draw_bars(
    ax: Axes | Figure | None, names: list[str], values: np.ndarray, label: str, *, errors: np.ndarray | None = None
) -> Figure:
    """Draw values [n] as bars with their names below, and error bars where there are errors [n]."""
    with styled():
        figure, axes = axes_at(ax, max(4.0, 0.55 * len(names) + 2.0), 3.6)
        axes.bar(np.arange(len(names)), values, yerr=errors, color=BLUE, width=0.7, capsize=3)
        axes.axhline(0.0, color="0.4", linewidth=0.6)
        axes.set_xticks(np.arange(len(names)), names, rotation=30, ha="right")
        axes.set_ylabel(label)
        return figure
