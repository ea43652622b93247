"""Root finding for rays: the two coordinates of each ray whose landing point is given.

Broyden's method (1965, Math. Comp. 19, 577) for all rays together. Each ray is on its own, so a batch may be split.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Distance from its target at which the search for a ray ends [size].
_FOUND = 1e-12
#: Distance from its target at which a ray counts as found after the last step [size].
_NEAR = 1e-9
#: Most steps of the iteration.
_STEPS = 30
#: Most halvings of a step that increases the distance.
_HALVINGS = 8

#: Function from coordinates [k, 2] and indices of rays [k] to landing points [k, 2]; NaN where a ray does not arrive.
Landing = Callable[[np.ndarray, np.ndarray], np.ndarray]


def find_points(
    landing: Landing,
    start: np.ndarray,
    target: np.ndarray,
    size: float,
    difference: float,
    slopes: np.ndarray | None = None,
) -> np.ndarray:
    """Return the coordinates [n, 2] of rays that land at targets [n, 2]; NaN where the search fails.

    Parameters
    ----------
    landing : callable
        Function from coordinates and indices of rays to landing points.
    start : ndarray, shape [n, 2]
        Coordinates that the search starts from.
    target : ndarray, shape [n, 2]
        Landing points.
    size : float
        Length on the landing surface that the accuracy of 1e-12 belongs to.
    difference : float
        Step of the coordinates that the first derivatives are taken over.
    slopes : ndarray, shape [n, 2, 2], optional
        First derivatives where they are known, about.
    """
    points, indices = start.copy(), np.arange(len(start))
    landed = landing(points, indices)
    miss = landed - target
    slopes = derivatives(landing, points, difference, landed) if slopes is None else slopes.copy()
    stuck = np.zeros(len(points), dtype=bool)
    for _ in range(_STEPS):
        distance = np.linalg.norm(miss, axis=1)
        # A ray at NaN is lost: no step leads away from it.
        active = np.flatnonzero((distance > _FOUND * size) & ~stuck & (np.abs(determinants(slopes)) > 0.0))
        if not len(active):
            break
        step = -solve_2x2(slopes[active], miss[active])
        for _ in range(_HALVINGS):
            trial = landing(points[active] + step, active) - target[active]
            astray = ~(np.linalg.norm(trial, axis=1) < distance[active])
            if not astray.any():
                break
            step = np.where(astray[:, None], 0.5 * step, step)
        stuck[active[astray]] = True
        rows, step, change = active[~astray], step[~astray], (trial - miss[active])[~astray]
        residual = change - (slopes[rows] @ step[..., None])[..., 0]
        slopes[rows] += residual[..., None] * step[:, None] / (step**2).sum(axis=1)[:, None, None]
        points[rows] += step
        miss[rows] = trial[~astray]
    points[~(np.linalg.norm(miss, axis=1) <= _NEAR * size)] = np.nan
    return points


def determinants(matrices: np.ndarray) -> np.ndarray:
    """Return the determinants of matrices [n, 2, 2]; NaN of such as hold NaN."""
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def solve_2x2(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solutions [n, 2] of linear equations, by Cramer's rule; NaN or infinite where there is none."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    x, y = right.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([d * x - b * y, a * y - c * x], axis=-1) / determinants(matrices)[:, None]


def derivatives(
    landing: Landing, points: np.ndarray, difference: float, landed: np.ndarray | None = None
) -> np.ndarray:
    """Return the derivatives [n, 2, 2] of landing points by the coordinates, from one-sided differences."""
    indices = np.arange(len(points))
    landed = landing(points, indices) if landed is None else landed
    # Both sides in one trace: with few rays the launch of the kernel takes most of the time.
    moved = np.concatenate([points + difference * axis for axis in np.eye(2)])
    beside = landing(moved, np.tile(indices, 2)).reshape(2, -1, 2) - landed
    return np.moveaxis(beside, 0, -1) / difference
