"""Geometries of optiland as shapes of Zemax surfaces, and shapes as geometries.

The sag of each, with the base conic of ``radius`` and ``conic``, ``r^2 = x^2 + y^2`` [mm]:

============================ =========================================================================================
Plane, StandardGeometry      the conic
EvenAsphere                  + coefficients of r^2, r^4...
OddAsphere                   + coefficients of r, r^2...
PolynomialGeometry           + coefficients [i][j] of x^i y^j
ChebyshevPolynomialGeometry  + coefficients [i][j] of T_i(x / norm_x) T_j(y / norm_y)
ZernikePolynomialGeometry    + Zernike terms of (x, y) / norm_radius, in the order of zernike_type
BiconicGeometry              sum of a conic in x and one in y: read where one of them is flat
ToroidalGeometry             a conic in y, revolved about an axis at radius_x
============================ =========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError
from ...shapes.freeform import OddAsphere, Toroid
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ...zernike_polynomials import noll_to_nm
from ..json_items import JsonObject
from ..lens.shapes import MOST_ODD, polynomial_powers, square_term
from ..lens.source import Findings
from ..zemax.placed import Line, numbered

#: Highest degree of polynomials.
MOST_DEGREE = 40
#: Parameters of Zemax's even aspheres that hold coefficients.
_PARAMETERS = 8


def shape_lines(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    """Return the height of the sag at the vertex [mm], and the lines of a geometry."""
    kind = geometry.text("type")
    if kind not in _KINDS:
        findings.report(geometry.problem(f"geometry {kind}: expected one of {', '.join(_KINDS)}"), "taken as a plane")
        return 0.0, [("TYPE", "STANDARD"), ("CURV", 0.0)]
    found = _KINDS[kind](geometry, findings)
    geometry.report_rest(findings, ("cs", "tol", "max_iter", "geometry_type"))
    return found


def _base(geometry: JsonObject, kind: str) -> list[Line]:
    radius = geometry.number("radius", math.inf, infinite=True)
    return [("TYPE", kind), ("CURV", 1.0 / radius if radius else 0.0), ("CONI", geometry.number("conic", 0.0))]


def _conic(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    return 0.0, _base(geometry, "STANDARD")


def _even(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    terms = geometry.numbers("coefficients")
    if any(terms[_PARAMETERS:]):
        # Zemax's extended asphere, over a radius of 1 mm.
        return 0.0, [*_base(geometry, "XASPHERE"), *_extra(terms)]
    return 0.0, [*_base(geometry, "EVENASPH"), *numbered("PARM", terms)]


def _odd(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    terms = geometry.numbers("coefficients")
    if any(terms[MOST_ODD:]):
        geometry.refuse("coefficients", f"at most {MOST_ODD} of them")
    return 0.0, [*_base(geometry, "ODDASPHE"), *numbered("PARM", terms)]


def _extra(terms: list[float], radius: float = 1.0) -> list[Line]:
    return numbered("XDAT", [float(len(terms)), radius, *terms])


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


def _polynomial(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    return _power_series(geometry, _table(geometry))


def _chebyshev(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    table = _table(geometry)
    for axis, key in enumerate(("norm_x", "norm_y")):
        size = table.shape[axis]
        # Rows are the powers of x / norm of each Chebyshev polynomial.
        powers = np.zeros((size, size))
        for i in range(size):
            terms = np.polynomial.chebyshev.cheb2poly(np.eye(size)[i])
            powers[i, : len(terms)] = terms
        powers = powers / geometry.number(key) ** np.arange(size)
        table = powers.T @ table if axis == 0 else table @ powers
    return _power_series(geometry, table)


def _power_series(geometry: JsonObject, table: np.ndarray) -> tuple[float, list[Line]]:
    """Return the lines of coefficients [i, j] of x^i y^j; the constant one moves the vertex."""
    nx, ny = table.shape
    degree = nx + ny - 2
    terms = [
        float(table[i, j]) if i < nx and j < ny else 0.0
        for i, j in polynomial_powers((degree + 1) * (degree + 2) // 2 - 1)
    ]
    return float(table[0, 0]), [*_base(geometry, "XPOLYNOM"), *(_extra(terms) if any(terms) else [])]


def _zernike(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
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
        noll.append(terms.pop(number(n, m), 0.0) / size)
    return 0.0, [*_base(geometry, "SZERNSAG"), *(_extra(noll, geometry.number("norm_radius")) if noll else [])]


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


def _biconic(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    radii = [geometry.number(f"radius_{a}", math.inf, infinite=True) or math.inf for a in "xy"]
    if not any(map(math.isinf, radii)):
        text = "BiconicGeometry with two curvatures: the sum of two conics is no surface of this package"
        findings.report(geometry.problem(text), "taken as a Zemax biconic")
    curvature = 0.0 if math.isinf(radii[1]) else 1.0 / radii[1]
    parameters = [0.0 if math.isinf(radii[0]) else radii[0], geometry.number("conic_x", 0.0)]
    head: list[Line] = [("TYPE", "BICONICX"), ("CURV", curvature), ("CONI", geometry.number("conic_y", 0.0))]
    geometry.used |= {"radius", "conic"}
    return 0.0, [*head, *numbered("PARM", parameters)]


def _toroid(geometry: JsonObject, findings: Findings) -> tuple[float, list[Line]]:
    radius_x, radius_y = (geometry.number(f"radius_{a}", math.inf, infinite=True) or math.inf for a in "xy")
    if any(geometry.numbers("coeffs_poly_y")):
        geometry.refuse("coeffs_poly_y", "zeros")
    geometry.used |= {"radius", "conic"}
    head: list[Line] = [("TYPE", "TOROIDAL"), ("CURV", 1.0 / radius_y), ("CONI", geometry.number("conic_yz", 0.0))]
    return 0.0, [*head, *numbered("PARM", [0.0 if math.isinf(radius_x) else radius_x])]


_KINDS: dict[str, Callable[[JsonObject, Findings], tuple[float, list[Line]]]] = {
    "Plane": _conic,
    "StandardGeometry": _conic,
    "EvenAsphere": _even,
    "OddAsphere": _odd,
    "PolynomialGeometry": _polynomial,
    "ChebyshevPolynomialGeometry": _chebyshev,
    "ZernikePolynomialGeometry": _zernike,
    "BiconicGeometry": _biconic,
    "ToroidalGeometry": _toroid,
}


def geometry_items(shape: Shape, unit: float) -> dict[str, Any]:
    """Return the dictionary of a shape [m], sag along the light, lengths in a unit [m].

    PrescriptionError if optiland has no geometry of this shape.
    """
    parts = list(shape.parts) if isinstance(shape, Sum) else [shape]
    base = next((p for p in parts if not isinstance(p, XYPolynomial | ZernikeSag)), Plane())
    rest = [p for p in parts if p is not base]
    square, rest = square_term(rest)
    if square and not rest and isinstance(base, Plane | Sphere | Conic | EvenAsphere):
        head = {"radius": _length(base.curvature, unit), "conic": base.conic}
        terms = [a * unit ** (2 * i + 1) for i, a in enumerate([square, *base.coefficients])]
        return {"type": "EvenAsphere", **head, "coefficients": terms}
    if not (square or rest):
        return _alone(base, unit)
    if square or len(rest) > 1 or not isinstance(base, Plane | Sphere | Conic):
        raise PrescriptionError("a sum of several shapes: optiland has no geometry of this shape")
    head = {"radius": _length(base.curvature, unit), "conic": base.conic}
    part = rest[0]
    if isinstance(part, ZernikeSag) and not part.inner_radius:
        terms = [a / unit for a in part.coefficients]
        own = {"coefficients": terms, "zernike_type": "noll", "norm_radius": part.outer_radius / unit}
        return {"type": "ZernikePolynomialGeometry", **head, **own}
    if isinstance(part, XYPolynomial):
        table = np.zeros((1 + max(i for i, *_ in part.terms), 1 + max(j for _, j, _ in part.terms)))
        for i, j, a in part.terms:
            table[i, j] = a * unit ** (i + j - 1)
        return {"type": "PolynomialGeometry", **head, "coefficients": table.tolist()}
    raise PrescriptionError("annular Zernike terms: optiland has those of the full disc")


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
        own = {"geometry_type": "Toroidal", "conic_yz": shape.conic_y, "coeffs_poly_y": []}
        return {"type": "ToroidalGeometry", **radii, **own}
    raise PrescriptionError(f"shape {type(shape).__name__}: optiland has no geometry of this shape")
