r"""Landing points of the light of one donut, and their response to the unknown wavefront.

Rays pass given points p of the plane of the entrance pupil. A wavefront W(p) [m] beside the telescope's own, positive
where it leads, is an optical delay of -W: it turns the light at p by :math:`-\nabla W`, and the ray lands elsewhere by
:math:`-J(p) \nabla W`, with J(p) the derivative of the landing point with respect to the direction cosines of the
incoming light at a fixed point of the pupil. Rays are traced with their own changed directions, so landing points
are exact for a wavefront of any size. Where rays are aimed, Zernikes are functions of the stop's coordinates.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ...core.errors import DomainError
from ...models.telescope import Telescope
from ...models.zernike_polynomials import annular_zernike_gradients
from ...raytrace.aiming import pupil_coordinates
from ...raytrace.launch import launch_bundles
from ...raytrace.rays import Rays, RayStatus, parallel_rays
from ...raytrace.trace import trace
from ...wavefront.chief_rays import JACOBIAN_STEP
from .pupil_cells import PupilCells

#: Step of the differences by which aimed pupil points follow those of the entrance pupil, in units of its radius.
_DIFFERENCE = 1e-4


class LightRays(Protocol):
    """Landing points of one star's light as functions of the unknowns of its wavefront."""

    weights: np.ndarray  #: fractions of the light of the points, [n]

    def landing(self, unknowns: np.ndarray) -> np.ndarray:
        """Return landing points minus that of the chief ray [m], detector x and y, shape [n, 2]."""

    def spread(self, landing: np.ndarray) -> np.ndarray:
        """Return second moments of the image of each point, beside the footprint of the cells [m^2], [n, 2, 2]."""

    def response(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivatives of :meth:`landing` with respect to the unknowns, shape [2, n, n_unknown]."""


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
        self._telescope, self._direction, self._wavelengths = telescope, direction, wavelengths
        self._cells, self._points = cells, cells.points
        self.weights = np.outer(wavelength_weights, cells.weights).ravel()
        middle = float(wavelengths[len(wavelengths) // 2])
        self._chief = chief_landing(telescope, direction, middle)
        #: Derivatives of the terms along x and y of the plane of the entrance pupil [1/m], [n_term, 2, n_point].
        self._gradients = _gradients(telescope, direction, middle, cells.points, noll)
        self._response = -np.concatenate([self._jacobian_times_gradients(float(w)) for w in wavelengths], axis=1)
        #: Sides of the image of a cell [m], columns of a matrix.
        self.footprint = cells.footprint(self._landing(middle, np.zeros((1, 2))))

    def _landing(self, wavelength: float, slopes: np.ndarray) -> np.ndarray:
        """Return detector x and y [m] of rays whose direction cosines are changed by slopes [n, 2] or [1, 2]."""
        cosines = np.broadcast_to(self._direction[:2] + slopes, self._points.shape)
        down = -np.sqrt(1.0 - (cosines**2).sum(axis=1, keepdims=True))
        directions = np.concatenate([cosines, down], axis=1)
        return landing_of(
            self._telescope, parallel_rays(self._telescope, directions, wavelength, self._points[:, None])
        )

    def _jacobian_times_gradients(self, wavelength: float) -> np.ndarray:
        """Return J(p) times the gradients of the terms, shape [2, n_point, n_term]."""
        step = JACOBIAN_STEP * np.eye(2)
        along = [(self._landing(wavelength, s[None]) - self._landing(wavelength, -s[None])) for s in step]
        jacobian = np.stack(along, axis=-1) / (2.0 * JACOBIAN_STEP)  # [n_point, detector axis, direction axis]
        return np.einsum("pij,tjp->ipt", jacobian, self._gradients)

    def landing(self, unknowns: np.ndarray) -> np.ndarray:
        """Return landing points for coefficients [m]; see :class:`LightRays`."""
        slopes = -np.einsum("t,tjp->pj", unknowns, self._gradients)
        return np.concatenate([self._landing(float(w), slopes) for w in self._wavelengths]) - self._chief

    def spread(self, landing: np.ndarray) -> np.ndarray:
        """Return the spread of the image of each point; see :class:`LightRays`."""
        return spread_of(self._cells, landing, self.footprint)

    def response(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the response at zero coefficients, the same to 1e-3 for all; see :class:`LightRays`."""
        return self._response


def _gradients(
    telescope: Telescope, direction: np.ndarray, wavelength: float, points: np.ndarray, noll: np.ndarray
) -> np.ndarray:
    """Return the derivatives of Zernike terms of the pupil by points of its plane [1/m], [n_term, 2, n_point]."""
    radius = 0.5 * telescope.pupil_diameter
    x, y = pupil_coordinates(telescope, direction, wavelength, points).T / radius
    terms: np.ndarray = annular_zernike_gradients(int(noll.max()), x, y, telescope.pupil_obscuration)[noll - 1] / radius
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
    each = landing.reshape(-1, len(cells), 2)
    return np.concatenate([cells.spread(one, footprint) for one in each])


def landing_of(telescope: Telescope, rays: Rays) -> np.ndarray:
    """Return landing points x and y [m] in the detector's own frame, shape [n, 2]."""
    return telescope.surfaces[-1].to_local(trace(telescope, rays, threads=1).position)[:, :2]


def chief_landing(telescope: Telescope, direction: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the landing point x, y [m] of the chief ray, vignetting ignored; a lost ray is a DomainError."""
    end = trace(telescope, launch_bundles(telescope, direction[None], wavelength, np.zeros((1, 2))), threads=1)
    if end.status[0] > RayStatus.VIGNETTED:
        raise DomainError("the chief ray does not reach the image")
    return telescope.surfaces[-1].to_local(end.position)[0, :2]
