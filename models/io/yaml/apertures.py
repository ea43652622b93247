"""Clear apertures and obstructions in prescription files: from a section of YAML and back.

A surface has ``circle: 0.4`` or ``annulus: [0.6, 4.1]``, with ``centre: [x, y]``, or any region under ``aperture``;
what blocks light stands under ``obscuration``. A region is one of:

================================================================= ====================================================
``{circle: 0.4, centre: [0, 0]}``                                 disc of a radius
``{annulus: [0.6, 4.1], centre: [0, 0]}``                         ring of two radii
``{rectangle: [0.05, 9.6], centre: [0, 0], angle: 45}``           width along x and height along y, then turned
``{polygon: [[0, 0], [1, 0], [0, 1]]}``                           corners in either sense
``{vane: 0.05, from: [0.4, 0], angle: 45, both_ways: true}``      strip of a width from a point outwards
``{union: [...]}``, ``{intersection: [...]}``, ``{complement: r}`` of other regions
================================================================= ====================================================

A mesh that blocks light is ``{name: top_end, file: top_end.stl, scale: 0.001, before: [M1]}`` in the list
``obstructions``; `scale` is the length of its unit in metres. Its file is looked for beside the prescription.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError
from ....core.yaml_reader import Section
from ...aperture import Annulus, Aperture, Circle, Complement, Intersection, Polygon, Rectangle, Union, Vane
from ...obstruction import Obstruction

Convert = Callable[[float], float]

#: Keys of a surface that say what it leaves clear.
APERTURE_KEYS = ("circle", "annulus", "centre", "aperture", "obscuration")
# The keys that a region of each kind has beside its own.
_REGIONS: dict[str, tuple[str, ...]] = {
    "circle": ("centre",),
    "annulus": ("centre",),
    "rectangle": ("centre", "angle"),
    "polygon": (),
    "vane": ("from", "angle", "both_ways"),
    "union": (),
    "intersection": (),
    "complement": (),
}


def read_aperture(section: Section, length: Convert, angle: Convert) -> Aperture | None:
    """Return the clear aperture that the keys of a surface describe; None where there are none.

    Parameters
    ----------
    section : Section
        The surface.
    length, angle : callable
        Conversions of the file's lengths and angles to SI.

    Raises
    ------
    PrescriptionError
        If the keys are malformed or contradict each other: file, key, value and what was expected.
    """
    shapes = [key for key in ("circle", "annulus", "aperture") if key in section]
    if len(shapes) > 1:
        raise section.error(shapes[0], f"{shapes[0]} or {shapes[1]}, not both")
    if "centre" in section and not (set(shapes) & {"circle", "annulus"}):
        raise section.error("centre", "a circle or an annulus beside it")
    clear: Aperture | None = None
    if shapes == ["aperture"]:
        clear = _read_region(section.section("aperture"), length, angle)
    elif shapes:
        clear = _read_disc(section, shapes[0], length)
    if "obscuration" in section:
        outside = Complement(_read_region(section.section("obscuration"), length, angle))
        return outside if clear is None else Intersection((clear, outside))
    return clear


def _read_region(section: Section, length: Convert, angle: Convert) -> Aperture:
    kinds = [key for key in _REGIONS if key in section]
    if len(kinds) != 1:
        found = ", ".join(section.keys()) or "nothing"
        raise PrescriptionError(f"{section.source}: {section.place} has {found}: expected one of {', '.join(_REGIONS)}")
    kind = kinds[0]
    section.allow(kind, *_REGIONS[kind])
    try:
        if kind in ("circle", "annulus"):
            return _read_disc(section, kind, length)
        if kind == "polygon":
            return Polygon(_read_corners(section, length))
        if kind == "complement":
            return Complement(_read_region(section.section(kind), length, angle))
        if kind in ("union", "intersection"):
            parts = tuple(_read_region(part, length, angle) for part in section.sections(kind, kind))
            return Union(parts) if kind == "union" else Intersection(parts)
        turn = angle(section.number("angle", 0.0))
        x, y = (length(v) for v in section.numbers("from" if kind == "vane" else "centre", 2, (0.0, 0.0)))
        if kind == "rectangle":
            width, height = (length(v) for v in section.numbers(kind, 2))
            return Rectangle(width, height, x, y, turn)
        return Vane(length(section.number(kind)), x, y, turn, _read_flag(section, "both_ways"))
    except PrescriptionError as error:
        raise section.placed(error) from None


def _read_disc(section: Section, kind: str, length: Convert) -> Circle | Annulus:
    x, y = (length(v) for v in section.numbers("centre", 2, (0.0, 0.0)))
    if kind == "circle":
        return Circle(length(section.number(kind)), x, y)
    inner, outer = (length(v) for v in section.numbers(kind, 2))
    return Annulus(inner, outer, x, y)


def _read_corners(section: Section, length: Convert) -> tuple[tuple[float, float], ...]:
    rows = section.value("polygon")
    if not isinstance(rows, list):
        raise section.error("polygon", "a list of corners [x, y]")
    # A section of the corners by number lets each report itself.
    corners = Section({str(i + 1): row for i, row in enumerate(rows)}, section.source, f"{section.place}.polygon")
    found = []
    for key in corners.keys():  # noqa: SIM118 - a Section is no mapping
        x, y = (length(v) for v in corners.numbers(key, 2))
        found.append((x, y))
    return tuple(found)


def _read_flag(section: Section, key: str) -> bool:
    flag = section.value(key) if key in section else False
    if not isinstance(flag, bool):
        raise section.error(key, "true or false")
    return flag


def read_obstructions(top: Section) -> tuple[Obstruction, ...]:
    """Return the meshes that the top level of a prescription file lists under ``obstructions``.

    Raises
    ------
    PrescriptionError
        If an entry is malformed, or its file is not a mesh.
    """
    if "obstructions" not in top:
        return ()
    found = []
    for section in top.sections("obstructions", "name"):
        section.allow("name", "file", "scale", "triangles", "before")
        before = section.names("before") if "before" in section else None
        try:
            if "triangles" in section:
                section.allow("name", "triangles", "before")
                found.append(Obstruction(section.text("name"), _read_triangles(section), before))
            else:
                # A relative path is meant from where the prescription lies.
                path = Path(section.source).parent / section.text("file")
                scale = section.number("scale", 1.0, positive=True)
                found.append(Obstruction.from_file(path, name=section.text("name"), scale=scale, before=before))
        except PrescriptionError as error:
            raise section.placed(error) from None
    return tuple(found)


def _read_triangles(section: Section) -> np.ndarray:
    try:
        content = base64.b64decode(section.text("triangles"), validate=True)
        return np.frombuffer(content, dtype="<f4").reshape(-1, 3, 3)
    except (binascii.Error, ValueError):
        raise section.error("triangles", "nine single-precision numbers a triangle, in base 64") from None


def aperture_angles(aperture: Aperture | None) -> Iterator[float]:
    """Yield the angles [rad] that a description of the aperture states."""
    if isinstance(aperture, (Rectangle, Vane)) and aperture.angle:
        yield aperture.angle
    elif isinstance(aperture, Complement):
        yield from aperture_angles(aperture.part)
    elif isinstance(aperture, (Union, Intersection)):
        for part in aperture.parts:
            yield from aperture_angles(part)


def aperture_items(
    aperture: Aperture | None, number: Callable[[float], str], listed: Callable[..., str], angle: Callable[[float], str]
) -> dict[str, str]:
    """Return the keys and values, as text, that :func:`read_aperture` makes the same aperture of.

    Parameters
    ----------
    aperture : Aperture or None
        What to describe.
    number, listed, angle : callable
        Text of a number, of several, and of an angle [rad] in the unit of the file.
    """

    def region(a: Aperture) -> dict[str, str]:
        if isinstance(a, Circle):
            items = {"circle": number(a.radius)}
        elif isinstance(a, Annulus):
            items = {"annulus": listed((a.inner, a.outer))}
        elif isinstance(a, Rectangle):
            items = {"rectangle": listed((a.width, a.height))}
        elif isinstance(a, Vane):
            items = {"vane": number(a.width)}
        elif isinstance(a, Polygon):
            return {"polygon": "[" + ", ".join(listed(c) for c in a.corners) + "]"}
        elif isinstance(a, Complement):
            return {"complement": nested(a.part)}
        else:
            key = "union" if isinstance(a, Union) else "intersection"
            return {key: "[" + ", ".join(nested(part) for part in a.parts) + "]"}
        if a.x or a.y:
            items["from" if isinstance(a, Vane) else "centre"] = listed((a.x, a.y))
        if isinstance(a, (Rectangle, Vane)) and a.angle:
            items["angle"] = angle(a.angle)
        if isinstance(a, Vane) and a.both_ways:
            items["both_ways"] = "true"
        return items

    def nested(a: Aperture) -> str:
        return "{" + ", ".join(f"{key}: {value}" for key, value in region(a).items()) + "}"

    if aperture is None:
        return {}
    if isinstance(aperture, (Circle, Annulus)):
        return region(aperture)
    if isinstance(aperture, Complement):
        return {"obscuration": nested(aperture.part)}
    if isinstance(aperture, Intersection) and len(aperture.parts) == 2:
        clear, outside = aperture.parts
        if isinstance(clear, (Circle, Annulus)) and isinstance(outside, Complement):
            return region(clear) | {"obscuration": nested(outside.part)}
    return {"aperture": nested(aperture)}


def obstruction_lines(obstructions: tuple[Obstruction, ...], text: Callable[[str], str]) -> list[str]:
    """Return the lines of the list of obstructions, triangles included, so that a file stands by itself."""
    lines = ["obstructions:"] if obstructions else []
    for obstruction in obstructions:
        items = [f"name: {text(obstruction.name)}"]
        if obstruction.before is not None:
            items.append("before: [" + ", ".join(text(name) for name in obstruction.before) + "]")
        content = base64.b64encode(obstruction.triangles.astype("<f4").tobytes()).decode()
        items.append(f"triangles: {json.dumps(content)}")
        lines.append("  - {" + ", ".join(items) + "}")
    return lines
