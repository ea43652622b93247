"""Write a telescope as the text of a prescription file; the format is described in `prescription`."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from ....core.errors import PachonError
from ....core.yaml_reader import loaded
from ...coating import AnyCoating
from ...grating import Grating
from ...media.medium import Medium
from ...surface import IDENTITY, Surface
from ...telescope import VACUUM, Telescope
from ...thin_lens import ThinLens
from ..writable import require_met
from .apertures import aperture_items, obstruction_items
from .coatings import coating_items, coating_names
from .design import design_items
from .media import medium_items
from .reader import INTERACTIONS, MAX_BYTES, telescope_of
from .shapes import shape_items
from .values import Bare, Metres, Turn, Wave, flow, in_metres, length_text, number_text, to_si

INTERACTION_NAMES = {value: name for name, value in INTERACTIONS.items()}


def telescope_to_yaml(telescope: Telescope) -> str:
    """Return the text of the prescription file of a telescope; it loads back equal to the last bit.

    Lengths are in mm where the telescope's unit of length is, else in metres. PrescriptionError if a value is not that
    of its pickup.
    """
    t = require_met(telescope)
    metres = _text(t, "m")
    if t.length_unit[0] != "mm":
        return metres
    # A shape or region whose lengths are not all written in the file's unit would be another one: then metres.
    millimetres = _text(t, "mm")
    with suppress(PachonError, ValueError):
        if _read(millimetres) == _read(metres):
            return millimetres
    return metres


def _read(text: str) -> Telescope:
    return telescope_of(loaded(text, max_bytes=MAX_BYTES), Path("written.yaml"))


def _text(t: Telescope, length_unit: str) -> str:
    names, coated = _medium_names(t), coating_names(t.surfaces)
    low, high = t.band or t.wavelength_range
    head: dict[str, Any] = {
        "name": t.name,
        "description": t.description,
        # A file must have both; a telescope that is built by hand need not.
        "source": t.source or "not stated",
        "version": t.version or "not stated",
        "units": {"length": length_unit},
        "stop": {"z": Metres(t.stop_z)}
        | ({"center": [Metres(v) for v in t.pupil_center]} if any(t.pupil_center) else {}),
        "pupil": {"diameter": Metres(t.pupil_diameter), "obscuration": t.pupil_obscuration},
        "launch_distance": Metres(t.launch_distance),
        "reference_sphere_radius": Metres(t.reference_sphere_radius),
        "field": {"radius": Turn(t.field_radius), "limit": Turn(t.field_limit)},
        "wavelengths": {
            "range": [Wave(w) for w in t.wavelength_range],
            "default": Wave(t.default_wavelength),
            "band": [Wave(low), Wave(high)],
        },
        "object_distance": Metres(t.object_distance) if math.isfinite(t.object_distance) else None,
        "camera": t.camera,
        "site": t.site,
        "dispersion_corrector": t.dispersion_corrector,
        "medium_before": names[t.medium_before] if t.medium_before != VACUUM else None,
    }
    lists = {
        "design": [(f"  {key}: ", value) for key, value in design_items(t.design_data).items()],
        "media": [(f"  {name}: ", medium_items(medium)) for medium, name in names.items() if medium != VACUUM],
        "coatings": [(f"  {flow(name)}: ", coating_items(coating)) for coating, name in coated.items()],
        "groups": [(f"  {flow(name)}: ", _group_items(t, name)) for name in t.groups],
        "obstructions": [("  - ", obstruction_items(obstruction)) for obstruction in t.obstructions],
    }
    before = (t.medium_before, *(s.medium_after for s in t.surfaces))
    surfaces = [_surface_items(*pair, names, coated) for pair in zip(t.surfaces, before, strict=False)]
    angles, waves = _found((head, lists, surfaces), Turn), _found((head, lists, surfaces), Wave)
    angle, turned = _in_unit(angles, "deg", "rad")
    wave, shown = _in_unit(waves, "um", "m")
    head["units"] |= {"angle": angle, "wavelength": wave}

    def number(value: float) -> str:
        if isinstance(value, Metres):
            return length_text(value, length_unit)
        return number_text({Turn: turned, Wave: shown}.get(type(value), {}).get(value, value))

    def text(value: Any) -> str:
        return flow(value, number)

    lines = [f"{key}: {text(value)}" for key, value in head.items() if value not in ("", None)]
    for key, entries in lists.items():
        lines += [f"{key}:", *(start + text(items) for start, items in entries)] if entries else []
    rows = [{key: text(value) for key, value in items.items()} for items in surfaces]
    return "\n".join([*lines, "surfaces:", *_aligned(rows)]) + "\n"


def _medium_names(t: Telescope) -> dict[Medium, str]:
    """Return a name for each medium: its own that no other medium has, else a number."""
    media = list(dict.fromkeys(m for m in (t.medium_before, *(s.medium_after for s in t.surfaces)) if m != VACUUM))
    names: dict[Medium, str] = {VACUUM: "vacuum"}
    numbered = (f"glass_{i}" for i in count(1))
    for medium in media:
        is_free = re.fullmatch(r"[A-Za-z][\w.-]*", medium.name) and medium.name not in names.values()
        names[medium] = medium.name if is_free else next(n for n in numbered if n not in {m.name for m in media})
    return names


def _group_items(t: Telescope, name: str) -> Any:
    members, (pivot, axes) = t.groups[name], t.group_frames[name]
    first = t.surface(members[0])
    framed = (pivot, axes) != (first.vertex, first.rotation)
    return {"surfaces": members, "pivot": in_metres(pivot), "rotation": axes} if framed else members


def _surface_items(
    surface: Surface, before: Medium, names: dict[Medium, str], coated: dict[AnyCoating, str]
) -> dict[str, Any]:
    x, y, z = surface.vertex
    shape = shape_items(surface.shape)
    kind = INTERACTION_NAMES[surface.interaction]
    items = {"name": surface.name, "type": kind, "shape": shape.pop("shape"), "z": Metres(z)}
    items |= {key: Metres(value) for key, value in (("x", x), ("y", y)) if value != 0}
    items |= {} if surface.rotation == IDENTITY else {"rotation": surface.rotation}
    items |= shape | aperture_items(surface.aperture)
    items |= {} if surface.semi_diameter is None else {"semi_diameter": Metres(surface.semi_diameter)}
    items |= {} if surface.coating is None else {"coating": coated[surface.coating]}
    items |= {} if surface.grating is None else {"grating": _grating_items(surface.grating)}
    items |= {} if surface.thin_lens is None else {"thin_lens": _thin_lens_items(surface.thin_lens)}
    # Without a name the medium stays what it is in front.
    named = kind == "refract" or surface.medium_after != before
    return items | ({"medium": Bare(names[surface.medium_after])} if named else {})


def _grating_items(grating: Grating) -> dict[str, Any]:
    items: dict[str, Any] = {"order": Bare(grating.order), "lines_per_mm": grating.lines_per_mm}
    return items | ({"groove_angle": Turn(grating.groove_angle)} if grating.groove_angle else {})


def _thin_lens_items(lens: ThinLens) -> dict[str, Any]:
    distant = math.isinf(lens.object_distance)
    return {"focal_length": Metres(lens.focal_length)} | (
        {} if distant else {"object_distance": Metres(lens.object_distance)}
    )


def _aligned(rows: list[dict[str, str]]) -> list[str]:
    """Return the lines of surfaces; the first keys, which all have, are aligned into columns."""
    # A sum of shapes is a list and breaks the column: it would push all others out of sight.
    aligned = ("name", "type", "shape", "z")
    width = {key: max((len(row[key]) for row in rows if row[key][0] != "["), default=0) for key in aligned}
    lines = []
    for row in rows:
        last = [*row][-1]
        cells = [f"{key}: {value}" + ("" if key == last else ",") for key, value in row.items()]
        padded = [cell.ljust(len(key) + 3 + width.get(key, -99)) for key, cell in zip(row, cells, strict=True)]
        lines.append("  - {" + " ".join([*padded[:-1], cells[-1]]) + "}")
    return lines


def _found(value: Any, kind: type[float]) -> list[float]:
    """Return the angles or wavelengths within nested mappings and lists."""
    if isinstance(value, kind):
        return [value]
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return [match for inner_part in inner for match in _found(inner_part, kind)]


def _in_unit(values: list[float], unit: str, fallback: str) -> tuple[str, dict[float, float]]:
    """Return a unit and the values in it that convert back exactly: the readable unit, or SI where it cannot."""
    converted = {}
    for value in values:
        near = value / to_si(1.0, unit)
        exact = [c for c in (float(f"{near:.{digits}g}") for digits in range(1, 18)) if to_si(c, unit) == value]
        if not exact:
            return fallback, {}
        converted[value] = exact[0]
    return unit, converted
