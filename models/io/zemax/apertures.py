"""Apertures of Zemax surfaces: lines CLAP, FLAP, OBSC, SQAP, SQOB, ELAP, ELOB, SPID, USAP, USOB, decentred by OBDC."""

from __future__ import annotations

import math

import numpy as np

from ....core.errors import PrescriptionError
from ...aperture import Annulus, Aperture, Circle, Complement, Ellipse, Rectangle, Union, Vane, shifted
from ..lens.apertures import ellipse, rectangle, ring
from ..lens.source import Findings
from ..lens.text import number_text
from .file import Block
from .user_apertures import read_user_aperture

#: What surfaces of a Zemax file have, as its messages say.
HELD_APERTURES = "discs, rings, ellipses and rectangles along x, clear or obscuring, and even spiders"


def read_aperture(block: Block, unit: float, findings: Findings) -> Aperture | None:
    """Return the clear region of a surface [m], or None where it has none.

    Semi-diameters (DIAM) clip no rays; a floating aperture (FLAP) does where its semi-diameter is fixed.
    """
    shift = block.last("OBDC")
    x, y = (shift.number(0) * unit, shift.number(1) * unit) if shift else (0.0, 0.0)
    regions: list[Aperture] = []
    for keyword in ("CLAP", "FLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "SPID"):
        line = block.last(keyword)
        if line is None:
            continue
        first, second = line.number(0, 0.0), line.number(1, 0.0)
        if (keyword == "FLAP" and block.number("DIAM", 0.0, 1) != 1) or (keyword == "OBSC" and second == 0):
            continue
        region: Aperture
        if keyword == "SPID":
            if not (first > 0 and 0 < second <= 1000 and second == int(second)):
                raise line.error("a width and a number of arms")
            turns = (2 * math.pi * arm / int(second) for arm in range(int(second)))
            region = Union(tuple(Vane(first * unit, x, y, turn) for turn in turns))
        elif keyword in ("SQAP", "SQOB", "ELAP", "ELOB"):
            half = rectangle if keyword in ("SQAP", "SQOB") else ellipse
            region = half(line, first * unit, second * unit, x, y)
        else:
            region = ring(line, first * unit, second * unit, x, y)
        regions.append(Complement(region) if keyword in ("OBSC", "SQOB", "ELOB", "SPID") else region)
    for keyword in ("UDAD", "USAP", "USOB", "UDAP"):
        for line in block.all(keyword)[:1]:
            try:
                regions.append(shifted(read_user_aperture(line, unit), x, y))
            except PrescriptionError as error:
                findings.report(error, "taken as none")
    if len(regions) > 1:
        raise block.lines[0].error("one aperture in this surface")
    return regions[0] if regions else None


def aperture_lines(aperture: Aperture, unit: float) -> list[str] | None:
    """Return the lines of a clear region, or None where Zemax surfaces have no such aperture."""
    clear = not isinstance(aperture, Complement)
    region = aperture.part if isinstance(aperture, Complement) else aperture
    if isinstance(region, Circle | Annulus):
        inner, outer = (0.0, region.radius) if isinstance(region, Circle) else (region.inner, region.outer)
        lines = [f"{'CLAP' if clear else 'OBSC'} {number_text(inner / unit)} {number_text(outer / unit)} 0"]
    elif isinstance(region, Rectangle) and region.angle == 0:
        half = f"{number_text(region.width / 2 / unit)} {number_text(region.height / 2 / unit)}"
        lines = [f"{'SQAP' if clear else 'SQOB'} {half} 0"]
    elif isinstance(region, Ellipse) and region.angle == 0:
        half = f"{number_text(region.semi_x / unit)} {number_text(region.semi_y / unit)}"
        lines = [f"{'ELAP' if clear else 'ELOB'} {half} 0"]
    elif isinstance(region, Union) and not clear and _is_spider(region):
        first = region.parts[0]
        assert isinstance(first, Vane)
        lines = [f"SPID {number_text(first.width / unit)} {len(region.parts)} 0"]
        region = Circle(1.0, first.x, first.y)
    else:
        return None
    if region.x or region.y:
        lines.append(f"OBDC {number_text(region.x / unit)} {number_text(region.y / unit)}")
    return lines


def _is_spider(union: Union) -> bool:
    """Return whether a union is one of equal vanes from one point, at equal angles, one of them along x."""
    vanes = [vane for vane in union.parts if isinstance(vane, Vane) and not vane.both_ways]
    if len(vanes) != len(union.parts) or len({(v.width, v.x, v.y) for v in vanes}) != 1:
        return False
    turns = np.sort(np.mod(np.array([v.angle for v in vanes]) + 1e-9, 2 * math.pi))
    return bool(np.allclose(turns, 2 * math.pi * np.arange(len(vanes)) / len(vanes), atol=1e-8))
