"""Shapes of Zemax surfaces, read and written, in their own local frame (+z along the light) and in metres.

The sag of each type, from the OpticStudio user guide ("Surface types"), with ``c`` CURV, ``k`` CONI, ``r^2 = x^2 +
y^2``:

========= ===================================================================================================
STANDARD  conic of revolution
EVENASPH  conic + PARM 1 r^2 + PARM 2 r^4 + ... + PARM 8 r^16
ODDASPHE  conic + PARM 1 r + PARM 2 r^2 + ... + PARM 8 r^8; translations of other formats go on beyond
BICONICX  conics of different curvature along y (CURV, CONI) and x (radius PARM 1, conic PARM 2)
TOROIDAL  conic + PARM 2 y^2 + ... + PARM 8 y^14 in y, z, revolved about an axis at PARM 1; Zernike terms in XDAT
FZERNSAG  as SZERNSAG with Fringe terms, at most 37
SZERNSAG  as EVENASPH + sum of XDAT (2 + j) Z_j(x / R, y / R), Noll, R = XDAT 2, XDAT 1 terms
XPOLYNOM  conic + sum of XDAT (2 + i) times x, y, x^2, xy, y^2, x^3... of x / R, y / R, R = XDAT 2, XDAT 1 terms
XASPHERE  conic + sum of XDAT (2 + i) (r / R)^(2 i), R = XDAT 2, XDAT 1 terms
TILTSURF  the plane x PARM 1 + y PARM 2
DGRATING  as STANDARD, with PARM 1 grooves a micrometre along the local y axis and the order PARM 2
PARAXIAL  a plane with an ideal thin lens of the focal length PARM 1; PARM 2, its mode of paths, is not used
GRID_SAG  as EVENASPH + a grid of nodes (GDAT nx ny dx dy; GARR i sag ...), interpolated by bicubics
QED_TYPE  conic + (r / R)^4 sum of XDAT (3 + m) Q_(m - 1)((r / R)^2), R = XDAT 3, XDAT 2 terms; Q those of Forbes (Qcon,
          XDAT 1 is 1): Jacobi polynomials P^(0, 4)(2 x - 1), so an even asphere (2007, Opt. Express 15, 5218); or his
          Qbfs terms on a sphere where XDAT 1 is 0 (`QbfsAsphere`)
========= ===================================================================================================
"""

from __future__ import annotations

import math

import numpy as np

from ....core.errors import PrescriptionError
from ...fringe_indices import FRINGE_TERMS, noll_from_fringe
from ...grating import Grating
from ...shapes.freeform import Biconic, OddAsphere, Toroid
from ...shapes.grid import GridSag
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.qbfs import QbfsAsphere
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ...thin_lens import ThinLens
from ...zernike_polynomials import annular_zernikes
from ..lens import shapes
from ..lens.shapes import MOST_ODD, even_asphere, polynomial_powers, square_term
from ..lens.source import Findings
from ..lens.text import number_text, scaled
from .file import Block

TYPES = (
    *("STANDARD", "EVENASPH", "ODDASPHE", "BICONICX", "TOROIDAL"),
    *("PARAXIAL", "SZERNSAG", "FZERNSAG", "XPOLYNOM", "XASPHERE", "TILTSURF", "GRID_SAG", "QED_TYPE", "DGRATING"),
)
#: What types of surfaces are, by the beginnings of their names, that have no counterpart here.
REFUSED = {
    "GRINSUR": "gradient-index media", "GRIN": "gradient-index media", "GRADIUM": "gradient-index media",
    "HOLOGRM": "holograms", "OPTHOLO": "holograms", "TORHOLO": "holograms", "BIREFRIN": "birefringent media",
    "BINARY": "phase profiles", "NONSEQ": "non-sequential parts", "NSC": "non-sequential parts",
    "USERSURF": "user-defined surfaces",
}  # fmt: skip
MOST_TERMS = 1000
MOST_NODES = 4_000_000
#: Qcon terms at most: more have powers of r that cancel beyond the twelfth digit.
MOST_Q = 10


def read_shape(block: Block, unit: float, findings: Findings) -> Shape:
    """Return the shape of a surface [m], sag along the light as Zemax has it; `unit` is the lens unit [m]."""
    kind = block.text("TYPE").split()[0].upper() if block.text("TYPE") else "STANDARD"
    kind = "GRID_SAG" if kind == "GRIDSAG" else kind
    if kind not in TYPES:
        refused = next((text for name, text in REFUSED.items() if kind.startswith(name)), None)
        reason = f"{refused} are not read" if refused else f"expected one of {', '.join(TYPES)}"
        findings.report(block.problem(f"TYPE {kind}: {reason}"), "taken as STANDARD")
        block.used |= {"PARM", "XDAT", "GDAT", "GARR"}
        kind = "STANDARD"
    curvature, conic = block.number("CURV", 0.0) / unit, block.number("CONI", 0.0)
    parameters = {i: v for i, v in block.table("PARM").items() if v != 0}
    if kind in ("DGRATING", "PARAXIAL"):
        # They are those of read_grating and read_thin_lens.
        parameters = {i: v for i, v in parameters.items() if i > 2}
    base = shapes.conic(curvature, conic)
    if kind in ("EVENASPH", "SZERNSAG", "FZERNSAG", "GRID_SAG"):
        base = even_asphere(curvature, conic, [parameters.pop(i, 0.0) * unit ** (1 - 2 * i) for i in range(1, 9)])
    elif kind == "ODDASPHE":
        powers = [parameters.pop(i, 0.0) * unit ** (1 - i) for i in range(1, MOST_ODD + 1)]
        base = shapes.odd_asphere(curvature, conic, powers)
    elif kind == "BICONICX":
        radius_x = parameters.pop(1, math.inf) * unit
        base = Biconic(radius_x, shapes.radius_of(curvature), parameters.pop(2, 0.0), conic)
    elif kind == "TOROIDAL":
        powers = [parameters.pop(1 + i, 0.0) * unit ** (1 - 2 * i) for i in range(1, 8)]
        base = shapes.toroid(parameters.pop(1, math.inf) * unit, curvature, conic, powers)
    elif kind == "TILTSURF":
        base = XYPolynomial(((1, 0, parameters.pop(1, 0.0)), (0, 1, parameters.pop(2, 0.0))))
    elif kind == "PARAXIAL":
        return Plane()
    elif kind == "XASPHERE":
        radius, terms = _extra_data(block, unit)
        base = even_asphere(curvature, conic, [a / radius ** (2 * i) for i, a in enumerate(terms, start=1)])
    elif kind == "QED_TYPE":
        base = _q_asphere(block, unit, curvature, conic, findings)
    for i, value in sorted(parameters.items()):
        findings.report(block.problem(f"PARM {i} {value:g}: not understood for TYPE {kind}"))
    if kind in ("SZERNSAG", "FZERNSAG", "TOROIDAL"):
        radius, terms = _extra_data(block, unit)
        if kind == "FZERNSAG" and terms:
            if any(terms[FRINGE_TERMS:]):
                raise block.all("XDAT")[0].error(f"at most {FRINGE_TERMS} Fringe terms")
            terms = noll_from_fringe(np.array(terms[:FRINGE_TERMS])).tolist()
        return shapes.zernike(base, terms, radius)
    if kind == "XPOLYNOM":
        radius, terms = _extra_data(block, unit)
        rows = ((i, j, a) for (i, j), a in zip(polynomial_powers(len(terms)), terms, strict=False))
        return shapes.polynomial(base, rows, radius)
    if kind == "GRID_SAG":
        return shapes.total(base, _grid(block, unit))
    if kind not in ("XASPHERE", "QED_TYPE"):
        for i, value in block.table("XDAT").items():
            if value != 0:
                findings.report(block.problem(f"XDAT {i} {value:g}: not understood for TYPE {kind}"))
    return base


def read_thin_lens(block: Block, unit: float) -> ThinLens | None:
    """Return the ideal thin lens of a surface PARAXIAL; None of another one, or of an infinite focal length."""
    if block.text("TYPE").upper().split()[:1] != ["PARAXIAL"]:
        return None
    focal_length = block.table("PARM").get(1, 0.0) * unit
    return ThinLens(focal_length) if focal_length else None


def read_grating(block: Block) -> Grating | None:
    """Return the grooves of a surface; None without them. A negative number of them reverses the order."""
    if not block.text("TYPE").upper().startswith("DGRATING"):
        return None
    numbers = {line.integer(0): line for line in block.all("PARM")}
    lines = numbers[1].number(1) if 1 in numbers else 0.0
    order = numbers[2].number(1) if 2 in numbers else 0.0
    if order != int(order):
        raise numbers[2].error("a whole number, the order of the grating")
    return Grating(int(math.copysign(1.0, lines)) * int(order), scaled(abs(lines), 3)) if lines and order else None


def _extra_data(block: Block, unit: float) -> tuple[float, list[float]]:
    """Return the normalisation radius [m] and the coefficients [m] in the extra data of a surface."""
    data = block.table("XDAT")
    count = round(data.get(1, 0.0))
    if count <= 0:
        return 1.0, []
    line = block.all("XDAT")[0]
    radius = data.get(2, 0.0) * unit
    if radius <= 0:
        raise line.error("a positive normalisation radius as XDAT 2")
    if count > MOST_TERMS:
        raise line.error(f"at most {MOST_TERMS} terms")
    return radius, [data.get(2 + i, 0.0) * unit for i in range(1, count + 1)]


def _q_asphere(block: Block, unit: float, curvature: float, conic: float, findings: Findings) -> Shape:
    """Return a conic with the Q-type terms of a surface."""
    data = block.table("XDAT")
    line = next(iter(block.all("XDAT")), block.lines[0])
    kind, count, radius = data.get(1, 0.0), round(data.get(2, 0.0)), data.get(3, 0.0) * unit
    if kind not in (0.0, 1.0):
        raise line.error("0 (Qbfs) or 1 (Qcon) as XDAT 1")
    most = MOST_Q if kind else MOST_TERMS
    if not 0 <= count <= most:
        raise line.error(f"up to {most} {'Qcon' if kind else 'Qbfs'} terms as XDAT 2, not {count}")
    if count and radius <= 0:
        raise line.error("a positive normalisation radius as XDAT 3")
    terms = [data.get(4 + m, 0.0) * unit for m in range(count)]
    if kind:
        return even_asphere(curvature, conic, _qcon_powers(terms, radius))
    if not any(terms):
        return shapes.conic(curvature, conic)
    if conic:
        # Forbes's terms are those of a sphere.
        findings.report(block.problem(f"CONI {conic:g}: expected 0 beside Qbfs terms"), "taken as the conic under them")
    return QbfsAsphere(shapes.radius_of(curvature), conic, radius, shapes.trimmed(terms))


def _qcon_powers(terms: list[float], radius: float) -> list[float]:
    """Return the coefficients of r^2, r^4, r^6... [m] of Qcon terms [m] over a radius [m].

    ``Q_m(x)`` is the sum over s of ``(-1)^(m + s) C(m, s) C(m + 4 + s, m) x^s``.
    """
    count = len(terms)
    powers = [
        sum((-1) ** (m + s) * math.comb(m, s) * math.comb(m + 4 + s, m) * terms[m] for m in range(s, count))
        for s in range(count)
    ]
    return [0.0, *(a / radius ** (2 * s + 4) for s, a in enumerate(powers))]


def _grid(block: Block, unit: float) -> GridSag:
    size = block.last("GDAT")
    if size is None:
        raise block.lines[0].error("a line GDAT with the size of the grid in this surface")
    nx, ny, dx, dy = size.integer(0), size.integer(1), size.number(2) * unit, size.number(3) * unit
    if not (nx > 3 and ny > 3 and nx * ny <= MOST_NODES and dx > 0 and dy > 0):
        raise size.error("at least 4 x 4 nodes and positive steps")
    values = np.full(nx * ny, np.nan)
    for line in block.all("GARR"):
        place = line.integer(0) - 1
        if not 0 <= place < nx * ny:
            raise line.error(f"a node from 1 to {nx * ny}")
        values[place] = line.number(1) * unit
    if np.any(np.isnan(values)):
        raise size.error(f"{nx * ny} lines GARR; that of node {int(np.argmax(np.isnan(values))) + 1} is missing")
    # The first node is at the smallest x and the largest y, and x runs first.
    x, y = (dx * (np.arange(nx) - (nx - 1) / 2), dy * (np.arange(ny) - (ny - 1) / 2))
    return GridSag(x, y, values.reshape(ny, nx)[::-1])


def shape_lines(shape: Shape, unit: float) -> list[str]:
    """Return the lines TYPE, CURV, CONI, PARM, XDAT, GDAT and GARR of a shape [m], sag along the light.

    PrescriptionError if no type of surface has this shape.
    """
    parts = list(shape.parts) if isinstance(shape, Sum) else [shape]
    base = next((p for p in parts if not isinstance(p, XYPolynomial | ZernikeSag | GridSag)), Plane())
    additions = [p for p in parts if p is not base]
    if isinstance(base, QbfsAsphere):
        if additions or base.conic:
            raise PrescriptionError("Qbfs terms on a conic or in a sum: no type of Zemax surface has this shape")
        head = ["TYPE QED_TYPE", f"CURV {number_text(unit / base.radius)}", "CONI 0.0"]
        data = [0.0, float(len(base.coefficients)), base.norm_radius / unit, *(a / unit for a in base.coefficients)]
        return [*head, *_extra_lines(data)]
    if isinstance(base, Biconic | Toroid | OddAsphere):
        if additions:
            raise PrescriptionError(f"sum with {type(base).__name__}: no type of Zemax surface has this shape")
        return _special_lines(base, unit)
    if not isinstance(base, Plane | Sphere | Conic | EvenAsphere):
        raise PrescriptionError(f"shape {type(base).__name__}: no type of Zemax surface has this shape")
    square, additions = square_term(additions)
    if len(additions) > 1:
        raise PrescriptionError("sum of several shapes: no type of Zemax surface has this shape")
    head = [f"CURV {number_text(base.curvature * unit)}", f"CONI {number_text(base.conic)}"]
    powers = [square, *base.coefficients]
    if len(powers) > 8:
        raise PrescriptionError(f"{len(base.coefficients)} coefficients: a Zemax surface has 7 from r^4 to r^16")
    parameters = [f"PARM {i} {number_text(a * unit ** (2 * i - 1))}" for i, a in enumerate(powers, start=1)]
    curved = any(powers)
    if not additions:
        return ["TYPE EVENASPH", *head, *parameters] if curved else ["TYPE STANDARD", *head]
    addition = additions[0]
    if isinstance(addition, ZernikeSag):
        return ["TYPE SZERNSAG", *head, *parameters, *_zernike_lines(addition, unit)]
    if isinstance(addition, GridSag):
        return ["TYPE GRID_SAG", *head, *parameters, *_grid_lines(addition, unit)]
    if isinstance(addition, XYPolynomial) and not curved:
        return ["TYPE XPOLYNOM", *head, *_polynomial_lines(addition, unit)]
    raise PrescriptionError(f"asphere with {type(addition).__name__}: no type of Zemax surface has this shape")


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
    if isinstance(shape, Toroid):
        if len(shape.coefficients) > 7:
            raise PrescriptionError(f"{len(shape.coefficients)} coefficients: a Zemax toroid has 7 from y^2 to y^14")
        terms = enumerate(shape.coefficients, start=1)
        lines += [f"PARM {1 + i} {number_text(a * unit ** (2 * i - 1))}" for i, a in terms]
    return [*lines, f"PARM 2 {number_text(shape.conic_x)}"] if isinstance(shape, Biconic) else lines


def _extra(count: int, radius: float, terms: list[float], unit: float) -> list[str]:
    return _extra_lines([float(count), radius / unit, *(a / unit for a in terms)])


def _extra_lines(data: list[float]) -> list[str]:
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
    coefficients = {(i, j): a for i, j, a in part.terms}
    if (0, 0) in coefficients:
        raise PrescriptionError("polynomial of x and y with a constant term: a Zemax surface has none")
    degree = max(i + j for i, j in coefficients)
    powers = polynomial_powers((degree + 1) * (degree + 2) // 2 - 1)
    # Lengths in units of the lens unit: the normalisation radius is one of these.
    return _extra(len(powers), unit, [coefficients.get(p, 0.0) * unit ** sum(p) for p in powers], unit)


def _grid_lines(part: GridSag, unit: float) -> list[str]:
    for axis in (part.x, part.y):
        if abs(axis[0] + axis[-1]) > 1e-9 * abs(axis[-1] - axis[0]):
            raise PrescriptionError("grid that is not centred on the vertex: expected one that is")
    dx, dy = part.step
    lines = [f"GDAT {len(part.x)} {len(part.y)} {number_text(dx / unit)} {number_text(dy / unit)}"]
    values = part.values[::-1].ravel() / unit
    return lines + [f"GARR {i} {number_text(v)} 0 0 0 0" for i, v in enumerate(values, start=1)]
