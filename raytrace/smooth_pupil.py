"""Aiming of very many rays of one field: a polynomial through some rays, and one step of Newton's method for each.

The map from points of the stop to points of the entrance pupil is smooth. A polynomial through rays that are found one
by one predicts all others so well that one trace to the stop and one step leave less than rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from ..core.threads import one_blas_thread

#: Fewest rays of a field for which this is faster than separate searches.
FEWEST = 1500
#: Degree of the polynomials.
_DEGREE = 10
#: Rings of the rays that the polynomials go through, of six rays more each.
_RINGS = 9
#: Distance at the stop, over its radius, at which a ray is found.
_FOUND = 1e-13
#: Distance at the stop, over its radius, whose square is below ``_FOUND``.
_NEAR = 1e-7
#: Error of the slopes of the polynomials over that of their values at most: the square of the degree, and ten times it.
_SLOPES = 1e3
#: Steps after which a ray is left to the search.
_STEPS = 8
#: Rays at once.
_AT_ONCE = 1 << 18
#: Rays whose monomials stay in the cache.
_IN_CACHE = 1 << 10

#: Function of points [n, 2]; NaN where a ray does not arrive, or is not found.
PointMap = Callable[[np.ndarray], np.ndarray]


def pupil_nodes(target: np.ndarray) -> np.ndarray:
    """Return the points of the stop, in units of its radius, that polynomials for targets [..., n, 2] are fitted to.

    Their shape is [..., n_node, 2].
    """
    return np.asarray(_node_radius(target)[..., None, None] * _disk_nodes())


def smooth_pupil(target: np.ndarray, at_nodes: np.ndarray, stop: PointMap, search: PointMap) -> np.ndarray:
    """Return the points [n, 2] of the entrance pupil [m] whose rays reach points of the stop, in units of its radius.

    ``at_nodes`` are those of :func:`pupil_nodes`; ``stop`` maps points of the entrance pupil to those of the stop;
    ``search`` finds points of the entrance pupil one by one. It is taken where polynomials fail: beyond folds of the
    pupil, and where rays do not arrive.
    """
    reach, finite = float(_node_radius(target)), np.isfinite(at_nodes).all(axis=1)
    if finite.sum() < 1.5 * _TERMS:
        return search(target)
    basis, inverse = _fit_matrices() if finite.all() else _least_squares_inverse(_monomials(_disk_nodes()[finite]))
    coefficients = inverse @ at_nodes[finite]
    table = np.concatenate([coefficients, *(_differentiated(coefficients, axis) / reach for axis in (0, 1))], axis=1)
    sense = np.sign(np.linalg.det(table[0, 2:].reshape(2, 2)))
    # A step leaves the error of its slopes, times the distance: where that is rounding, no trace has to confirm it.
    error = float(np.abs(basis @ coefficients - at_nodes[finite]).max() / np.abs(table[0, 2:]).max())
    near = min(_NEAR, _FOUND / max(_SLOPES * error, _FOUND))
    points = np.empty_like(target)
    for first in range(0, len(target), _AT_ONCE):
        chunk = slice(first, first + _AT_ONCE)
        points[chunk] = _by_newton(target[chunk], table, reach, float(sense), near, stop)
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(lost):
        points[lost] = search(target[lost])
    return points


def _by_newton(
    target: np.ndarray, table: np.ndarray, reach: float, sense: float, near: float, stop: PointMap
) -> np.ndarray:
    """Return the points of the entrance pupil [n, 2], NaN where they are not found.

    A ray is found by the step that begins within a distance `near` of its target, over the radius of the stop.
    """
    value = np.empty((len(target), 6))
    for first in range(0, len(target), _IN_CACHE):
        chunk = slice(first, first + _IN_CACHE)
        value[chunk] = _monomials(target[chunk] / reach) @ table
    points, by_x, by_y = value[:, :2].copy(), value[:, 2:4], value[:, 4:]
    active = np.arange(len(target))
    for step in range(_STEPS):
        rows = slice(None) if step == 0 else active
        miss = target[rows] - stop(points[rows])
        points[rows] += miss[:, :1] * by_x[rows] + miss[:, 1:] * by_y[rows]
        active = active[~((np.abs(miss[:, 0]) <= near) & (np.abs(miss[:, 1]) <= near))]
        if not len(active):
            break
    points[active] = np.nan
    # Beyond a fold the map goes the other way round.
    points[~((by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]) * sense > 0.0)] = np.nan
    return points


def _node_radius(target: np.ndarray) -> np.ndarray:
    """Return the radius of the nodes for targets [..., n, 2], shape [...]."""
    return np.asarray(np.maximum(1.0, np.linalg.norm(target, axis=-1).max(axis=-1)))


def _disk_nodes() -> np.ndarray:
    """Return points of the unit disk, denser towards the rim, shape [n, 2]."""
    rings = np.arange(1, _RINGS + 1)
    radius = np.sin(0.5 * np.pi * rings / _RINGS)
    angles = [2.0 * np.pi * np.arange(6 * k) / (6 * k) for k in rings]
    points = [r * np.stack([np.cos(a), np.sin(a)], axis=-1) for r, a in zip(radius, angles, strict=True)]
    return np.concatenate([np.zeros((1, 2)), *points])


@lru_cache(maxsize=1)
def _fit_matrices() -> tuple[np.ndarray, np.ndarray]:
    """Return the monomials at all nodes, and the matrix from values there to coefficients by least squares."""
    return _least_squares_inverse(_monomials(_disk_nodes()))


def _least_squares_inverse(basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    with one_blas_thread():
        return basis, np.linalg.pinv(basis)


def _powers() -> list[tuple[int, int]]:
    return [(i, degree - i) for degree in range(_DEGREE + 1) for i in range(degree, -1, -1)]


def _monomials(points: np.ndarray) -> np.ndarray:
    """Return the monomials of points, degree by degree, shape [n, n_term]."""
    terms = np.empty((_TERMS, len(points)))
    x, y = np.ascontiguousarray(points.T)
    terms[0] = 1.0
    k = 1
    for degree in range(1, _DEGREE + 1):
        terms[k : k + degree] = terms[k - degree : k] * x
        terms[k + degree] = terms[k - 1] * y
        k += degree + 1
    return terms.T


def _differentiated(coefficients: np.ndarray, axis: int) -> np.ndarray:
    """Return the coefficients of the derivatives of polynomials along an axis."""
    place = {power: k for k, power in enumerate(_powers())}
    out = np.zeros_like(coefficients)
    for (i, j), k in place.items():
        power = (i, j)[axis]
        if power:
            out[place[(i - 1, j) if axis == 0 else (i, j - 1)]] += power * coefficients[k]
    return out


_TERMS = (_DEGREE + 1) * (_DEGREE + 2) // 2
