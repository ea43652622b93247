"""Shapes of surfaces as lens files state them: a conic with a series of powers, a polynomial of x and y, a toroid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ...core.errors import PrescriptionError
from ..shapes.freeform import OddAsphere, Toroid
from ..shapes.polynomial import XYPolynomial
from ..shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ..shapes.sum import Sum

#: Relative difference of binomial coefficients that rounding makes.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Profile:
    """A conic with one of several additions, in one unit of length.

    Attributes
    ----------
    curvature, conic : float
        Curvature along y [1/unit] and conic constant.
    even : tuple of float
        Coefficients of r^2, r^4, r^6...
    odd : tuple of float
        Coefficients of r, r^2, r^3..., of a shape with odd powers.
    terms : tuple of (i, j, coefficient)
        Terms x^i y^j of a polynomial.
    curvature_x : float, optional
        Curvature along x [1/unit] of a toroid, whose section in the y, z plane is the conic.
    """

    curvature: float
    conic: float
    even: tuple[float, ...] = ()
    odd: tuple[float, ...] = ()
    terms: tuple[tuple[int, int, float], ...] = ()
    curvature_x: float | None = None

    @property
    def radius(self) -> float:
        """Radius of curvature along y to 15 digits [unit], 0 of a plane."""
        return float(f"{1.0 / self.curvature:.15g}") if self.curvature else 0.0

    @classmethod
    def of(cls, shape: Shape, unit: float) -> Profile:
        """Return the profile of a shape [m] for a unit of length [m]; PrescriptionError if it is none of these."""
        parts = list(shape.parts) if isinstance(shape, Sum) else [shape]
        even: dict[int, float] = {}
        polynomial: dict[tuple[int, int], float] = {}
        base = cls(0.0, 0.0)
        curved_count = 0
        for shape_part in parts:
            if isinstance(shape_part, XYPolynomial):
                for i, j, a in shape_part.terms:
                    polynomial[i, j] = polynomial.get((i, j), 0.0) + a
            elif isinstance(shape_part, Plane | Sphere | Conic | EvenAsphere):
                base, curved_count = (
                    cls(shape_part.curvature * unit, shape_part.conic),
                    curved_count + (not isinstance(shape_part, Plane)),
                )
                for power, a in enumerate(shape_part.coefficients, start=2):
                    even[2 * power] = even.get(2 * power, 0.0) + a * unit ** (2 * power - 1)
            elif isinstance(shape_part, OddAsphere):
                odd = tuple(a * unit ** (power - 1) for power, a in enumerate(shape_part.coefficients, start=1))
                base, curved_count = cls(unit / shape_part.radius, shape_part.conic, odd=odd), curved_count + 1
            elif isinstance(shape_part, Toroid) and shape_part.coefficients:
                raise PrescriptionError("toroid with powers of y: expected one of a conic")
            elif isinstance(shape_part, Toroid):
                base = cls(unit / shape_part.radius_y, shape_part.conic_y, curvature_x=unit / shape_part.radius_x)
                curved_count += 1
            else:
                raise PrescriptionError(
                    f"shape {type(shape_part).__name__}: expected a conic with powers of r or of x and y"
                )
        terms = tuple((i, j, a) for (i, j), a in polynomial.items())
        radial = _radial(terms)
        if radial is not None:
            terms = ()
            for power, a in radial.items():
                even[power] = even.get(power, 0.0) + a * unit ** (power - 1)
        special = bool(base.odd) or base.curvature_x is not None
        if curved_count > 1 or (special and (even or terms)) or (any(even.values()) and terms):
            kinds = ", ".join(type(shape_part).__name__ for shape_part in parts)
            raise PrescriptionError(f"sum of {kinds}: expected a conic with powers of r, or of x and y")
        highest = max((power for power, a in even.items() if a), default=0)
        polynomial_terms = tuple((i, j, a * unit ** (i + j - 1)) for i, j, a in terms)
        return replace(base, even=tuple(even.get(p, 0.0) for p in range(2, highest + 1, 2)), terms=polynomial_terms)


def _radial(terms: tuple[tuple[int, int, float], ...]) -> dict[int, float] | None:
    """Return the coefficients by power of r of a polynomial of x and y that is one of r^2, None for another."""
    coefficients = {(i, j): a for i, j, a in terms if a}
    powers: dict[int, float] = {}
    expected = 0
    for n in sorted({(i + j) // 2 for i, j in coefficients}):
        powers[2 * n] = coefficients.get((2 * n, 0), 0.0)
        row = {(2 * i, 2 * (n - i)): powers[2 * n] * math.comb(n, i) for i in range(n + 1)}
        expected += len(row)
        if n == 0 or any(not math.isclose(coefficients.get(key, 0.0), a, rel_tol=_ROUNDING) for key, a in row.items()):
            return None
    return powers if expected == len(coefficients) else None
