"""Plot of measured heights: the focal plane with the CCDs of each vendor, and the distributions of their heights."""

from __future__ import annotations

from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ...core.number_text import counted
from ...core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, new_figure, plain_text, styled
from ...measure.focal_plane_axes import draw_outlines, frame_axes
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.height_statistics import height_statistics, sampled_heights

_COLOURS = (RED, BLUE, ORANGE, PURPLE, GREY)
# Pixels of the map along a side.
_SAMPLES = 700
# Widths of the heights of a CCD up to which there is a bin for each micrometre [um].
_WIDTHS = 59.0
# Percentile of |height| at the ends of the scale of the map: a few corners go far beyond.
_SCALE = 99.0


def vendor_heights_plot(focal_plane: FocalPlane, title: str) -> Figure:
    """Draw heights as a map with the borders between vendors, and their distributions by vendor."""
    camera = focal_plane.camera
    groups = {v: np.array([w == v for w in camera.vendors]) for v in dict.fromkeys(camera.vendors)}
    groups = groups or {"all": np.ones(len(camera), dtype=bool)}
    heights = 1e6 * sampled_heights(focal_plane)[2]
    colours = dict(zip(groups, cycle(_COLOURS), strict=False))
    with styled():
        figure = new_figure(11.6, 6.6)
        panels: dict[str, Axes] = figure.subplot_mosaic([["map", "all"], ["map", "within"]], width_ratios=[1.75, 1.0])
        axes, upper, lower = panels["map"], panels["all"], panels["within"]
        _draw_map(axes, focal_plane, float(np.nanpercentile(np.abs(heights), _SCALE)))
        if camera.vendors:
            _draw_borders(axes, camera)
        axes.set_title(plain_text(title))
        statistics = height_statistics(focal_plane)
        edge = max(float(np.ceil(np.nanpercentile(np.abs(heights), 99.8))), 1.0)
        widths = np.ptp(np.nanpercentile(heights, (2.5, 97.5), axis=1), axis=0)
        # Micrometres, or as many as reach to the widest.
        width_bins = list(np.linspace(0.0, max(_WIDTHS, float(np.nanmax(widths))), round(_WIDTHS) + 1))
        for name, of in groups.items():
            row, colour = statistics[name], colours[name]
            label = f"{name.upper()}: {counted(row.n_ccd, 'CCD')}, rms {row.rms * 1e6:.1f} µm"
            bins = list(np.linspace(-edge, edge, 81))
            upper.hist(heights[of].ravel(), bins, density=True, histtype="step", color=colour, lw=1.4, label=label)
            label = f"{name.upper()}: median {np.median(widths[of]):.1f} µm"
            lower.hist(widths[of], width_bins, histtype="step", color=colour, lw=1.4, label=label)
        upper.set(xlabel="height [µm]", ylabel="density [1/µm]", xlim=(-edge, edge))
        lower.set(xlabel="middle 95 % of the heights of a CCD [µm]", ylabel="CCDs")
        lower.set_xlim(0.0, max(1.05 * float(np.nanmax(widths)), 1.0))
        for panel in (upper, lower):
            panel.margins(y=0.25)
            panel.autoscale(axis="y")
            panel.legend(loc="upper right")
        return figure


def _draw_map(axes: Axes, focal_plane: FocalPlane, bound: float) -> None:
    camera = focal_plane.camera
    edge = 1.03 * camera.reach
    axis = np.linspace(-edge, edge, _SAMPLES)
    x, y = np.meshgrid(axis, axis)
    extent = (-1e3 * edge, 1e3 * edge, -1e3 * edge, 1e3 * edge)
    height = np.where(focal_plane.measured_at(x, y), 1e6 * focal_plane.height(x, y), np.nan)
    on_ccd = np.where(focal_plane.ccd_at(x, y) >= 0, 0.8, np.nan)
    axes.imshow(on_ccd, extent=extent, cmap="gray", vmin=0.0, vmax=1.0)
    image = axes.imshow(height, extent=extent, cmap="RdBu_r", vmin=-bound, vmax=bound)
    draw_outlines(axes, camera, range(len(camera)), "0.5", 0.3)
    frame_axes(axes, extent)
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.045, pad=0.02, extend="both")
    bar.set_label("height along +z of the detector [µm]")


def _draw_borders(axes: Axes, camera: Camera) -> None:
    """Draw the borders between rafts of different vendors, and write the vendors' names."""
    vendor = dict(zip(camera.raft_of, camera.vendors, strict=True))
    centers = {raft: camera.centers[[r == raft for r in camera.raft_of]].mean(axis=0) * 1e3 for raft in vendor}
    pitch = (
        min(np.hypot(*(a - b)) for r, a in centers.items() for s, b in centers.items() if r != s)
        if len(centers) > 1
        else 0.0
    )
    lines = []
    for raft, center in centers.items():
        axes.annotate(f"{raft} {vendor[raft].upper()}", center, ha="center", va="center", fontsize=6.5, color="0.15")
        for neighbour, neighbour_center in centers.items():
            if vendor[raft] < vendor[neighbour] and np.hypot(*(center - neighbour_center)) < 1.01 * pitch:
                middle, along = 0.5 * (center + neighbour_center), 0.5 * (neighbour_center - center)[::-1]
                lines.append(np.stack([middle - along, middle + along]))
    axes.add_collection(LineCollection(lines, colors="black", linewidths=2.0))
