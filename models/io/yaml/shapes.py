"""Shapes in prescription files: sections of YAML, and their text.

A surface has its shape's name under ``shape`` and the parameters beside it; the sum of several shapes is a list of
mappings under ``shape``, each written the same way. Parameters are lengths in the file's unit, and powers of it:

================= ====================================================================================================
``plane``
``sphere``        ``radius``
``conic``         ``radius``, ``conic``
``paraboloid``    ``radius``
``even_asphere``  ``radius``, ``conic``, ``coefficients`` of r^4, r^6, r^8...; a radius may be ``flat``
``odd_asphere``   ``radius``, ``conic``, ``coefficients`` of r^1, r^2, r^3...; a radius may be ``flat``
``biconic``       ``radius_x``, ``radius_y``, ``conic_x``, ``conic_y``; a radius may be ``flat``
``toroid``        ``radius_x``, ``radius_y``, ``conic_y``, ``coefficients`` of y^2, y^4...; a radius may be ``flat``
``qbfs``          ``radius``, ``conic``, ``norm_radius``, ``coefficients`` of Forbes's Q_0, Q_1...; a ``flat`` radius
``xy_polynomial`` ``terms``: a list of [power of x, power of y, coefficient]
``zernike``       ``coefficients`` (Noll order from j = 1), ``outer_radius``, ``inner_radius``
``grid``          ``file``, a FITS image, or ``nodes_x``, ``nodes_y`` and ``values``, a row of x for each y
``mesh``          ``file`` and ``scale``, its unit in metres, or ``vertices`` and ``faces`` in base 64; ``smooth``:
                  whether slopes are interpolated
================= ====================================================================================================

A relative path of a file is meant from where the prescription lies. Of a surface of type ``phase`` the shape is the map
of optical path.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator

from ....core.errors import PrescriptionError
from ....core.schema import Parameters, Tagged, WrittenAs, checked, either, expected, written
from ....core.yaml_reader import as_number
from ...shapes.freeform import Biconic, OddAsphere, Toroid
from ...shapes.grid import GridSag
from ...shapes.mesh import MeshSurface
from ...shapes.polynomial import XYPolynomial, ZernikeSag
from ...shapes.qbfs import QbfsAsphere
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere
from ...shapes.sum import Sum
from ..grid_file import read_grid
from .values import (
    LIST,
    ROWS,
    Bare,
    Flag,
    Info,
    Length,
    Lengths,
    Metres,
    Number,
    OptionalFile,
    PositiveLength,
    PositiveNumber,
    Radius,
    decoded,
    encoded,
    in_metres,
    power_of_length,
    scaled,
)


def _coefficients(powers: range) -> Any:
    """Return the type of coefficients of powers of the radius: lengths over lengths to these powers."""

    def convert(coefficients: tuple[float, ...], info: Info) -> tuple[float, ...]:
        return tuple(scaled(a, power_of_length(1 - n, info)) for n, a in zip(powers, coefficients, strict=False))

    def write(coefficients: tuple[float, ...]) -> list[Metres]:
        return [Metres(a, 1 - n) for n, a in zip(powers, coefficients, strict=False)]

    return Annotated[tuple[float, ...], BeforeValidator(convert), LIST, WrittenAs(write)]


def _terms(value: Any, info: Info) -> tuple[tuple[int, int, float], ...]:
    if not isinstance(value, list) or not value:
        raise expected("a list of [power of x, power of y, coefficient]")
    terms = []
    for row in value:
        i, j, a = map(as_number, row) if isinstance(row, list) and len(row) == 3 else (None, None, None)
        if i is None or j is None or a is None or i % 1 or j % 1 or i < 0 or j < 0:
            raise expected(f"[power of x, power of y, coefficient], not {row!r}")
        terms.append((int(i), int(j), scaled(a, power_of_length(1 - int(i) - int(j), info))))
    return tuple(terms)


def _equal_rows(values: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len({len(row) for row in values}) > 1:
        raise expected("rows of one length")
    return values


_TERMS = Annotated[
    Any,
    BeforeValidator(_terms),
    WrittenAs(lambda terms: [(Bare(i), Bare(j), Metres(a, 1 - i - j)) for i, j, a in terms]),
]
_ROW = "three numbers a row, in base 64"


class ShapeSection(Parameters):
    """A shape: its name, and its parameters as attributes of the class that it describes."""

    shape: str


class GridSection(ShapeSection):
    """Grid of sag in a FITS file, or written out."""

    make = GridSag
    parameters = ("nodes_x", "nodes_y", "values")
    file: OptionalFile = None
    nodes_x: Lengths = ()
    nodes_y: Lengths = ()
    values: Annotated[
        tuple[Lengths, ...],
        checked(lambda v: v if isinstance(v, list) else None, "a list of rows of numbers"),
        WrittenAs(in_metres),
        AfterValidator(_equal_rows),
    ] = ()

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        either(content, "file", cls.parameters)

    def build(self) -> Shape:  # noqa: D102
        return super().build() if self.file is None else read_grid(self.file)


class MeshSection(ShapeSection):
    """Mesh in a file, or written out in base 64."""

    make = MeshSurface
    parameters = ("vertices", "faces", "smooth")
    file: OptionalFile = None
    scale: PositiveNumber = 1.0
    vertices: Annotated[Any, decoded("<f8", (-1, 3), _ROW), encoded("<f8")] = None
    faces: Annotated[Any, decoded("<i4", (-1, 3), _ROW), encoded("<i4")] = None
    smooth: Flag = False

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        either(content, "file", ("vertices", "faces"))

    def build(self) -> Shape:  # noqa: D102
        if self.file is None:
            return MeshSurface(self.vertices, self.faces, smooth=self.smooth)
        return MeshSurface.from_file(self.file, scale=self.scale, smooth=self.smooth)


#: Sections of single shapes by the name of the shape.
SHAPES: dict[str, type[ShapeSection]] = {
    "plane": ShapeSection.of(Plane),
    "sphere": ShapeSection.of(Sphere, radius=Length),
    "conic": ShapeSection.of(Conic, radius=Length, conic=Number),
    "paraboloid": ShapeSection.of(lambda radius: Conic(radius, -1.0), radius=Length),
    "even_asphere": ShapeSection.of(
        EvenAsphere, radius=Radius, conic=(Number, 0.0), coefficients=_coefficients(range(4, 1000, 2))
    ),
    "odd_asphere": ShapeSection.of(
        OddAsphere, radius=Radius, conic=(Number, 0.0), coefficients=_coefficients(range(1, 1000))
    ),
    "biconic": ShapeSection.of(Biconic, radius_x=Radius, radius_y=Radius, conic_x=(Number, 0.0), conic_y=(Number, 0.0)),
    "toroid": ShapeSection.of(
        Toroid,
        radius_x=Radius,
        radius_y=Radius,
        conic_y=(Number, 0.0),
        coefficients=(_coefficients(range(2, 1000, 2)), ()),
    ),
    "qbfs": ShapeSection.of(
        QbfsAsphere, radius=Radius, conic=(Number, 0.0), norm_radius=PositiveLength, coefficients=Lengths
    ),
    "xy_polynomial": ShapeSection.of(XYPolynomial, terms=_TERMS),
    "zernike": ShapeSection.of(ZernikeSag, coefficients=Lengths, outer_radius=Length, inner_radius=(Length, 0.0)),
    "grid": GridSection,
    "mesh": MeshSection,
}


def shape_items(shape: Shape) -> dict[str, Any]:
    """Return the section of a shape, in metres; grids and meshes are written out, so that a file stands by itself."""
    if (section := written(SURFACE_SHAPES, shape)) is None:
        raise PrescriptionError(f"shape {type(shape).__name__}: expected one of {', '.join(SHAPES)}")
    kind, items = section
    return {"shape": kind} | items


_PARTS = Annotated[
    tuple[Annotated[Any, Tagged.by_value("shape", SHAPES)], ...],
    ROWS,
    WrittenAs(lambda parts: [shape_items(part) for part in parts]),
]
#: Sections of shapes and, under a list in place of a name, of their sum.
SURFACE_SHAPES = SHAPES | {"sum": ShapeSection.of(Sum, shape=_PARTS)}
