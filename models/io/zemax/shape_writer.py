"""The lines of a Zemax file that describe a shape: what `zemax_shapes` reads, the other way."""

from __future__ import annotations

import numpy as np

from ....core.errors import PrescriptionError
from ...shapes.freeform import Biconic, OddAsphere, Toroid, XYPolynomial, ZernikeSag
from ...shapes.grid import GridSag
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere, Sum
from ...zernike_polynomials import annular_zernikes
from .shape_reader import polynomial_powers


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
        raise PrescriptionError("sum of several figures: no type of Zemax surface has this shape")
    head = [f"CURV {_number(base.curvature * unit)}", f"CONI {_number(base.conic)}"]
    powers = [square, *base.coefficients]
    if len(powers) > 8:
        raise PrescriptionError(f"{len(base.coefficients)} coefficients: a Zemax surface has 7 from r^4 to r^16")
    parameters = [f"PARM {i} {_number(a * unit ** (2 * i - 1))}" for i, a in enumerate(powers, start=1)]
    curved = any(powers)
    if not rest:
        return ["TYPE EVENASPH", *head, *parameters] if curved else ["TYPE STANDARD", *head]
    figure = rest[0]
    if isinstance(figure, ZernikeSag):
        return ["TYPE SZERNSAG", *head, *parameters, *_zernike_lines(figure, unit)]
    if isinstance(figure, GridSag):
        return ["TYPE GRID_SAG", *head, *parameters, *_grid_lines(figure, unit)]
    if isinstance(figure, XYPolynomial) and not curved:
        return ["TYPE XPOLYNOM", *head, *_polynomial_lines(figure, unit)]
    raise PrescriptionError(f"asphere with {type(figure).__name__}: no type of Zemax surface has this shape")


def _number(value: float) -> str:
    return repr(float(value) + 0.0)


def _special_lines(shape: Biconic | Toroid | OddAsphere, unit: float) -> list[str]:
    def reach(radius: float) -> float:
        return radius / unit if np.isfinite(radius) else 0.0

    if isinstance(shape, OddAsphere):
        if len(shape.coefficients) > 8:
            raise PrescriptionError(f"{len(shape.coefficients)} coefficients: a Zemax surface has 8 from r^1 to r^8")
        head = ["TYPE ODDASPHE", f"CURV {_number(unit / shape.radius)}", f"CONI {_number(shape.conic)}"]
        terms = enumerate(shape.coefficients, start=1)
        return [*head, *(f"PARM {i} {_number(a * unit ** (i - 1))}" for i, a in terms)]
    kind = "BICONICX" if isinstance(shape, Biconic) else "TOROIDAL"
    lines = [f"TYPE {kind}", f"CURV {_number(unit / shape.radius_y)}", f"CONI {_number(shape.conic_y)}"]
    lines.append(f"PARM 1 {_number(reach(shape.radius_x))}")
    return [*lines, f"PARM 2 {_number(shape.conic_x)}"] if isinstance(shape, Biconic) else lines


def _square_term(parts: list[Shape]) -> tuple[float, list[Shape]]:
    """Return the coefficient of r^2 that a part of its own has, and the other parts."""
    for part in parts:
        terms = {(i, j): a for i, j, a in part.terms} if isinstance(part, XYPolynomial) else {}
        if set(terms) == {(2, 0), (0, 2)} and terms[2, 0] == terms[0, 2]:
            return terms[2, 0], [p for p in parts if p is not part]
    return 0.0, parts


def _extra(count: int, radius: float, terms: list[float], unit: float) -> list[str]:
    data = [float(count), radius / unit, *(a / unit for a in terms)]
    return [f"XDAT {i} {_number(v)} 0 0 1 0 0" for i, v in enumerate(data, start=1)]


def _zernike_lines(figure: ZernikeSag, unit: float) -> list[str]:
    terms = list(figure.coefficients)
    if figure.inner_radius:
        # Annular polynomials are sums of those of the full disc up to the same degree: three points for each unknown,
        # on rings that tell the degrees apart, make the solution exact but for rounding.
        size = _complete(len(terms))
        r, theta = np.meshgrid(np.sqrt(np.linspace(0.0, 1.0, 41)), np.linspace(0, 2 * np.pi, 83, endpoint=False))
        x, y = (r * np.cos(theta)).ravel(), (r * np.sin(theta)).ravel()
        ratio = figure.inner_radius / figure.outer_radius
        annular = annular_zernikes(len(terms), x, y, ratio)
        disc = annular_zernikes(size, x, y)
        terms = np.linalg.lstsq(disc.T, np.array(terms) @ annular, rcond=None)[0].tolist()
    return _extra(len(terms), figure.outer_radius, terms, unit)


def _complete(count: int) -> int:
    """Return the number of terms up to the end of the radial degree that a number of terms reaches."""
    n = 0
    while (n + 1) * (n + 2) // 2 < count:
        n += 1
    return (n + 1) * (n + 2) // 2


def _polynomial_lines(figure: XYPolynomial, unit: float) -> list[str]:
    found = {(i, j): a for i, j, a in figure.terms}
    if (0, 0) in found:
        raise PrescriptionError("polynomial of x and y with a constant term: a Zemax surface has none")
    degree = max(i + j for i, j in found)
    powers = polynomial_powers((degree + 1) * (degree + 2) // 2 - 1)
    # Lengths in units of the lens unit: the normalisation radius is one of these.
    return _extra(len(powers), unit, [found.get(p, 0.0) * unit ** sum(p) for p in powers], unit)


def _grid_lines(figure: GridSag, unit: float) -> list[str]:
    for axis in (figure.x, figure.y):
        if abs(axis[0] + axis[-1]) > 1e-9 * abs(axis[-1] - axis[0]):
            raise PrescriptionError("grid that is not centred on the vertex: expected one that is")
    dx, dy = figure.step
    lines = [f"GDAT {len(figure.x)} {len(figure.y)} {_number(dx / unit)} {_number(dy / unit)}"]
    values = figure.values[::-1].ravel() / unit
    return lines + [f"GARR {i} {_number(v)} 0 0 0 0" for i, v in enumerate(values, start=1)]
