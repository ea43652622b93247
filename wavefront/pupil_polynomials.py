"""Smooth functions of the pupil: polynomials through values at many points, and their derivatives."""

from __future__ import annotations

import numpy as np

#: Degree of the polynomials: landing points of an aberrated telescope are smooth over the pupil.
_DEGREE = 8
_POWERS = np.arange(_DEGREE + 1.0)
#: Powers of x and of y in each monomial.
_P, _Q = np.array([(a, b) for a in range(_DEGREE + 1) for b in range(_DEGREE + 1 - a)]).T


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
        values, slopes = self._terms(points)
        # Monomials up to the eighth degree: products keep seven digits. Too few points determine some of them.
        self._values, self._inverse = values, np.linalg.pinv(values @ values.T, rcond=1e-13, hermitian=True)
        self._slopes = slopes.astype(np.float32)

    def _terms(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return monomials at points [n, 2], shape [m, n], and their derivatives along x and y [1/m], [2, m, n]."""
        powers = self._powers(points)
        slopes = np.zeros_like(powers)
        slopes[:, 1:] = powers[:, :-1] * (_POWERS[1:, None] / self._radius)
        (x, y), (slopes_x, slopes_y) = powers, slopes
        monomials = np.empty((3, len(_P), len(points)))
        for out, along_x, along_y in zip(monomials, (x, slopes_x, x), (y, y, slopes_y), strict=True):
            np.multiply(along_x[_P], along_y[_Q], out=out)
        return monomials[0], monomials[1:]

    def _powers(self, points: np.ndarray) -> np.ndarray:
        """Return powers of the coordinates of points [n, 2] in units of the radius, shape [2, degree + 1, n]."""
        powers = np.ones((2, _DEGREE + 1, len(points)))
        powers[:, 1] = (points - self._center).T / self._radius
        for k in range(2, _DEGREE + 1):
            np.multiply(powers[:, k - 1], powers[:, 1], out=powers[:, k])
        return powers

    def fitted(self, values: np.ndarray) -> np.ndarray:
        """Return the coefficients of values [n, k], shape [m, k]."""
        right = self._values @ values
        fitted = self._inverse @ right
        # One step of refinement: the inverse of nearly dependent products is the less exact of the two.
        return np.asarray(fitted + self._inverse @ (right - self._values @ (self._values.T @ fitted)))

    def derivatives(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of values [n, 2] along the pupil at the points, in single precision, [n, 2, 2]."""
        fitted = self.fitted(values).astype(np.float32)
        return np.moveaxis(np.matmul(fitted.T, self._slopes), 0, -1).transpose(1, 0, 2)

    def at(self, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values [n, k] at other points [m, 2], shape [m, k], and their derivatives there, [m, k, 2]."""
        return self.sums(points, self.fitted(values))

    def sums(self, points: np.ndarray, fitted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and derivatives as :meth:`at`, from the coefficients of :meth:`fitted`."""
        coefficients = np.zeros((fitted.shape[1], _DEGREE + 1, _DEGREE + 1))
        coefficients[:, _P, _Q] = fitted.T
        x, y = self._powers(points)
        # Sums over powers of y first: monomials of both take several times as long.
        along_y = coefficients @ y
        slopes_y = (coefficients[:, :, 1:] * _POWERS[1:]) @ y[:-1]
        values = np.einsum("kpn,pn->nk", along_y, x)
        by_x = np.einsum("kpn,pn->nk", along_y[:, 1:] * _POWERS[1:, None], x[:-1])
        by_y = np.einsum("kpn,pn->nk", slopes_y, x)
        return values, np.stack([by_x, by_y], axis=-1) / self._radius
