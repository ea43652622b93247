"""Annular Zernike coefficients of an OPD map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.errors import DomainError
from ..models.zernike_polynomials import annular_zernikes
from .opd import OpdMap


@dataclass(frozen=True)
class ZernikeFit:
    """Annular Zernike coefficients of an OPD map.

    Attributes
    ----------
    coefficients : ndarray, shape [jmax]
        Noll order from j = 1 [m]; orthonormal terms, so each is its own rms over the unvignetted annulus.
    obscuration : float
        Inner over outer radius of the annulus.
    residual_rms : float
        Root mean square of what the fit leaves [m].
    """

    coefficients: np.ndarray
    obscuration: float
    residual_rms: float


def fit_zernikes(opd: OpdMap, pupil_radius: float, obscuration: float, jmax: int = 28) -> ZernikeFit:
    """Fit annular Zernikes to an OPD map by least squares over its lit points.

    Coordinates are those of the entrance pupil. Where the pupil is vignetted the terms are no longer orthogonal over
    the lit points, and the coefficients then depend on ``jmax``.

    Parameters
    ----------
    opd : OpdMap
        The map.
    pupil_radius : float
        Outer radius [m].
    obscuration : float
        Inner over outer radius.
    jmax : int
        Highest Noll index.

    Raises
    ------
    DomainError
        If fewer points are lit than there are terms.
    """
    lit = opd.lit
    if lit.sum() < jmax:
        raise DomainError(f"jmax = {jmax}: only {int(lit.sum())} pupil points are lit; expected at least as many")
    terms = annular_zernikes(jmax, opd.x[lit] / pupil_radius, opd.y[lit] / pupil_radius, obscuration)
    coefficients, *_ = np.linalg.lstsq(terms.T, opd.value[lit], rcond=None)
    residual = opd.value[lit] - coefficients @ terms
    return ZernikeFit(coefficients, obscuration, float(np.sqrt(np.mean(residual**2))))
