"""The picture of vignetting: a profile, and a map of the field of view."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import BLUE, figure_of, new_figure, styled
from ..drawing import draw_field_map, spread_in_field
from ..metrics.vignetting import Vignetting


def vignetting_figure(result: Vignetting) -> Figure:
    """Draw the light relative to the axis against the distance from it, and as a map where there are fields enough."""
    with_map = spread_in_field(result.fields)
    with styled():
        figure = new_figure(11.0 if with_map else 6.5, 4.6)
        panels = figure.subplots(1, 2 if with_map else 1, squeeze=False)[0]
        _draw_profile(panels[0], result)
        if with_map:
            _draw_map(panels[1], result)
        figure.suptitle(
            f"{result.telescope}: vignetting at {result.wavelength * 1e9:.4g} nm; "
            f"on the axis {100 * result.axis_fraction:.1f} % of the annular pupil is lit",
            fontsize=11,
        )
        return figure


def _draw_profile(axes: Axes, result: Vignetting) -> None:
    radius = np.rad2deg(np.linalg.norm(result.fields, axis=-1))
    percent = 100.0 * result.relative
    axes.errorbar(
        radius,
        percent,
        100.0 * result.error / result.axis_fraction,
        fmt=".",
        color=BLUE,
        ecolor="0.6",
        elinewidth=0.7,
        markersize=3.5,
        label="field points, with their errors",
    )
    rounded = np.round(radius, 6)
    rings = np.unique(rounded)
    if len(rings) < len(radius):
        axes.plot(rings, [percent[rounded == r].mean() for r in rings], color=BLUE, linewidth=1.3, label="mean")
    axes.axhline(100.0, color="0.6", linewidth=0.7)
    axes.set_xlim(left=0.0)
    axes.set_ylim(top=max(101.0, float(percent.max()) + 1.0))
    axes.set_xlabel("distance from the axis [deg]")
    axes.set_ylabel("light relative to the axis [%]")
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.legend(loc="lower left")


def _draw_map(axes: Axes, result: Vignetting) -> None:
    image = draw_field_map(axes, result.fields, 100.0 * result.relative, cmap="viridis")
    axes.set_xlabel("field x [deg]")
    axes.set_ylabel("field y [deg]")
    figure_of(axes).colorbar(image, ax=axes, fraction=0.046, pad=0.02).set_label("light relative to the axis [%]")
