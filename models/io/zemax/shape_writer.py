"""Lines of a Zemax file for a shape: the inverse of `shape_reader`."""

from __future__ import annotations

import numpy as np

from ....core.errors import PrescriptionError
from ...shapes.freeform import Biconic, OddAsphere, Toroid, XYPolynomial, ZernikeSag
from ...shapes.grid import GridSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere, Sum
from ...zernike_polynomials import annular_zernikes
from .shape_reader import polynomial_powers
from .text import number_text


def shape_lines(shape: Shape, unit: float) -> list[str]:
    """Return the lines TYPE, CURV, CONI, PARM, XDAT, GDAT and GARR of a shape.

    Parameters
    ----------
    shape : Shape
        In metres, sag along the light.
    unit : float
        Lens unit [m].

    Raises
    ------
    PrescriptionError
        If no type of surface has this shape.
    """
    parts = list(shape.parts) if isinstance(shape, Sum) else [shape]
    base = next((p for p in parts if not isinstance(p, XYPolynomial | ZernikeSag | GridSag)), Plane())
    rest = [p for p in parts if p is not base]
    if isinstance(base, Biconic | Toroid | OddAsphere):
        if rest:
            raise PrescriptionError(f"sum with {type(base).__name__}: no type of Zemax surface has this shape")
        return _special_lines(base, unit)
    if not isinstance(base, Plane | Sphere | Conic | EvenAsphere):
        raise PrescriptionError(f"shape {type(base).__name__}: no type of Zemax surface has this shape")
    square, rest = _square_term(rest)
    if len(rest) > 1:
        raise PrescriptionError("sum of several shapes: no type of Zemax surface has this shape")
    head = [f"CURV {number_text(base.curvature * unit)}", f"CONI {number_text(base.conic)}"]
    powers = [square, *base.coefficients]
    if len(powers) > 8:
        raise PrescriptionError(f"{len(base.coefficients)} coefficients: a Zemax surface has 7 from r^4 to r^16")
    parameters = [f"PARM {i} {number_text(a * unit ** (2 * i - 1))}" for i, a in enumerate(powers, start=1)]
    curved = any(powers)
    if not rest:
        return ["TYPE EVENASPH", *head, *parameters] if curved else ["TYPE STANDARD", *head]
    part = rest[0]
    if isinstance(part, ZernikeSag):
        return ["TYPE SZERNSAG", *head, *parameters, *_zernike_lines(part, unit)]
    if isinstance(part, GridSag):
        return ["TYPE GRID_SAG", *head, *parameters, *_grid_lines(part, unit)]
    if isinstance(part, XYPolynomial) and not curved:
        return ["TYPE XPOLYNOM", *head, *_polynomial_lines(part, unit)]
    raise PrescriptionError(f"asphere with {type(part).__name__}: no type of Zemax surface has this shape")


def _special_lines(shape: Biconic | Toroid | OddAsphere, unit: float) -> list[str]:
    def reach(radius: float) -> float:
        return radius / unit if np.isfinite(radius) else 0.0

    if isinstance(shape, OddAsphere):
        if len(shape.coefficients) > 8:
            raise PrescriptionError(f"{len(shape.coefficients)} coefficients: a Zemax surface has 8 from r^1 to r^8")
        head = ["TYPE ODDASPHE", f"CURV {number_text(unit / shape.radius)}", f"CONI {number_text(shape.conic)}"]
        terms = enumerate(shape.coefficients, start=1)
        return [*head, *(f"PARM {i} {number_text(a * unit ** (i - 1))}" for i, a in terms)]
    kind = "BICONICX" if isinstance(shape, Biconic) else "TOROIDAL"
    lines = [f"TYPE {kind}", f"CURV {number_text(unit / shape.radius_y)}", f"CONI {number_text(shape.conic_y)}"]
    lines.append(f"PARM 1 {number_text(reach(shape.radius_x))}")
    return [*lines, f"PARM 2 {number_text(shape.conic_x)}"] if isinstance(shape, Biconic) else lines


def _square_term(parts: list[Shape]) -> tuple[float, list[Shape]]:
    """Return the coefficient of r^2 that a part of its own has, and the other parts."""
    for part in parts:
        terms = {(i, j): a for i, j, a in part.terms} if isinstance(part, XYPolynomial) else {}
        if set(terms) == {(2, 0), (0, 2)} and terms[2, 0] == terms[0, 2]:
            return terms[2, 0], [p for p in parts if p is not part]
    return 0.0, parts


def _extra(count: int, radius: float, terms: list[float], unit: float) -> list[str]:
    data = [float(count), radius / unit, *(a / unit for a in terms)]
    return [f"XDAT {i} {number_text(v)} 0 0 1 0 0" for i, v in enumerate(data, start=1)]


def _zernike_lines(part: ZernikeSag, unit: float) -> list[str]:
    terms = list(part.coefficients)
    if part.inner_radius:
        # Annular polynomials are sums of those of the full disc up to the same degree: three points for each unknown,
        # on rings that tell the degrees apart, make the solution exact but for rounding.
        size = _complete(len(terms))
        r, theta = np.meshgrid(np.sqrt(np.linspace(0.0, 1.0, 41)), np.linspace(0, 2 * np.pi, 83, endpoint=False))
        x, y = (r * np.cos(theta)).ravel(), (r * np.sin(theta)).ravel()
        ratio = part.inner_radius / part.outer_radius
        annular = annular_zernikes(len(terms), x, y, ratio)
        disc = annular_zernikes(size, x, y)
        terms = np.linalg.lstsq(disc.T, np.array(terms) @ annular, rcond=None)[0].tolist()
    return _extra(len(terms), part.outer_radius, terms, unit)


def _complete(count: int) -> int:
    """Return the number of terms up to the end of the radial degree that a number of terms reaches."""
    n = 0
    while (n + 1) * (n + 2) // 2 < count:
        n += 1
    return (n + 1) * (n + 2) // 2


def _polynomial_lines(part: XYPolynomial, unit: float) -> list[str]:
    found = {(i, j): a for i, j, a in part.terms}
    if (0, 0) in found:
        raise PrescriptionError("polynomial of x and y with a constant term: a Zemax surface has none")
    degree = max(i + j for i, j in found)
    powers = polynomial_powers((degree + 1) * (degree + 2) // 2 - 1)
    # Lengths in units of the lens unit: the normalisation radius is one of these.
    return _extra(len(powers), unit, [found.get(p, 0.0) * unit ** sum(p) for p in powers], unit)


def _grid_lines(part: GridSag, unit: float) -> list[str]:
    for axis in (part.x, part.y):
        if abs(axis[0] + axis[-1]) > 1e-9 * abs(axis[-1] - axis[0]):
            raise PrescriptionError("grid that is not centred on the vertex: expected one that is")
    dx, dy = part.step
    lines = [f"GDAT {len(part.x)} {len(part.y)} {number_text(dx / unit)} {number_text(dy / unit)}"]
    values = part.values[::-1].ravel() / unit
    return lines + [f"GARR {i} {number_text(v)} 0 0 0 0" for i, v in enumerate(values, start=1)]
