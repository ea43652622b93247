"""Polynomials of x and y, written as polynomials of the radius for each azimuthal order.

Monomials of x and y, Zernike polynomials (annular or not) and even powers of the radius are all of the one form::

    f(x, y) = Re sum_m q_m(s) (x + i y)^m,    s = x^2 + y^2,    q_m(s) = sum_k q_mk s^k

where Re q_m goes with cos(m theta) and -Im q_m with sin(m theta). So one evaluation, two nested Horner schemes, serves
them all, and a sum of several is one of them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from ...core.units import plane_points
from ..zernike_polynomials import noll_to_nm, radial_series


@dataclass(frozen=True, eq=False)
class PolarPolynomial:
    """A polynomial of x and y [m]."""

    terms: np.ndarray  #: coefficient of ``s^k (x + i y)^m`` [m^(1 - m - 2 k)], complex, [m_max + 1, k_max + 1]

    def __add__(self, other: PolarPolynomial) -> PolarPolynomial:
        shape = np.maximum(self.terms.shape, other.terms.shape)
        total = np.zeros(shape, dtype=np.complex128)
        for terms in (self.terms, other.terms):
            total[: terms.shape[0], : terms.shape[1]] += terms
        return PolarPolynomial(total)

    @property
    def degree(self) -> int:
        """Highest total degree in x and y of a term that is not zero."""
        m, k = np.nonzero(self.terms)
        return int((m + 2 * k).max(initial=0))

    @property
    def order(self) -> int:
        """Highest azimuthal order m of a term that is not zero."""
        return int(np.nonzero(self.terms)[0].max(initial=0))

    def value(self, x: Any, y: Any) -> np.ndarray:
        """Return the polynomial at points [m], any shape."""
        return self._sums(x, y)[0].real

    def gradient(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives along x and along y."""
        _, f_z, f_s, *_ = self._sums(x, y)
        return (f_z + 2 * x * f_s).real, (1j * f_z + 2 * y * f_s).real

    def hessian(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the second derivatives along xx, xy and yy [1/m]."""
        _, _, f_s, f_zz, f_zs, f_ss = self._sums(x, y)
        xx = f_zz + 4 * x * f_zs + 2 * f_s + 4 * x * x * f_ss
        xy = 1j * f_zz + 2 * (y + 1j * x) * f_zs + 4 * x * y * f_ss
        yy = -f_zz + 4j * y * f_zs + 2 * f_s + 4 * y * y * f_ss
        return xx.real, xy.real, yy.real

    def _sums(self, x: Any, y: Any) -> tuple[np.ndarray, ...]:
        """Return the complex sum and its derivatives z, s, zz, zs, ss, with z = x + iy and s independent."""
        x, y = plane_points(x, y)
        z, s = x + 1j * y, x * x + y * y
        f, f_z, f_s, f_zz, f_zs, f_ss = (np.zeros(x.shape, dtype=np.complex128) for _ in range(6))
        for series in self.terms[::-1]:
            q, q_s, q_ss = (np.zeros(x.shape, dtype=np.complex128) for _ in range(3))
            for coefficient in series[::-1]:
                q_ss = q_ss * s + 2 * q_s
                q_s = q_s * s + q
                q = q * s + coefficient
            # Each line needs the value that the next one changes.
            f_zz = f_zz * z + 2 * f_z
            f_zs = f_zs * z + f_s
            f_z = f_z * z + f
            f, f_s, f_ss = f * z + q, f_s * z + q_s, f_ss * z + q_ss
        return f, f_z, f_s, f_zz, f_zs, f_ss


def from_even_powers(coefficients: Sequence[float], first: int = 4) -> PolarPolynomial:
    """Return ``sum_n a_n r^n`` over even n from ``first``; the coefficients are in m^(1 - n)."""
    return PolarPolynomial(np.array([[0.0] * (first // 2) + list(coefficients)], dtype=np.complex128))


def from_monomials(monomials: Sequence[tuple[int, int, float]]) -> PolarPolynomial:
    """Return ``sum a x^i y^j`` over terms (i, j, a), the coefficients in m^(1 - i - j)."""
    degree = max((i + j for i, j, _ in monomials), default=0)
    terms = np.zeros((degree + 1, degree // 2 + 1), dtype=np.complex128)
    for i, j, a in monomials:
        # x^i y^j = ((z + z*) / 2)^i ((z - z*) / 2i)^j; z^p z*^q is s^min(p, q) times a power of z or of z*. Terms in
        # z* are the conjugates of those in z, so those in z count twice.
        for p in range(i + 1):
            for q in range(j + 1):
                factor = a * comb(i, p) * comb(j, q) * (-1) ** (j - q) / (2.0 ** (i + j)) / 1j**j
                up, down = p + q, i + j - p - q
                if up >= down:
                    terms[up - down, down] += factor * (2 if up > down else 1)
    return PolarPolynomial(terms)


def from_zernikes(coefficients: Sequence[float], outer_radius: float, inner_radius: float = 0.0) -> PolarPolynomial:
    """Return a sum of annular Zernike polynomials, Noll order from j = 1 [m], over an annulus of given radii [m]."""
    orders = [noll_to_nm(j) for j in range(1, len(coefficients) + 1)]
    m_max = max((abs(m) for _, m in orders), default=0)
    n_max = max((n for n, _ in orders), default=0)
    terms = np.zeros((m_max + 1, n_max // 2 + 1), dtype=np.complex128)
    for m in range(m_max + 1):
        rows = [(a, n, signed) for a, (n, signed) in zip(coefficients, orders, strict=True) if abs(signed) == m]
        count = (max(n for _, n, _ in rows) - m) // 2 + 1
        series = radial_series(m, count, inner_radius / outer_radius)
        scale = outer_radius ** -(m + 2.0 * np.arange(count)) * (1.0 if m == 0 else np.sqrt(2.0))
        for a, n, signed in rows:
            column = series[:, (n - m) // 2] * scale
            terms[m, :count] += a * (column if signed >= 0 else -1j * column)
    return PolarPolynomial(terms)
