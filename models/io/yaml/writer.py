"""Write a telescope as the text of a prescription file; the format is described in `prescription`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from itertools import count
from typing import Any

import yaml

from ...media.medium import Medium
from ...surface import IDENTITY, Surface
from ...telescope import VACUUM, Telescope
from .apertures import aperture_angles, aperture_items, obstruction_lines
from .media import medium_items, medium_wavelengths
from .reader import INTERACTIONS
from .shapes import shape_items
from .values import ANGLES, WAVELENGTHS

INTERACTION_NAMES = {value: name for name, value in INTERACTIONS.items()}


def telescope_to_yaml(telescope: Telescope) -> str:
    """Return the text of the prescription file of a telescope; it loads back equal to the last bit."""
    t = telescope
    band = t.band or t.wavelength_range
    waves: tuple[float, ...] = (*t.wavelength_range, t.default_wavelength, *band)
    glasses = [m for m in (s.medium_after for s in t.surfaces) if m != VACUUM]
    glasses = list(dict.fromkeys([*([t.medium_before] if t.medium_before != VACUUM else []), *glasses]))
    for glass in glasses:
        waves += medium_wavelengths(glass)
    turns = [turn for s in t.surfaces for turn in aperture_angles(s.aperture)]
    angle, angles = _in_unit((t.field_radius, t.field_limit, *turns), "deg", ANGLES, "rad")
    shown_angles = dict(zip(turns, angles[2:], strict=True))
    wave, waves_out = _in_unit(waves, "um", WAVELENGTHS, "m")
    shown = dict(zip(waves, waves_out, strict=True))
    names: dict[Medium, str] = {VACUUM: "vacuum"}
    taken = {glass.name for glass in glasses}
    numbered = (f"glass_{i}" for i in count(1))
    for glass in glasses:
        # A name of its own that no other medium has; without one, a number.
        own = re.fullmatch(r"[A-Za-z][\w.-]*", glass.name) and glass.name not in names.values()
        names[glass] = glass.name if own else next(n for n in numbered if n not in taken)

    def wave_list(values: tuple[float, ...]) -> str:
        return _list(shown[v] for v in values)

    lines = [f"name: {_text(t.name)}"]
    lines += [f"{key}: {_text(getattr(t, key))}" for key in ("description", "source", "version") if getattr(t, key)]
    lines += [
        f"units: {{length: m, angle: {angle}, wavelength: {wave}}}",
        f"stop: {{z: {_number(t.stop_z)}}}",
        f"pupil: {{diameter: {_number(t.pupil_diameter)}, obscuration: {_number(t.pupil_obscuration)}}}",
        f"launch_distance: {_number(t.launch_distance)}",
        f"reference_sphere_radius: {_number(t.reference_sphere_radius)}",
        f"field: {{radius: {_number(angles[0])}, limit: {_number(angles[1])}}}",
        f"wavelengths: {{range: {wave_list(t.wavelength_range)}, default: {_number(shown[t.default_wavelength])}, "
        f"band: {wave_list(band)}}}",
    ]
    if math.isfinite(t.object_distance):
        lines.append(f"object_distance: {_number(t.object_distance)}")
    if t.camera is not None:
        lines.append(f"camera: {_text(t.camera)}")
    if t.medium_before != VACUUM:
        lines.append(f"medium_before: {names[t.medium_before]}")
    if glasses:
        lines.append("media:")
    for glass in glasses:
        items = medium_items(glass, _number, _list, wave_list)
        lines.append(f"  {names[glass]}: {{" + ", ".join(f"{key}: {value}" for key, value in items.items()) + "}")
    if t.groups:
        lines.append("groups:")
    for group, members in t.groups.items():
        listed = "[" + ", ".join(_text(m) for m in members) + "]"
        pivot, axes = t.group_frames[group]
        first = t.surface(members[0])
        if (pivot, axes) != (first.vertex, first.rotation):
            listed = f"{{surfaces: {listed}, pivot: {_list(pivot)}, rotation: {_matrix(axes)}}}"
        lines.append(f"  {_text(group)}: {listed}")
    lines += obstruction_lines(t.obstructions, _text)
    lines.append("surfaces:")
    return "\n".join(lines + _surface_lines(t.surfaces, names, lambda turn: _number(shown_angles[turn]))) + "\n"


def _surface_lines(surfaces: tuple[Surface, ...], names: dict[Medium, str], angle: Callable[[float], str]) -> list[str]:
    rows = [_surface_items(s, names, angle) for s in surfaces]
    # The first keys, which every surface has, are aligned so that the eye can run down a column.
    aligned = ("name", "type", "shape", "z")
    # A sum of shapes is a list and breaks the column: it would push all others out of sight.
    width = {key: max((len(row[key]) for row in rows if row[key][0] != "["), default=0) for key in aligned}
    lines = []
    for row in rows:
        keys = list(row)
        cells = []
        for key in keys:
            comma = "" if key == keys[-1] else ","
            cell = f"{key}: {row[key]}{comma}"
            cells.append(cell.ljust(len(key) + 3 + width[key]) if key in aligned and comma else cell)
        lines.append("  - {" + " ".join(cells) + "}")
    return lines


def _surface_items(surface: Surface, names: dict[Medium, str], angle: Callable[[float], str]) -> dict[str, str]:
    x, y, z = surface.vertex
    shape = shape_items(surface.shape, _number, _list)
    items = {
        "name": _text(surface.name),
        "type": INTERACTION_NAMES[surface.interaction],
        "shape": shape["shape"],
        "z": _number(z),
    }
    items |= {key: _number(value) for key, value in (("x", x), ("y", y)) if value != 0}
    if surface.rotation != IDENTITY:
        items["rotation"] = _matrix(surface.rotation)
    items |= {key: value for key, value in shape.items() if key != "shape"}
    items |= aperture_items(surface.aperture, _number, _list, angle)
    if surface.interaction == INTERACTIONS["refract"]:
        items["medium"] = names[surface.medium_after]
    return items


def _in_unit(
    values: tuple[float, ...], unit: str, units: dict[str, Callable[[float], float]], fallback: str
) -> tuple[str, tuple[float, ...]]:
    """Return a unit and the values in it that convert back exactly: the readable unit, or SI where it cannot."""
    convert = units[unit]
    found = []
    for value in values:
        near = value / convert(1.0)
        exact = [c for c in (float(f"{near:.{digits}g}") for digits in range(1, 18)) if convert(c) == value]
        if not exact:
            return fallback, values
        found.append(exact[0])
    return unit, tuple(found)


def _number(value: float) -> str:
    text = repr(float(value) + 0.0)
    # YAML 1.1 takes 8e-07 for a text: a number needs its point.
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


def _list(values: Any) -> str:
    return "[" + ", ".join(_number(v) for v in values) + "]"


def _matrix(rows: Any) -> str:
    return "[" + ", ".join(_list(row) for row in rows) + "]"


def _text(value: str) -> str:
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.()/;+ -]*", value) and value == value.strip()
    return value if plain and yaml.safe_load(value) == value else json.dumps(value, ensure_ascii=False)
