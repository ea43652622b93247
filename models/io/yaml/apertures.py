"""Clear apertures and obstructions in prescription files: sections of YAML, and their text.

A surface has ``circle: 0.4`` or ``annulus: [0.6, 4.1]``, with ``centre: [x, y]``, or any region under ``aperture``;
regions that block light stand under ``obscuration``. A region is one of:

================================================================= ====================================================
``{circle: 0.4, centre: [0, 0]}``                                 disc of a radius
``{annulus: [0.6, 4.1], centre: [0, 0]}``                         ring of two radii
``{ellipse: [0.4, 0.3], centre: [0, 0], angle: 45}``              semi-axes along x and y, then rotated
``{rectangle: [0.05, 9.6], centre: [0, 0], angle: 45}``           width along x and height along y, then rotated
``{polygon: [[0, 0], [1, 0], [0, 1]]}``                           corners in either sense
``{vane: 0.05, from: [0.4, 0], angle: 45, both_ways: true}``      strip of a width from a point outwards
``{union: [...]}``, ``{intersection: [...]}``, ``{complement: r}`` of other regions
================================================================= ====================================================

A mesh that blocks light is ``{name: top_end, file: top_end.stl, scale: 0.001, before: [M1]}`` in the list
``obstructions``; `scale` is the length of its unit in metres. Its file is looked for beside the prescription.
"""

from __future__ import annotations

from typing import Annotated, Any

from ....core.errors import PrescriptionError
from ....core.schema import Parameters, Section, Tagged, WrittenAs, checked, either, expected, problem, written
from ...aperture import Annulus, Aperture, Circle, Complement, Ellipse, Intersection, Polygon, Rectangle, Union, Vane
from ...obstruction import Obstruction
from .values import (
    ROWS,
    Angle,
    Flag,
    Length,
    OptionalFile,
    OptionalLength,
    OptionalNames,
    OptionalPoint,
    Point,
    PositiveNumber,
    Text,
    decoded,
    encoded,
    in_metres,
)


def _region_kind(content: dict[str, Any]) -> str:
    kinds = [key for key in REGIONS if key in content]
    if len(kinds) != 1:
        raise problem(f" has {', '.join(content) or 'nothing'}: expected one of {', '.join(REGIONS)}")
    return kinds[0]


class RegionSection(Parameters):
    """A region of the plane; written without the values that are by default."""

    pairs = ("annulus", "ellipse", "rectangle", "centre", "from")

    @classmethod
    def written(cls, built: Any) -> dict[str, Any]:  # noqa: D102
        items = super().written(built).items()
        return {key: value for key, value in items if value != cls.model_fields[key].default}


#: Sections of regions by the key that tells their kind.
REGIONS: dict[str, type[Parameters]] = {}
_REGION = Tagged(REGIONS, _region_kind)
_PARTS = Annotated[
    tuple[Annotated[Any, _REGION], ...], ROWS, WrittenAs(lambda parts: [_region_items(part) for part in parts])
]
_CORNERS = Annotated[
    tuple[Point, ...],
    checked(lambda v: v if isinstance(v, list) else None, "a list of corners [x, y]"),
    WrittenAs(in_metres),
]
_CENTRE, _ANGLE = (Point, (0.0, 0.0)), (Angle, 0.0)
REGIONS |= {
    "circle": RegionSection.of(Circle, circle=Length, centre=_CENTRE),
    "annulus": RegionSection.of(Annulus, annulus=Point, centre=_CENTRE),
    "ellipse": RegionSection.of(Ellipse, ellipse=Point, centre=_CENTRE, angle=_ANGLE),
    "rectangle": RegionSection.of(Rectangle, rectangle=Point, centre=_CENTRE, angle=_ANGLE),
    "polygon": RegionSection.of(Polygon, polygon=_CORNERS),
    "vane": RegionSection.of(Vane, vane=Length, **{"from": _CENTRE}, angle=_ANGLE, both_ways=(Flag, False)),
    "union": RegionSection.of(Union, union=_PARTS),
    "intersection": RegionSection.of(Intersection, intersection=_PARTS),
    "complement": RegionSection.of(
        Complement, complement=Annotated[Any, _REGION, WrittenAs(lambda part: _region_items(part))]
    ),
}


class ApertureKeys(Section):
    """Keys of a surface for its clear aperture."""

    circle: OptionalLength = None
    annulus: OptionalPoint = None
    centre: Point = (0.0, 0.0)
    aperture: Annotated[Aperture | None, _REGION] = None
    obscuration: Annotated[Aperture | None, _REGION] = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        aperture_keys = [key for key in ("circle", "annulus", "aperture") if key in content]
        if len(aperture_keys) > 1:
            raise expected(f"{aperture_keys[0]} or {aperture_keys[1]}, not both", aperture_keys[0])
        if "centre" in content and not set(aperture_keys) & {"circle", "annulus"}:
            raise expected("a circle or an annulus beside it", "centre")

    def clear_aperture(self) -> Aperture | None:
        """Return the clear aperture; None where there is none."""
        clear = self.aperture
        if self.circle is not None:
            clear = Circle(self.circle, *self.centre)
        elif self.annulus is not None:
            clear = Annulus(*self.annulus, *self.centre)
        if self.obscuration is None:
            return clear
        outside = Complement(self.obscuration)
        return outside if clear is None else Intersection((clear, outside))


class ObstructionSection(Parameters):
    """Mesh that blocks light, in a file or written out in base 64."""

    make = Obstruction
    parameters = ("name", "triangles", "before")
    name: Text
    file: OptionalFile = None
    scale: PositiveNumber = 1.0
    triangles: Annotated[
        Any, decoded("<f4", (-1, 3, 3), "nine single-precision numbers a triangle, in base 64"), encoded("<f4")
    ] = None
    before: OptionalNames = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        either(content, "file", ("triangles",))

    def build(self) -> Obstruction:
        """Return the obstruction."""
        if self.file is None:
            return super().build()
        return Obstruction.from_file(self.file, name=self.name, scale=self.scale, before=self.before)


def aperture_items(aperture: Aperture | None) -> dict[str, Any]:
    """Return the keys of a surface for its aperture."""
    if aperture is None:
        return {}
    if isinstance(aperture, (Circle, Annulus)):
        return _region_items(aperture)
    if isinstance(aperture, Complement):
        return {"obscuration": _region_items(aperture.part)}
    if isinstance(aperture, Intersection) and len(aperture.parts) == 2:
        clear, outside = aperture.parts
        if isinstance(clear, (Circle, Annulus)) and isinstance(outside, Complement):
            return _region_items(clear) | {"obscuration": _region_items(outside.part)}
    return {"aperture": _region_items(aperture)}


def _region_items(region: Aperture) -> dict[str, Any]:
    if (section := written(REGIONS, region)) is None:
        raise PrescriptionError(f"aperture {type(region).__name__}: expected one of {', '.join(REGIONS)}")
    return section[1]


def obstruction_items(obstruction: Obstruction) -> dict[str, Any]:
    """Return the section of an obstruction, triangles included, so that a file stands by itself."""
    items = ObstructionSection.written(obstruction)
    ordered = {key: items[key] for key in ("name", "before", "triangles")}
    return {key: value for key, value in ordered.items() if value is not None}
