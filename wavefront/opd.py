"""Optical path differences over the entrance pupil, of one field point or of many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError
from ..core.units import field_label
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.silicon import Silicon
from ..models.telescope import Telescope
from ..raytrace.ideal_lens import image_direction, image_points, require_image
from ..raytrace.pack.surfaces import refractive_indices
from ..raytrace.rays import Projection, RayStatus, pupil_points
from ..raytrace.trace import TraceResult, trace
from .chief_rays import image_jacobians, reference_rays
from .opd_map import OpdMap, OpdMaps
from .opd_packets import traced_opds
from .pupil_grid import pupil_grid
from .pupil_sampling import CHIEF_RAY
from .reference_sphere import path_to_plane, path_to_sphere, require_met
from .request import Request

#: Zero of the OPD: at the chief ray, or in the mean over the lit pupil.
OpdReference = Literal["chief", "mean"]
#: What replaces the radius of the sphere in a call.
_SPHERE = "telescope=replace(telescope, reference_sphere_radius=...)"
#: What a call of many fields cannot do without.
_ADVICE = "; wavefront_opd can do without it, with reference='mean'"


@removed_arguments(sphere_radius=_SPHERE)
@check_arguments
def wavefront_opd(
    telescope: Telescope | Request,
    field: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    pupil: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    grid: int | None = None,
    reference: OpdReference = "chief",
    focal_plane: FocalPlane | None = None,
    silicon: Silicon | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> OpdMap:
    """Return the optical path difference over the entrance pupil.

    The OPD is the path of the reference ray minus that of each ray, to a sphere centred where the chief ray meets
    the image surface (the CCD surface, where a focal plane is given); its radius is the telescope's
    `reference_sphere_radius`. The chief ray, through the centre of the
    entrance pupil, is traced with vignetting ignored: in an obscured telescope it is blocked.

    Parameters
    ----------
    telescope, projection, threads
        As in :meth:`pachon.Request.of`: a request in place of the telescope has the field and the wavelength too.
    field : (tx, ty)
        Field angles [rad] or Quantities, in the stated projection; slopes of the light's own travel.
    wavelength : float or Quantity
        Vacuum wavelength [m].
    pupil : (px, py), optional
        Entrance-pupil coordinates [m], arrays of one shape. Results are NaN where no light passes.
    grid : int, optional
        In place of ``pupil``: cells across the pupil diameter of a square grid. 64 when neither is given. Points of
        the grid outside the pupil are dark (:func:`~pachon.wavefront.pupil_grid.pupil_grid`); those of ``pupil`` are
        taken as given.
    reference : {"chief", "mean"}
        "chief": sphere and zero of the path at the chief ray. "mean": sphere about the mean landing point of the
        lit rays, zero at their mean path.
    focal_plane : FocalPlane, optional
        CCD surfaces; the nominal detector surface without it.
    silicon : Silicon, optional
        Silicon behind that surface: the OPD is then that of light at the mean depth at which it turns into charge, to
        the point where the chief ray (or the mean of the lit rays) is there. Silicon adds s/(2n) times the square of
        the distance of the light's direction cosines from those of the chief ray, with the mean path s in silicon of
        index n.

    Returns
    -------
    OpdMap

    Raises
    ------
    ConfigError
        If both ``pupil`` and ``grid`` are given, or the reference or projection is unknown.
    DomainError
        If field or wavelength lie outside what the telescope covers, silicon is transparent, no reference point
        exists, or rays miss the reference sphere.
    """
    request = Request.of(telescope, field, wavelength, sampling=CHIEF_RAY, projection=projection, threads=threads)
    focal_plane = request.on(focal_plane).focal_plane
    telescope, threads = request.telescope, request.threads
    if len(request.fields) != 1:
        raise DomainError(f"field of shape {request.fields.shape}: expected two angles")
    x, y, inside = _pupil_points(telescope, pupil, grid)
    radius = _sphere_radius(telescope, focal_plane, silicon)
    w, index = request.wavelength, refractive_indices(telescope, request.wavelength)[-2]
    rays = request.launch(w, np.stack([x.ravel(), y.ravel()], axis=-1))
    end = trace(telescope, rays, focal_plane=focal_plane, threads=threads)
    landing = image_points(telescope, end)
    lit = inside.ravel() & ((end.status == RayStatus.OK) | (end.status == RayStatus.GAP))
    if reference == "chief":
        sphere = _spheres(request, radius, focal_plane)[0]
        center = sphere[:3]
    else:
        if not lit.any():
            raise DomainError(f"{field_label(request.fields[0])}: no ray reaches the image")
        center = landing[lit].mean(axis=0)
    path = _reference_path(telescope, end, index, center, radius)
    require_met(path, lit, radius)
    if silicon is not None:
        middle = (0.0, 0.0) if reference == "chief" else (x.ravel()[lit].mean(), y.ravel()[lit].mean())
        path = path - _silicon_opd(request, silicon, x - middle[0], y - middle[1]).ravel()
    zero = sphere[3] if reference == "chief" else path[lit].mean()
    return OpdMap(
        value=np.where(lit, zero - path, np.nan).reshape(x.shape),
        x=x,
        y=y,
        lit=lit.reshape(x.shape),
        wavelength=w,
        field=(float(request.fields[0, 0]), float(request.fields[0, 1])),
        center=center,
        radius=radius,
        exit_direction=end.direction.reshape(*x.shape, 3),
        landing=landing.reshape(*x.shape, 3),
    )


@removed_arguments(sphere_radius=_SPHERE)
@check_arguments
def wavefront_opds(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    pupil: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    grid: int | None = None,
    focal_plane: FocalPlane | None = None,
    silicon: Silicon | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> OpdMaps:
    """Return the optical path difference over the entrance pupil of many field points.

    The maps are those of :func:`wavefront_opd` with the chief ray as reference, but for rounding in the last bits. Rays
    are not stored, and light that the first aperture stops is traced no further. Beside the maps a batch takes a few
    megabytes.

    Parameters
    ----------
    telescope, wavelength, pupil, grid, focal_plane, silicon, projection, threads
        As in :func:`wavefront_opd`; the pupil points are the same for all fields.
    fields : array_like or Quantity, shape [n_field, 2]
        Field angles [rad], in the stated projection.
    progress : callable, optional
        Called after each batch with the number of fields done since the last call.

    Returns
    -------
    OpdMaps

    Raises
    ------
    ConfigError
        If both ``pupil`` and ``grid`` are given, or the projection is unknown.
    DomainError
        If a field or the wavelength lies outside what the telescope covers, or a chief ray does not reach the image or
        lands between the CCDs.
    """
    request = Request.of(telescope, fields, wavelength, sampling=CHIEF_RAY, projection=projection, threads=threads)
    focal_plane = request.on(focal_plane).focal_plane
    x, y, inside = _pupil_points(request.telescope, pupil, grid)
    radius = _sphere_radius(request.telescope, focal_plane, silicon)
    spheres = _spheres(request, radius, focal_plane)
    value = traced_opds(request, x.ravel(), y.ravel(), spheres, radius, progress).reshape(-1, *x.shape)
    value[:, ~inside] = np.nan
    return OpdMaps(
        value=value if silicon is None else value + _silicon_opd(request, silicon, x, y),
        x=x,
        y=y,
        wavelength=request.wavelength,
        radius=radius,
        fields=request.fields,
        centers=spheres[:, :3],
    )


def _pupil_points(
    telescope: Telescope, pupil: tuple[ArrayLike, ArrayLike] | None, grid: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return entrance-pupil coordinates [m], as given or of a grid, and whether they lie in the pupil."""
    if pupil is not None and grid is not None:
        raise ConfigError("pupil and grid are both given: expected one of them")
    if pupil is None:
        return pupil_grid(telescope, 64 if grid is None else grid)
    x, y = (np.array(v) for v in pupil_points(pupil))
    return x, y, np.ones(x.shape, dtype=bool)


def _silicon_opd(request: Request, silicon: Silicon, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the OPD by silicon [m], shape [n_field, *x.shape], at pupil coordinates from the reference [m].

    The direction cosines of the light are those of the pupil and the Jacobian, good to 1e-4 (:doc:`conventions`).
    """
    jacobian = image_jacobians(request.telescope, request.directions, request.wavelength, request.threads)
    cosines = np.stack([x.ravel(), y.ravel()], axis=-1) @ np.linalg.inv(jacobian)
    shift, _ = silicon.defocus(request.wavelength)
    return np.asarray(0.5 * shift * (cosines**2).sum(axis=-1)).reshape(-1, *x.shape)


def _sphere_radius(telescope: Telescope, focal_plane: FocalPlane | None, silicon: Silicon | None) -> float:
    """Return the radius of reference spheres [m]; DomainError for arguments that an afocal telescope cannot have."""
    image_arguments = {"a focal plane": focal_plane, "silicon": silicon}
    for name in (name for name, value in image_arguments.items() if value is not None):
        require_image(telescope, name)
    return telescope.sphere_radius


def _reference_path(
    telescope: Telescope, end: TraceResult, index: float, center: np.ndarray, radius: float
) -> np.ndarray:
    """Return optical paths [m] of rays to the reference sphere about an image point or, if afocal, to a plane."""
    if not telescope.design_data.afocal:
        return path_to_sphere(end.path_length, index, end.position, end.direction, center, radius)
    along = image_direction(telescope, center, end.direction)
    place = end.position - np.asarray(telescope.surfaces[-1].vertex)
    return path_to_plane(end.path_length, index, place, end.direction, along)


def _spheres(request: Request, radius: float, focal_plane: FocalPlane | None) -> np.ndarray:
    """Return centres of the reference spheres and optical paths of the chief rays to them [m], shape [n_field, 4].

    Where the light is parallel, centres are image points, and paths are those to planes through the detector's vertex.
    """
    telescope = request.telescope
    chief = reference_rays(request, request.wavelength, focal_plane, advice=_ADVICE)
    center, index = image_points(telescope, chief), refractive_indices(telescope, request.wavelength)[-2]
    if telescope.design_data.afocal:
        place = chief.position - np.asarray(telescope.surfaces[-1].vertex)
        path = path_to_plane(chief.path_length, index, place, chief.direction, chief.direction)
    else:
        path = path_to_sphere(chief.path_length, index, center, chief.direction, center, radius)
    return np.column_stack([center, path])
