"""Bundles: the rays of many field points through the same pupil points, at the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..raytrace.rays import RayStatus
from .reference_sphere import path_to_sphere


@dataclass(frozen=True)
class Bundles:
    """Rays of one wavelength at the detector, bundle by bundle, in the detector's own frame.

    Attributes
    ----------
    position : ndarray, shape [n_field, n_pupil, 3]
        Where the rays meet the detector [m]; NaN where they do not.
    direction : ndarray, shape [n_field, n_pupil, 3]
        Unit directions of travel.
    path : ndarray, shape [n_field, n_pupil]
        Optical path from a plane perpendicular to the light in front of the telescope [m].
    status : ndarray of int32, shape [n_field, n_pupil]
        A :class:`~pachon.raytrace.rays.RayStatus` each.
    chief_position, chief_direction : ndarray, shape [n_field, 3]
        The ray through the centre of the entrance pupil, vignetting ignored. Where it does not reach the detector,
        its position is NaN.
    chief_path : ndarray, shape [n_field]
        Its optical path [m].
    index : float
        Refractive index in front of the detector.
    wavelength : float
        Vacuum wavelength [m].
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    status: np.ndarray
    chief_position: np.ndarray
    chief_direction: np.ndarray
    chief_path: np.ndarray
    index: float
    wavelength: float

    def one(self, i: int) -> Bundles:
        """Return the bundle of field ``i`` alone."""
        k = slice(i, i + 1)
        rays = (self.position[k], self.direction[k], self.path[k], self.status[k])
        chief = (self.chief_position[k], self.chief_direction[k], self.chief_path[k])
        return Bundles(*rays, *chief, self.index, self.wavelength)

    @property
    def lit(self) -> np.ndarray:
        """Where light passes, shape [n_field, n_pupil] bool."""
        return self.status == RayStatus.OK

    def landing(self, defocus: float = 0.0) -> np.ndarray:
        """Return where the rays meet the plane at a height [m] above the detector's own, shape [n_field, n_pupil, 2].

        Exact at every height for a flat detector; for ``defocus = 0`` these are the landing points themselves.
        """
        return _at_height(self.position, self.direction, defocus)

    def chief_landing(self, defocus: float = 0.0) -> np.ndarray:
        """Return where the chief rays meet the plane at a height [m] above the detector's own, shape [n_field, 2]."""
        return _at_height(self.chief_position, self.chief_direction, defocus)

    def opd(self, radius: float, defocus: float = 0.0) -> np.ndarray:
        """Return the optical path difference to spheres about the chief rays' landing points, NaN where undefined.

        Parameters
        ----------
        radius : float
            Radius of the reference spheres [m].
        defocus : float
            Height above the detector [m] of the plane whose landing points are the centres.

        Returns
        -------
        ndarray, shape [n_field, n_pupil]
            Path of the chief ray minus path of the ray [m]; vignetted rays have one too.
        """
        along = (defocus / self.chief_direction[:, 2:]) if defocus else 0.0
        center = self.chief_position + along * self.chief_direction
        chief = (self.chief_path, self.index, self.chief_position, self.chief_direction)
        rays = (self.path, self.index, self.position, self.direction)
        return path_to_sphere(*chief, center, radius)[:, None] - path_to_sphere(*rays, center[:, None], radius)


def _at_height(position: np.ndarray, direction: np.ndarray, height: float) -> np.ndarray:
    return position[..., :2] + height * direction[..., :2] / direction[..., 2:]
