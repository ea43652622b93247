"""Reference spheres: optical paths of rays to a sphere about an image point, or to a plane where light is parallel.

Zemax refers the OPD to the exit pupil. That of the LSST is virtual and lies beyond the focal plane, where chief rays
still converge towards the axis; therefore paths are those to the sphere beyond the image.
"""

from __future__ import annotations

import numpy as np

from ..core.errors import DomainError


def path_to_sphere(
    path: np.ndarray, index: float, position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float
) -> np.ndarray:
    """Return the optical path [m] of rays to the reference sphere, shape [...].

    ``path`` [...] leads up to the positions [..., 3] [m], in front of an image in a medium of refractive index
    ``index``. ``direction`` holds unit vectors; ``center`` [m] has shape [3] or [..., 3], in the frame of the rays. The
    sphere lies beyond the image or, with a negative radius, in front of it.
    """
    root, along = _root_and_projection(position - center, direction, radius)
    return path + index * (np.copysign(root, radius) - along)


def path_to_plane(
    path: np.ndarray, index: float, position: np.ndarray, direction: np.ndarray, along: np.ndarray
) -> np.ndarray:
    """Return the optical path [m] of rays to the plane through the origin across a direction, shape [...].

    Arguments are those of :func:`path_to_sphere`; ``along`` [..., 3] holds unit vectors.
    """
    distance = -np.einsum("...i,...i", position, along) / np.einsum("...i,...i", direction, along)
    return np.asarray(path + index * distance)


def plane_distance_derivatives(
    position: np.ndarray, direction: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance [m] along rays to the plane of :func:`path_to_plane`, shape [n], and its derivatives.

    Arguments have the shape [3, n]. Derivatives, shape [3, n] each, are those by the position, by the direction and by
    ``along`` as free vectors [m].
    """
    reach, slope = (position * along).sum(axis=0), (direction * along).sum(axis=0)
    ratio = reach / slope**2
    return -reach / slope, -along / slope, ratio * along, ratio * direction - position / slope


def sphere_distance_derivatives(
    position: np.ndarray, direction: np.ndarray, center: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance [m] along rays to the reference sphere, shape [n], and its derivatives, shape [3, n] each.

    Arguments are those of :func:`path_to_sphere`, but of shape [3, n]. Derivatives are those with respect to the
    position (with respect to the centre: the opposite) and to the direction as a free vector [m].
    """
    q = position - center
    root, along = _root_and_projection(q.T, direction.T, radius)
    ratio = along / root
    return root - along, ratio * direction - q / root - direction, (ratio - 1.0) * q


def _root_and_projection(q: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sqrt((q.d)^2 - q.q + R^2) and q.d [m] of positions relative to the centre of the sphere.

    The root is NaN where a ray misses the sphere.
    """
    along = np.einsum("...i,...i", q, direction)
    # |q| is micrometres to millimetres against metres of radius, so the root does not cancel.
    with np.errstate(invalid="ignore"):
        return np.sqrt(along**2 - np.einsum("...i,...i", q, q) + radius**2), along


def require_met(path: np.ndarray, lit: np.ndarray, radius: float) -> None:
    """Raise a DomainError where rays that are lit miss their reference sphere of a radius [m]; paths are NaN there."""
    if not np.isfinite(path[lit]).all():
        raise DomainError(
            f"reference sphere of {radius:g} m: rays miss it: expected a detector nearer to the focus, or a larger "
            "reference_sphere_radius"
        )
