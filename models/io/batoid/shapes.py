"""Surfaces of batoid files: sections of YAML, and their text.

A sag has its class under ``type`` and the arguments of its constructor beside it, lengths in metres:

============== =======================================================================================================
``Plane``
``Sphere``     ``R``
``Paraboloid`` ``R``
``Quadric``    ``R``, ``conic``
``Asphere``    ``R``, ``conic``, ``coefs`` of r^(2 imin), r^(2 imin + 2)...; ``imin`` is 2 by default
``Zernike``    ``coef`` from j = 0, which does nothing, ``R_outer``, ``R_inner``
``Bicubic``    ``xs``, ``ys``, ``zs``
``Tilted``     ``tanx``, ``tany``
``Sum``        ``items``
============== =======================================================================================================
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ....core.errors import PrescriptionError
from ....core.schema import Count, Parameters, Tagged, WrittenAs, checked, expected, written
from ....core.yaml_reader import as_number
from ...shapes.freeform import OddAsphere
from ...shapes.grid import GridSag
from ...shapes.polar_polynomial import from_zernikes
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ..yaml.values import ROWS, Number, Numbers


class SurfaceSection(Parameters):
    """A sag: the name of its class, and its parameters."""

    type: str


class ZernikeSection(SurfaceSection):
    """Zernike polynomials about the vertex."""

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        for key in ("x_origin", "y_origin"):
            if as_number(content.get(key, 0.0)) != 0.0:
                raise expected("0, polynomials about the vertex", key)


def _asphere(radius: float, conic: float, coefficients: tuple[float, ...], first: int) -> Shape:
    even = (0.0,) * (first - 1) + coefficients
    if not any(even[:1]):
        return EvenAsphere(radius, conic, even[1:])
    # A term in r^2 needs the shape with all powers from r^1; those of odd powers are zero.
    return OddAsphere(radius, conic, tuple(a for term in even for a in (0.0, term)))


def _zernike(coefficients: tuple[float, ...], outer: float, inner: float, x: float, y: float) -> ZernikeSag:
    return ZernikeSag(coefficients[1:] or (0.0,), outer, inner)


def _tilted(along_x: float, along_y: float) -> XYPolynomial:
    return XYPolynomial(((1, 0, along_x), (0, 1, along_y)))


def _radius(value: Any) -> float | None:
    return value if isinstance(value, float) and math.isinf(value) else as_number(value)


#: No surface has powers of hundreds.
_FIRST = Annotated[Count, Field(le=100)]
_RADIUS = Annotated[float, checked(_radius, "a number")]
_AXIS = Annotated[Numbers, WrittenAs(np.ndarray.tolist)]
_NODES = Annotated[
    tuple[Numbers, ...],
    checked(lambda v: v if isinstance(v, list) and len({len(row) for row in v if isinstance(row, list)}) == 1 else None,
            "a list of rows of numbers, all of one length"),
    WrittenAs(np.ndarray.tolist),
]  # fmt: skip
#: Sections by the name of the class.
SURFACES: dict[str, type[SurfaceSection]] = {}
_SURFACE = Tagged.by_value("type", SURFACES)
_PARTS = Annotated[
    tuple[Annotated[Any, _SURFACE], ...], ROWS, WrittenAs(lambda parts: [surface_items(part) for part in parts])
]
SURFACES |= {
    "Plane": SurfaceSection.of(Plane),
    "Sphere": SurfaceSection.of(Sphere, R=Number),
    "Paraboloid": SurfaceSection.of(lambda radius: Conic(radius, -1.0), R=Number),
    "Quadric": SurfaceSection.of(Conic, R=Number, conic=Number),
    "Asphere": SurfaceSection.of(_asphere, R=_RADIUS, conic=Number, coefs=Numbers, imin=(_FIRST, 2)),
    "Zernike": ZernikeSection.of(
        _zernike, coef=Numbers, R_outer=(Number, 1.0), R_inner=(Number, 0.0), x_origin=(Number, 0.0),
        y_origin=(Number, 0.0),
    ),
    "Bicubic": SurfaceSection.of(
        lambda x, y, values, policy: GridSag(x, y, values),
        xs=_AXIS, ys=_AXIS, zs=_NODES, nanpolicy=(Literal["nan", "NAN"], "nan"),
    ),
    "Tilted": SurfaceSection.of(_tilted, tanx=Number, tany=Number),
    "Sum": SurfaceSection.of(Sum, items=_PARTS),
}  # fmt: skip
#: A surface as the annotation of a field.
AnySurface = Annotated[Shape, _SURFACE]


def surface_items(shape: Shape) -> dict[str, Any]:
    """Return the section of a shape; PrescriptionError where batoid has no such surface."""
    if isinstance(shape, Conic) and shape.conic == -1.0:
        # Rays do not meet batoid's Quadric of this conic constant.
        return {"type": "Paraboloid", "R": shape.radius}
    if isinstance(shape, EvenAsphere):
        return _asphere_items(shape, shape.coefficients, 2)
    if isinstance(shape, OddAsphere) and not any(shape.coefficients[::2]):
        return _asphere_items(shape, shape.coefficients[1::2], 1)
    if isinstance(shape, ZernikeSag):
        return _zernike_items(shape.coefficients, shape.outer_radius, shape.inner_radius)
    if isinstance(shape, XYPolynomial):
        return _zernike_items(_zernikes_of(shape), 1.0, 0.0)
    if isinstance(shape, GridSag):
        return {"type": "Bicubic", "xs": shape.x.tolist(), "ys": shape.y.tolist(), "zs": shape.values.tolist()}
    if (section := written(SURFACES, shape)) is None:
        raise PrescriptionError(f"shape {type(shape).__name__}: expected one that batoid has: {', '.join(SURFACES)}")
    return {"type": section[0]} | section[1]


def _asphere_items(shape: EvenAsphere | OddAsphere, coefficients: tuple[float, ...], first: int) -> dict[str, Any]:
    items = {"type": "Asphere", "R": shape.radius, "conic": shape.conic, "coefs": list(coefficients)}
    items |= {"imin": first} if first != 2 else {}
    flat = math.isinf(shape.radius)
    if not flat and shape.conic != -1.0:
        return items
    # Rays do not meet batoid's aspheres of these two kinds, but they do meet their sum with the base surface.
    base = {"type": "Plane"} if flat else {"type": "Paraboloid", "R": shape.radius}
    return {"type": "Sum", "items": [base, items | {"R": math.inf, "conic": 0.0}]}


def _zernike_items(coefficients: tuple[float, ...], outer: float, inner: float) -> dict[str, Any]:
    return {"type": "Zernike", "coef": [0.0, *coefficients], "R_outer": outer, "R_inner": inner}


def _zernikes_of(shape: XYPolynomial) -> tuple[float, ...]:
    """Return the Zernike coefficients [m], over the disc of radius 1 m, of a polynomial of x and y."""
    polynomial = shape.polynomial
    # As many Zernike polynomials as monomials up to the same degree: the system is square but for rows of zeros.
    count = (polynomial.degree + 1) * (polynomial.degree + 2) // 2
    columns = []
    for j in range(count):
        terms = np.zeros((polynomial.degree + 1, polynomial.degree // 2 + 1), dtype=np.complex128)
        zernike_terms = from_zernikes((0.0,) * j + (1.0,), 1.0).terms
        terms[: zernike_terms.shape[0], : zernike_terms.shape[1]] = zernike_terms
        columns.append(np.concatenate([terms.real.ravel(), terms.imag.ravel()]))
    target = np.zeros_like(terms)
    rows, powers = (min(a, b) for a, b in zip(target.shape, polynomial.terms.shape, strict=True))
    target[:rows, :powers] = polynomial.terms[:rows, :powers]
    solution = np.linalg.lstsq(np.array(columns).T, np.concatenate([target.real.ravel(), target.imag.ravel()]))[0]
    return tuple(float(a) for a in solution)
