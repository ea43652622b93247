"""Smooth functions of the pupil: polynomials through values at many points, and their derivatives."""

from __future__ import annotations

import numpy as np

#: Degree of the polynomials: landing points of an aberrated telescope are smooth over the pupil.
_DEGREE = 8


class PupilPolynomials:
    """Polynomials of the eighth degree over points of the pupil.

    Parameters
    ----------
    points : ndarray, shape [n, 2]
        Points at which values are given [m].
    center : ndarray, shape [2]
        Middle of the pupil [m].
    least : float
        Lower bound of the radius that scales coordinates [m].
    """

    def __init__(self, points: np.ndarray, center: np.ndarray, least: float) -> None:
        self._center, self._radius = center, max(float(np.abs(points - center).max()), least)
        self._values, self._slopes = self._terms(points)
        self._products = self._values.T @ self._values

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return monomials at points [n, 2], shape [n, m], and their derivatives along x and y [1/m], [2, n, m]."""
        x, y = (points - self._center).T / self._radius
        p, q = np.array([(a, b) for a in range(_DEGREE + 1) for b in range(_DEGREE + 1 - a)]).T
        powers_x, powers_y = (np.vander(v, _DEGREE + 1, increasing=True) for v in (x, y))
        values = powers_x[:, p] * powers_y[:, q]
        along_x = (p / self._radius) * powers_x[:, np.maximum(p - 1, 0)] * powers_y[:, q]
        along_y = (q / self._radius) * powers_x[:, p] * powers_y[:, np.maximum(q - 1, 0)]
        return values, np.stack([along_x, along_y])

    def _fitted(self, values: np.ndarray) -> np.ndarray:
        # Monomials up to the eighth degree: products keep seven digits. Too few points determine some of them.
        return np.linalg.lstsq(self._products, self._values.T @ values, rcond=1e-13)[0]

    def derivatives(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of values [n, 2] along the pupil at the points, shape [n, 2, 2]."""
        return np.moveaxis(self._slopes @ self._fitted(values), 0, -1)

    def at(self, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values [n, k] at other points [m, 2], shape [m, k], and their derivatives there, [m, k, 2]."""
        terms, slopes = self._terms(points)
        fitted = self._fitted(values)
        return terms @ fitted, np.moveaxis(slopes @ fitted, 0, -1)
