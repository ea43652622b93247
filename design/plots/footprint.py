"""The picture of footprints: outlines over the clear aperture, a panel for each surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from ...core.plotting import RED, styled
from ..drawing import FEW, field_colors, field_label, panel_grid
from ..metrics.footprint import Footprint, SurfaceFootprint

#: Points across the picture of a clear aperture.
_ACROSS = 700


def footprint_figure(result: Footprint) -> Figure:
    """Draw the rims of the pupil as they lie on each surface [mm], faint where an earlier surface has blocked them.

    What the surface's aperture blocks is grey, rays that it is the first to block are red.
    """
    colors = field_colors(len(result.fields))
    with styled():
        large = len(result.surfaces) == 1
        figure, panels = panel_grid(len(result.surfaces), *((6.0, 5.6) if large else (2.9, 3.0)))
        for axes, footprint in zip(panels, result.surfaces, strict=True):
            _draw_surface(axes, footprint, colors, [field_label(f) for f in result.fields])
        panels[0].plot([], [], ".", color=RED, markersize=6.0, label="blocked here first")
        handles, labels = panels[0].get_legend_handles_labels()
        if len(result.fields) > FEW:
            handles, labels = handles[-1:], labels[-1:]
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        figure.suptitle(f"{result.telescope}: footprints [mm]", fontsize=11)
        return figure


def _frame(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return middle and half-width [m] of a picture: about the vertex, unless light keeps far away from it."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    if np.linalg.norm(middle) > 2.0 * half:
        return middle, 1.15 * half
    return np.zeros(2), 1.15 * float(np.abs([low, high]).max())


def _draw_surface(axes: Axes, footprint: SurfaceFootprint, colors: list[Any], names: list[str]) -> None:
    surface = footprint.surface
    known = footprint.arriving_points().reshape(-1, 2)
    known = known[np.isfinite(known).all(axis=-1)]
    if not len(known):
        axes.set_title(f"{surface.name}: no ray arrives", loc="left")
        axes.set_axis_off()
        return
    middle, half = _frame(known)
    x, y = (np.linspace(c - half, c + half, _ACROSS) for c in middle)
    extent = tuple(1e3 * v for v in (x[0], x[-1], y[0], y[-1]))
    if surface.aperture is not None:
        clear = np.asarray(surface.aperture.contains(*np.meshgrid(x, y)))
        axes.imshow(clear, extent=extent, cmap=ListedColormap(["0.8", "1.0"]), vmin=0, vmax=1, aspect="equal")
    for i, (rims, color, name) in enumerate(zip(footprint.outlines, colors, names, strict=True)):
        for k, (rim, arriving) in enumerate(zip(rims, footprint.outline_arriving[i], strict=True)):
            axes.plot(*rim.T * 1e3, color=color, linewidth=0.6, alpha=0.3)
            lit = np.where(arriving[:, None], rim, np.nan) * 1e3
            axes.plot(*lit.T, color=color, linewidth=1.2, label=name if k == 0 else None)
        light = footprint.position[i, footprint.arriving[i]]
        if len(light) and np.ptp(light, axis=0).max() < 0.02 * half:
            # A focus would not be seen without.
            axes.plot(*light.mean(axis=0) * 1e3, ".", color=color, markersize=3.0)
        blocked = footprint.arriving[i] & ~footprint.passing[i]
        axes.plot(*footprint.position[i, blocked].T * 1e3, ".", color=RED, markersize=1.6, markeredgewidth=0.0)
    axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    axes.tick_params(labelsize=7)
    worst = float(footprint.blocked_fraction.max())
    if worst > 0:
        axes.set_xlabel(f"blocks up to {100 * worst:.2g} %", fontsize=8, color=RED)
    axes.set_title(surface.name, loc="left", fontsize=9)
