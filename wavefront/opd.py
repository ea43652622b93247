"""Optical path difference of a telescope at one field point and wavelength."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import ConfigError, DomainError
from ..core.units import metres, radians
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.pack.surfaces import refractive_indices
from ..raytrace.rays import RayStatus, field_direction, launch_rays
from ..raytrace.trace import trace
from .reference_sphere import distance_to_sphere, reference_spheres

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .zernike import ZernikeFit


@dataclass(frozen=True)
class OpdMap:
    """Optical path difference over the entrance pupil.

    Attributes
    ----------
    value : ndarray
        Path of the reference ray minus path of the ray [m], to the reference sphere; positive where the wavefront
        leads. NaN where no light passes. Shape of the pupil coordinates.
    x, y : ndarray
        Entrance-pupil coordinates [m], same shape.
    lit : ndarray of bool
        Where light passes, same shape.
    wavelength : float
        Vacuum wavelength [m].
    field : tuple of float
        Field angles [rad].
    center : ndarray, shape [3]
        Centre of the reference sphere, telescope frame [m].
    radius : float
        Radius of the reference sphere [m].
    exit_direction : ndarray, shape [..., 3]
        Directions of the rays at the image, telescope frame; the first two are the exit-pupil coordinates that
        diffraction knows.
    landing : ndarray, shape [..., 3]
        Where the rays meet the image surface, telescope frame [m].
    """

    value: np.ndarray
    x: np.ndarray
    y: np.ndarray
    lit: np.ndarray
    wavelength: float
    field: tuple[float, float]
    center: np.ndarray
    radius: float
    exit_direction: np.ndarray
    landing: np.ndarray

    @property
    def waves(self) -> np.ndarray:
        """The map in waves at its own wavelength."""
        return self.value / self.wavelength

    @property
    def rms(self) -> float:
        """Root mean square over the lit points, piston removed [m]."""
        return float(np.std(self.value[self.lit]))

    @property
    def peak_to_valley(self) -> float:
        """Highest minus lowest value over the lit points [m]."""
        return float(np.ptp(self.value[self.lit]))

    @property
    def without_tilt(self) -> np.ndarray:
        """The map [m] less the piston and the tilts that fit its lit points best."""
        if not self.lit.any():
            raise DomainError(f"field = {self.field}: no light passes; expected a lit pupil")
        plane = np.stack([np.ones_like(self.x), self.x, self.y], axis=-1)
        terms, *_ = np.linalg.lstsq(plane[self.lit], self.value[self.lit], rcond=None)
        return self.value - plane @ terms

    def plot(self, zernikes: ZernikeFit | None = None, name: str = "") -> Figure:
        """Draw the map, which must be on a square grid, with and without piston and tilt.

        Parameters
        ----------
        zernikes : ZernikeFit, optional
            Zernike terms to draw as bars below.
        name : str
            Name of the telescope, for the title.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from .opd_plot import opd_figure

        return opd_figure(self, zernikes, name)


def pupil_grid(diameter: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres of n x n cells that tile the square about the entrance pupil, [y, x] order [m]."""
    if int(n) != n or n < 2:
        raise DomainError(f"grid = {n!r}: expected a whole number of at least 2 points across the pupil")
    u = ((np.arange(int(n)) + 0.5) / int(n) - 0.5) * diameter
    x, y = np.meshgrid(u, u)
    return x, y


def pupil_points(
    telescope: Telescope, pupil: tuple[Any, Any] | None, grid: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return entrance-pupil coordinates [m] as given, or those of a square grid, of 64 cells if neither is given.

    Raises
    ------
    ConfigError
        If both are given.
    """
    if pupil is not None and grid is not None:
        raise ConfigError("pupil and grid are both given: expected one of them")
    if pupil is None:
        return pupil_grid(telescope.pupil_diameter, 64 if grid is None else grid)
    x, y = (np.array(v) for v in np.broadcast_arrays(metres(pupil[0], "pupil x"), metres(pupil[1], "pupil y")))
    return x, y


def sphere_radius_of(telescope: Telescope, sphere_radius: Any) -> float:
    """Return the radius of the reference sphere [m]: the one given, or the telescope's own."""
    if sphere_radius is None:
        return telescope.reference_sphere_radius
    radius = float(metres(sphere_radius, "sphere_radius"))
    if not radius > 0:
        raise DomainError(f"sphere_radius = {sphere_radius!r}: expected a positive length in metres")
    return radius


def wavefront_opd(
    telescope: Telescope,
    field: tuple[Any, Any],
    wavelength: Any,
    pupil: tuple[Any, Any] | None = None,
    projection: str = "zemax",
    reference: str = "chief",
    focal_plane: FocalPlane | None = None,
    *,
    grid: int | None = None,
    sphere_radius: Any = None,
    threads: int | None = None,
) -> OpdMap:
    """Return the optical path difference over the entrance pupil.

    The OPD is the path of the reference ray minus that of each ray, to a sphere centred where the chief ray meets
    the image surface (the CCD surface, where a focal plane is given). The chief ray, through the centre of the
    entrance pupil, is traced with vignetting ignored: in an obscured telescope it is blocked.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    field : (tx, ty)
        Field angles [rad] or Quantities, in the stated projection; slopes of the light's own travel.
    wavelength : float or Quantity
        Vacuum wavelength [m].
    pupil : (px, py), optional
        Entrance-pupil coordinates [m], arrays of one shape.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    reference : {"chief", "mean"}
        "chief": sphere and zero of the path at the chief ray. "mean": sphere about the mean landing point of the
        lit rays, zero at their mean path.
    focal_plane : FocalPlane, optional
        CCD surfaces; the nominal detector surface without it.
    grid : int, optional
        In place of ``pupil``: cells across the pupil diameter of a square grid. 64 when neither is given.
    sphere_radius : float or Quantity, optional
        Radius of the reference sphere [m]; the telescope's own by default.
    threads : int, optional
        Number of threads; all processors by default.

    Returns
    -------
    OpdMap

    Raises
    ------
    ConfigError
        If both ``pupil`` and ``grid`` are given, or the reference or projection is unknown.
    DomainError
        If field or wavelength lie outside what the telescope covers, or no reference point exists.
    """
    if reference not in ("chief", "mean"):
        raise ConfigError(f"reference = {reference!r}: expected 'chief' or 'mean'")
    x, y = pupil_points(telescope, pupil, grid)
    radius = sphere_radius_of(telescope, sphere_radius)
    rays = launch_rays(telescope, field, wavelength, (x, y), projection)
    angles = np.array([float(radians(field[0], "field x")), float(radians(field[1], "field y"))])
    end = trace(telescope, rays, focal_plane=focal_plane, threads=threads)
    lit = (end.status == RayStatus.OK) | (end.status == RayStatus.GAP)
    if reference == "chief":
        direction = field_direction(angles[0], angles[1], projection)[None]
        chief = reference_spheres(telescope, angles[None], direction, rays.wavelength, radius, focal_plane, threads)
        center = chief.center[0]
    else:
        if not lit.any():
            raise DomainError(f"field = {field!r}: no ray reaches the image")
        center = end.position[lit].mean(axis=0)
    index = refractive_indices(telescope, rays.wavelength)[-2]
    path = end.path_length + index * distance_to_sphere(end.position, end.direction, center, radius)
    zero = chief.path[0] if reference == "chief" else path[lit].mean()
    value = np.where(lit, zero - path, np.nan)
    return OpdMap(
        value=value.reshape(x.shape),
        x=x,
        y=y,
        lit=lit.reshape(x.shape),
        wavelength=rays.wavelength,
        field=(float(angles[0]), float(angles[1])),
        center=center,
        radius=radius,
        exit_direction=end.direction.reshape(*x.shape, 3),
        landing=end.position.reshape(*x.shape, 3),
    )
