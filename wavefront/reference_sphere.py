"""The reference sphere: optical path of rays to a sphere about their image point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.errors import DomainError
from ..core.units import field_label
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.pack.surfaces import refractive_indices
from ..raytrace.rays import RayStatus, launch_bundles
from ..raytrace.trace import trace


@dataclass(frozen=True)
class ReferenceSpheres:
    """Spheres about where chief rays meet the image surface, one for each field point.

    Attributes
    ----------
    center : ndarray, shape [n_field, 3]
        Centres, telescope frame [m].
    path : ndarray, shape [n_field]
        Optical paths of the chief rays to them [m].
    """

    center: np.ndarray
    path: np.ndarray


def reference_spheres(
    telescope: Telescope,
    fields: np.ndarray,
    directions: np.ndarray,
    wavelength: float,
    radius: float,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
) -> ReferenceSpheres:
    """Return the spheres of a radius [m] about the chief rays' landing points; vignetting does not stop a chief ray.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad], for messages.
    directions : ndarray, shape [n_field, 3]
        Unit vectors in which the chief rays travel.
    wavelength : float
        Vacuum wavelength [m].
    radius : float
        Radius of the spheres [m].
    focal_plane : FocalPlane, optional
        CCD surfaces that the chief rays land on.
    threads : int, optional
        Number of threads.

    Raises
    ------
    DomainError
        If a chief ray does not reach the image, or lands between the CCDs.
    """
    rays = launch_bundles(telescope, directions, wavelength, np.zeros((1, 2)))
    end = trace(telescope, rays, focal_plane=focal_plane, threads=threads)
    lost = np.isin(end.status, (RayStatus.MISSED, RayStatus.TOTAL_REFLECTION, RayStatus.NOT_CONVERGED))
    if lost.any():
        raise DomainError(
            f"{field_label(fields[lost][0])}: the chief ray does not reach the image; "
            "wavefront_opd can do without it, with reference='mean'"
        )
    if end.ccd is not None and (end.ccd < 0).any():
        raise DomainError(
            f"{field_label(fields[end.ccd < 0][0])}: the chief ray lands between the CCDs; expected a point on a CCD"
        )
    center = np.array(end.position)
    index = refractive_indices(telescope, wavelength)[-2]
    path = end.path_length + index * distance_to_sphere(end.position, end.direction, center, radius)
    return ReferenceSpheres(center, path)


def distance_to_sphere(position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Return how far along each ray, beyond the image, the reference sphere lies.

    Zemax refers the OPD to the exit pupil. That of the LSST is virtual and lies beyond the focal plane (chief rays
    still close in on the axis there), and so the sphere stands on that side.

    Parameters
    ----------
    position, direction : ndarray, shape [n, 3]
        Rays near the image, telescope frame [m].
    center : ndarray, shape [3] or [n, 3]
        Centre of the sphere, the image point [m].
    radius : float
        Radius of the sphere [m].

    Returns
    -------
    ndarray, shape [n]
        Distance [m] from the given positions, along the rays.
    """
    q = position - center
    along = np.einsum("...i,...i", q, direction)
    # |q| is micrometres to millimetres beside metres of radius, so the root does not cancel.
    return np.sqrt(along**2 - np.einsum("...i,...i", q, q) + radius**2) - along


def sphere_distance_derivatives(
    position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance to the reference sphere and its derivatives, components first.

    Parameters
    ----------
    position, direction, center : ndarray, shape [3, n]
        As in :func:`distance_to_sphere`, but components first.
    radius : float
        Radius of the sphere [m].

    Returns
    -------
    distance : ndarray, shape [n]
        Distance along the rays [m].
    by_position, by_direction : ndarray, shape [3, n]
        Derivatives with respect to the position (that with respect to the centre is the opposite) and to the direction
        as a free vector [m].
    """
    q = position - center
    along = np.einsum("in,in->n", q, direction)
    root = np.sqrt(along**2 - np.einsum("in,in->n", q, q) + radius**2)
    ratio = along / root
    return root - along, ratio * direction - q / root - direction, (ratio - 1.0) * q
