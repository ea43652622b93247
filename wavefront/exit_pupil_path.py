r"""Paths to spheres through the exit pupil: waves of these phases land where rays do.

With p the pupil coordinate, u the direction cosines of a ray along the detector times the index there, x its landing
point from the reference point, and V its path to the foot of the perpendicular from there, all less those of the chief
ray, :math:`dV = -x' \cdot du` (Malus' theorem), where x' is x on a plane across the detector's z: on a tilted CCD the
ray is not there yet. Fourier optics takes :math:`-J^{-T} p` for u, and so needs a path with the gradient
:math:`J^{-1} x`: that is V plus C with

.. math:: \nabla C = J^{-1} (x - x') - (\partial \delta / \partial p)^T x', \quad \delta = -u - J^{-T} p.

C is next to nothing in focus, and where the exit pupil is an even image of the entrance pupil: at infinity, of a
telescope that obeys the sine condition. Donuts of others were up to 1.5 % too small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..core.threads import one_blas_thread
from ..raytrace.rays import RayStatus
from ..raytrace.trace import TraceResult, trace
from .request import Request

#: Rays that tell the directions: on a spiral, and turned by quarters, so that the camera may be.
_RAYS = 200
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
#: Highest degree of the polynomials.
_DEGREE = 8
#: Fewest lit rays to a term of them.
_RAYS_A_TERM = 2


@dataclass(frozen=True)
class ExitPupil:
    """What paths to spheres through the exit pupils of stars depend on, all at the middle wavelength."""

    request: Request  #: telescope and light
    index: float  #: refractive index at the image
    chief: TraceResult  #: chief rays at the reference points
    slopes: np.ndarray  #: of the CCDs there along x and y of the detector, [n_star, 2]
    jacobian: np.ndarray  #: [n_star, 2, 2] m/rad: detector position by direction cosines of the incoming light

    def path(self, pupil: np.ndarray, path: np.ndarray, landing: np.ndarray) -> np.ndarray:
        """Return paths to spheres through the exit pupils less those of the chief rays [m].

        Parameters
        ----------
        pupil : ndarray, shape [n_pupil, 2]
            Points of the pupil [m].
        path : ndarray, shape [n_star, n_wave, n_pupil]
            Paths to the reference spheres less those of the chief rays [m].
        landing : ndarray, shape [n_star, n_wave, n_pupil, 2]
            Landing points on the CCDs less reference points [m].
        """
        sphere, (x, y) = self.request.telescope.reference_sphere_radius, pupil.T / self._radius
        chief, inverse, out = self._chief_cosines, np.linalg.inv(self.jacobian), np.empty_like(path)
        for k, coefficients in enumerate(self._further_path()):
            # Directions of an even exit pupil suffice here: squares over the radius of the sphere are small.
            cosines = chief[k, :2] - pupil @ inverse[k] / self.index
            onward = np.copysign(np.sqrt(np.maximum(1.0 - (cosines**2).sum(axis=1), 0.0)), chief[k, 2])
            height = landing[k] @ self.slopes[k]
            along = np.einsum("wpi,pi->wp", landing[k], cosines) + height * onward
            across = (landing[k] ** 2).sum(axis=-1) + height**2 - along**2
            with np.errstate(invalid="ignore"):
                to_foot = sphere * (1.0 - np.sqrt(1.0 - across / sphere**2))
            out[k] = path[k] + self.index * to_foot + np.polynomial.polynomial.polyval2d(x, y, coefficients)
        return out

    @property
    def _radius(self) -> float:
        return 0.5 * self.request.telescope.pupil_diameter

    @property
    def _chief_cosines(self) -> np.ndarray:
        """Directions of the chief rays along the axes of the detector, [n_star, 3]."""
        return self.request.telescope.surfaces[-1].along(self.chief.direction)

    def _further_path(self) -> list[np.ndarray]:
        """Return C [m] of each star: coefficients of powers of x and y over the radius, [degree + 1, degree + 1]."""
        request, detector, count = self.request, self.request.telescope.surfaces[-1], np.arange(_RAYS // 4) + 0.5
        radius, angle = np.sqrt(count / len(count)), _GOLDEN_ANGLE * count
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        unit = np.concatenate([np.stack(quarter, axis=1) for quarter in ((x, y), (-y, x), (-x, -y), (y, -x))])
        end = trace(request.telescope, request.launch(request.middle, self._radius * unit), threads=request.threads)
        shape = (len(self.jacobian), _RAYS)
        light, place = (
            detector.along(vectors.reshape(-1, 3)).reshape(*shape, 3)
            for vectors in (end.direction, end.position.reshape(*shape, 3) - self.chief.position[:, None])
        )
        across = light[..., :2] / light[..., 2:]
        # On the plane through the reference point across z, and from there to the CCD.
        level = place[..., :2] - place[..., 2:] * across
        height = np.einsum("sni,si->sn", level, self.slopes) / (1.0 - np.einsum("sni,si->sn", across, self.slopes))
        inverse = self._radius * np.linalg.inv(self.jacobian)
        tilted = np.einsum("sn,sni,sji->snj", height, across, inverse)
        bend = -self.index * (light[..., :2] - self._chief_cosines[:, None, :2]) - unit @ inverse
        lit = (end.status == RayStatus.OK).reshape(shape)
        with one_blas_thread():
            return [_fitted(unit[used], *(v[k, used] for v in (bend, level, tilted))) for k, used in enumerate(lit)]


def _fitted(unit: np.ndarray, bend: np.ndarray, level: np.ndarray, tilted: np.ndarray) -> np.ndarray:
    """Return the coefficients of C of a star [m].

    Parameters
    ----------
    unit : ndarray, shape [n, 2]
        Points of the unit disc with lit rays.
    bend : ndarray, shape [n, 2]
        Direction cosines less those of an even exit pupil.
    level : ndarray, shape [n, 2]
        Landing points on a plane across z [m].
    tilted : ndarray, shape [n, 2]
        Part of the gradient by the slope of the CCD [m a radius of the pupil].
    """
    degree = max(d for d in range(_DEGREE + 1) if d == 0 or _RAYS_A_TERM * (d + 1) * (d + 2) // 2 <= len(unit))
    p, q = np.array([(total - j, j) for total in range(degree + 1) for j in range(total + 1)]).T
    x, y = (u[:, None] ** np.arange(degree + 1) for u in unit.T)
    slopes = np.stack([p * x[:, np.maximum(p - 1, 0)] * y[:, q], q * x[:, p] * y[:, np.maximum(q - 1, 0)]])
    out = np.zeros((degree + 1, degree + 1))
    if degree:
        bend_terms = np.linalg.lstsq(x[:, p] * y[:, q], bend, rcond=None)[0]
        gradient = tilted.T - np.einsum("jnt,ti,ni->jn", slopes, bend_terms, level)
        # No constant: paths are less those of the chief ray.
        by_gradient = slopes[:, :, 1:].reshape(-1, len(p) - 1)
        out[p[1:], q[1:]] = np.linalg.lstsq(by_gradient, gradient.ravel(), rcond=None)[0]
    return out
