"""Zernike polynomials in Fringe order, those of interferometers: 37 terms of amplitude one at the rim of a full disc.

Fringe index j of radial degree n and azimuthal order m (m < 0: sine) is ``(1 + (n + |m|)/2)^2 - 2 |m| + (m < 0)`` up
to 36; term 37 is the spherical aberration of degree 12 (Loomis 1978, FRINGE User's Manual; Wyant & Creath 1992, Applied
Optics and Optical Engineering XI, table III). A term is Noll's over its norm, sqrt(n + 1) or sqrt(2 (n + 1)).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import finite, metres, require_count
from .zernike_polynomials import annular_zernikes, noll_to_nm

#: Number of terms.
FRINGE_TERMS = 37
#: Names of the first terms, as optical shops call them.
FRINGE_NAMES = {
    1: "piston",
    2: "tilt x",
    3: "tilt y",
    4: "defocus",
    5: "astigmatism 0",
    6: "astigmatism 45",
    7: "coma x",
    8: "coma y",
    9: "spherical",
    10: "trefoil x",
    11: "trefoil y",
    16: "2nd spherical",
    25: "3rd spherical",
    36: "4th spherical",
    37: "5th spherical",
}


@check_arguments
def fringe_to_nm(j: int) -> tuple[int, int]:
    """Return radial degree n and signed azimuthal order m of Fringe index j (m < 0: sine)."""
    require_count(j, "Fringe index", 1, FRINGE_TERMS)
    if j == FRINGE_TERMS:
        return 12, 0
    group = math.isqrt(j - 1)  # (n + |m|) / 2
    below = (group + 1) ** 2 - j  # 2 |m|, less 1 for a sine
    m = (below + 1) // 2
    return 2 * group - m, -m if below % 2 else m


_NOLL = {noll_to_nm(j): j for j in range(1, 92)}
#: Noll index of each Fringe index from 1, and norm of that term.
_INDEX = np.array([_NOLL[fringe_to_nm(j)] for j in range(1, FRINGE_TERMS + 1)])
_NORM = np.array([math.sqrt((n + 1) * (2 if m else 1)) for n, m in map(fringe_to_nm, range(1, FRINGE_TERMS + 1))])


@check_arguments
def fringe_zernikes(jmax: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Evaluate Fringe Zernike polynomials 1 ... jmax.

    Parameters
    ----------
    jmax : int
        Highest Fringe index, at most 37.
    x, y : ndarray
        Pupil coordinates in units of the outer radius, one shape.

    Returns
    -------
    ndarray, shape [jmax, ...]
        NaN where a coordinate is NaN, or so large that its powers are.

    Raises
    ------
    DomainError
        If the index is out of range.
    """
    require_count(jmax, "jmax", 1, FRINGE_TERMS)
    noll_indices = _INDEX[:jmax]
    terms = annular_zernikes(int(noll_indices.max()), x, y)[noll_indices - 1]
    return terms / _NORM[:jmax].reshape(-1, *(1,) * (terms.ndim - 1))


@check_arguments
def fringe_from_noll(coefficients: ArrayLike) -> np.ndarray:
    """Return the Fringe coefficients of a wavefront over a full disc from its Noll coefficients.

    Parameters
    ----------
    coefficients : array_like, shape [..., jmax]
        Noll order from j = 1 [m].

    Returns
    -------
    ndarray, shape [..., 37]
        Fringe order from j = 1 [m].

    Raises
    ------
    DomainError
        If a coefficient is not finite, or one that is not zero belongs to a term that the Fringe order does not have.
    """
    noll = np.atleast_1d(finite(metres(coefficients, "coefficients"), "coefficients"))
    if not (count := noll.shape[-1]):
        raise DomainError(f"coefficients of shape {noll.shape}: expected at least one")
    absent_terms = np.setdiff1d(np.arange(count), _INDEX - 1)
    lost = absent_terms[(noll.reshape(-1, count)[:, absent_terms] != 0).any(axis=0)]
    if len(lost):
        raise DomainError(f"coefficients: Noll term {lost[0] + 1} is not among the {FRINGE_TERMS} Fringe terms")
    padded = np.concatenate([noll, np.zeros((*noll.shape[:-1], max(0, int(_INDEX.max()) - count)))], axis=-1)
    return padded[..., _INDEX - 1] * _NORM


@check_arguments
def noll_from_fringe(coefficients: ArrayLike) -> np.ndarray:
    """Return the Noll coefficients of a wavefront over a full disc from its Fringe coefficients.

    Parameters
    ----------
    coefficients : array_like, shape [..., jmax]
        Fringe order from j = 1, at most 37 [m].

    Returns
    -------
    ndarray, shape [..., n]
        Noll order from j = 1 up to the highest of the terms [m].

    Raises
    ------
    DomainError
        If a coefficient is not finite, or there are more than 37.
    """
    fringe = np.atleast_1d(finite(metres(coefficients, "coefficients"), "coefficients"))
    count = require_count(fringe.shape[-1], "number of coefficients", 1, FRINGE_TERMS)
    noll = np.zeros((*fringe.shape[:-1], int(_INDEX[:count].max())))
    noll[..., _INDEX[:count] - 1] = fringe / _NORM[:count]
    return noll
