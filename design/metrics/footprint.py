"""Footprints: the patch of a surface that the light of a field point fills, beside the surface's clear aperture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import DomainError
from ...models.surface import Surface
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus, field_direction, launch_bundles
from ...raytrace.trace import trace
from ...wavefront.pupil_sampling import PupilSampling, pupil_sampling
from ...wavefront.request import field_points, wavelength_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Points of an outline, and how far inside the annulus they lie, in units of its radius: a ray through the very rim is
#: blocked or not by rounding.
_RIM, _INSIDE = 181, 1e-6


@dataclass(frozen=True)
class SurfaceFootprint:
    """Footprints of several field points on one surface, in the surface's own x and y.

    Attributes
    ----------
    surface : Surface
        The surface.
    outlines : ndarray, shape [n_field, 2, n_rim, 2]
        Where the outer and the inner rim of the entrance pupil lie on the surface [m], blocked or not. The inner rim
        is NaN where there is no obscuration.
    outline_arriving : ndarray of bool, shape [n_field, 2, n_rim]
        Rays of the rims that no earlier surface has blocked.
    position : ndarray, shape [n_field, n_pupil, 2]
        Where the rays meet the surface [m].
    arriving : ndarray of bool, shape [n_field, n_pupil]
        Rays that no earlier surface has blocked.
    passing : ndarray of bool, shape [n_field, n_pupil]
        Those of them that this surface lets pass.
    weights : ndarray, shape [n_pupil]
        What each ray stands for; they sum to 1.
    """

    surface: Surface
    outlines: np.ndarray
    outline_arriving: np.ndarray
    position: np.ndarray
    arriving: np.ndarray
    passing: np.ndarray
    weights: np.ndarray

    @property
    def blocked_fraction(self) -> np.ndarray:
        """Part of the pupil that this surface is the first to block, shape [n_field]."""
        return (self.arriving & ~self.passing) @ self.weights

    @property
    def largest_radius(self) -> np.ndarray:
        """Largest distance of arriving light from the vertex [m], shape [n_field]; NaN where none arrives."""
        radius = np.linalg.norm(self.arriving_points(), axis=-1)
        largest = np.where(np.isfinite(radius), radius, -np.inf).max(axis=1)
        return np.where(largest >= 0, largest, np.nan)

    def arriving_points(self) -> np.ndarray:
        """Return where the rays that arrive, rims included, meet the surface [m]: [n_field, n, 2], NaN for others."""
        points = np.concatenate([self.outlines.reshape(len(self.outlines), -1, 2), self.position], axis=1)
        arriving = np.concatenate([self.outline_arriving.reshape(len(self.outlines), -1), self.arriving], axis=1)
        return np.where(arriving[..., None], points, np.nan)


@dataclass(frozen=True)
class Footprint:
    """Footprints of several field points on several surfaces.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    surfaces : tuple of SurfaceFootprint
        One for each surface asked for.
    """

    telescope: str
    fields: np.ndarray
    wavelength: float
    surfaces: tuple[SurfaceFootprint, ...]

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; lists run over the fields."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "field_deg": np.rad2deg(self.fields),
            "surfaces": [
                {
                    "name": s.surface.name,
                    "largest_radius_mm": s.largest_radius * 1e3,
                    "blocked_fraction": s.blocked_fraction,
                    "arriving_fraction": s.arriving @ s.weights,
                }
                for s in self.surfaces
            ],
        }

    def plot(self) -> Figure:
        """Draw a panel for each surface: outlines of the footprints over the clear aperture."""
        from ..plots.footprint import footprint_figure

        return footprint_figure(self)


def footprint(
    telescope: Telescope,
    surfaces: str | Sequence[str] | None = None,
    fields: Any = None,
    wavelength: Any = None,
    *,
    sampling: str | PupilSampling = "rings",
    projection: str = "zemax",
    threads: int | None = None,
) -> Footprint:
    """Trace the footprints of field points on surfaces.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    surfaces : str or sequence of str, optional
        Names of surfaces; all of them by default.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; five from the axis to the edge by default.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's own by default.
    sampling : {"gauss", "rings", "spiral", "square"} or PupilSampling
        Points of the pupil whose rays tell what is blocked.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    UnknownNameError
        If no surface has such a name.
    DomainError
        If no surface is named, or fields or wavelength are out of range.
    """
    names = [surfaces] if isinstance(surfaces, str) else list(telescope.surface_names if surfaces is None else surfaces)
    if not names:
        raise DomainError("surfaces = []: expected the name of a surface at least")
    wanted = [telescope.surface_names.index(telescope.surface(name).name) for name in names]
    points = field_points(telescope, fields)
    (w,) = wavelength_points(telescope, wavelength)
    pupil = pupil_sampling(telescope, sampling)
    angle = np.linspace(0.0, 2.0 * np.pi, _RIM)
    circle = 0.5 * telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    hole = telescope.pupil_obscuration + _INSIDE if telescope.pupil_obscuration else np.nan
    everything = np.concatenate([(1.0 - _INSIDE) * circle, hole * circle, pupil.points])
    directions = field_direction(points[:, 0], points[:, 1], projection)
    results = trace(telescope, launch_bundles(telescope, directions, float(w), everything), "all", threads=threads)
    footprints = []
    for i in wanted:
        surface = telescope.surfaces[i]
        position = surface.to_local(results[i].position).reshape(len(points), -1, 3)[:, :, :2]
        before = results[i - 1].status if i else np.zeros_like(results[i].status)
        arriving, passing = ((s == RayStatus.OK).reshape(len(points), -1) for s in (before, results[i].status))
        footprints.append(
            SurfaceFootprint(
                surface=surface,
                outlines=position[:, : 2 * _RIM].reshape(len(points), 2, _RIM, 2),
                outline_arriving=(arriving[:, : 2 * _RIM]).reshape(len(points), 2, _RIM),
                position=position[:, 2 * _RIM :],
                arriving=arriving[:, 2 * _RIM :],
                passing=passing[:, 2 * _RIM :],
                weights=pupil.weights,
            )
        )
    return Footprint(telescope.name, points, float(w), tuple(footprints))
