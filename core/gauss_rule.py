"""Gauss rules over distributions that are given at points (Golub & Welsch 1969, Math. Comp. 23, 221)."""

from __future__ import annotations

import math

import numpy as np


def gauss_rule(points: np.ndarray, density: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights [count] of the Gauss rule over a distribution at points [n], of parts [n] of sum 1.

    It has the mean of polynomials up to the order ``2 count - 1``; there are more points than nodes.
    """
    from scipy.linalg import eigh_tridiagonal

    # Recurrence of the orthonormal polynomials of the distribution, by Stieltjes' procedure.
    diagonal, beside = np.empty(count), np.zeros(count)
    previous, current = np.zeros_like(points), np.ones_like(points)
    for k in range(count):
        diagonal[k] = density @ (points * current**2)
        following = (points - diagonal[k]) * current - beside[k - 1] * previous
        beside[k] = math.sqrt(density @ following**2)
        previous, current = current, following / beside[k]
    nodes, vectors = eigh_tridiagonal(diagonal, beside[: count - 1])
    return nodes, vectors[0] ** 2
