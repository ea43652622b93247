"""From the axes of Zemax, where light enters along +z, to those of a telescope, where it enters along -z, and back.

The two differ by half a turn about y: ``(x, y, z)`` there is ``(-x, y, -z)`` here, for points and for each surface's
own axes alike. So a surface that is not tilted is not tilted here either, its sag changes sign and its x axis is
turned round. Half a turn about y is its own inverse: the functions below work both ways.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from ....core.errors import PrescriptionError
from ...aperture import Annulus, Aperture, Circle, Complement, Intersection, Polygon, Rectangle, Union, Vane
from ...shapes.freeform import Biconic, OddAsphere, Toroid, XYPolynomial, ZernikeSag
from ...shapes.grid import GridSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere, Sum
from ...surface import IDENTITY, Matrix
from ...zernike_polynomials import noll_to_nm

TURN = np.diag([-1.0, 1.0, -1.0])


def turned_axes(axes: np.ndarray) -> Matrix:
    """Return the axes of a surface (columns, shape (3, 3)) on the other side."""
    turned = TURN @ axes @ TURN
    if np.array_equal(turned, np.eye(3)):
        return IDENTITY
    return cast(Matrix, tuple(tuple(float(v) for v in row) for row in turned + 0.0))


def turned_shape(shape: Shape) -> Shape:
    """Return the shape seen along the turned axes: ``-sag(-x, y)``.

    Raises
    ------
    PrescriptionError
        If it is a kind of shape that Zemax files do not hold here.
    """
    if isinstance(shape, Plane):
        return shape
    if isinstance(shape, Sphere):
        return Sphere(-shape.radius)
    if isinstance(shape, Conic):
        return Conic(-shape.radius, shape.conic)
    if isinstance(shape, EvenAsphere | OddAsphere):
        return type(shape)(-shape.radius, shape.conic, tuple(-a for a in shape.coefficients))
    if isinstance(shape, Biconic):
        return Biconic(-shape.radius_x, -shape.radius_y, shape.conic_x, shape.conic_y)
    if isinstance(shape, Toroid):
        return Toroid(-shape.radius_x, -shape.radius_y, shape.conic_y)
    if isinstance(shape, XYPolynomial):
        return XYPolynomial(tuple((i, j, a if i % 2 else -a) for i, j, a in shape.terms))
    if isinstance(shape, ZernikeSag):
        turned = tuple(-a * _parity(j) for j, a in enumerate(shape.coefficients, start=1))
        return ZernikeSag(turned, shape.outer_radius, shape.inner_radius)
    if isinstance(shape, GridSag):
        return GridSag(-shape.x[::-1], shape.y, -shape.values[:, ::-1])
    if isinstance(shape, Sum):
        return Sum(tuple(turned_shape(part) for part in shape.parts))
    raise PrescriptionError(f"shape {type(shape).__name__}: expected one that a Zemax file can hold")


def _parity(j: int) -> int:
    """Return the sign that a Zernike polynomial takes when x does; cos and sin of m theta, theta to pi - theta."""
    _, m = noll_to_nm(j)
    sign = -1 if m % 2 else 1
    return sign if m >= 0 else -sign


def turned_aperture(aperture: Aperture) -> Aperture:
    """Return the clear region seen along the turned axes: x changes sign."""
    if isinstance(aperture, Circle):
        return Circle(aperture.radius, 0.0 - aperture.x, aperture.y)
    if isinstance(aperture, Annulus):
        return Annulus(aperture.inner, aperture.outer, 0.0 - aperture.x, aperture.y)
    if isinstance(aperture, Rectangle):
        return Rectangle(aperture.width, aperture.height, 0.0 - aperture.x, aperture.y, 0.0 - aperture.angle)
    if isinstance(aperture, Vane):
        return Vane(aperture.width, 0.0 - aperture.x, aperture.y, math.pi - aperture.angle, aperture.both_ways)
    if isinstance(aperture, Polygon):
        return Polygon(tuple((0.0 - x, y) for x, y in aperture.corners))
    if isinstance(aperture, Complement):
        return Complement(turned_aperture(aperture.part))
    if isinstance(aperture, Union | Intersection):
        return type(aperture)(tuple(turned_aperture(part) for part in aperture.parts))
    raise PrescriptionError(f"aperture {type(aperture).__name__}: expected one that a Zemax file can hold")
