"""Chief rays: reference points on the image surface, Jacobians of the image, and field angles of detector positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import field_label, length, metres
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.ideal_lens import image_points
from ..raytrace.launch import launch_bundles
from ..raytrace.rays import LOST, Projection, Rays, RayStatus, field_angles, field_direction, require_distant_object
from ..raytrace.trace import TraceResult, trace
from .request import Request

#: Step of the central differences for the Jacobian [rad]: 20 arcsec, so that both rounding (1e-15 m / 1e-4) and the
#: third-order distortion over it stay below 1e-8 of the focal length.
JACOBIAN_STEP = 1.0e-4
#: Largest distance of a chief ray from its target on the detector [m].
_TOLERANCE = 1e-12
#: Steps of the iteration with the Jacobian on the axis.
_SCALE_STEPS = 12
#: Largest ratio of the scales of the image on the axis along two directions with which that iteration is tried.
_MOST_SQUEEZED = 1e6
#: Steps of Newton's method after it.
_NEWTON_STEPS = 20


def chief_rays(
    telescope: Telescope,
    directions: np.ndarray,
    wavelength: float,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
) -> TraceResult:
    """Trace parallel light along unit vectors [n, 3] through the centre of the entrance pupil, vignetting ignored.

    It ends on the CCDs of a focal plane, or on the nominal detector without one.
    """
    require_distant_object(telescope)
    rays = launch_bundles(telescope, directions, wavelength, np.zeros((1, 2)))
    return trace(telescope, rays, focal_plane=focal_plane, threads=threads)


def reference_rays(
    request: Request, wavelength: float, focal_plane: FocalPlane | None = None, *, advice: str = ""
) -> TraceResult:
    """Trace the chief rays of one wavelength [m] as :func:`chief_rays` does, from an object at any distance.

    Raises
    ------
    DomainError
        If a chief ray does not reach the image (``advice`` ends the message), or lands between the CCDs.
    """
    rays = request.launch(wavelength, np.zeros((1, 2)))
    end = trace(request.telescope, rays, focal_plane=focal_plane, threads=request.threads)
    lost = np.isin(end.status, LOST)
    if lost.any():
        if (end.status[lost][0]) == RayStatus.EVANESCENT:
            advice = f": {_evanescent_order(request.telescope, rays)}"
        raise DomainError(f"{field_label(request.fields[lost][0])}: the chief ray does not reach the image{advice}")
    if end.ccd is not None and (end.ccd < 0).any():
        name = field_label(request.fields[end.ccd < 0][0])
        raise DomainError(f"{name}: the chief ray lands between the CCDs; expected a point on a CCD")
    return end


def _evanescent_order(telescope: Telescope, rays: Rays) -> str:
    """Return which order of which grating is the first that does not exist for one of the rays."""
    met = trace(telescope, rays, "all")
    surface = next(s for s, m in zip(telescope.surfaces, met, strict=True) if (m.status == RayStatus.EVANESCENT).any())
    order = surface.grating.order if surface.grating else 0
    return f"order {order} of the grating {surface.name} does not exist at {rays.wavelength * 1e9:.6g} nm"


def image_jacobians(
    telescope: Telescope, directions: np.ndarray, wavelength: float, threads: int | None = None
) -> np.ndarray:
    """Return d(position on the detector)/d(direction cosines) [m], shape [n, 2, 2], by central differences."""
    steps = JACOBIAN_STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    # One trace for all four neighbours: with few rays the launch of the kernel takes most of the time.
    cosines = (directions[:, :2] + steps[:, None]).reshape(-1, 2)
    end = chief_rays(telescope, _downward_directions(cosines), wavelength, threads=threads)
    place = telescope.surfaces[-1].to_local(image_points(telescope, end))[:, :2]
    forward, backward = np.moveaxis(place.reshape(2, 2, -1, 2), 1, 0)
    return np.moveaxis((forward - backward) / (2 * JACOBIAN_STEP), 0, -1)


@check_arguments
def fields_at(
    telescope: Telescope,
    positions: ArrayLike,
    wavelength: ArrayLike | None = None,
    *,
    projection: Projection = "zemax",
    threads: int | None = None,
) -> np.ndarray:
    """Return the field angles whose chief rays meet given points of the detector.

    Parameters
    ----------
    telescope, projection, threads
        As in :meth:`pachon.Request.of`.
    positions : array_like or Quantity, shape [n, 2]
        Detector x and y [m], on the nominal flat surface.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's default if not given.

    Returns
    -------
    ndarray, shape [n, 2]
        Field angles [rad].

    Raises
    ------
    ConfigError
        If the projection is unknown.
    DomainError
        If a point lies outside the field that the telescope covers, or the search for its chief ray fails.
    """
    target = np.atleast_2d(metres(positions, "positions"))
    if target.ndim != 2 or target.shape[1] != 2:
        raise DomainError(f"positions of shape {target.shape}: expected x, y, shape [n, 2]")
    light = telescope.default_wavelength if wavelength is None else length(wavelength, "wavelength")
    field_angles(np.zeros((1, 2)), projection)  # an unknown projection is an error before anything is traced
    slopes = _by_axis_scale(telescope, target, light, threads, np.zeros(len(target), dtype=np.int64))
    if slopes is None:
        slopes = _by_newton(telescope, target, light, threads)
    return field_angles(slopes, projection)


def fields_of_groups(
    telescope: Telescope, positions: np.ndarray, counts: Sequence[int], wavelength: float, threads: int | None = None
) -> np.ndarray:
    """Return :func:`fields_at` of groups of so many positions each [m], [n, 2], with the same bytes as group by group.

    The search ends when all positions of a group are met, so that a group of its own has a number of steps of its own.
    """
    target = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
    slopes = _by_axis_scale(telescope, target, wavelength, threads, np.repeat(np.arange(len(counts)), counts))
    if slopes is not None:
        return field_angles(slopes)
    groups = np.split(target, np.cumsum(counts)[:-1])
    return np.concatenate([fields_at(telescope, group, wavelength, threads=threads) for group in groups if len(group)])


def _by_axis_scale(
    telescope: Telescope, target: np.ndarray, wavelength: float, threads: int | None, group: np.ndarray
) -> np.ndarray | None:
    """Return slopes by iteration with the Jacobian on the axis; None if it fails.

    A group [n] of targets ends when all of it are met.
    """
    corners = JACOBIAN_STEP * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    origin, *ends = _landing_points(
        telescope, field_direction(corners[:, 0], corners[:, 1], "gnomonic"), wavelength, threads
    )
    jacobian = np.stack([end - origin for end in ends], axis=1) / JACOBIAN_STEP
    if not np.isfinite(jacobian).all() or np.linalg.cond(jacobian) > _MOST_SQUEEZED:
        return None
    (xx, xy), (yx, yy) = np.linalg.inv(jacobian)

    def change_of(miss: np.ndarray) -> np.ndarray:
        # Written out: the rounding of a product of matrices depends on the number of rows.
        x, y = miss.T
        return np.stack([xx * x + xy * y, yx * x + yy * y], axis=1)

    slopes = change_of(target - origin)
    searched = np.arange(len(target))
    # The Jacobian is within a per cent everywhere, so each step gains two digits or more.
    for _ in range(_SCALE_STEPS):
        light = field_direction(slopes[searched, 0], slopes[searched, 1], "gnomonic")
        miss = target[searched] - _landing_points(telescope, light, wavelength, threads)
        slopes[searched] += change_of(miss)
        if not np.isfinite(miss).all():
            return None
        missed = group[searched][~(np.abs(miss).max(axis=1, initial=0.0) < _TOLERANCE)]
        searched = searched[np.isin(group[searched], missed)]
        if not len(searched):
            return slopes
    return None


def _by_newton(telescope: Telescope, target: np.ndarray, wavelength: float, threads: int | None) -> np.ndarray:
    """Return slopes by Newton's method from the axis, with the Jacobian of each chief ray."""
    cosines = np.zeros_like(target)
    for _ in range(_NEWTON_STEPS):
        light = _downward_directions(cosines)
        miss = target - _landing_points(telescope, light, wavelength, threads)
        jacobian = image_jacobians(telescope, light, wavelength, threads)
        if not (np.isfinite(miss).all() and np.isfinite(jacobian).all()):
            raise DomainError("positions: a point of the detector lies outside the field of the telescope")
        if np.abs(miss).max(initial=0.0) < _TOLERANCE:
            return cosines / -light[:, 2:]
        if not np.linalg.det(jacobian).all():
            break
        cosines = cosines + np.linalg.solve(jacobian, miss[..., None])[..., 0]
    x, y = target[np.argmax(np.abs(miss).max(axis=1))]
    raise DomainError(
        f"positions = ({x:.6g}, {y:.6g}) m: no chief ray that lands there was found; expected a telescope whose images "
        "move steadily with the field angle"
    )


def _landing_points(telescope: Telescope, directions: np.ndarray, wavelength: float, threads: int | None) -> np.ndarray:
    """Return detector x and y [m] of the landing points of chief rays, shape [n, 2]."""
    end = chief_rays(telescope, directions, wavelength, threads=threads)
    return telescope.surfaces[-1].to_local(image_points(telescope, end))[:, :2]


def _downward_directions(cosines: np.ndarray) -> np.ndarray:
    """Return the unit vectors towards the primary of given direction cosines x and y, shape [n, 3]."""
    x, y = cosines.T
    with np.errstate(invalid="ignore"):
        return np.stack([x, y, -np.sqrt(1.0 - x**2 - y**2)], axis=-1)
