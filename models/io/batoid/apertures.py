"""Obscurations of batoid files: sections of YAML, and their text.

``ObscCircle``, ``ObscAnnulus``, ``ObscRectangle``, ``ObscRay`` and ``ObscPolygon`` block the light inside a region,
``ObscNegation`` outside of one; ``ObscUnion`` and ``ObscIntersection`` combine several. ``Clear`` in place of ``Obsc``
blocks the light outside.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from ....core.errors import PrescriptionError
from ....core.schema import Parameters, Tagged, WrittenAs, written
from ...aperture import Annulus, Aperture, Circle, Complement, Intersection, Polygon, Rectangle, Union, Vane
from ..yaml.values import ROWS, Number, Numbers


class ObscurationSection(Parameters):
    """A region that blocks light; written without the values that are by default."""

    type: str

    @classmethod
    def written(cls, built: Any) -> dict[str, Any]:  # noqa: D102
        items = super().written(built).items()
        return {key: value for key, value in items if value != cls.model_fields[key].default}


def _ray(width: float, theta: float, x: float, y: float) -> Vane:
    return Vane(width, x, y, theta)


def _polygon(xs: tuple[float, ...], ys: tuple[float, ...]) -> Polygon:
    if len(xs) != len(ys):
        raise PrescriptionError(f"ys = {len(ys)} numbers: expected {len(xs)}, one for each of xs")
    corners = tuple(zip(xs, ys, strict=True))
    # The outline is closed already; batoid's may repeat its first corner.
    return Polygon(corners[:-1] if len(corners) > 3 and corners[0] == corners[-1] else corners)


def _clear(section: type[ObscurationSection]) -> type[ObscurationSection]:
    """Return the section of what is blocked outside the region of another section."""

    class ClearSection(section):  # type: ignore[valid-type, misc]
        def build(self) -> Aperture:
            return clear_region(super().build())

    return ClearSection


#: Sections by the name of the class.
OBSCURATIONS: dict[str, type[ObscurationSection]] = {}
_REGION = Tagged.by_value("type", OBSCURATIONS)
_ITEMS = Annotated[
    tuple[Annotated[Any, _REGION], ...], ROWS, WrittenAs(lambda parts: [_region_items(part) for part in parts])
]
_AT = {"x": (Number, 0.0), "y": (Number, 0.0)}
_SECTIONS = {
    "Circle": ObscurationSection.of(Circle, radius=Number, **_AT),
    "Annulus": ObscurationSection.of(Annulus, inner=Number, outer=Number, **_AT),
    "Rectangle": ObscurationSection.of(Rectangle, width=Number, height=Number, **_AT, theta=(Number, 0.0)),
    "Ray": ObscurationSection.of(_ray, width=Number, theta=Number, **_AT),
    "Polygon": ObscurationSection.of(_polygon, xs=Numbers, ys=Numbers),
    "Union": ObscurationSection.of(Union, items=_ITEMS),
    "Intersection": ObscurationSection.of(Intersection, items=_ITEMS),
    "Negation": ObscurationSection.of(lambda region: clear_region(region), original=Annotated[Any, _REGION]),
}
OBSCURATIONS |= {f"Obsc{name}": section for name, section in _SECTIONS.items()}
OBSCURATIONS |= {f"Clear{name}": _clear(section) for name, section in _SECTIONS.items()}
#: A region that blocks light as the annotation of a field.
Obscuration = Annotated[Aperture | None, _REGION]


def clear_region(blocked: Aperture) -> Aperture:
    """Return the region outside another."""
    return blocked.part if isinstance(blocked, Complement) else Complement(blocked)


def obscuration_items(aperture: Aperture) -> dict[str, Any]:
    """Return the section of the obscuration that leaves an aperture clear; PrescriptionError where batoid has none."""
    return _region_items(clear_region(aperture))


def _region_items(region: Aperture) -> dict[str, Any]:
    """Return the section of an obscuration that blocks a region."""
    if isinstance(region, Complement):
        inner = _region_items(region.part)
        return inner | {"type": inner["type"].replace("Obsc", "Clear", 1)}
    if isinstance(region, Vane):
        ray = {"type": "ObscRay", "width": region.width, "theta": region.angle, "x": region.x, "y": region.y}
        if not region.both_ways:
            return ray
        # Half a turn; the line across the point itself belongs to neither ray, and no light is on a line.
        return {"type": "ObscUnion", "items": [ray, ray | {"theta": region.angle + math.pi}]}
    if isinstance(region, Polygon):
        xs, ys = zip(*region.corners, strict=True)
        return {"type": "ObscPolygon", "xs": list(xs), "ys": list(ys)}
    section = written(OBSCURATIONS, region)
    if section is None:
        raise PrescriptionError(
            f"aperture {type(region).__name__}: expected one that batoid has: disc, ring, rectangle, polygon, vane"
        )
    return {"type": section[0]} | section[1]
