"""Fit of annular Zernikes to an OPD map."""

from __future__ import annotations

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import require_count, require_positive
from ..models.zernike_polynomials import MOST_TERMS, annular_zernikes
from .opd_map import OpdMap, ZernikeFit

#: Least over greatest singular value of terms that points tell apart: where 4 % of HSC's pupil are lit, 28 terms have
#: 3e-11, and coefficients of 10 cm.
SEPARATED = 1e-5


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
        If fewer points are lit than there are terms, these cannot be told apart where light passes, or the radius is
        not about that of the lit points: a tenth of the farthest to ten times.
    """
    pupil_radius, lit = require_positive(pupil_radius, "pupil_radius", "metres"), opd.lit
    if lit.sum() < require_count(jmax, "jmax", 1, MOST_TERMS):
        raise DomainError(f"jmax = {jmax}: only {int(lit.sum())} pupil points are lit; expected at least as many")
    farthest = float(np.hypot(opd.x[lit], opd.y[lit]).max())
    if not 0.1 * pupil_radius <= farthest <= 10.0 * pupil_radius:
        raise DomainError(f"pupil_radius = {pupil_radius:g} m: expected about that of the lit points, {farthest:.4g} m")
    terms = annular_zernikes(jmax, opd.x[lit] / pupil_radius, opd.y[lit] / pupil_radius, obscuration)
    coefficients, _, _, sizes = np.linalg.lstsq(terms.T, opd.value[lit], rcond=None)
    if sizes[-1] < SEPARATED * sizes[0]:
        count = int(lit.sum())
        raise DomainError(f"jmax = {jmax}: terms cannot be told apart at the {count} lit points; expected fewer")
    residual = opd.value[lit] - coefficients @ terms
    return ZernikeFit(coefficients, obscuration, float(np.sqrt(np.mean(residual**2))))
