"""Clear apertures and obstructions in prescription files: sections of YAML, and their text.

A surface has ``circle: 0.4`` or ``annulus: [0.6, 4.1]``, with ``centre: [x, y]``, or any region under ``aperture``;
regions that block light stand under ``obscuration``. A region is one of:

================================================================= ====================================================
``{circle: 0.4, centre: [0, 0]}``                                 disc of a radius
``{annulus: [0.6, 4.1], centre: [0, 0]}``                         ring of two radii
``{rectangle: [0.05, 9.6], centre: [0, 0], angle: 45}``           width along x and height along y, then rotated
``{polygon: [[0, 0], [1, 0], [0, 1]]}``                           corners in either sense
``{vane: 0.05, from: [0.4, 0], angle: 45, both_ways: true}``      strip of a width from a point outwards
``{union: [...]}``, ``{intersection: [...]}``, ``{complement: r}`` of other regions
================================================================= ====================================================

A mesh that blocks light is ``{name: top_end, file: top_end.stl, scale: 0.001, before: [M1]}`` in the list
``obstructions``; `scale` is the length of its unit in metres. Its file is looked for beside the prescription.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any

from ....core.schema import Parameters, Section, Tagged, checked, either, expected, problem
from ...aperture import Annulus, Aperture, Circle, Complement, Intersection, Polygon, Rectangle, Union, Vane
from ...obstruction import Obstruction
from .values import (
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
    array,
    encoded,
    rows,
)


def _region_kind(content: dict[str, Any]) -> str:
    kinds = [key for key in REGIONS if key in content]
    if len(kinds) != 1:
        raise problem(f" has {', '.join(content) or 'nothing'}: expected one of {', '.join(REGIONS)}")
    return kinds[0]


class RegionSection(Parameters):
    """A region of the plane."""

    def build(self) -> Aperture:
        """Return the region; pairs of lengths are two arguments of its class."""
        values = (getattr(self, key) for key in self.parameters)
        return self.make(*(v for value in values for v in (value if isinstance(value, tuple) else (value,))))


#: Sections of regions by the key that tells their kind.
REGIONS: dict[str, type[Parameters]] = {}
_REGION = Tagged(REGIONS, _region_kind)
_PARTS = Annotated[tuple[Annotated[Any, _REGION], ...], checked(rows, "a list of mappings, one a line")]
_CORNERS = Annotated[
    tuple[Point, ...], checked(lambda v: v if isinstance(v, list) else None, "a list of corners [x, y]")
]
_CENTRE, _ANGLE = (Point, (0.0, 0.0)), (Angle, 0.0)
REGIONS |= {
    "circle": RegionSection.of(Circle, circle=Length, centre=_CENTRE),
    "annulus": RegionSection.of(Annulus, annulus=Point, centre=_CENTRE),
    "rectangle": RegionSection.of(Rectangle, rectangle=Point, centre=_CENTRE, angle=_ANGLE),
    "polygon": Parameters.of(Polygon, polygon=_CORNERS),
    "vane": RegionSection.of(Vane, vane=Length, **{"from": _CENTRE}, angle=_ANGLE, both_ways=(Flag, False)),
    "union": Parameters.of(Union, union=_PARTS),
    "intersection": Parameters.of(Intersection, intersection=_PARTS),
    "complement": Parameters.of(Complement, complement=Annotated[Any, _REGION]),
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
        given = [key for key in ("circle", "annulus", "aperture") if key in content]
        if len(given) > 1:
            raise expected(f"{given[0]} or {given[1]}, not both", given[0])
        if "centre" in content and not set(given) & {"circle", "annulus"}:
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

    name: Text
    file: OptionalFile = None
    scale: PositiveNumber = 1.0
    triangles: Annotated[
        Any, checked(array("<f4", (-1, 3, 3)), "nine single-precision numbers a triangle, in base 64")
    ] = None
    before: OptionalNames = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        either(content, "file", ("triangles",))

    def build(self) -> Obstruction:
        """Return the obstruction."""
        if self.file is None:
            return Obstruction(self.name, self.triangles, self.before)
        return Obstruction.from_file(self.file, name=self.name, scale=self.scale, before=self.before)


def aperture_angles(aperture: Aperture | None) -> Iterator[float]:
    """Yield the angles [rad] in the section of an aperture."""
    if isinstance(aperture, (Rectangle, Vane)) and aperture.angle:
        yield aperture.angle
    elif isinstance(aperture, Complement):
        yield from aperture_angles(aperture.part)
    elif isinstance(aperture, (Union, Intersection)):
        for part in aperture.parts:
            yield from aperture_angles(part)


def aperture_items(aperture: Aperture | None, angle: Callable[[float], float]) -> dict[str, Any]:
    """Return the keys of a surface for its aperture; `angle` converts radians to the unit of the file."""
    if aperture is None:
        return {}
    if isinstance(aperture, (Circle, Annulus)):
        return _region_items(aperture, angle)
    if isinstance(aperture, Complement):
        return {"obscuration": _region_items(aperture.part, angle)}
    if isinstance(aperture, Intersection) and len(aperture.parts) == 2:
        clear, outside = aperture.parts
        if isinstance(clear, (Circle, Annulus)) and isinstance(outside, Complement):
            return _region_items(clear, angle) | {"obscuration": _region_items(outside.part, angle)}
    return {"aperture": _region_items(aperture, angle)}


def _region_items(region: Aperture, angle: Callable[[float], float]) -> dict[str, Any]:
    if isinstance(region, Polygon):
        return {"polygon": region.corners}
    if isinstance(region, Complement):
        return {"complement": _region_items(region.part, angle)}
    if isinstance(region, (Union, Intersection)):
        key = "union" if isinstance(region, Union) else "intersection"
        return {key: [_region_items(part, angle) for part in region.parts]}
    items: dict[str, Any]
    if isinstance(region, Circle):
        items = {"circle": region.radius}
    elif isinstance(region, Annulus):
        items = {"annulus": (region.inner, region.outer)}
    elif isinstance(region, Rectangle):
        items = {"rectangle": (region.width, region.height)}
    else:
        items = {"vane": region.width}
    if region.x or region.y:
        items["from" if isinstance(region, Vane) else "centre"] = (region.x, region.y)
    if isinstance(region, (Rectangle, Vane)) and region.angle:
        items["angle"] = angle(region.angle)
    return items | ({"both_ways": True} if isinstance(region, Vane) and region.both_ways else {})


def obstruction_items(obstruction: Obstruction) -> dict[str, Any]:
    """Return the section of an obstruction, triangles included, so that a file stands by itself."""
    before = {} if obstruction.before is None else {"before": obstruction.before}
    return {"name": obstruction.name} | before | {"triangles": encoded(obstruction.triangles, "<f4")}
