"""The picture of ghosts: all of them on the detector, and the brightest ones in order."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ...core.plotting import RED, new_figure, styled
from ..drawing import draw_circle, field_label
from ..metrics.ghosts import Ghost, Ghosts

#: Ghosts that are drawn by themselves, and decades of irradiance that the map shows.
_ALONE, _DECADES = 8, 4.0


def ghosts_figure(result: Ghosts) -> Figure:
    """Draw the irradiance of all ghosts together over the detector [mm], and each of the brightest by itself."""
    with styled():
        figure = new_figure(11.6, 5.3)
        parts: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.12])
        left, right = parts
        _draw_map(left.subplots(), result)
        shown = result.ghosts[:_ALONE]
        panels = right.subplots(2, _ALONE // 2, squeeze=False).ravel()
        for axes in panels[len(shown) :]:
            axes.set_axis_off()
        for axes, ghost, magnitude in zip(panels, shown, result.magnitudes, strict=False):
            _draw_ghost(axes, ghost, float(magnitude))
        right.suptitle("the brightest: reflected at, and then at", fontsize=9.5)
        figure.suptitle(
            f"{result.telescope}: ghosts of a star at {field_label(result.field)}, {result.wavelength * 1e9:.4g} nm, "
            f"{100 * result.flux:.2g} % of its light (detector reflects {100 * result.detector_reflectivity:.3g} %)",
            fontsize=11,
        )
        return figure


def _draw_map(axes: Axes, result: Ghosts) -> None:
    light = result.irradiance * 1e-6
    edges = result.edges * 1e3
    top = float(light.max())
    if top > 0:
        shown: Any = axes.pcolormesh(
            edges, edges, np.maximum(light, 1e-300), norm=LogNorm(top * 10.0**-_DECADES, top), cmap="magma"
        )
        axes.set_facecolor("black")
        key = axes.figure.colorbar(shown, ax=axes, shrink=0.82, pad=0.02)
        key.set_label("part of the star's light per mm²")
    axes.plot(*(result.star * 1e3), "+", color="white", markersize=9.0, markeredgewidth=1.2)
    axes.annotate(
        "star",
        (result.star[0] * 1e3, result.star[1] * 1e3),
        xytext=(6, 5),
        textcoords="offset points",
        color="white",
        fontsize=8,
    )
    draw_circle(axes, result.image_radius * 1e3, color="0.75", style=(0, (4, 3)))
    axes.set(aspect="equal", xlim=(edges[0], edges[-1]), ylim=(edges[0], edges[-1]))
    axes.set(xlabel="detector x [mm]", ylabel="detector y [mm]")


def _draw_ghost(axes: Axes, ghost: Ghost, magnitude: float) -> None:
    light = np.where(ghost.irradiance > 0, ghost.irradiance, np.nan) * 1e-6
    x, y = ghost.edges * 1e3
    axes.pcolormesh(x, y, light, cmap="magma", vmin=0.0)
    axes.set_facecolor("black")
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("0.8")
    axes.set_title(f"{ghost.first}\n{ghost.second}", fontsize=8, color=RED)
    axes.set_xlabel(
        f"⌀ {ghost.diameter * 1e3:.3g} mm\nflux {ghost.flux:.2g}\n"
        f"peak {ghost.peak * 1e-6:.2g}/mm²\n{magnitude:.1f} mag/arcsec²",
        fontsize=7.5,
    )
