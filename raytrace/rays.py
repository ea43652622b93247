"""Rays and where they start: a plane wave from a point of the field, through given points of the entrance pupil."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from ..models.errors import ConfigError, DomainError
from ..models.telescope import Telescope
from ..models.units import metres, radians
from . import surface_kernels


class RayStatus(IntEnum):
    """What became of a ray."""

    OK = int(surface_kernels.OK)
    #: Outside a clear aperture. The ray is marked and goes on; its positions stay valid.
    VIGNETTED = int(surface_kernels.VIGNETTED)
    #: Did not meet a surface; positions are NaN from there on.
    MISSED = int(surface_kernels.MISSED)
    #: Totally reflected at a lens surface; directions are NaN from there on.
    TOTAL_REFLECTION = int(surface_kernels.TOTAL_REFLECTION)
    #: Newton's method did not find the surface.
    NOT_CONVERGED = int(surface_kernels.NOT_CONVERGED)
    #: Landed between the CCDs (only when traced to a focal plane of CCDs).
    GAP = 5


PROJECTIONS = ("zemax", "gnomonic", "postel")


def field_direction(tx: Any, ty: Any, projection: str = "zemax") -> np.ndarray:
    """Return the unit direction in which light from a field point travels.

    Parameters
    ----------
    tx, ty : array_like
        Field angles [rad], of the light's own travel: the source on the sky lies the opposite way.
    projection : {"zemax", "gnomonic", "postel"}
        "zemax": (vx, vy)/|vz| = (tan tx, tan ty). "gnomonic": (vx, vy)/|vz| = (tx, ty). "postel" (zenithal
        equidistant): sin(rho) (tx, ty)/rho with rho = hypot(tx, ty) the angle from the axis.

    Returns
    -------
    ndarray, shape [..., 3]
        Unit vectors in the telescope frame; z is negative (towards the primary).

    Raises
    ------
    ConfigError
        If the projection is unknown.
    """
    tx, ty = np.broadcast_arrays(radians(tx, "field x"), radians(ty, "field y"))
    if projection == "zemax":
        sx, sy = np.tan(tx), np.tan(ty)
    elif projection == "gnomonic":
        sx, sy = tx, ty
    elif projection == "postel":
        rho = np.hypot(tx, ty)
        scale = np.sinc(rho / np.pi)
        return np.stack([tx * scale, ty * scale, -np.cos(rho)], axis=-1)
    else:
        raise ConfigError(f"projection = {projection!r}: expected one of {', '.join(PROJECTIONS)}")
    down = -1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
    return np.stack([-sx * down, -sy * down, down], axis=-1)


@dataclass(frozen=True)
class Rays:
    """Rays of one wavelength before the first surface, in the telescope frame.

    Attributes
    ----------
    position : ndarray, shape [n, 3]
        Starting points [m].
    direction : ndarray, shape [n, 3]
        Unit vectors of travel.
    path_length : ndarray, shape [n]
        Optical path already travelled [m]; zero for rays that start in phase.
    wavelength : float
        Vacuum wavelength [m].
    """

    position: np.ndarray
    direction: np.ndarray
    path_length: np.ndarray
    wavelength: float

    def __len__(self) -> int:
        return len(self.path_length)


def check_wavelength(wavelength: Any) -> float:
    """Return one wavelength in metres, or raise DomainError."""
    value = metres(wavelength, "wavelength")
    if value.ndim != 0 or not np.isfinite(value) or value <= 0:
        raise DomainError(f"wavelength = {wavelength!r}: expected one positive length in metres")
    return float(value)


def launch_rays(
    telescope: Telescope,
    field: tuple[Any, Any],
    wavelength: Any,
    pupil: tuple[Any, Any],
    projection: str = "zemax",
) -> Rays:
    """Launch a plane wave from one field point through given points of the entrance pupil.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    field : (tx, ty)
        Field angles [rad]; see :func:`field_direction`.
    wavelength : float or Quantity
        Vacuum wavelength [m].
    pupil : (px, py)
        Entrance-pupil coordinates [m], arrays of one shape (flattened): points of the plane z = ``telescope.stop_z``
        that the rays pass through.
    projection : str
        Meaning of the field angles.

    Returns
    -------
    Rays
        Rays in phase: they start on one plane perpendicular to their direction, before the first surface.

    Raises
    ------
    DomainError
        If the field or the wavelength lies outside what the telescope covers.
    """
    tx, ty = (float(v) for v in np.broadcast_arrays(radians(field[0], "field x"), radians(field[1], "field y")))
    telescope.check_field(tx, ty)
    wavelength = check_wavelength(wavelength)
    telescope.check_wavelength(wavelength)
    px, py = np.broadcast_arrays(metres(pupil[0], "pupil x"), metres(pupil[1], "pupil y"))
    v = field_direction(tx, ty, projection)
    # Components are kept contiguous (structure of arrays), as the kernels read them.
    points = np.stack([px.ravel(), py.ravel(), np.full(px.size, telescope.stop_z)])
    back = v[0] * points[0] + v[1] * points[1] + v[2] * points[2] + telescope.launch_distance
    return Rays(
        position=(points - v[:, None] * back).T,
        direction=np.repeat(v[:, None], px.size, axis=1).T,
        path_length=np.zeros(px.size),
        wavelength=wavelength,
    )
