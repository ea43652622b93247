"""Write a telescope as the text of a prescription file; the format is described in `prescription`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from itertools import count
from typing import Any

from ...media.medium import Medium
from ...surface import IDENTITY, Surface
from ...telescope import VACUUM, Telescope
from .apertures import aperture_angles, aperture_items, obstruction_items
from .media import medium_items, medium_wavelengths
from .reader import INTERACTIONS
from .shapes import shape_items
from .values import ANGLES, WAVELENGTHS, flow

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
    span, edges = [shown[v] for v in t.wavelength_range], [shown[v] for v in band]
    names: dict[Medium, str] = {VACUUM: "vacuum"}
    taken = {glass.name for glass in glasses}
    numbered = (f"glass_{i}" for i in count(1))
    for glass in glasses:
        # A name of its own that no other medium has; without one, a number.
        own = re.fullmatch(r"[A-Za-z][\w.-]*", glass.name) and glass.name not in names.values()
        names[glass] = glass.name if own else next(n for n in numbered if n not in taken)

    lines = [f"name: {flow(t.name)}"]
    lines += [f"{key}: {flow(getattr(t, key))}" for key in ("description", "source", "version") if getattr(t, key)]
    lines += [
        f"units: {{length: m, angle: {angle}, wavelength: {wave}}}",
        f"stop: {flow({'z': t.stop_z})}",
        f"pupil: {flow({'diameter': t.pupil_diameter, 'obscuration': t.pupil_obscuration})}",
        f"launch_distance: {flow(t.launch_distance)}",
        f"reference_sphere_radius: {flow(t.reference_sphere_radius)}",
        f"field: {flow({'radius': angles[0], 'limit': angles[1]})}",
        f"wavelengths: {flow({'range': span, 'default': shown[t.default_wavelength], 'band': edges})}",
    ]
    if math.isfinite(t.object_distance):
        lines.append(f"object_distance: {flow(t.object_distance)}")
    if t.camera is not None:
        lines.append(f"camera: {flow(t.camera)}")
    if t.medium_before != VACUUM:
        lines.append(f"medium_before: {names[t.medium_before]}")
    if glasses:
        lines.append("media:")
    lines += [f"  {names[glass]}: {flow(medium_items(glass, shown.__getitem__))}" for glass in glasses]
    if t.groups:
        lines.append("groups:")
    for group, members in t.groups.items():
        group_items: Any = members
        pivot, axes = t.group_frames[group]
        first = t.surface(members[0])
        if (pivot, axes) != (first.vertex, first.rotation):
            group_items = {"surfaces": members, "pivot": pivot, "rotation": axes}
        lines.append(f"  {flow(group)}: {flow(group_items)}")
    if t.obstructions:
        lines += ["obstructions:", *(f"  - {flow(obstruction_items(o))}" for o in t.obstructions)]
    lines.append("surfaces:")
    return "\n".join(lines + _surface_lines(t.surfaces, names, shown_angles.__getitem__)) + "\n"


def _surface_lines(
    surfaces: tuple[Surface, ...], names: dict[Medium, str], angle: Callable[[float], float]
) -> list[str]:
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


def _surface_items(surface: Surface, names: dict[Medium, str], angle: Callable[[float], float]) -> dict[str, str]:
    x, y, z = surface.vertex
    shape = shape_items(surface.shape)
    kind = INTERACTION_NAMES[surface.interaction]
    items = {"name": surface.name, "type": kind, "shape": shape.pop("shape"), "z": z}
    items |= {key: value for key, value in (("x", x), ("y", y)) if value != 0}
    if surface.rotation != IDENTITY:
        items["rotation"] = surface.rotation
    items |= shape | aperture_items(surface.aperture, angle)
    texts = {key: flow(value) for key, value in items.items()}
    return texts | ({"medium": names[surface.medium_after]} if kind == "refract" else {})


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
