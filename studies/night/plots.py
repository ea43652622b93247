"""Pictures of a night: maps of the sky, and correlation of the PSF and of what its models leave."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from ...core.number_text import counted
from ...core.plotting import new_figure, png_bytes, styled
from ...measure.correlation_plots import draw_correlation, log_axes
from ...measure.focal_plane_axes import AWAY, TRUTH
from .maps import NightMaps
from .residual_correlation import MeanCorrelation

_LABELS = {"truth": (TRUTH, "o", "noise-free PSFs"), "away": (AWAY, "^", "less the models, where no star is")}
_TITLES = ("rms width of the PSF [pixel]", "limiting magnitude (AB, S/N 5)", "visits")
_COLOURS = ("viridis", "cividis", "magma_r")
#: Place of the number of visits among the titles, which begins at zero.
_COUNTED = 2
#: Points of the grid on which a map is drawn, along its longer side.
_GRID = 480
#: Widest part of the sky [deg] that is drawn in a plane; a wider one by Hammer's equal-area projection.
_WIDEST_PLANE = 60.0
#: Height of a panel of the whole sky over that of a part of it.
_HEIGHT_OF_SKY = 0.55
#: Least side of a part of the sky [deg] on which a CCD would be too small to be seen, and has a dot.
_DOTTED = 10.0
#: Area of a dot [pt^2].
_DOT = 5.0
_MARGIN = 0.04
#: Least side of a panel over the other.
_FLATTEST = 0.5
#: Place of the colour bar beside a panel: left, bottom, width, height in units of the panel.
_BAR = (1.03, 0.0, 0.04, 1.0)
#: Relative difference of the values of a map up to which they are one number.
_ONE_VALUE = 1e-6


def maps_plot(maps: NightMaps) -> bytes:
    """Draw PSF width, depth and number of visits of each band; north is up, east at the left."""
    bands = {band: maps.pictured(band) for band in sorted(maps.bands)}
    grids = [_Grid(pictured[0]) for pictured in bands.values()]
    heights = [_HEIGHT_OF_SKY if grid.whole_sky else 1.0 for grid in grids]
    with styled():
        figure = new_figure(12.5, 3.9 * sum(heights))
        panels = figure.add_gridspec(len(bands), len(_TITLES), height_ratios=heights)
        for row, (grid, (band, pictured)) in enumerate(zip(grids, bands.items(), strict=True)):
            for column, (content, title, colours) in enumerate(zip(pictured, _TITLES, _COLOURS, strict=True)):
                axes = figure.add_subplot(panels[row, column], projection=grid.projection)
                valid = content[content.valid_pixels]
                scale = Normalize(0.0 if column == _COUNTED else valid.min(), valid.max())
                style: dict[str, Any] = {"cmap": colours, "norm": scale, "rasterized": True}
                if grid.dotted:
                    axes.scatter(*grid.dots, c=content[grid.dot_pixels], s=_DOT, linewidths=0.0, zorder=1.0, **style)
                image = axes.pcolormesh(*grid.mesh, grid.values(content), zorder=1.1, **style)
                _colour_bar(image, axes, counts=column == _COUNTED)
                axes.set_title(f"{band}: {title}", loc="left", fontsize=9)
                grid.label(axes)
        return png_bytes(figure)


def correlations_plot(means: Mapping[str, Mapping[str, MeanCorrelation]]) -> bytes:
    """Draw xi+ of g of each band against separation: filled symbols positive, open ones negative."""
    with styled():
        figure = new_figure(max(5.6, 4.2 * len(means)), 4.2)
        panels = figure.subplots(1, len(means), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (band, kinds) in zip(panels, means.items(), strict=True):
            for kind, correlation in kinds.items():
                draw_correlation(axes, correlation, "plus", *_LABELS[kind])
            visits = max(correlation.visits for correlation in kinds.values())
            log_axes(axes, f"{band}, {counted(visits, 'visit')}")
            axes.set_xlabel("separation [arcmin]")
        panels[0].set_ylabel("$|\\xi_+|$ of g, mean over visits")
        panels[0].legend(loc="best")
        return png_bytes(figure)


def _colour_bar(image: QuadMesh, axes: Axes, *, counts: bool) -> None:
    """Draw the colour bar of a map, as high as its panel: whole numbers for counts, one number for a map of one."""
    lowest, highest = image.get_clim()
    bar = axes.figure.colorbar(image, cax=axes.inset_axes(_BAR))
    if counts:
        bar.locator = MaxNLocator(nbins="auto", integer=True)
    elif highest - lowest <= _ONE_VALUE * abs(highest):
        bar.set_ticks([highest], labels=[f"{highest:.4g}"])
    else:
        bar.formatter = ScalarFormatter(useOffset=False)
    bar.update_ticks()


class _Grid:
    """Points of the sky at which the maps of a band are drawn."""

    def __init__(self, content: Any) -> None:
        ra, dec = content.valid_pixels_pos(lonlat=True)
        # About the mean direction, so that no field is cut at 0 h.
        east, north = np.deg2rad(ra), np.deg2rad(dec)
        mean_y, mean_x = (np.cos(north) * np.sin(east)).mean(), (np.cos(north) * np.cos(east)).mean()
        self.ra = float(np.rad2deg(np.arctan2(mean_y, mean_x)) % 360.0)
        offset = (np.asarray(ra) - self.ra + 180.0) % 360.0 - 180.0
        low, high = float(np.min(dec)), float(np.max(dec))
        self.whole_sky = max(float(np.ptp(offset)) * np.cos(np.deg2rad(0.5 * (low + high))), high - low) > _WIDEST_PLANE
        if self.whole_sky:
            self._offset, self._dec = np.linspace(-180.0, 180.0, 2 * _GRID), np.linspace(-90.0, 90.0, _GRID)
        else:
            margin = max(_MARGIN * (high - low), 0.02)
            degree = max(np.cos(np.deg2rad(0.5 * (low + high))), 0.02)  # of right ascension, on the sky
            width, height = degree * np.ptp(offset) + 2.0 * margin, high - low + 2.0 * margin
            least_side = _FLATTEST * max(width, height)
            across = (margin + 0.5 * max(least_side - width, 0.0)) / degree
            along = margin + 0.5 * max(least_side - height, 0.0)
            self._offset = np.linspace(offset.min() - across, offset.max() + across, _GRID)
            self._dec = np.linspace(max(low - along, -90.0), min(high + along, 90.0), _GRID)
        #: Whether a CCD is too small to be seen, and has a dot.
        self.dotted = max(float(np.ptp(self._offset)) * np.cos(north.mean()), high - low) > _DOTTED
        cells = [np.searchsorted(axis, at) for axis, at in ((self._offset, offset), (self._dec, dec))]
        first = np.unique(cells, axis=1, return_index=True)[1]
        self.dot_pixels = content.valid_pixels[first]  #: pixels that have a dot, one a cell
        self.dots = self._axes(offset[first], np.asarray(dec)[first])  #: their places on the axes

    @property
    def projection(self) -> str | None:
        return "hammer" if self.whole_sky else None

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Points of the grid on the axes."""
        return self._axes(self._offset, self._dec)

    def _axes(self, offset: np.ndarray, dec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return offsets in right ascension and declinations [deg] as the axes have them: east is at the left."""
        if self.whole_sky:
            return np.deg2rad(-offset), np.deg2rad(dec)
        return self.ra + offset, dec

    def values(self, content: Any) -> np.ndarray:
        """Return a map at the points, masked where it has nothing."""
        offset, dec = np.meshgrid(self._offset, self._dec)
        values = np.asarray(content.get_values_pos((self.ra + offset) % 360.0, dec, lonlat=True), dtype=np.float64)
        return np.ma.masked_where(~np.isfinite(values) | (values == content.sentinel), values)

    def label(self, axes: Axes) -> None:
        """Name the axes, and turn them as the sky is seen."""
        axes.grid(True, color="0.85", linewidth=0.5)
        if self.whole_sky:
            hours = [(self.ra - offset) % 360.0 for offset in range(-150, 151, 30)]
            axes.set_xticklabels([f"{value:.0f}°" for value in hours], fontsize=6)
            axes.set_yticks(np.deg2rad([-60.0, -30.0, 0.0, 30.0, 60.0]))
            return
        axes.set(xlabel="right ascension [deg]", ylabel="declination [deg]")
        axes.set_xlim(self.ra + self._offset[-1], self.ra + self._offset[0])
        axes.xaxis.set_major_formatter(lambda ra, _: f"{round(ra, 6) % 360.0:g}")  # of a field about 0 h
        axes.set_aspect(1.0 / max(np.cos(np.deg2rad(self._dec.mean())), 0.02))
