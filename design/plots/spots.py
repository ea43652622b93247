"""The picture of spot diagrams: a panel for each field, all on one scale."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import BLUE, RED, styled
from ..drawing import (
    bare_frame,
    draw_circle,
    draw_scale_bar,
    field_label,
    panel_grid,
    round_length,
    wavelength_colors,
)
from ..metrics.spots import SpotDiagram

#: The frame reaches no farther than so many times the radius of 80 % of the rays: stray rays would hide the spots.
_FARTHEST = 5.0
#: Dots in one panel beyond which every second, third... ray is left out of the picture.
_DOTS = 6000


def spots_figure(spots: SpotDiagram) -> Figure:
    """Draw spots about their centroids [um], with the Airy disc and the circle that holds 80 % of the rays."""
    share = spots.radius_holding(0.8)
    light = np.nanmax(spots.geometric_radius, initial=0.0), _FARTHEST * np.nanmax(share, initial=0.0)
    half = 1.08e6 * max(float(min(light)), float(np.nanmax(spots.airy_radius, initial=1e-9)))
    with styled():
        figure, panels = panel_grid(len(spots.fields), 2.5, 3.0)
        for i, axes in enumerate(panels):
            _draw_spot(axes, spots, i, half, share[i])
        bar = round_length(0.7 * half)
        arcsec = bar * 1e-6 * float(np.rad2deg(spots.plate_scale[0])) * 3600.0
        draw_scale_bar(panels[0], bar, f'{bar:g} µm = {arcsec:.3g}"')
        handles, labels = panels[0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7), markerscale=3.0)
        for handle in filter(None, legend.legend_handles):
            handle.set_alpha(1.0)
        figure.suptitle(f"{spots.telescope}: spots about the centroid", fontsize=11)
        return figure


def _draw_spot(axes: Axes, spots: SpotDiagram, i: int, half: float, share: float) -> None:
    centered = (spots.displacement[i] - spots.centroid[i]) * 1e6
    names = [f"{w * 1e9:.4g} nm" for w in spots.wavelengths]
    colors = wavelength_colors(len(names)) if len(names) > 1 else [BLUE]
    step = -(-spots.weight[i].size // _DOTS)
    for xy, weight, name, color in zip(centered, spots.weight[i], names, colors, strict=True):
        lit = np.flatnonzero(weight > 0)[::step]
        axes.plot(*xy[lit].T, ".", markersize=1.6, markeredgewidth=0.0, color=color, alpha=0.7, label=name)
    draw_circle(axes, spots.airy_radius[i] * 1e6, color="black", style="-", label="Airy disc")
    draw_circle(axes, share * 1e6, color=RED, style=(0, (4, 2)), label="80 % of the rays")
    bare_frame(axes, half)
    scale = float(np.rad2deg(spots.plate_scale[i])) * 3600.0
    rms = spots.rms_radius[i]
    text = f'rms {rms * 1e6:.3g} µm = {rms * scale:.3g}"\n80 % {share * 1e6:.3g} µm = {share * scale:.3g}"'
    if not np.isfinite(rms):
        text = "no light arrives"
    elif spots.lit_fraction[i] < 0.995:
        text += f"\nlit {100 * spots.lit_fraction[i]:.1f} % of the pupil"
    beyond = float(spots.weight[i][np.abs(centered).max(axis=-1) > half].sum())
    if beyond > 0:
        text += f"\n{100 * beyond / spots.lit_fraction[i]:.2g} % of the rays beyond the frame"
    axes.set_title(field_label(spots.fields[i]), fontsize=9.5)
    axes.set_xlabel(text, fontsize=7.5)
