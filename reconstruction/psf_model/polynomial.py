"""Polynomials of a position on a CCD, of limited total degree."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError
from ...core.units import real_array

Extent = tuple[float, float, float, float]

#: Largest position in any unit.
_LARGEST = 1e50


def term_count(order: int) -> int:
    """Return how many terms x^l y^m there are with l + m <= order."""
    return (order + 1) * (order + 2) // 2


#: Highest order of a polynomial.
MOST_ORDER = 100
# Orders from which an automatic choice is made.
_AUTOMATIC_ORDERS = range(5)
#: Number of folds of stars that are held out for it; the i-th star is in fold i modulo this.
FOLDS = 5
# Most terms of polynomials over the stars that they are fitted to.
_MOST_TERMS = 0.5


def automatic_orders(n_stars: int) -> list[int]:
    """Return the orders of polynomials that may be chosen for so many stars, ascending."""
    fitted = n_stars - -(-n_stars // FOLDS)
    return [order for order in _AUTOMATIC_ORDERS if order == 0 or term_count(order) <= _MOST_TERMS * fitted]


def design_matrix(positions: Any, extent: Extent, order: int) -> np.ndarray:
    """Return the polynomial terms at each position, [n, n_terms], of total degree up to `order`.

    The terms are products of Legendre polynomials P_l(u) P_m(v), l + m <= order, in which (u, v) is the position mapped
    from the extent to [-1, 1]. They span the same functions as x^l y^m (Jee & Tyson 2011, sec. 3) and stay nearly
    orthogonal for stars spread over the CCD, so that the fit loses no digits.
    """
    if not 0 <= order <= MOST_ORDER:
        raise ConfigError(f"order = {order}: expected a polynomial order from 0 to {MOST_ORDER}")
    along_u, along_v = (np.polynomial.legendre.legvander(t, order) for t in mapped(positions, extent).T)
    return np.stack([along_u[:, i] * along_v[:, j] for i, j in degrees(order)], axis=1)


def degrees(order: int) -> list[tuple[int, int]]:
    """Return the degrees (l, m) of the terms of :func:`design_matrix`, in their order."""
    return [(total - m, m) for total in range(order + 1) for m in range(total + 1)]


def mapped(positions: Any, extent: Extent) -> np.ndarray:
    """Return positions [n, 2] mapped from the extent to [-1, 1]."""
    points = as_positions(positions)
    xmin, xmax, ymin, ymax = extent
    u = 2.0 * (points[:, 0] - xmin) / (xmax - xmin) - 1.0
    v = 2.0 * (points[:, 1] - ymin) / (ymax - ymin) - 1.0
    return np.stack([u, v], axis=1)


def as_positions(positions: Any) -> np.ndarray:
    """Return positions as a float64 array [n, 2] (one position may be given as [2])."""
    points = real_array(positions, "positions: expected real numbers [n, 2]")
    if points.ndim == 1:
        points = points[None]
    if points.ndim != 2 or points.shape[1] != 2:
        raise DomainError(f"positions have shape {np.shape(positions)}: expected [n, 2]")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise DomainError(f"positions[{finite.argmin()}] is not finite")
    if points.size and (largest := np.abs(points).max()) > _LARGEST:
        raise DomainError(f"positions of {largest:g}: expected numbers below {_LARGEST:g}, whose squares are finite")
    return points
