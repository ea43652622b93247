"""Pickups and solves of a Zemax file: radius, thickness and glass of another surface, and a paraxial back focus.

``CURV value 4 surface scale``, ``PZUP surface scale offset``, ``GLAS name 2 surface``, ``MAZH height zone``. Others are
passed over: their solution stands in the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from ...design_data import DesignData
from ...links import Pickup, Solve
from ...telescope import Telescope
from ..writable import unmet_pickup
from .file import Block, Findings
from .text import number_text

#: Solve types of a curvature and of a glass that take over that of another surface.
_CURVATURE, _GLASS = 4, 2


def with_links(
    telescope: Telescope, blocks: list[Block], names: Mapping[int, str], unit: float, findings: Findings
) -> Telescope:
    """Return a telescope with the pickups and solves of its file; `names` are those of surfaces by their numbers.

    Pickups that the values of the file do not meet, or of values that a telescope has not, are left out with a warning.
    """
    pickups, solves = [], []
    for number, block in enumerate(blocks):
        for choices in _pickups(block, number, names, unit):
            kept = next((one for one in choices if unmet_pickup(telescope, one) is None), None)
            if kept is not None:
                pickups.append(kept)
            else:
                findings.note(block.problem(f"{choices[0].address}: the file has another value"), "it is not kept")
        line = block.last("MAZH")
        # A zone other than 0 is that of a real ray.
        if line is not None and line.number(1, 0.0) == 0.0 and number in names and names[number] != _last_name(names):
            solves.append(Solve(names[number], "marginal_height", line.number(0, 0.0) * unit))
    if not (pickups or solves):
        return telescope
    return telescope.with_design(pickups=tuple(pickups), solves=tuple(solves))


def _last_name(names: Mapping[int, str]) -> str:
    """Return the name of the last surface."""
    return names[max(names)]


def _pickups(block: Block, number: int, names: Mapping[int, str], unit: float) -> Iterator[tuple[Pickup, ...]]:
    """Yield the pickups of a surface, each with the meanings that it may have."""
    if number not in names:
        return
    curvature, gap, glass = block.last("CURV"), block.last("PZUP"), block.last("GLAS")
    if curvature is not None and curvature.number(1, 0.0) == _CURVATURE:
        source, scale = names.get(int(curvature.number(2, 0.0))), curvature.number(3, 1.0)
        if source is not None and source != names[number] and scale:
            # Of the radius, or of the curvature.
            yield tuple(Pickup(names[number], "radius", source, one) for one in dict.fromkeys((scale, 1.0 / scale)))
    if gap is not None:
        source, scale = names.get(int(gap.number(0, 0.0))), gap.number(1, 1.0)
        if (
            source is not None
            and source != names[number]
            and scale
            and _last_name(names) not in (source, names[number])
        ):
            yield (Pickup(names[number], "thickness", source, scale, gap.number(2, 0.0) * unit),)
    if glass is not None and glass.number(1, 0.0) == _GLASS:
        source = names.get(int(glass.number(2, 0.0)))
        if source is not None and source != names[number]:
            yield (Pickup(names[number], "glass", source),)


def add_link_lines(data: DesignData, own: Mapping[str, tuple[int, list[str]]], unit: float) -> None:
    """Add pickups and solves to the lines of surfaces, which are given with their numbers by name.

    Conic constants, heights of chief rays, edges and radii with a factor have no place in such a file.
    """
    for pickup in data.pickups:
        lines, source = own[pickup.surface][1], own[pickup.source][0]
        if pickup.quantity == "thickness":
            lines.append(f"PZUP {source} {number_text(pickup.scale)} {number_text(pickup.offset / unit)} 0")
        for i, line in enumerate(lines):
            if pickup.quantity == "glass" and line.startswith("GLAS "):
                lines[i] = line.replace(" 0 0 ", f" {_GLASS} {source} ", 1)
            elif pickup.quantity == "radius" and line.startswith("CURV ") and abs(pickup.scale) == 1.0:
                lines[i] = f"{line} {_CURVATURE} {source} {number_text(pickup.scale)}" * (not pickup.offset) or line
    for solve in data.solves:
        if solve.kind == "marginal_height":
            own[solve.surface][1].append(f"MAZH {number_text(solve.value / unit)} 0")
