"""Fit of annular Zernikes to an OPD map."""

from __future__ import annotations

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import require_count, require_positive
from ..models.zernike_polynomials import MOST_TERMS, annular_zernikes
from .opd_map import OpdMap, ZernikeFit


@check_arguments
def fit_zernikes(opd: OpdMap, pupil_radius: float, obscuration: float, jmax: int = 28) -> ZernikeFit:
    """Fit annular Zernikes to an OPD map by least squares over its lit points.

    Coordinates are those of the entrance pupil. Where the pupil is vignetted the terms are no longer orthogonal over
    the lit points, and the coefficients then depend on ``jmax``.

    Parameters
    ----------
    opd : OpdMap
        The map.
    pupil_radius : float
        Outer radius of the pupil [m].
    obscuration : float
        Inner over outer radius of the pupil.
    jmax : int
        Highest Noll index.

    Raises
    ------
    DomainError
        If fewer points are lit than there are terms, or the radius is not about that of the lit points: a tenth of the
        farthest to ten times.
    """
    pupil_radius, lit = require_positive(pupil_radius, "pupil_radius", "metres"), opd.lit
    if lit.sum() < require_count(jmax, "jmax", 1, MOST_TERMS):
        raise DomainError(f"jmax = {jmax}: only {int(lit.sum())} pupil points are lit; expected at least as many")
    farthest = float(np.hypot(opd.x[lit], opd.y[lit]).max())
    if not 0.1 * pupil_radius <= farthest <= 10.0 * pupil_radius:
        raise DomainError(f"pupil_radius = {pupil_radius:g} m: expected about that of the lit points, {farthest:.4g} m")
    terms = annular_zernikes(jmax, opd.x[lit] / pupil_radius, opd.y[lit] / pupil_radius, obscuration)
    coefficients, *_ = np.linalg.lstsq(terms.T, opd.value[lit], rcond=None)
    residual = opd.value[lit] - coefficients @ terms
    return ZernikeFit(coefficients, obscuration, float(np.sqrt(np.mean(residual**2))))
