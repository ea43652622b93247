r"""Residual aberration of active optics: a small random wavefront of each exposure, added to the traced one.

Wavefront sensors in the four corners of the LSST's focal plane keep mirrors and camera in place, "within the <~ 0.2 um
accuracy" of the reconstructed wavefront (Jee & Tyson 2011, sec. 2, after Manuel et al. 2010), with errors that are
random from one exposure to the next (their sec. 6). The residual OPD is

.. math:: W(p, \theta) = \sum_j (c_j + g_j \cdot \theta) Z_j(p),

annular Zernikes of the entrance pupil whose coefficients have a constant and a linear part over the field: the first
three terms of a double Zernike expansion. To first order these are the effects of shifted and tilted elements: a
decentre brings coma that is constant over the field, a tilted camera defocus that is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.random_streams import stream
from ..core.row_sums import sums_of_products
from ..core.units import metres, plane_points, radians, require_seed
from ..models.telescope import Telescope
from ..models.zernike_polynomials import annular_zernike_gradients, annular_zernikes, noll_to_nm

#: Accuracy that Jee & Tyson (2011) quote for the LSST's active optics [m].
PAPER_RMS = 0.2e-6
#: Largest rms that can be drawn [m], ten times the paper's: beyond it the blur of 1.5 arcsec extends beyond the stamps.
LARGEST_RMS = 10.0 * PAPER_RMS
# Points of a pupil whose terms are stored.
_FEW_POINTS = 1000
#: Fraction of the variance, averaged over the field, that is linear in the field angle. Four sensors at the corners of
#: a square within the field, of equal and independent errors, give a plane with as much variance in its slopes as in
#: its mean.
LINEAR_FRACTION = 0.5


@check_arguments
@dataclass(frozen=True, eq=False)
class ResidualWavefront:
    """An aberration added to the traced wavefront.

    Attributes
    ----------
    coefficients : ndarray, shape [n_term]
        OPD of the Noll terms j = 4, 5, ... on the axis [m]: positive where the wavefront leads, as
        :func:`~pachon.wavefront.zernike.fit_zernikes` gives them.
    pupil_diameter, pupil_obscuration : float
        Outer diameter of the entrance pupil [m], and its inner over its outer diameter.
    field_gradient : ndarray, shape [n_term, 2], optional
        Change of the coefficients along the field slopes x and y [m/rad]; none by default.
    """

    coefficients: np.ndarray
    pupil_diameter: float
    pupil_obscuration: float
    field_gradient: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def __repr__(self) -> str:
        return f"<ResidualWavefront: {len(self.coefficients)} Noll terms, pupil {self.pupil_diameter:g} m>"

    def __post_init__(self) -> None:
        values = metres(self.coefficients, "coefficients")
        gradient = np.asarray(self.field_gradient, dtype=np.float64)
        gradient = gradient if gradient.size else np.zeros((values.size, 2))
        if values.ndim != 1 or not np.isfinite(values).all():
            raise DomainError(
                f"coefficients of shape {values.shape}: expected a list of finite lengths in metres, from Noll's j = 4"
            )
        if gradient.shape != (len(values), 2) or not np.isfinite(gradient).all():
            raise DomainError(
                f"field_gradient of shape {gradient.shape}: expected finite numbers, shape ({len(values)}, 2)"
            )
        if not (math.isfinite(self.pupil_diameter) and self.pupil_diameter > 0.0):
            raise DomainError(f"pupil_diameter = {self.pupil_diameter!r}: expected a positive length in metres")
        if not 0.0 <= self.pupil_obscuration < 1.0:
            raise DomainError(f"pupil_obscuration = {self.pupil_obscuration!r}: expected 0 <= obscuration < 1")
        for name, array in (("coefficients", values.copy()), ("field_gradient", gradient.copy())):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def draw(
        cls,
        telescope: Telescope,
        rms: ArrayLike = PAPER_RMS,
        seed: int = 0,
        epoch: int = 0,
        *,
        terms: Iterable[int] = range(4, 23),
        linear_fraction: float = LINEAR_FRACTION,
    ) -> ResidualWavefront:
        """Draw the aberration of one exposure.

        Every term is Gaussian and independent of the others. Variances fall as n^(-11/3) with the radial degree n, as
        those of turbulence do (Noll 1976), which limits the wavefront sensors in their own exposures. The paper gives
        the size of the error, not its distribution over the terms.

        Parameters
        ----------
        telescope : Telescope
            Telescope with the pupil and the field radius.
        rms : float or Quantity
            Root mean square of the OPD over pupil, field of view and exposures [m], 0 to 2 um; 0.2 um in the paper.
        seed, epoch : int
            Seed of the run and number of the exposure; aberrations of exposures are independent.
        terms : iterable of int
            Noll indices to draw, from 4; to the second spherical aberration by default. Tilt only moves stars.
        linear_fraction : float
            Fraction of the variance that is linear over the field, 0 to 1; at 0 all stars have the same aberration.

        Returns
        -------
        ResidualWavefront

        Raises
        ------
        DomainError
            If an argument is outside its range.
        """
        size = metres(rms, "rms")
        if size.size != 1 or not 0.0 <= size.item() <= LARGEST_RMS:
            raise DomainError(f"rms = {rms!r}: expected 0 to {LARGEST_RMS:g} m of wavefront error")
        if not 0.0 <= linear_fraction <= 1.0:
            raise DomainError(f"linear_fraction = {linear_fraction!r}: expected 0 to 1")
        for name, number in (("seed", seed), ("epoch", epoch)):
            require_seed(number, name)
        noll_indices = sorted(set(terms))
        if not noll_indices or noll_indices[0] < 4:
            raise DomainError(f"terms = {noll_indices}: expected Noll indices from 4 (piston and tilt are not drawn)")
        variance = np.array([float(noll_to_nm(j)[0]) ** (-11.0 / 3.0) for j in noll_indices])
        sigma = size.item() * np.sqrt(variance / variance.sum())
        # The mean square of a slope along x over a disc is a quarter of the square of its radius.
        per_radian = math.sqrt(2.0 * linear_fraction) / telescope.field_radius
        coefficients, gradient = np.zeros(noll_indices[-1] - 3), np.zeros((noll_indices[-1] - 3, 2))
        for j, scale in zip(noll_indices, sigma, strict=True):
            normal = scale * stream(seed, "active optics", epoch, j).standard_normal(3)
            coefficients[j - 4] = math.sqrt(1.0 - linear_fraction) * normal[0]
            gradient[j - 4] = per_radian * normal[1:]
        return cls(coefficients, telescope.pupil_diameter, telescope.pupil_obscuration, gradient)

    def at(self, slopes: ArrayLike) -> np.ndarray:
        """Return the coefficients [m] at field slopes [..., 2] of the light's travel, shape [..., n_term]."""
        values = radians(slopes, "slopes")
        if values.shape[-1:] != (2,):
            raise DomainError(f"slopes of shape {values.shape}: expected [..., 2]")
        tx, ty = np.split(values, 2, axis=-1)
        return self.coefficients + tx * self.field_gradient[:, 0] + ty * self.field_gradient[:, 1]

    def opd(self, x: ArrayLike, y: ArrayLike, slopes: ArrayLike = (0.0, 0.0)) -> np.ndarray:
        """Return the OPD [m] over the pupil, of mean zero over the annulus, positive where the wavefront leads.

        Parameters
        ----------
        x, y : ndarray, shape [n_pupil]
            Entrance-pupil coordinates [m].
        slopes : ndarray, shape [..., 2]
            Slopes (tx, ty) of the light's travel [rad]; on the axis by default.

        Returns
        -------
        ndarray, shape [..., n_pupil]
            NaN where the powers of a coordinate have no number.
        """
        return _sum_of_terms(self.at(slopes), self._basis(annular_zernikes, x, y))

    def gradient(self, x: ArrayLike, y: ArrayLike, slopes: ArrayLike = (0.0, 0.0)) -> np.ndarray:
        """Return the derivatives of :meth:`opd` along x and y of the pupil [rad], shape [..., n_pupil, 2].

        They are NaN where the powers of a coordinate have no number.
        """
        basis = self._basis(annular_zernike_gradients, x, y) / (0.5 * self.pupil_diameter)
        return _sum_of_terms(self.at(slopes), np.moveaxis(basis, 1, -1))

    def _basis(self, terms: Callable[..., np.ndarray], x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the terms or their derivatives from j = 4 on."""
        radius, last = 0.5 * self.pupil_diameter, 3 + len(self.coefficients)
        px, py = (points / radius for points in plane_points(x, y))
        if px.size <= _FEW_POINTS:
            return _stored_terms(terms, last, px.tobytes(), py.tobytes(), px.shape, self.pupil_obscuration)[3:]
        return terms(last, px, py, self.pupil_obscuration)[3:]


@dataclass(frozen=True, eq=False)
class StarWavefronts(ResidualWavefront):
    """A separate aberration for each star; a field point has that of the nearest star.

    Attributes
    ----------
    stars : ndarray, shape [n_star, n_term]
        Coefficients of each star, as those of a :class:`ResidualWavefront`.
    slopes : ndarray, shape [n_star, 2]
        Field slopes of the stars [rad].
    """

    stars: np.ndarray = field(default_factory=lambda: np.zeros((1, 0)))
    slopes: np.ndarray = field(default_factory=lambda: np.zeros((1, 2)))

    def at(self, slopes: ArrayLike) -> np.ndarray:
        """Return the coefficients [m] at field slopes [..., 2] of the light's travel, shape [..., n_term]."""
        apart = np.asarray(slopes, dtype=np.float64)[..., None, :] - self.slopes
        return np.asarray(self.stars[np.argmin((apart**2).sum(axis=-1), axis=-1)])


@lru_cache(maxsize=8)
def _stored_terms(
    terms: Callable[..., np.ndarray], last: int, x: bytes, y: bytes, shape: tuple[int, ...], obscuration: float
) -> np.ndarray:
    """Return terms at a few points, the same for all stars of an engine."""
    values = terms(last, *(np.frombuffer(points).reshape(shape) for points in (x, y)), obscuration)
    values.setflags(write=False)
    return values


def _sum_of_terms(coefficients: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Sum terms in a fixed order, so that the bytes of a star do not depend on its neighbours."""
    count = len(basis)
    total = sums_of_products(coefficients.reshape(-1, count), basis.reshape(count, -1))
    return total.reshape(coefficients.shape[:-1] + basis.shape[1:])
