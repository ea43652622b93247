"""Pickups and solves of a Zemax file: radius, thickness and glass of another surface, and a paraxial back focus.

``CURV value 4 surface scale``, ``PZUP surface scale offset``, ``GLAS name 2 surface``, ``MAZH height zone``, and, as a
pickup, ``TCOM surface sum``. Of others the solution stands in the file; they are named in a note.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...links import Pickup, Solve
from ...surface import Interaction, Surface
from ...telescope import Telescope
from ...thickness import thickness
from ..lens.build import surface_names
from ..lens.description import LensDescription, LensSurface
from ..lens.source import Source
from ..lens.text import number_text
from .file import Block

#: Solve type of a curvature that takes over that of another surface.
_CURVATURE = 4
#: Solve type of a glass that takes over that of another surface.
_GLASS = 2
#: Solves of a curvature without a place in a telescope, by their numbers: rays, normals, power, focal ratio...
_CURVATURE_SOLVES = {
    2: "marginal ray angle",
    3: "chief ray angle",
    5: "marginal ray normal",
    6: "chief ray normal",
    7: "aplanatic",
    8: "element power",
    9: "concentric with a surface",
    10: "concentric with a radius",
    11: "f-number",
    12: "macro",
}
#: Lines of pickups and solves without a place in a telescope; PDIA and PZUP of drawing sizes and thicknesses apart.
_UNKEPT = frozenset(
    (
        "PCUP",
        "PPAR",
        "PXDT",
        "PCOP",
        "PGLA",
        "PKUP",
        "CPKP",
        "MARG",
        "CHAZ",
        "CHAA",
        "POSI",
        "COMP",
        "CURF",
        "GLCZ",
        "TOLE",
    )
)
#: Lines of pickups and solves of a thickness.
_THICKNESS = frozenset(("PZUP", "MAZH", "TCOM", "TOLE"))
#: Lines that pickups of Zemax files stand in, by the quantity; a thickness has one of its own.
_LINES = {"radius": "CURV", "glass": "GLAS"}


def state_links(lens: LensDescription, blocks: list[Block]) -> None:
    """State the pickups and solves of a file.

    Of pickups of values that a telescope has not, and of heights of real marginal rays, those of a zone other than 0,
    there is a warning.
    """
    names = dict(zip((s.number for s in lens.surfaces), surface_names(lens.surfaces), strict=True))
    mirrors = dict(zip(names.values(), _mirrors(lens.surfaces), strict=True))
    for number, block in enumerate(blocks):
        source = Source(block.file, block.place)
        lens.pickups += [(source, choices) for choices in _pickups(block, number, names, mirrors, lens.unit)]
        line = block.last("MAZH")
        if line is None or number not in names or names[number] == _last_name(names):
            continue
        if zone := line.number(1, 0.0):
            text = f"MAZH: zone {zone:g} of the pupil: expected 0, the paraxial ray; its solution stands in the file"
            lens.findings.note(block.problem(text), "it is not kept")
        else:
            lens.solves.append(Solve(names[number], "marginal_height", line.number(0, 0.0) * lens.unit))
    if unkept := [name for number, block in enumerate(blocks) for name in _unkept(block, number)]:
        text = f"pickups and solves {', '.join(unkept)}: their solutions stand in the file"
        lens.findings.note(lens.problem(text), "they are not kept")


def _unkept(block: Block, number: int) -> Iterator[str]:
    """Yield the names of pickups and solves of a surface that a telescope has no place for."""
    # Coordinate breaks become places of surfaces, whatever their parameters follow; the thickness behind one is part
    # of that of a surface.
    if block.text("TYPE").upper() == "COORDBRK":
        yield from dict.fromkeys(f"S{number} {line.keyword}" for line in block.lines if line.keyword in _THICKNESS)
        return
    curvature = block.last("CURV")
    kind = 0 if curvature is None else int(curvature.number(1, 0.0))
    if kind in _CURVATURE_SOLVES:
        yield f"S{number} CURV ({_CURVATURE_SOLVES[kind]})"
    yield from dict.fromkeys(f"S{number} {line.keyword}" for line in block.lines if line.keyword in _UNKEPT)


def _last_name(names: Mapping[int, str]) -> str:
    """Return the name of the last surface."""
    return names[max(names)]


def _pickups(
    block: Block, number: int, names: Mapping[int, str], mirrors: Mapping[str, int], unit: float
) -> Iterator[tuple[Pickup, ...]]:
    """Yield the pickups of a surface, each with the meanings that it may have."""
    if number not in names:
        return
    curvature, gap, glass = block.last("CURV"), block.last("PZUP"), block.last("GLAS")
    if gap is None and (compensator := block.last("TCOM")) is not None:
        # The sum of two thicknesses is kept.
        words = (str(compensator.integer(0)), "-1.0", number_text(compensator.number(1)))
        gap = replace(compensator, words=words)
    if curvature is not None and curvature.number(1, 0.0) == _CURVATURE:
        source, scale = names.get(int(curvature.number(2, 0.0))), curvature.number(3, 1.0)
        if source is not None and source != names[number] and scale:
            # Of the radius, or of the curvature.
            yield tuple(Pickup(names[number], "radius", source, f) for f in dict.fromkeys((scale, 1.0 / scale)))
    if gap is not None:
        source, scale = names.get(int(gap.number(0, 0.0))), gap.number(1, 1.0)
        if (
            source is not None
            and source != names[number]
            and scale
            and _last_name(names) not in (source, names[number])
        ):
            scale, offset = _signed(mirrors, names[number], source, scale, gap.number(2, 0.0) * unit)
            yield (Pickup(names[number], "thickness", source, scale, offset),)
    if glass is not None and glass.number(1, 0.0) == _GLASS:
        source = names.get(int(glass.number(2, 0.0)))
        if source is not None and source != names[number]:
            yield (Pickup(names[number], "glass", source),)


def add_link_lines(t: Telescope, own: Mapping[str, tuple[int, list[str]]], unit: float) -> list[Pickup | Solve]:
    """Add links to the lines of surfaces, given with their numbers by name; return those without a place.

    Conic constants, heights of chief rays, edges and radii with a factor have none; nor has a thickness that coordinate
    breaks stand in, nor the glass of a mirror that is also that of a lens surface.
    """
    left_out: list[Pickup | Solve] = []
    mirrors = dict(zip(t.surface_names, _mirrors(t.surfaces), strict=True))
    for pickup in t.design_data.pickups:
        (number, source_lines), lines = own[pickup.source], own[pickup.surface][1]
        follower_line, source = (_line(ls, _LINES.get(pickup.quantity, "")) for ls in (lines, source_lines))
        if pickup.quantity == "thickness":
            held = all(_is_one_line(t, name, own[name][1], unit) for name in (pickup.surface, pickup.source))
            scale, offset = _signed(mirrors, pickup.surface, pickup.source, pickup.scale, pickup.offset)
            link_line = f"PZUP {number} {number_text(scale)} {number_text(offset / unit)} 0"
        elif pickup.quantity == "glass":
            held = bool(follower_line) and follower_line.split()[1:2] == source.split()[1:2]
            link_line = follower_line.replace(" 0 0 ", f" {_GLASS} {number} ", 1)
        else:
            held = bool(follower_line and source) and abs(pickup.scale) == 1.0 and not pickup.offset
            link_line = f"{follower_line} {_CURVATURE} {number} {number_text(pickup.scale)}"
        if not held:
            left_out.append(pickup)
        elif pickup.quantity == "thickness":
            lines.append(link_line)
        else:
            lines[lines.index(follower_line)] = link_line
    for solve in t.design_data.solves:
        lines = own[solve.surface][1]
        if solve.kind == "marginal_height" and _is_one_line(t, solve.surface, lines, unit):
            lines.append(f"MAZH {number_text(solve.value / unit)} 0")
        else:
            left_out.append(solve)
    return left_out


def _line(lines: list[str], keyword: str) -> str:
    """Return the line with a keyword, empty where there is none."""
    return next((line for line in lines if line.split()[0] == keyword), "")


def _is_one_line(t: Telescope, name: str, lines: list[str], unit: float) -> bool:
    """Return whether the thickness of a surface is that of its own line, no coordinate breaks between."""
    written = float(_line(lines, "DISZ").split()[1]) * unit
    return math.isclose(abs(written), abs(thickness(t, t.surface_names.index(name))), rel_tol=1e-12, abs_tol=1e-15)


def _mirrors(surfaces: Sequence[Surface | LensSurface]) -> list[int]:
    """Return the number of mirrors up to each surface."""
    return np.cumsum([s.interaction == Interaction.MIRROR for s in surfaces]).tolist()


def _signed(mirrors: Mapping[str, int], surface: str, source: str, scale: float, offset: float) -> tuple[float, float]:
    """Return scale and offset of thicknesses with the signs of a file, where they are negative behind odd mirrors.

    The other way round it is the same.
    """
    follower_sign, source_sign = (-1.0 if mirrors[name] % 2 else 1.0 for name in (surface, source))
    return follower_sign * source_sign * scale, follower_sign * offset
