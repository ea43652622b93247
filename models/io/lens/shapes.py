"""Shapes of surfaces [m] from the numbers that lens files state: a conic, and what is added to it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from ...shapes.freeform import Biconic, OddAsphere, Toroid
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum

#: Powers of r of an odd asphere at most.
MOST_ODD = 30


def radius_of(curvature: float) -> float:
    """Return the radius of a curvature, infinite of 0."""
    return 1.0 / curvature if curvature else math.inf


def conic(curvature: float, constant: float = 0.0) -> Shape:
    """Return a conic of revolution of a curvature [1/m] and a conic constant."""
    if curvature == 0:
        return Plane()
    return Conic(1.0 / curvature, constant) if constant else Sphere(1.0 / curvature)


def even_asphere(curvature: float, constant: float, powers: Sequence[float]) -> Shape:
    """Return a conic with coefficients [m] of r^2, r^4, r^6...; a term in r^2 becomes a part of its own."""
    square, higher = (powers[0] if powers else 0.0), trimmed(powers[1:])
    base = EvenAsphere(radius_of(curvature), constant, higher) if higher else conic(curvature, constant)
    return total(base, XYPolynomial(((2, 0, square), (0, 2, square)))) if square else base


def odd_asphere(curvature: float, constant: float, powers: Sequence[float]) -> Shape:
    """Return a conic with coefficients [m] of r, r^2, r^3..."""
    terms = trimmed(powers)
    return OddAsphere(radius_of(curvature), constant, terms) if terms else conic(curvature, constant)


def toroid(radius_x: float, curvature_y: float, constant: float, powers: Sequence[float] = ()) -> Shape:
    """Return a conic in y with coefficients [m] of y^2, y^4..., revolved about an axis at a radius [m] along x."""
    terms = trimmed(powers)
    flat = curvature_y == 0 and math.isinf(radius_x) and not terms
    return Plane() if flat else Toroid(radius_x, radius_of(curvature_y), constant, terms)


def sum_of_conics(radius_x: float, radius_y: float, constant_x: float, constant_y: float) -> Shape:
    """Return the sum of a conic in x and one in y, radii [m]; one that is flat along an axis is a cylinder."""
    along_x = Biconic(radius_x, math.inf, constant_x, 0.0)
    along_y = Biconic(math.inf, radius_y, 0.0, constant_y)
    if math.isinf(radius_x) or math.isinf(radius_y):
        return Biconic(radius_x, radius_y, constant_x, constant_y)
    return Sum((along_x, along_y))


def polynomial(base: Shape, terms: Iterable[tuple[int, int, float]], radius: float) -> Shape:
    """Return a shape with terms a (x / radius)^i (y / radius)^j, rows (i, j, a) [m]."""
    rows = tuple((i, j, a / radius ** (i + j)) for i, j, a in terms if a)
    return total(base, XYPolynomial(rows)) if rows else base


def zernike(base: Shape, terms: Sequence[float], radius: float) -> Shape:
    """Return a shape with Zernike terms [m], Noll's from 1 on, over a disc."""
    return total(base, ZernikeSag(tuple(terms), radius)) if any(terms) else base


def total(*parts: Shape) -> Shape:
    """Return the sum of shapes, of which planes are no part."""
    curved: list[Shape] = []
    for shape in parts:
        curved += shape.parts if isinstance(shape, Sum) else [shape] if not isinstance(shape, Plane) else []
    return Sum(tuple(curved)) if len(curved) > 1 else curved[0] if curved else Plane()


def trimmed(values: Sequence[float]) -> tuple[float, ...]:
    """Return values without the zeros at their end."""
    count = next((i for i in range(len(values), 0, -1) if values[i - 1] != 0), 0)
    return tuple(values[:count])


def polynomial_powers(count: int) -> list[tuple[int, int]]:
    """Return the powers (i, j) of x and y of the terms of a polynomial in order: x, y, x^2, xy, y^2, x^3..."""
    powers = [(n - j, j) for n in range(1, 60) for j in range(n + 1)]
    return powers[:count]


def square_term(parts: list[Shape]) -> tuple[float, list[Shape]]:
    """Return the coefficient of r^2 that a part of its own has, and the other parts."""
    for shape in parts:
        terms = {(i, j): a for i, j, a in shape.terms} if isinstance(shape, XYPolynomial) else {}
        if set(terms) == {(2, 0), (0, 2)} and terms[2, 0] == terms[0, 2]:
            return terms[2, 0], [p for p in parts if p is not shape]
    return 0.0, parts
