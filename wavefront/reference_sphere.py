"""Reference spheres: optical paths of rays to a sphere about an image point."""

from __future__ import annotations

import numpy as np


def distance_to_sphere(position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Return the distance along each ray to the reference sphere beyond the image.

    Zemax refers the OPD to the exit pupil. That of the LSST is virtual and lies beyond the focal plane, where chief
    rays still converge towards the axis; therefore the sphere is taken on that side.

    Parameters
    ----------
    position, direction : ndarray, shape [..., 3]
        Rays near the image, telescope frame [m].
    center : ndarray, shape [3] or [..., 3]
        Centre of the sphere, the image point [m].
    radius : float
        Radius of the sphere [m].

    Returns
    -------
    ndarray, shape [...]
        Distance [m] from the given positions.
    """
    root, along = _root_and_projection(position - center, direction, radius)
    return root - along


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
    root, along = _root_and_projection(q.T, direction.T, radius)
    ratio = along / root
    return root - along, ratio * direction - q / root - direction, (ratio - 1.0) * q


def path_to_sphere(
    path: np.ndarray, index: float, position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float
) -> np.ndarray:
    """Return the optical path [m] of rays to the reference sphere.

    Parameters
    ----------
    path : ndarray, shape [...]
        Optical path up to the positions [m].
    index : float
        Refractive index in front of the image.
    position, direction, center, radius
        As in :func:`distance_to_sphere`.
    """
    return path + index * distance_to_sphere(position, direction, center, radius)


def _root_and_projection(q: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sqrt((q.d)^2 - q.q + R^2) and q.d [m] of positions relative to the centre of the sphere."""
    along = np.einsum("...i,...i", q, direction)
    # |q| is micrometres to millimetres against metres of radius, so the root does not cancel.
    return np.sqrt(along**2 - np.einsum("...i,...i", q, q) + radius**2), along
