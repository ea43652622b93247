"""Rays before the first surface: directions of field points, plane waves and light from points of an object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError
from ..core.number_text import counted
from ..core.point_plots import draw_points
from ..core.result import Result
from ..core.units import broadcast_together, metres, radians
from ..models.telescope import Telescope
from .kernels import surface as surface_kernels
from .kernels.packet import whole_packets

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class RayStatus(IntEnum):
    """Status of a ray."""

    OK = int(surface_kernels.OK)
    #: Outside a clear aperture. The ray is marked and traced on; its positions stay valid.
    VIGNETTED = int(surface_kernels.VIGNETTED)
    #: Did not meet a surface; positions are NaN from there on.
    MISSED = int(surface_kernels.MISSED)
    #: Totally reflected at a lens surface; directions are NaN from there on.
    TOTAL_REFLECTION = int(surface_kernels.TOTAL_REFLECTION)
    #: Newton's method did not find the surface.
    NOT_CONVERGED = int(surface_kernels.NOT_CONVERGED)
    #: Landed between the CCDs (only when traced to a focal plane of CCDs).
    GAP = 5
    #: The order of a grating does not exist for its direction and wavelength; directions are NaN from there on.
    EVANESCENT = int(surface_kernels.EVANESCENT)


#: Statuses of rays that do not reach the image, with positions of NaN.
LOST = (RayStatus.MISSED, RayStatus.TOTAL_REFLECTION, RayStatus.NOT_CONVERGED, RayStatus.EVANESCENT)


#: Meanings of field angles: see :func:`field_direction`.
Projection = Literal["zemax", "gnomonic", "postel"]
PROJECTIONS: tuple[Projection, ...] = get_args(Projection)


def field_direction(tx: Any, ty: Any, projection: Projection = "zemax") -> np.ndarray:
    """Return the unit vector along which light from a field point travels, telescope frame, shape [..., 3].

    Field angles (tx, ty) [rad] are those of the light's own travel v, with vz < 0 (towards the primary): the source on
    the sky lies the opposite way. Projections are "zemax", (vx, vy)/|vz| = (tan tx, tan ty); "gnomonic",
    (vx, vy)/|vz| = (tx, ty); "postel" (zenithal equidistant), (vx, vy) = sin(rho) (tx, ty)/rho with rho = hypot(tx, ty)
    the angle from the axis. Another one is a ConfigError.
    """
    tx, ty = broadcast_together({"field x": radians(tx, "field x"), "field y": radians(ty, "field y")})
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


def field_angles(slopes: np.ndarray, projection: Projection = "zemax") -> np.ndarray:
    """Return the field angles [rad] of light of slopes (vx, vy)/|vz|, both [n, 2]: the inverse of `field_direction`."""
    if projection == "zemax":
        return np.arctan(slopes)
    if projection == "gnomonic":
        return slopes
    if projection == "postel":
        slope = np.hypot(*slopes.T)[:, None]
        return slopes * np.divide(np.arctan(slope), slope, out=np.ones_like(slope), where=slope > 0)
    raise ConfigError(f"projection = {projection!r}: expected one of {', '.join(PROJECTIONS)}")


@check_arguments
@dataclass(frozen=True)
class Rays(Result):
    """Rays of one wavelength before the first surface, in the telescope frame.

    Attributes
    ----------
    position : ndarray, shape [n, 3]
        Starting points [m]; a ray that starts at NaN has no place on any surface, which its status says.
    direction : ndarray, shape [n, 3]
        Unit vectors of travel.
    path_length : ndarray, shape [n]
        Optical path already travelled [m]; zero for rays that start in phase.
    wavelength : float
        Vacuum wavelength [m].

    Raises
    ------
    DomainError
        If the arrays differ in length, or have other shapes.
    """

    _table = ("position", "direction", "path_length")

    position: np.ndarray
    direction: np.ndarray
    path_length: np.ndarray
    wavelength: float

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw where the rays start, in x and y of the telescope."""
        return draw_points(ax, self.position[:, 0], self.position[:, 1], ("x [m]", "y [m]"), equal=True)

    def _label(self) -> str:
        return f"{counted(len(self), 'ray')}, {self.wavelength * 1e9:.5g} nm"

    def __post_init__(self) -> None:
        # Kernels read as many rays as there are path lengths, whatever the length of the others.
        n = len(self.path_length) if np.ndim(self.path_length) == 1 else "n"
        for name, expected in (("position", (n, 3)), ("direction", (n, 3)), ("path_length", (n,))):
            if np.shape(getattr(self, name)) != expected:
                shape = f"[{', '.join(map(str, expected))}]"
                raise DomainError(f"{name} of rays has shape {np.shape(getattr(self, name))}: expected {shape}")

    def __len__(self) -> int:
        return len(self.path_length)


def pupil_points(pupil: tuple[ArrayLike, ArrayLike]) -> tuple[np.ndarray, ...]:
    """Return entrance-pupil coordinates [m] of one shape."""
    return broadcast_together(
        {f"pupil {name}": metres(v, f"pupil {name}") for name, v in zip("xy", pupil, strict=True)}
    )


def check_wavelength(wavelength: Any) -> float:
    """Return one wavelength in metres, or raise DomainError."""
    value = metres(wavelength, "wavelength")
    if value.ndim != 0 or not np.isfinite(value) or value <= 0:
        raise DomainError(f"wavelength = {wavelength!r}: expected one positive length in metres")
    return float(value)


def straight_bundles(telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray) -> Rays:
    """Launch the light of several field points, at any distance, through points of the plane of the entrance pupil.

    ``directions`` [n_direction, 3] are those of the chief rays, as :func:`field_direction` gives them; ``pupil`` [m] is
    [n_pupil, 2], the same for all of them, or [n_direction, n_pupil, 2]. Returned are ``n_direction * n_pupil`` rays,
    direction by direction; those of one direction are in phase.
    """
    if not np.isfinite(telescope.object_distance):
        return parallel_rays(telescope, directions, wavelength, pupil)
    start = object_points(telescope, directions)
    x, y = np.moveaxis(np.broadcast_to(pupil, (len(directions), *pupil.shape[-2:])), -1, 0)
    through = np.stack([x, y, np.full(x.shape, telescope.stop_z)])
    reach = through - start.T[:, :, None]
    # The plane of the pupil may lie behind the object: the light goes down all the same.
    reach *= -np.sign(reach[2]) / np.linalg.norm(reach, axis=0)
    position = np.repeat(start.T, x.shape[1], axis=1)
    return Rays(position.T, reach.reshape(3, -1).T, np.zeros(x.size), wavelength)


def object_points(telescope: Telescope, directions: np.ndarray) -> np.ndarray:
    """Return the points [m] of an object at a finite distance that chief rays of given directions [n, 3] come from."""
    height = telescope.object_distance - telescope.stop_z
    return directions * (height / directions[:, 2:]) + [0.0, 0.0, telescope.stop_z]


def require_distant_object(telescope: Telescope) -> None:
    """Raise a DomainError for an object at a finite distance."""
    if np.isfinite(telescope.object_distance):
        raise DomainError(
            f"{telescope.name}: object at {telescope.object_distance:.6g} m: expected an object at infinity, "
            "as stars are; of a near object pachon computes spots, opd, zernikes, sensitivity"
        )


def parallel_rays(telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray) -> Rays:
    """Launch plane waves as :func:`straight_bundles`; an object at a finite distance is a DomainError."""
    require_distant_object(telescope)
    # Components stay contiguous (structure of arrays) and in whole packets, as the kernels read them; without temporary
    # arrays of all rays, as memory sets the pace.
    v = directions.T[:, :, None]
    x, y = np.moveaxis(pupil if pupil.ndim == 3 else pupil[None], -1, 0)
    bundles = len(directions), x.shape[1]
    position, direction = whole_packets((2, 3), math.prod(bundles))
    path = whole_packets((), math.prod(bundles))
    back = path.reshape(bundles)
    np.multiply(v[0], x, out=back)
    back += v[1] * y
    back += v[2] * telescope.stop_z
    back += telescope.launch_distance
    components = zip(position, direction, (x, y, telescope.stop_z), v, strict=True)
    for places, cosines, point, along in components:
        place = places.reshape(bundles)
        np.multiply(along, back, out=place)
        np.subtract(point, place, out=place)
        cosines.reshape(bundles)[:] = along
    path[:] = 0.0
    return Rays(position=position.T, direction=direction.T, path_length=path, wavelength=wavelength)
