"""Footprints: patches of the surfaces that the light of field points fills, with their clear apertures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import RED, plain_text, styled
from ...models.surface import Surface
from ...models.telescope import Telescope
from ...raytrace.rays import Projection, RayStatus
from ...raytrace.trace import trace
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..drawing import FEW, Color, field_colors, panel_grid
from ..result import FieldResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points of an outline.
_RIM = 181
#: Distance of outlines from the rims of the annulus in units of its radius: rounding decides whether a ray through the
#: very rim is blocked.
_INSIDE = 1e-6
#: Points across the image of a clear aperture.
_ACROSS = 700


@dataclass(frozen=True)
class SurfaceFootprint:
    """Footprints of several field points on one surface, in the surface's own x and y.

    Outlines are the outer and inner rim of the entrance pupil, blocked or not; the inner rim is NaN where there is no
    obscuration. A ray arrives if no earlier surface has blocked it, and passes if this one does not block it either.
    """

    surface: Surface
    outlines: np.ndarray  #: [n_field, 2, n_rim, 2] intersections of the rims with the surface, m
    outline_arriving: np.ndarray  #: [n_field, 2, n_rim] bool
    position: np.ndarray  #: [n_field, n_pupil, 2] intersections of the rays with the surface, m
    arriving: np.ndarray  #: [n_field, n_pupil] bool
    passing: np.ndarray  #: [n_field, n_pupil] bool
    weights: np.ndarray  #: [n_pupil] fraction of the pupil for each ray; they sum to 1

    @property
    def name(self) -> str:
        """Name of the surface."""
        return self.surface.name

    @property
    def blocked_fraction(self) -> np.ndarray:
        """Fraction of the pupil that this surface is the first to block, shape [n_field]."""
        return (self.arriving & ~self.passing) @ self.weights

    @property
    def largest_radius(self) -> np.ndarray:
        """Largest distance of arriving light from the vertex [m], shape [n_field]; NaN where none arrives."""
        radius = np.linalg.norm(self.arriving_points(), axis=-1)
        largest = np.where(np.isfinite(radius), radius, -np.inf).max(axis=1)
        return np.where(largest >= 0, largest, np.nan)

    def arriving_points(self) -> np.ndarray:
        """Return the intersections of arriving rays, rims included [m], shape [n_field, n, 2]; NaN for others."""
        points = np.concatenate([self.outlines.reshape(len(self.outlines), -1, 2), self.position], axis=1)
        arriving = np.concatenate([self.outline_arriving.reshape(len(self.outlines), -1), self.arriving], axis=1)
        return np.where(arriving[..., None], points, np.nan)


@dataclass(frozen=True)
class Footprint(FieldResult):
    """Footprints of several field points on several surfaces.

    Attributes
    ----------
    surfaces : tuple of SurfaceFootprint
        One for each surface.
    """

    _table = ("name", "largest_radius", "blocked_fraction")
    _row_type = SurfaceFootprint

    surfaces: tuple[SurfaceFootprint, ...]

    def _columns(self) -> dict[str, Any]:
        return {name: np.array([getattr(s, name) for s in self.surfaces]) for name in self._table}

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            **self.field_items(),
            "surfaces": [
                {
                    "name": s.name,
                    "largest_radius_mm": s.largest_radius * 1e3,
                    "blocked_fraction": s.blocked_fraction,
                    "arriving_fraction": s.arriving @ s.weights,
                }
                for s in self.surfaces
            ],
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw a panel for each surface: outlines of the footprints over the clear aperture."""
        colors = field_colors(len(self.fields))
        with styled():
            large = len(self.surfaces) == 1
            figure, panels = panel_grid(ax, len(self.surfaces), *((6.0, 5.6) if large else (2.9, 3.0)))
            for axes, footprint in zip(panels, self.surfaces, strict=True):
                _draw_surface(axes, footprint, colors, self.field_labels())
            panels[0].plot([], [], ".", color=RED, markersize=6.0, label="blocked here first")
            handles, labels = panels[0].get_legend_handles_labels()
            if len(self.fields) > FEW:
                handles, labels = handles[-1:], labels[-1:]
            figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
            return self._titled(figure, "footprints [mm]")


@check_arguments
def footprint(
    telescope: Telescope | Request,
    surfaces: str | Sequence[str] | None = None,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    sampling: SamplingName | PupilSampling = "rings",
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> Footprint:
    """Trace the footprints of field points on surfaces.

    Parameters
    ----------
    telescope, fields, wavelength, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`.
    surfaces : str or sequence of str, optional
        Names of surfaces; all of them by default.

    Raises
    ------
    UnknownNameError
        If no surface has such a name.
    DomainError
        If no surface is named.
    """
    request = Request.of(
        telescope,
        fields,
        wavelength,
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
        one_wavelength=True,
    )
    telescope, threads = request.telescope, request.threads
    names = [surfaces] if isinstance(surfaces, str) else list(telescope.surface_names if surfaces is None else surfaces)
    if not names:
        raise DomainError("surfaces = []: expected the name of a surface at least")
    surface_indices = [telescope.surface_names.index(telescope.surface(name).name) for name in names]
    n_field = len(request.fields)
    angle = np.linspace(0.0, 2.0 * np.pi, _RIM)
    circle = 0.5 * telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    hole = telescope.pupil_obscuration + _INSIDE if telescope.pupil_obscuration else np.nan
    pupil_points = np.concatenate([(1.0 - _INSIDE) * circle, hole * circle, request.pupil.points])
    results = trace(telescope, request.launch(request.wavelength, pupil_points), "all", threads=threads)
    footprints = []
    for i in surface_indices:
        surface = telescope.surfaces[i]
        position = surface.to_local(results[i].position).reshape(n_field, -1, 3)[:, :, :2]
        before = results[i - 1].status if i else np.zeros_like(results[i].status)
        arriving, passing = ((s == RayStatus.OK).reshape(n_field, -1) for s in (before, results[i].status))
        footprints.append(
            SurfaceFootprint(
                surface=surface,
                outlines=position[:, : 2 * _RIM].reshape(n_field, 2, _RIM, 2),
                outline_arriving=arriving[:, : 2 * _RIM].reshape(n_field, 2, _RIM),
                position=position[:, 2 * _RIM :],
                arriving=arriving[:, 2 * _RIM :],
                passing=passing[:, 2 * _RIM :],
                weights=request.pupil.weights,
            )
        )
    return Footprint(request, tuple(footprints))


def _frame(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre and half-width [m] of a panel: about the vertex, unless light stays far away from it."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    if np.linalg.norm(middle) > 2.0 * half:
        return middle, 1.15 * half
    return np.zeros(2), 1.15 * float(np.abs([low, high]).max())


def _draw_surface(axes: Axes, footprint: SurfaceFootprint, colors: list[Color], names: list[str]) -> None:
    from matplotlib.colors import ListedColormap

    surface = footprint.surface
    arrivals = footprint.arriving_points().reshape(-1, 2)
    arrivals = arrivals[np.isfinite(arrivals).all(axis=-1)]
    if not len(arrivals):
        axes.set_title(f"{plain_text(surface.name)}: no ray arrives", loc="left")
        axes.set_axis_off()
        return
    middle, half = _frame(arrivals)
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
            # A focus is too small for its outline.
            axes.plot(*light.mean(axis=0) * 1e3, ".", color=color, markersize=3.0)
        blocked = footprint.arriving[i] & ~footprint.passing[i]
        axes.plot(*footprint.position[i, blocked].T * 1e3, ".", color=RED, markersize=1.6, markeredgewidth=0.0)
    axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    axes.tick_params(labelsize=7)
    worst = float(footprint.blocked_fraction.max())
    if worst > 0:
        axes.set_xlabel(f"blocks up to {100 * worst:.2g} %", fontsize=8, color=RED)
    axes.set_title(plain_text(surface.name), loc="left", fontsize=9)
