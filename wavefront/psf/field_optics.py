r"""Optics of stars interpolated over the field: landing points and rims of the pupil, traced once a telescope.

Through one point of the pupil, the place where light lands and its slope are smooth functions of the direction that it
comes from, as are the squares of its distances from the axes of apertures. They are traced at some directions, and
interpolated by polynomials of the slopes of the field,

.. math:: f(s) = \sum_{i + j \le 9} c_{ij} T_i(s_x / R) \, T_j(s_y / R),

with Chebyshev's T. Rays traced between these directions tell the error: where landing points, on CCDs of usual heights
too, are off by more than :data:`LANDING_ERROR`, nothing is interpolated. The LSST's are off by 4e-11 m.

A star depends on no other: the directions are those of the telescope's field of view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import warp as wp

from ...core.errors import DomainError
from ...core.launch import launch
from ...core.row_sums import in_packets, sums_of_packets, sums_of_products
from ...core.threads import one_blas_thread
from ...core.units import field_label
from ...core.warp_arrays import warp_array
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope, unturned_axes
from ...raytrace.aiming import entrance_points
from ...raytrace.detector import land_on_ccds
from ...raytrace.launch import launch_bundles
from ...raytrace.pack.surfaces import clear_annulus
from ...raytrace.rays import field_direction
from ...raytrace.trace import trace
from ..aberration import ResidualWavefront
from ..chief_rays import image_jacobians
from ..pupil_optics import PupilOptics
from .clear_pupil import EDGE_RINGS, SpokePupil, aperture_distances, edges_of
from .field_optics_kernels import land_rays

#: Largest error of landing points [m]: a ten-thousandth of a pixel, which moves e by less than 1e-6.
LANDING_ERROR = 1e-9
# The same of the slopes of light at the image, over heights of 1 mm, and of squared distances at apertures [m^2].
_SLOPE_ERROR = LANDING_ERROR / 1e-3
_SQUARE_ERROR = 1e-8
# The same of the Jacobian [m/rad].
_JACOBIAN_ERROR = 1e-5
# Largest field [rad] of wide telescopes.
_LARGEST_FIELD = math.radians(20.0)
# Degree of the polynomials.
_DEGREE = 9
# Radii of fields that are tried, over that of the field of view: corners of cameras reach beyond it.
_REACHES = (1.2, 1.0)
# Rings of directions, and directions on the outer one over these.
_RINGS = 9
_DIRECTIONS = 5.0
# Directions between them at which the error is looked at, on a spiral.
_CHECKS = 60
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class FieldOptics:
    """Polynomials over the field of the optics of a telescope through points of the pupil."""

    telescope: Telescope
    wavelengths: np.ndarray  #: [n_wave] m
    pupil: np.ndarray  #: points of the entrance pupil [m], [n_pupil, 2]
    unit: np.ndarray  #: directions of the spokes on which rims are found, [n_spoke, 2]
    reach: float  #: largest field slope
    coefficients: np.ndarray  #: of the terms, [n_term, n_value]
    onward: float  #: sign of the light's direction along z of the detector

    def covers(self, slopes: np.ndarray) -> np.ndarray:
        """Return which field slopes [n, 2] lie within the polynomials, [n] bool."""
        return np.hypot(*slopes.T) <= self.reach

    def at(
        self,
        fields: np.ndarray,
        slopes: np.ndarray,
        focal_plane: FocalPlane | None,
        aberration: ResidualWavefront | None,
        threads: int | None = None,
    ) -> tuple[PupilOptics, np.ndarray]:
        """Return optics and edges of the clear pupil of stars at fields [rad] and slopes [n, 2].

        Optics are those of :func:`.pupil_optics.trace_pupils`, without paths; edges those of
        :func:`.clear_pupil.clear_edges`, which tell what is lit.

        Raises
        ------
        DomainError
            If a chief ray lands between the CCDs.
        """
        n_star, n_wave, n_pupil = len(slopes), len(self.wavelengths), len(self.pupil)
        values = sums_of_packets(_terms(slopes / self.reach), self._packets, threads)[:, : self.coefficients.shape[1]]
        chief, jacobian, rays, distances = np.split(values, np.cumsum([4, 4, 4 * n_wave * n_pupil]), axis=1)
        reference, steepness = self._land(fields, chief, focal_plane)
        jacobian = jacobian.reshape(-1, 2, 2)
        gradient = np.zeros((n_star, n_pupil, 2))
        if aberration is not None:
            gradient = aberration.gradient(self.pupil[:, 0], self.pupil[:, 1], slopes)
        displacement = np.empty((n_star, n_wave, n_pupil, 2), dtype=np.float32)
        launch(
            land_rays,
            n_star,
            [
                warp_array(rays.reshape(n_star, 2, n_wave, n_pupil, 2), wp.vec2d),
                warp_array(chief[:, :2] - reference[:, :2], wp.vec2d),
                warp_array(reference[:, 2]),
                warp_array(steepness, wp.vec2d),
                warp_array(jacobian, wp.mat22d),
                warp_array(gradient, wp.vec2d),
                warp_array(displacement, wp.vec2f),
            ],
            threads=threads,
        )
        distances = distances.reshape(n_star, -1, EDGE_RINGS * len(self.unit))
        edges = edges_of(self.telescope, distances, len(self.unit), threads)
        return PupilOptics(
            pupil=self.pupil,
            displacement=displacement,
            path=np.broadcast_to(np.nan, (n_star, n_wave, n_pupil)),
            lit=np.repeat(self._lit(edges)[:, None], n_wave, axis=1),
            jacobian=jacobian,
            reference_points=self.telescope.surfaces[-1].to_telescope(reference),
            reference_cosines=self._cosines(chief)[:, :2],
            fields=fields,
            wavelengths=self.wavelengths,
        ), edges

    @cached_property
    def _packets(self) -> np.ndarray:
        """Coefficients in packets of values."""
        return in_packets(self.coefficients)

    def turned(self, telescope: Telescope, angle: float) -> FieldOptics:
        """Return the polynomials of a telescope whose detector is turned by an angle [rad], from x towards y."""
        n_ray = len(self.wavelengths) * len(self.pupil)
        # Pairs along x and y: of the chief ray place and slope, then of the Jacobian both columns, and of the rays.
        x = np.concatenate([[0, 2, 4, 5], 8 + 2 * np.arange(2 * n_ray)])
        y = np.concatenate([[1, 3, 6, 7], 9 + 2 * np.arange(2 * n_ray)])
        coefficients = self.coefficients.copy()
        cosine, sine = math.cos(angle), math.sin(angle)
        coefficients[:, x] = cosine * self.coefficients[:, x] + sine * self.coefficients[:, y]
        coefficients[:, y] = cosine * self.coefficients[:, y] - sine * self.coefficients[:, x]
        return replace(self, telescope=telescope, coefficients=coefficients)

    def _cosines(self, chief: np.ndarray) -> np.ndarray:
        """Return unit vectors of chief rays along the axes of the detector, [n, 3]."""
        along_z = self.onward / np.sqrt(1.0 + (chief[:, 2:] ** 2).sum(axis=1, keepdims=True))
        return np.concatenate([chief[:, 2:] * along_z, along_z], axis=1)

    def _land(
        self, fields: np.ndarray, chief: np.ndarray, focal_plane: FocalPlane | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return reference points in the frame of the detector [m], [n, 3], and slopes of the CCDs there, [n, 2]."""
        nominal = np.concatenate([chief[:, :2], np.zeros((len(chief), 1))], axis=1)
        if focal_plane is None:
            return nominal, np.zeros((len(chief), 2))
        detector = self.telescope.surfaces[-1]
        direction = self._cosines(chief) @ detector.matrix.T
        landing = land_on_ccds(detector, focal_plane, detector.to_telescope(nominal), direction)
        if (landing.ccd < 0).any():
            name = field_label(fields[landing.ccd < 0][0])
            raise DomainError(f"{name}: the chief ray lands between the CCDs; expected a point on a CCD")
        reference = detector.to_local(landing.position)
        place = focal_plane.camera.to_local(landing.ccd, reference[:, 0], reference[:, 1])
        return reference, focal_plane.slopes_on(landing.ccd, *place)

    def _lit(self, edges: np.ndarray) -> np.ndarray:
        """Return which points of the pupil lie between the edges of their spokes, [n, n_pupil] bool."""
        radius = np.hypot(*self.pupil.T).reshape(-1, len(self.unit))
        inside = (radius >= edges[:, None, :, 0]) & (radius <= edges[:, None, :, 1])
        return np.asarray(inside.reshape(len(edges), -1))


def field_optics(telescope: Telescope, wavelengths: tuple[float, ...], pupil: SpokePupil) -> FieldOptics | None:
    """Return the polynomials of a telescope through points on spokes; None where they are not good enough.

    Those of the last few are stored, for any angle of the rotator.
    """
    return _turned(telescope, wavelengths, len(pupil.radius), pupil.n_spoke)


# Of one visit, through each of its pupils.
@lru_cache(maxsize=4)
def _turned(telescope: Telescope, wavelengths: tuple[float, ...], n_ring: int, n_spoke: int) -> FieldOptics | None:
    """Return the polynomials of a telescope at any angle of the rotator."""
    unturned, angle = _without_rotator(telescope)
    optics = _field_optics(unturned, wavelengths, n_ring, n_spoke)
    return optics if optics is None or angle == 0.0 else optics.turned(telescope, angle)


def _without_rotator(telescope: Telescope) -> tuple[Telescope, float]:
    """Return the telescope with the x axis of its detector as near to its own as a turn makes it, and the turn [rad].

    The turn leads from there to the axes of the detector, about its normal. There is none where it would matter to
    more than axes.
    """
    detector = telescope.surfaces[-1]
    clear = clear_annulus(detector.aperture)
    axes = unturned_axes(detector)
    if clear is None or any(clear[:2]) or axes is None:
        return telescope, 0.0
    # Zeros are positive, so that equal axes are one key.
    first, second, third = ((a + 0.0, b + 0.0, c + 0.0) for a, b, c in axes.tolist())
    unturned = replace(detector, rotation=(first, second, third))
    return replace(telescope, surfaces=(*telescope.surfaces[:-1], unturned)), telescope.rotator


# Of a night: six bands, through four pupils.
@lru_cache(maxsize=24)
def _field_optics(
    telescope: Telescope, wavelengths: tuple[float, ...], n_ring: int, n_spoke: int
) -> FieldOptics | None:
    pupil = SpokePupil.fill(telescope.pupil_diameter, telescope.pupil_obscuration, n_ring * n_spoke, n_ring)
    aimed = entrance_points(telescope, field_direction(np.zeros(1), np.zeros(1)), wavelengths[0], pupil.points)
    if aimed.ndim != 2:
        return None
    for reach in _REACHES:
        radius = math.tan(min(reach * telescope.field_radius, telescope.field_limit, _LARGEST_FIELD))
        (values, onward), (checks, _) = (
            _traced(telescope, wavelengths, pupil, radius * places) for places in (_places(), _spiral())
        )
        if values is None or checks is None:
            continue
        with one_blas_thread():
            coefficients = np.linalg.lstsq(_terms(_places()), values, rcond=None)[0]
        error = np.abs(sums_of_products(_terms(_spiral()), coefficients) - checks).max(axis=0)
        n_ray = 2 * len(wavelengths) * len(pupil.points)
        largest = np.repeat(
            [LANDING_ERROR, _SLOPE_ERROR, _JACOBIAN_ERROR, LANDING_ERROR, _SLOPE_ERROR, _SQUARE_ERROR],
            [2, 2, 4, n_ray, n_ray, len(error) - 8 - 2 * n_ray],
        )
        if (error <= largest).all():
            return FieldOptics(telescope, np.array(wavelengths), pupil.points, pupil.unit, radius, coefficients, onward)
    return None


def _places() -> np.ndarray:
    """Return places in the unit disc at which polynomials are fitted, denser at its rim, [n, 2]."""
    rings = []
    for k in range(_RINGS):
        radius = math.cos(math.pi * (k + 0.5) / (2 * _RINGS))
        count = max(5, round(_DIRECTIONS * _RINGS * radius))
        angle = 2.0 * math.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(rings)


def _spiral() -> np.ndarray:
    """Return places of the unit disc at which the error is looked at, [n, 2]."""
    count = np.arange(_CHECKS) + 0.5
    radius = np.sqrt(count / (_CHECKS - 0.5))
    return np.stack([radius * np.cos(_GOLDEN_ANGLE * count), radius * np.sin(_GOLDEN_ANGLE * count)], axis=-1)


def _terms(places: np.ndarray) -> np.ndarray:
    """Return products of Chebyshev polynomials at places of the unit disc [n, 2], [n, n_term]."""
    x, y = (np.polynomial.chebyshev.chebvander(u, _DEGREE) for u in places.T)
    return np.stack([x[:, t - j] * y[:, j] for t in range(_DEGREE + 1) for j in range(t + 1)], axis=1)


def _traced(
    telescope: Telescope, wavelengths: tuple[float, ...], pupil: SpokePupil, slopes: np.ndarray
) -> tuple[np.ndarray | None, float]:
    """Return what is interpolated at field slopes [n, 2], [n, n_value], and the sign of the light's direction.

    They are landing point and slopes of the chief ray, Jacobian, landing points of all rays from that of the chief ray
    and their slopes, all in the frame of the detector, and squared distances at apertures. None where a ray is lost, or
    the detector is curved.
    """
    direction = field_direction(slopes[:, 0], slopes[:, 1], "gnomonic")
    middle, detector, points = wavelengths[len(wavelengths) // 2], telescope.surfaces[-1], pupil.points

    def landing(wavelength: float, points: np.ndarray) -> np.ndarray:
        """Return position and direction of rays in the frame of the detector, [n, n_point, 6]."""
        end = trace(telescope, launch_bundles(telescope, direction, wavelength, points))
        ends = np.concatenate([detector.to_local(end.position), detector.along(end.direction)], axis=1)
        return ends.reshape(len(slopes), len(points), 6)

    chief = landing(middle, np.zeros((1, 2)))
    rays = np.stack([landing(w, points) for w in wavelengths], axis=1)
    onward = float(np.sign(chief[0, 0, 5]))
    for ends in (chief, rays):
        ends[..., 3:5] /= ends[..., 5:]
    rays[..., :2] -= chief[:, None, :, :2]
    squares = aperture_distances(telescope, direction, pupil.unit, middle)
    values = np.concatenate(
        [
            part.reshape(len(slopes), -1)
            for part in (
                chief[..., [0, 1, 3, 4]],
                image_jacobians(telescope, direction, middle),
                rays[..., :2],
                rays[..., 3:5],
                squares,
            )
        ],
        axis=1,
    )
    flat = max(np.abs(ends[..., 2]).max() for ends in (chief, rays)) < LANDING_ERROR
    return (values if flat and np.isfinite(values).all() else None), onward
