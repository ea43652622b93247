"""The picture of chief and marginal rays: what they say, against the distance from the axis."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...core.plotting import BLUE, GREY, ORANGE, new_figure, styled
from ..metrics.principal_rays import PrincipalRays


def principal_rays_figure(result: PrincipalRays) -> Figure:
    """Draw focal ratio, plate scale, exit pupil and incidence against the distance from the axis [deg]."""
    radius = np.rad2deg(np.linalg.norm(result.fields, axis=-1))
    order = np.argsort(radius, kind="stable")
    scale = np.rad2deg(result.plate_scale) * 3600e-6
    pairs = [
        ("working focal ratio", result.f_number),
        ('plate scale ["/µm]', scale),
        ("exit pupil, from the detector [m]", result.exit_pupil_distance),
        ("diameter of the exit pupil [m]", result.exit_pupil_diameter),
    ]
    with styled():
        figure = new_figure(11.0, 6.4)
        panels = figure.subplots(2, 3, sharex=True).ravel()
        for axes, (label, values) in zip(panels, pairs, strict=False):
            axes.plot(radius[order], values[order, 0], ".-", color=BLUE, label="tangential")
            axes.plot(radius[order], values[order, 1], ".-", color=ORANGE, label="sagittal")
            axes.set_ylabel(label)
        panels[0].legend(loc="best")
        panels[4].plot(radius[order], np.rad2deg(result.chief_angle[order]), ".-", color=GREY)
        panels[4].set_ylabel("incidence of the chief ray [deg]")
        panels[5].set_axis_off()
        for axes in panels[:5]:
            axes.grid(True, color="0.92", linewidth=0.6)
            axes.ticklabel_format(useOffset=False)
        for axes in panels[2:5]:
            axes.set_xlabel("distance from the axis [deg]")
            axes.tick_params(labelbottom=True)
        figure.suptitle(f"{result.telescope}: chief and marginal rays, {result.wavelength * 1e9:.4g} nm", fontsize=11)
        return figure
