"""Geometries of optiland as shapes, and shapes as geometries.

The sag of each, with the base conic of ``radius`` and ``conic``, ``r^2 = x^2 + y^2`` [mm]:

============================ =========================================================================================
Plane, StandardGeometry      the conic
EvenAsphere                  + coefficients of r^2, r^4...
OddAsphere                   + coefficients of r, r^2...
PolynomialGeometry           + coefficients [i][j] of x^i y^j
ChebyshevPolynomialGeometry  + coefficients [i][j] of T_i(x / norm_x) T_j(y / norm_y)
ZernikePolynomialGeometry    + Zernike terms of (x, y) / norm_radius, in the order of zernike_type
BiconicGeometry              sum of a conic in x and one in y, as in optiland up to 0.6
ToroidalGeometry             a conic in y with coefficients of y^2, y^4..., revolved about an axis at radius_x
ForbesQNormalSlopeGeometry   + Forbes's Qbfs terms of (r / norm_radius)^2
PlaneGrating                 a plane with grooves (`gratings`)
StandardGratingGeometry      the conic with grooves
============================ =========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError
from ...shapes.freeform import Biconic, OddAsphere, Toroid
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.qbfs import QbfsAsphere
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ...zernike_polynomials import noll_to_nm
from ..json_items import JsonObject
from ..lens import shapes
from ..lens.shapes import MOST_ODD, polynomial_powers, square_term
from ..lens.source import Findings
from .gratings import GRATINGS, GROOVES

MM = 1e-3
#: Highest degree of polynomials.
MOST_DEGREE = 40


def shape_of(geometry: JsonObject, findings: Findings) -> tuple[float, Shape]:
    """Return the height of the sag at the vertex [m], and the shape of a geometry without it."""
    kind = geometry.text("type")
    if kind not in _KINDS:
        findings.report(geometry.problem(f"geometry {kind}: expected one of {', '.join(_KINDS)}"), "taken as a plane")
        return 0.0, Plane()
    with geometry.part(f"geometry {kind}").context():
        shape = _KINDS[kind](geometry)
    geometry.report_rest(findings, ("cs", "tol", "max_iter", "geometry_type", *(GROOVES if kind in GRATINGS else ())))
    return shape if isinstance(shape, tuple) else (0.0, shape)


def _base(geometry: JsonObject) -> tuple[float, float]:
    """Return curvature [1/m] and conic constant."""
    radius = geometry.number("radius", math.inf, infinite=True)
    return (1.0 / radius if radius else 0.0) / MM, geometry.number("conic", 0.0)


def _conic(geometry: JsonObject) -> Shape:
    return shapes.conic(*_base(geometry))


def _even(geometry: JsonObject) -> Shape:
    terms = geometry.numbers("coefficients")
    return shapes.even_asphere(*_base(geometry), [a * MM ** (1 - 2 * i) for i, a in enumerate(terms, start=1)])


def _odd(geometry: JsonObject) -> Shape:
    terms = geometry.numbers("coefficients")
    if any(terms[MOST_ODD:]):
        geometry.refuse("coefficients", f"at most {MOST_ODD} of them")
    powers = [a * MM ** (1 - i) for i, a in enumerate(terms[:MOST_ODD], start=1)]
    return shapes.odd_asphere(*_base(geometry), powers)


def _table(geometry: JsonObject) -> np.ndarray:
    """Return the coefficients [i, j] of a polynomial."""
    value = geometry.get("coefficients")
    rows = value if isinstance(value, list) else []
    try:
        table = np.atleast_2d(np.array([row if isinstance(row, list) else [row] for row in rows], dtype=np.float64))
    except (TypeError, ValueError):
        table = np.full((1, 1), np.nan)
    if not table.size or not np.all(np.isfinite(table)) or sum(table.shape) > MOST_DEGREE + 2:
        geometry.refuse("coefficients", f"rows of finite numbers, all of one length, of degrees up to {MOST_DEGREE}")
    return table


def _polynomial(geometry: JsonObject) -> tuple[float, Shape]:
    return _power_series(geometry, _table(geometry))


def _chebyshev(geometry: JsonObject) -> tuple[float, Shape]:
    table = _table(geometry)
    for axis, key in enumerate(("norm_x", "norm_y")):
        size, norm = table.shape[axis], _positive(geometry, key)
        # Rows are the powers of x / norm of each Chebyshev polynomial.
        powers = np.zeros((size, size))
        for i in range(size):
            terms = np.polynomial.chebyshev.cheb2poly(np.eye(size)[i])
            powers[i, : len(terms)] = terms
        powers = powers / norm ** np.arange(size)
        table = powers.T @ table if axis == 0 else table @ powers
    return _power_series(geometry, table)


def _positive(geometry: JsonObject, key: str) -> float:
    value = geometry.number(key)
    return value if value > 0 else geometry.refuse(key, "a positive number")


def _power_series(geometry: JsonObject, table: np.ndarray) -> tuple[float, Shape]:
    """Return the shape of coefficients [i, j] of x^i y^j; the constant one moves the vertex."""
    nx, ny = table.shape
    degree = nx + ny - 2
    powers = [(i, j) for i, j in polynomial_powers((degree + 1) * (degree + 2) // 2 - 1) if i < nx and j < ny]
    rows = [(i, j, float(table[i, j]) * MM) for i, j in powers]
    return float(table[0, 0]) * MM, shapes.polynomial(_conic(geometry), rows, MM)


def _zernike(geometry: JsonObject) -> Shape:
    kind = geometry.text("zernike_type")
    if kind not in _ORDERS:
        geometry.refuse("zernike_type", f"one of {', '.join(_ORDERS)}")
    first, number, normalised = _ORDERS[kind]
    terms = dict(enumerate(geometry.numbers("coefficients"), start=first))
    noll: list[float] = []
    while any(terms.values()):
        n, m = noll_to_nm(len(noll) + 1)
        if n > MOST_DEGREE:
            geometry.refuse("coefficients", f"terms of degrees up to {MOST_DEGREE}")
        size = 1.0 if normalised else math.sqrt((n + 1) * (1 if m == 0 else 2))
        noll.append(terms.pop(number(n, m), 0.0) / size * MM)
    base = _conic(geometry)
    return shapes.zernike(base, noll, _positive(geometry, "norm_radius") * MM) if noll else base


def _fringe(n: int, m: int) -> int:
    return (1 + (n + abs(m)) // 2) ** 2 - 2 * abs(m) + (1 if m < 0 else 0)


def _standard(n: int, m: int) -> int:
    return (n * (n + 2) + m) // 2


def _noll(n: int, m: int) -> int:
    first = n * (n + 1) // 2 + 1
    return next(j for j in range(first, first + n + 1) if noll_to_nm(j) == (n, m))


#: First number, number of the term of degrees n and m (m < 0: sine), and whether its mean square is 1.
_ORDERS: dict[str, tuple[int, Callable[[int, int], int], bool]] = {
    "noll": (1, _noll, True),
    "standard": (0, _standard, True),
    "fringe": (1, _fringe, False),
}


def _biconic(geometry: JsonObject) -> Shape:
    radii = [(geometry.number(f"radius_{a}", math.inf, infinite=True) or math.inf) * MM for a in "xy"]
    geometry.used |= {"radius", "conic"}
    return shapes.sum_of_conics(*radii, *(geometry.number(f"conic_{a}", 0.0) for a in "xy"))


def _toroid(geometry: JsonObject) -> Shape:
    radius_x, radius_y = (geometry.number(f"radius_{a}", math.inf, infinite=True) or math.inf for a in "xy")
    powers = [a * MM ** (1 - 2 * i) for i, a in enumerate(geometry.numbers("coeffs_poly_y"), start=1)]
    geometry.used |= {"radius", "conic"}
    return shapes.toroid(radius_x * MM, 1.0 / radius_y / MM, geometry.number("conic_yz", 0.0), powers)


def _qbfs(geometry: JsonObject) -> Shape:
    config = geometry.child("surface_config")
    curvature, constant = _base(config)
    terms = config.child("terms") if "terms" in config else JsonObject({}, config.source, config.place)
    orders = {key: int(key) for key in terms.content if key.isdecimal() and int(key) <= MOST_DEGREE}
    if set(orders) != set(terms.content):
        config.refuse("terms", f"orders from 0 to {MOST_DEGREE}")
    coefficients = [0.0] * (1 + max(orders.values(), default=-1))
    for key, order in orders.items():
        coefficients[order] = terms.number(key) * MM
    geometry.used |= {"solver_config"}
    if not any(coefficients):
        return shapes.conic(curvature, constant)
    radius = _positive(config, "norm_radius") * MM
    return QbfsAsphere(shapes.radius_of(curvature), constant, radius, shapes.trimmed(coefficients))


_KINDS: dict[str, Callable[[JsonObject], Shape | tuple[float, Shape]]] = {
    "Plane": _conic,
    "StandardGeometry": _conic,
    **dict.fromkeys(GRATINGS, _conic),
    "EvenAsphere": _even,
    "OddAsphere": _odd,
    "PolynomialGeometry": _polynomial,
    "ChebyshevPolynomialGeometry": _chebyshev,
    "ZernikePolynomialGeometry": _zernike,
    "BiconicGeometry": _biconic,
    "ToroidalGeometry": _toroid,
    "ForbesQNormalSlopeGeometry": _qbfs,
    "ForbesQbfsGeometry": _qbfs,
}


def geometry_items(shape: Shape, unit: float) -> dict[str, Any]:
    """Return the dictionary of a shape [m], sag along the light, lengths in a unit [m].

    PrescriptionError if optiland has no geometry of this shape.
    """
    parts = list(shape.parts) if isinstance(shape, Sum) else [shape]
    if all(isinstance(component, Biconic) for component in parts) and (items := _biconic_items(parts, unit)):
        return items
    base = next((p for p in parts if not isinstance(p, XYPolynomial | ZernikeSag)), Plane())
    additions = [p for p in parts if p is not base]
    square, additions = square_term(additions)
    if square and not additions and isinstance(base, Plane | Sphere | Conic | EvenAsphere):
        head = {"radius": _length(base.curvature, unit), "conic": base.conic}
        terms = [a * unit ** (2 * i + 1) for i, a in enumerate([square, *base.coefficients])]
        return {"type": "EvenAsphere", **head, "coefficients": terms}
    if not (square or additions):
        return _alone(base, unit)
    if square or len(additions) > 1 or not isinstance(base, Plane | Sphere | Conic):
        raise PrescriptionError("a sum of several shapes: optiland has no geometry of this shape")
    head = {"radius": _length(base.curvature, unit), "conic": base.conic}
    component = additions[0]
    if isinstance(component, ZernikeSag) and not component.inner_radius:
        terms = [a / unit for a in component.coefficients]
        zernike_items = {"coefficients": terms, "zernike_type": "noll", "norm_radius": component.outer_radius / unit}
        return {"type": "ZernikePolynomialGeometry", **head, **zernike_items}
    if isinstance(component, XYPolynomial):
        table = np.zeros((1 + max(i for i, *_ in component.terms), 1 + max(j for _, j, _ in component.terms)))
        for i, j, a in component.terms:
            table[i, j] = a * unit ** (i + j - 1)
        return {"type": "PolynomialGeometry", **head, "coefficients": table.tolist()}
    raise PrescriptionError("annular Zernike terms: optiland has those of the full disc")


def _biconic_items(parts: Sequence[Shape], unit: float) -> dict[str, Any]:
    """Return the dictionary of a sum of a conic in x and one in y; empty of another sum."""
    sections: dict[str, float] = {}
    for section in parts:
        flat = [axis for axis in "xy" if math.isinf(getattr(section, f"radius_{axis}"))]
        for axis in {*"xy"} - {*flat}:
            if not flat or f"radius_{axis}" in sections:
                return {}
            sections |= {f"radius_{axis}": getattr(section, f"radius_{axis}") / unit}
            sections |= {f"conic_{axis}": getattr(section, f"conic_{axis}")}
    default = {"radius_x": math.inf, "radius_y": math.inf, "conic_x": 0.0, "conic_y": 0.0}
    return {"type": "BiconicGeometry", **default, **sections}


def _length(curvature: float, unit: float) -> float:
    return 1.0 / (curvature * unit) if curvature else math.inf


def _alone(shape: Shape, unit: float) -> dict[str, Any]:
    """Return the dictionary of a shape that is no sum."""
    if isinstance(shape, Plane):
        return {"type": "Plane", "radius": math.inf}
    if isinstance(shape, Sphere | Conic):
        return {"type": "StandardGeometry", "radius": shape.radius / unit, "conic": shape.conic}
    if isinstance(shape, EvenAsphere | OddAsphere):
        even = isinstance(shape, EvenAsphere)
        terms = [a * unit ** (2 * i + 3 if even else i) for i, a in enumerate(shape.coefficients)]
        head = {"radius": shape.radius / unit, "conic": shape.conic}
        kind = "EvenAsphere" if even else "OddAsphere"
        return {"type": kind, **head, "coefficients": [0.0, *terms] if even else terms}
    if isinstance(shape, Toroid):
        radii = {"radius_x": shape.radius_x / unit, "radius_y": shape.radius_y / unit}
        powers = [a * unit ** (2 * i - 1) for i, a in enumerate(shape.coefficients, start=1)]
        meridian_items = {"geometry_type": "Toroidal", "conic_yz": shape.conic_y, "coeffs_poly_y": powers}
        return {"type": "ToroidalGeometry", **radii, **meridian_items}
    if isinstance(shape, QbfsAsphere):
        raise PrescriptionError("Qbfs terms: optiland does not open files with them, its own included")
    raise PrescriptionError(f"shape {type(shape).__name__}: optiland has no geometry of this shape")
