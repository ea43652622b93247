"""The picture of encircled energy: the curves, and the radii of some shares against the field."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import BLUE, ORANGE, RED, new_figure, styled
from ..drawing import FEW, field_colors, field_label, second_scale
from ..images.encircled_energy import EncircledEnergy


def encircled_energy_figure(result: EncircledEnergy) -> Figure:
    """Draw the share of the light within a radius for each field, and the radii of 50, 80 and 90 %."""
    with styled():
        figure = new_figure(10.0, 4.2)
        left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
        _draw_curves(left, result)
        _draw_shares(right, result)
        kind = "with diffraction" if result.kind == "diffraction" else "of rays alone"
        waves = ", ".join(f"{w * 1e9:.4g}" for w in result.wavelengths)
        figure.suptitle(f"{result.telescope}: encircled energy {kind}, {waves} nm", fontsize=11)
        return figure


def _draw_curves(axes: Axes, result: EncircledEnergy) -> None:
    few = len(result.fields) <= FEW
    colors = field_colors(len(result.fields))
    for field, row, color in zip(result.fields, result.fraction, colors, strict=True):
        axes.plot(result.radius * 1e6, row, color=color, linewidth=1.3, label=field_label(field) if few else None)
    for share in (0.5, 0.8):
        axes.axhline(share, color="0.6", linewidth=0.7, linestyle=(0, (4, 3)))
        axes.annotate(f"{100 * share:.0f} %", (1.0, share), xycoords=("axes fraction", "data"), xytext=(-3, 2),
                      textcoords="offset points", ha="right", fontsize=7.5, color="0.4")  # fmt: skip
    # Where the light of every field has come in, the rest is a flat line.
    full = np.flatnonzero((result.fraction >= 0.985).all(axis=0))
    edge = result.radius[full[0]] if len(full) else result.radius[-1]
    axes.set(xlim=(0.0, max(edge, 0.25 * result.radius[-1]) * 1e6), ylim=(0.0, 1.02))
    axes.set_xlabel("radius about the centroid of the rays [µm]")
    axes.set_ylabel("share of the light within")
    axes.grid(True, color="0.92", linewidth=0.6)
    second_scale(axes, float(np.rad2deg(result.plate_scale[0])) * 3600e-6, "arc seconds")
    if few:
        axes.legend(loc="lower right")


def _draw_shares(axes: Axes, result: EncircledEnergy) -> None:
    away = np.rad2deg(np.linalg.norm(result.fields, axis=-1))
    order = np.argsort(away, kind="stable")
    scale = np.rad2deg(result.plate_scale) * 3600.0
    for share, color in ((0.9, ORANGE), (0.8, RED), (0.5, BLUE)):
        radius = result.radius_holding(share) * scale
        axes.plot(
            away[order], radius[order], "o-", color=color, markersize=3.5, linewidth=1.2, label=f"{100 * share:.0f} %"
        )
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("distance from the axis [deg]")
    axes.set_ylabel("radius that holds the share [arcsec]")
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.legend(loc="best", ncols=3)
