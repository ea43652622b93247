"""Optical part of a focal-plane model: long-exposure PSFs at fitted heights and alignment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...models.camera.focal_plane import FocalPlane
from ...wavefront.aberration import ResidualWavefront
from .covariance import Places
from .heights import HeightPrior
from .response import ExposureResponse, Instrument

# Difference in height for the derivative of the shapes [m].
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class OpticsPart:
    """Optics of one exposure, fitted.

    Attributes
    ----------
    instrument : Instrument
        Telescope, wavelengths, atmosphere and detector.
    plane : FocalPlane
        Fitted heights.
    aberration : ResidualWavefront
        Fitted residual wavefront.
    seeing : float
        Logarithm of the Fried parameter over the assumed one.
    prior : HeightPrior
        Parametrisation of the heights.
    covariance : ndarray of float32, shape [n_parameter, n_parameter]
        Covariance of the parameters of the heights and of the exposure.
    response : ExposureResponse
        Derivatives with respect to the parameters of the exposure.
    """

    instrument: Instrument
    plane: FocalPlane
    aberration: ResidualWavefront
    seeing: float
    prior: HeightPrior
    covariance: np.ndarray
    response: ExposureResponse

    @property
    def pixel_scale(self) -> float:
        """Angle of a pixel of the images [rad]."""
        return self.instrument.pixel_scale

    def shapes(
        self, places: Places, threads: int | None = None, progress: Callable[[int], None] | None = None
    ) -> np.ndarray:
        """Return e1, e2 and ln size at places, shape [n, 3]."""
        fields = self.instrument.fields(places.xy, threads)
        return self.instrument.shapes(fields, self.plane, self.aberration, self.seeing, threads, progress)

    def images(self, places: Places, threads: int | None = None) -> np.ndarray:
        """Return the PSFs of unit sum at places, shape [n, ny, nx]."""
        fields = self.instrument.fields(places.xy, threads)
        return self.instrument.images(fields, self.plane, self.aberration, self.seeing, threads)[0]

    def design(self, places: Places, shapes: np.ndarray, threads: int | None = None) -> np.ndarray:
        """Return the derivatives of the shapes with respect to the parameters of the CCD, shape [n, n_parameter, 3].

        `shapes` [n, 3] are those of :meth:`shapes` at the places.
        """
        fields = self.instrument.fields(places.xy, threads)
        heights = self.plane.height(*places.xy.T)
        # One-sided: these derivatives serve for the uncertainty alone.
        slopes = (self._shapes_at_step(fields, threads) - shapes) / _STEP
        return self.design_of(places, slopes, self.response.columns(fields, heights))

    def design_of(self, places: Places, slopes: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the same from derivatives [n, 3] with respect to height and columns [n, 25, 3] of the exposure."""
        terms = np.concatenate([self.prior.common_terms(places), self.prior.ccd_polynomials(places)], axis=1)
        return np.concatenate([terms[:, :, None] * slopes[:, None], columns], axis=1)

    def _shapes_at_step(self, fields: np.ndarray, threads: int | None) -> np.ndarray:
        surfaces = self.plane.surfaces
        polynomial = surfaces.polynomial.copy()
        polynomial[:, 0] += _STEP
        moved = replace(self.plane, surfaces=replace(surfaces, polynomial=polynomial))
        return self.instrument.shapes(fields, moved, self.aberration, self.seeing, threads)
