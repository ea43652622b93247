"""Bundles: the rays of many field points through the same pupil points, at the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..raytrace.ideal_lens import tangents
from ..raytrace.rays import RayStatus
from .reference_sphere import path_to_plane, path_to_sphere


@dataclass(frozen=True)
class Bundles:
    """Rays of one wavelength at the detector, bundle by bundle, in the detector's own frame.

    The chief ray is that through the centre of the entrance pupil, vignetting ignored. Optical paths begin on a plane
    perpendicular to the light in front of the telescope. Positions are NaN where a ray does not meet the detector.
    Where light is parallel behind the telescope, its image points are tangents of directions (:mod:`~.ideal_lens`).
    """

    position: np.ndarray  #: [n_field, n_pupil, 3] m
    direction: np.ndarray  #: [n_field, n_pupil, 3] unit vectors of travel
    path: np.ndarray  #: [n_field, n_pupil] m
    status: np.ndarray  #: [n_field, n_pupil] int32, :class:`~pachon.raytrace.rays.RayStatus`
    chief_position: np.ndarray  #: [n_field, 3] m
    chief_direction: np.ndarray  #: [n_field, 3]
    chief_path: np.ndarray  #: [n_field] m
    index: float  #: refractive index in front of the detector
    wavelength: float  #: in vacuum, m
    afocal: bool = False  #: whether light is parallel behind the telescope

    def one(self, i: int) -> Bundles:
        """Return the bundle of field ``i`` alone."""
        k = slice(i, i + 1)
        rays = (self.position[k], self.direction[k], self.path[k], self.status[k])
        chief = (self.chief_position[k], self.chief_direction[k], self.chief_path[k])
        return Bundles(*rays, *chief, self.index, self.wavelength, self.afocal)

    @property
    def lit(self) -> np.ndarray:
        """Mask of the rays that no aperture stops, shape [n_field, n_pupil]."""
        return self.status == RayStatus.OK

    def landing(self) -> np.ndarray:
        """Return x and y [m] of the image points, shape [n_field, n_pupil, 2]."""
        return self._image(self.position, self.direction)

    def chief_landing(self) -> np.ndarray:
        """Return x and y [m] of the image points of the chief rays, shape [n_field, 2]."""
        return self._image(self.chief_position, self.chief_direction)

    def _image(self, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
        image = position[..., :2]
        if self.afocal:
            image = np.where(np.isfinite(image), tangents(direction), np.nan)
        return np.asarray(image + 0.0)  # negative zeros of symmetric systems become positive

    @property
    def cosines(self) -> np.ndarray:
        """Direction cosines of the rays at the image along x and y, shape [n_field, n_pupil, 2].

        Behind the ideal lens of an afocal telescope they are the opposite of the places on it, over its focal length.
        """
        return -self.position[..., :2] if self.afocal else self.direction[..., :2]

    def opd(self, radius: float, defocus: float = 0.0) -> np.ndarray:
        """Return paths of the chief rays minus paths of the rays [m] to reference spheres, shape [n_field, n_pupil].

        The spheres, of one radius [m], are centred where the chief rays meet the plane at a height [m] above the
        detector. Where light is parallel, they are planes across the chief rays. Vignetted rays have values too.
        """
        chief = (self.chief_path, self.index, self.chief_position, self.chief_direction)
        rays = (self.path, self.index, self.position, self.direction)
        if self.afocal:
            normal = self.chief_direction
            return path_to_plane(*chief, normal)[:, None] - path_to_plane(*rays, normal[:, None])
        along = (defocus / self.chief_direction[:, 2:]) if defocus else 0.0
        center = self.chief_position + along * self.chief_direction
        return path_to_sphere(*chief, center, radius)[:, None] - path_to_sphere(*rays, center[:, None], radius)
