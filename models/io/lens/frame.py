"""Rotation between the axes of a lens, where light enters along +z, and those of a telescope, where it enters along -z.

The two differ by half a turn about y: ``(x, y, z)`` in one is ``(-x, y, -z)`` in the other, for points and for the
local axes of each surface alike. A surface that is not tilted in one is not tilted in the other; its sag changes sign
and its x axis is reversed. Half a turn is its own inverse, so the functions below work both ways.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np

from ....core.errors import PrescriptionError
from ...aperture import Aperture, Complement, Ellipse, Intersection, Polygon, Rectangle, Union, Vane
from ...shapes.freeform import Biconic, OddAsphere, Toroid
from ...shapes.grid import GridSag
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.qbfs import QbfsAsphere
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ...surface import IDENTITY, Matrix
from ...zernike_polynomials import noll_to_nm

#: Half a turn about y.
HALF_TURN = np.diag([-1.0, 1.0, -1.0])


def rotated_axes(axes: np.ndarray) -> Matrix:
    """Return the axes of a surface (columns, shape (3, 3)) in the other frame."""
    rotated = HALF_TURN @ axes @ HALF_TURN
    if np.array_equal(rotated, np.eye(3)):
        return IDENTITY
    return cast(Matrix, tuple(tuple(float(v) for v in row) for row in rotated + 0.0))


def rotated_shape(shape: Shape) -> Shape:
    """Return the shape in the rotated axes, ``-sag(-x, y)``; PrescriptionError if lens files have no such shape."""
    if isinstance(shape, Plane):
        return shape
    if isinstance(shape, Sphere | Conic):
        return replace(shape, radius=-shape.radius)
    if isinstance(shape, EvenAsphere | OddAsphere | QbfsAsphere):
        return replace(shape, radius=-shape.radius, coefficients=tuple(-a for a in shape.coefficients))
    if isinstance(shape, Biconic):
        return replace(shape, radius_x=-shape.radius_x, radius_y=-shape.radius_y)
    if isinstance(shape, Toroid):
        powers = tuple(-a for a in shape.coefficients)
        return replace(shape, radius_x=-shape.radius_x, radius_y=-shape.radius_y, coefficients=powers)
    if isinstance(shape, XYPolynomial):
        return XYPolynomial(tuple((i, j, a if i % 2 else -a) for i, j, a in shape.terms))
    if isinstance(shape, ZernikeSag):
        return replace(shape, coefficients=tuple(-a * _parity(j) for j, a in enumerate(shape.coefficients, start=1)))
    if isinstance(shape, GridSag):
        return GridSag(-shape.x[::-1], shape.y, -shape.values[:, ::-1])
    if isinstance(shape, Sum):
        return Sum(tuple(rotated_shape(component) for component in shape.parts))
    raise PrescriptionError(f"shape {type(shape).__name__}: expected one that a lens file can hold")


def _parity(j: int) -> int:
    """Return the sign of a Zernike polynomial under x to -x: cos and sin of m theta, theta to pi - theta."""
    _, m = noll_to_nm(j)
    sign = -1 if m % 2 else 1
    return sign if m >= 0 else -sign


def rotated_aperture(aperture: Aperture) -> Aperture:
    """Return the clear region in the rotated axes: x changes sign."""
    if isinstance(aperture, Polygon):
        return Polygon(tuple((0.0 - x, y) for x, y in aperture.corners))
    if isinstance(aperture, Complement):
        return Complement(rotated_aperture(aperture.part))
    if isinstance(aperture, Union | Intersection):
        return type(aperture)(tuple(rotated_aperture(region) for region in aperture.parts))
    if isinstance(aperture, Ellipse | Rectangle | Vane):
        aperture = replace(aperture, angle=(math.pi if isinstance(aperture, Vane) else 0.0) - aperture.angle)
    return replace(aperture, x=0.0 - aperture.x)
