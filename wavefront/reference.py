"""The reference sphere: optical path of rays to a sphere about their image point."""

from __future__ import annotations

import numpy as np


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
