"""Fresnel's equations: light that a bare interface reflects and transmits, unpolarised (Born & Wolf, section 1.5.3).

::

    R_s = ((n1 cos i - n2 cos t) / (n1 cos i + n2 cos t))^2,   R_p = ((n2 cos i - n1 cos t) / (n2 cos i + n1 cos t))^2
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.layer_stack import checked_cosines


@check_arguments
def fresnel_transmission(cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
    """Return the transmission of a bare interface for unpolarised light.

    Parameters
    ----------
    cosine : array_like
        Cosine of the angle of incidence.
    n1, n2 : float
        Refractive indices before and behind.

    Returns
    -------
    ndarray
        Transmitted power over incident power, mean of both polarisations; 0 where reflection is total.

    Raises
    ------
    DomainError
        If a cosine is beyond 1, or an index is not positive.
    """
    if not (0 < n1 < np.inf and 0 < n2 < np.inf):
        raise DomainError(f"n1 = {n1!r}, n2 = {n2!r}: expected positive refractive indices")
    return 1.0 - fresnel_reflectivity(checked_cosines(cosine), n1, n2)


def fresnel_reflectivity(cosine: np.ndarray, before: float, after: float) -> np.ndarray:
    """Return the reflectivity of a bare interface for unpolarised light (Fresnel's equations); 1 at total reflection.

    The refractive indices are those on the side of the light and on the other.
    """
    cosine = np.abs(np.asarray(cosine, dtype=np.float64))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        square = 1.0 - np.square(np.float64(before) / after) * (1.0 - cosine**2)
        within = np.sqrt(np.maximum(square, 0.0))
        s = (before * cosine - after * within) / (before * cosine + after * within)
        p = (after * cosine - before * within) / (after * cosine + before * within)
    return np.where(square > 0, 0.5 * (s**2 + p**2), 1.0)


def refracted_reflectivity(turn: np.ndarray, before: float, after: float) -> np.ndarray:
    """Return the reflectivity of a bare interface for light that it refracts, from the cosine of the angle of turn.

    Snell's law in vectors, n' d' - n d along the normal, gives both cosines from the cosine t of the angle by which the
    ray is turned. In Fresnel's ratios their common length cancels: with a = n^2 + n'^2, b = 2 n n' and c = n'^2 - n^2
    they are (a - b t) / c across the plane of incidence and (a - b / t) / c in it.
    """
    if before == after:
        return np.zeros_like(turn)
    square, double = before * before + after * after, 2.0 * before * after
    across, along = square - double * turn, square - double / turn
    return np.asarray((across * across + along * along) * (0.5 / (after * after - before * before) ** 2))
