r"""Landing points of the light of one donut, and their response to the unknown wavefront.

Rays pass given points p of the plane of the entrance pupil. A wavefront W(p) [m] beside the telescope's own, positive
where it leads, is an optical delay of -W: it turns the light at p by :math:`-\nabla W`, and the ray lands elsewhere by
:math:`-J(p) \nabla W`, with J(p) the derivative of the landing point with respect to the direction cosines of the
incoming light at a fixed point of the pupil. Rays are traced with their own changed directions, so landing points
are exact for a wavefront of any size. Where rays are aimed, Zernikes are functions of the stop's coordinates.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..core.errors import DomainError
from ..models.telescope import Telescope
from ..models.zernike_polynomials import low_zernike_gradients
from ..raytrace.aiming import pupil_coordinates
from ..raytrace.launch import launch_bundles
from ..raytrace.rays import Rays, RayStatus, parallel_rays
from ..raytrace.trace import trace
from ..wavefront.psf.pupil_rims import PupilRims
from .pupil_cells import PupilCells, moments_beyond
from .rim_light import RimsAt

#: Distance that light has moved by since it was traced, over the side of the image of a cell, up to which it is taken
#: to have moved by its response: this is right to a thousandth, which is 1e-4 pixels.
_FOLLOWED = 0.05
#: Angle by which light is turned for the change of its landing points [rad].
_TURN = 1e-5
#: Step of the differences by which aimed pupil points follow those of the entrance pupil, in units of its radius.
_DIFFERENCE = 1e-4


class LightRays(Protocol):
    """Landing points of one star's light as functions of unknowns: those of the wavefront, then shifts of rims."""

    cells: PupilCells  #: points of the pupil and their weights
    rates: np.ndarray  #: derivatives of :meth:`weights` with respect to the shifts of rims [1/m], [n, n_shift]

    @property
    def count(self) -> int:
        """Number of unknowns."""

    def weights(self, unknowns: np.ndarray) -> np.ndarray:
        """Return fractions of the light of the points, shape [n]."""

    def landing(self, unknowns: np.ndarray) -> np.ndarray:
        """Return landing points minus that of the chief ray [m], detector x and y, shape [n, 2]."""

    def spread(self, landing: np.ndarray) -> np.ndarray:
        """Return second moments of the image of each point, beside the footprint of the cells [m^2], [n, 2, 2]."""

    def at_rims(self, rims: PupilRims, landing: np.ndarray, response: np.ndarray | None) -> RimsAt:
        """Return where the light of rims lands for landing points of the light [m], and its own response to them."""

    def response(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivatives of :meth:`landing` with respect to the unknown wavefront, shape [2, n, n_wave]."""

    def release(self) -> None:
        """Free what can be computed again."""


@dataclass
class _LastLight:
    """Light of a wavefront: coefficients [m], landing points [m], spread of its image once that was computed.

    It `follows` other light by its response, unless its own rays were traced.
    """

    coefficients: np.ndarray
    landing: np.ndarray
    spread: np.ndarray | None = None
    follows: _LastLight | None = None

    @property
    def traced(self) -> _LastLight:
        """The light that was traced."""
        return self.follows or self


class ZernikeRays:
    """Landing points for a wavefront of annular Zernikes [m].

    Parameters
    ----------
    telescope : Telescope
        Telescope with the detector where the star's light meets it.
    direction : ndarray, shape [3]
        Unit vector along which the light travels.
    wavelengths, wavelength_weights : ndarray, shape [n_wave]
        Vacuum wavelengths [m] and fractions of the light.
    cells : PupilCells
        Points of the pupil and their weights, for all wavelengths.
    noll : ndarray of int
        Noll indices of the terms.
    """

    def __init__(
        self,
        telescope: Telescope,
        direction: np.ndarray,
        wavelengths: np.ndarray,
        wavelength_weights: np.ndarray,
        cells: PupilCells,
        noll: np.ndarray,
    ) -> None:
        self._direction, self._wavelengths, self._fractions = direction, wavelengths, wavelength_weights
        self.cells, self._points, self.noll = cells, cells.points, noll
        self._weights, self.rates = cells.at_wavelengths(wavelength_weights)
        self._middle = float(wavelengths[len(wavelengths) // 2])
        #: Derivatives of the terms along x and y of the plane of the entrance pupil [1/m], [n_term, 2, n_point].
        self._gradients = _gradients(telescope, direction, self._middle, cells.points, noll)
        self._set_telescope(telescope)
        self._jacobians = [self._jacobian(float(w)) for w in self._wavelengths]
        self._set_response(self._gradients)
        self._moving = self._single

    def _set_telescope(self, telescope: Telescope) -> None:
        """Have the landing points of light through a telescope."""
        self._telescope = telescope
        self._chief = chief_landing(telescope, self._direction, self._middle)
        self._begin({})

    def _begin(self, straight: dict[float, np.ndarray]) -> None:
        """Begin with landing points without a wavefront beside the telescope's, where they are at hand."""
        #: Several images of one wavefront follow each other, and others near it.
        self._last: _LastLight | None = None
        self._straight = straight
        self._merged: ZernikeRays | None = None
        #: Sides of the image of a cell [m], columns of a matrix.
        self.footprint = self.cells.footprint(self._unaberrated(self._middle))

    def through(self, telescope: Telescope) -> ZernikeRays:
        """Return the light of the same cells of the pupil, of the same response, through a telescope out of focus."""
        rays = copy(self)
        rays._set_telescope(telescope)
        return rays

    def merged(self) -> ZernikeRays:
        """Return the light of squares of two by two cells, for images that are coarse enough."""
        if self._merged is None:
            merging = self.cells.merging()

            def mean(values: np.ndarray) -> np.ndarray:
                """Return means of values of the cells [..., n]."""
                return np.asarray((merging @ values.reshape(-1, values.shape[-1]).T).T.reshape(*values.shape[:-1], -1))

            rays = copy(self)
            rays.cells = self.cells.merged(merging)
            rays._points = rays.cells.points
            rays._weights, rays.rates = rays.cells.at_wavelengths(self._fractions)
            rays._gradients = mean(self._gradients)
            rays._jacobians = [np.moveaxis(mean(np.moveaxis(j, 1, 2)), 2, 1) for j in self._jacobians]
            rays._begin({w: mean(landing.T).T for w, landing in self._straight.items()})
            rays._set_response(rays._gradients)
            rays._moving = rays._single
            self._merged = rays
        return self._merged

    def _landing(self, wavelength: float, slopes: np.ndarray) -> np.ndarray:
        """Return detector x and y [m] of rays, [m, n, 2], with direction cosines changed by slopes [m, n or 1, 2]."""
        cosines = np.broadcast_to(self._direction[:2] + slopes, (len(slopes), *self._points.shape))
        with np.errstate(invalid="ignore"):
            # NaN for slopes of more than a right angle, which trials of a search may have.
            down = -np.sqrt(1.0 - (cosines**2).sum(axis=2, keepdims=True))
        directions = np.concatenate([cosines, down], axis=2).reshape(-1, 3)
        points = np.tile(self._points, (len(slopes), 1))[:, None]
        return landing_of(self._telescope, parallel_rays(self._telescope, directions, wavelength, points)).reshape(
            cosines.shape
        )

    def _unaberrated(self, wavelength: float) -> np.ndarray:
        """Return landing points without a wavefront beside the telescope's, shape [n, 2]."""
        if wavelength not in self._straight:
            self._straight[wavelength] = self._landing(wavelength, np.zeros((1, 1, 2)))[0]
        return self._straight[wavelength]

    def _jacobian(self, wavelength: float) -> np.ndarray:
        """Return J(p), shape [direction axis, n_point, detector axis]."""
        # Differences to one side are off by 1e-5: light turns by as much as it lands elsewhere.
        along = self._landing(wavelength, _TURN * np.eye(2)[:, None])
        return np.asarray((along - self._unaberrated(wavelength)) / _TURN)

    def _set_response(self, gradients: np.ndarray) -> None:
        """Have the response to terms of these gradients [n_term, 2, n_point]."""
        x, y = np.moveaxis(gradients, 1, 0)
        x, y = (np.ascontiguousarray(v.T, dtype=np.float32) for v in (x, y))
        products = [
            np.stack([-jacobian[0, :, i, None] * x - jacobian[1, :, i, None] * y for i in range(2)])
            for jacobian in (j.astype(np.float32) for j in self._jacobians)
        ]
        self._single = np.concatenate(products, axis=1)
        self._rims = RimsOfCells(self.cells, self._single)

    def responding_to(self, noll: np.ndarray) -> ZernikeRays:
        """Return the same light for the same unknowns, with the response to other terms that it does not have."""
        rays = copy(self)
        rays._set_response(_gradients(self._telescope, self._direction, self._middle, self._points, noll))
        return rays

    def beside(self, points: np.ndarray, moments: np.ndarray, landing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where light through points of the pupil next to the cells lands, and the spread of its image.

        Parameters
        ----------
        points : ndarray, shape [m, 2]
            Points of the plane of the entrance pupil [m].
        moments : ndarray, shape [m, 2, 2]
            Second moments of what they stand for [m^2].
        landing : ndarray, shape [n, 2]
            Landing points of the light of the cells [m], one wavelength after the other.

        Returns
        -------
        landing, spread : ndarray, shapes [n_wave * m, 2] and [n_wave * m, 2, 2]
            As those of :class:`LightRays`, one wavelength after the other.
        """
        smooth = [self.cells.smooth.at(points, places) for places in landing.reshape(-1, len(self.cells), 2)]
        spreads = [moments_beyond(self.footprint, magnification, moments) for _, magnification in smooth]
        return np.concatenate([places for places, _ in smooth]), np.concatenate(spreads)

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self._gradients) + self.rates.shape[1]

    def weights(self, unknowns: np.ndarray) -> np.ndarray:
        """Return fractions of the light; see :class:`LightRays`."""
        return self._weights + self.rates @ unknowns[len(self._gradients) :]

    def holding(self, shifts: np.ndarray) -> ZernikeRays:
        """Return the light with its first rims held at shifts [m], for unknowns of the wavefront and other rims."""
        held, count = copy(self), len(shifts)
        held._weights, held.rates = self._weights + self.rates[:, :count] @ shifts, self.rates[:, count:]
        return held

    def landing(self, unknowns: np.ndarray) -> np.ndarray:
        """Return landing points for coefficients [m]; see :class:`LightRays`."""
        coefficients = unknowns[: len(self._gradients)]
        if self._last is None or not np.array_equal(self._last.coefficients, coefficients):
            self._last = self._light_of(coefficients.copy())
        return self._last.landing

    def _light_of(self, coefficients: np.ndarray) -> _LastLight:
        """Return light of some coefficients [m], which follows the last that was traced where it is near that."""
        if not coefficients.any():
            straight = np.concatenate([self._unaberrated(float(w)) for w in self._wavelengths])
            return _LastLight(coefficients, straight - self._chief)
        if self._last is not None:
            traced = self._last.traced
            moved = (self._moving @ (coefficients - traced.coefficients).astype(np.float32)).T
            limit = _FOLLOWED**2 * abs(float(np.linalg.det(self.footprint)))
            if float(np.abs(self._weights) @ (moved**2).sum(axis=1)) < limit:
                return _LastLight(coefficients, traced.landing + moved, follows=traced)
        slopes = -np.tensordot(coefficients, self._gradients, axes=1).T[None]
        landing = np.concatenate([self._landing(float(w), slopes)[0] for w in self._wavelengths])
        return _LastLight(coefficients, landing - self._chief)

    def spread(self, landing: np.ndarray) -> np.ndarray:
        """Return the spread of the image of each point; see :class:`LightRays`."""
        if self._last is None or landing is not self._last.landing:
            return spread_of(self.cells, landing, self.footprint)
        traced = self._last.traced
        if traced.spread is None:
            traced.spread = spread_of(self.cells, traced.landing, self.footprint)
        return traced.spread

    def at_rims(self, rims: PupilRims, landing: np.ndarray, response: np.ndarray | None) -> RimsAt:
        """Return the rims on the detector; see :class:`LightRays`."""
        return self._rims.at(rims, landing, responding=response is not None)

    def response(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the response at zero coefficients, the same to 1e-3 for all; see :class:`LightRays`."""
        return self._single

    def release(self) -> None:
        """Free the polynomials over the pupil."""
        self.cells.release()


def _gradients(
    telescope: Telescope, direction: np.ndarray, wavelength: float, points: np.ndarray, noll: np.ndarray
) -> np.ndarray:
    """Return the derivatives of Zernike terms of the pupil by points of its plane [1/m], [n_term, 2, n_point]."""
    radius = 0.5 * telescope.pupil_diameter
    x, y = pupil_coordinates(telescope, direction, wavelength, points).T / radius
    terms = low_zernike_gradients(noll, x, y, telescope.pupil_obscuration) / radius
    if telescope.design_data.aiming == "off":
        return terms
    step = _DIFFERENCE * radius
    sides = [
        pupil_coordinates(telescope, direction, wavelength, points + axis)
        - pupil_coordinates(telescope, direction, wavelength, points - axis)
        for axis in step * np.eye(2)
    ]
    # [n_point, pupil axis, axis of the plane]: the terms are functions of the pupil, which the front of a lens deforms.
    change = np.stack(sides, axis=-1) / (2.0 * step)
    return np.einsum("tip,pij->tjp", terms, change)


def spread_of(cells: PupilCells, landing: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Return the spreads [m^2] of the landing points of one or more wavelengths, one after the other."""
    by_wavelength = landing.reshape(-1, len(cells), 2)
    return np.concatenate([cells.spread(points, footprint) for points in by_wavelength])


class RimsOfCells:
    """Rims on the detector, from the landing points of the cells of the pupil.

    Parameters
    ----------
    cells : PupilCells
        The cells.
    response : ndarray, shape [2, n, n_wave], optional
        Derivatives of the landing points of the cells, of one or more wavelengths one after the other [m]; without
        them rims have none.
    """

    def __init__(self, cells: PupilCells, response: np.ndarray | None = None) -> None:
        self._cells, self._response = cells, response
        self._last: tuple[PupilRims, np.ndarray, np.ndarray] | None = None

    def at(self, rims: PupilRims, landing: np.ndarray, *, responding: bool = True) -> RimsAt:
        """Return rims at the middle wavelength for landing points of the cells [m], shape [n, 2]."""
        smooth = self._cells.smooth
        if self._response is None or not responding:
            none = np.zeros((2, len(rims.points), 0))
            return RimsAt(*rims.landing(smooth, self._middle(landing)), none, none)
        if self._last is None or self._last[0] is not rims:
            places, leans = zip(*(rims.landing(smooth, self._middle(axis)) for axis in self._response), strict=True)
            self._last = rims, np.stack(places), np.stack(leans)
        _, response, inward_response = self._last
        return RimsAt(*rims.landing(smooth, self._middle(landing)), response, inward_response)

    def _middle(self, values: np.ndarray) -> np.ndarray:
        """Return values of all wavelengths at the middle one."""
        by_wavelength = values.reshape(-1, len(self._cells), values.shape[1])
        return np.asarray(by_wavelength[len(by_wavelength) // 2])


def landing_of(telescope: Telescope, rays: Rays) -> np.ndarray:
    """Return landing points x and y [m] in the detector's own frame, shape [n, 2]."""
    return telescope.surfaces[-1].to_local(trace(telescope, rays, threads=1).position)[:, :2]


def chief_landing(telescope: Telescope, direction: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the landing point x, y [m] of the chief ray, vignetting ignored; a lost ray is a DomainError."""
    end = trace(telescope, launch_bundles(telescope, direction[None], wavelength, np.zeros((1, 2))), threads=1)
    if end.status[0] > RayStatus.VIGNETTED:
        raise DomainError("the chief ray does not reach the image")
    return telescope.surfaces[-1].to_local(end.position)[0, :2]
