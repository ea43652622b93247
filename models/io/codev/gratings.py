"""Linear gratings of CODE V: GRT with order GRO, spacing GRS and the vector GRX GRY GRZ across the grooves."""

from __future__ import annotations

import math

from ...grating import Grating
from ..lens.source import Findings
from ..lens.text import FileSurface

#: Numbers of gratings.
GROOVES = ("GRO", "GRS", "GRX", "GRY", "GRZ")
#: Vector across the grooves where it is not stated.
_ACROSS = (0.0, 1.0, 0.0)


def grating_of(surface: FileSurface, unit: float, findings: Findings) -> Grating | None:
    """Return the grooves of a surface, parallel planes along its z axis a spacing apart; `unit` is that of GRS [m]."""
    ruled = surface.commands.get("GRT")
    stated = [surface.commands[key] for key in GROOVES if key in surface.values]
    if ruled is None:
        if stated:
            text = f"{stated[0].shown}: expected a grating (GRT)"
            findings.report(stated[0].problem(text), "taken as no grating")
        return None
    order, spacing = surface.get("GRO"), surface.get("GRS") * unit
    if order != int(order):
        raise surface.commands["GRO"].error("a whole number, the order of the grating")
    x, y, z = (surface.values.get(key, default) for key, default in zip(GROOVES[2:], _ACROSS, strict=True))
    if z or not (x or y):
        raise surface.commands.get("GRZ", ruled).error("a vector GRX GRY across the grooves, GRZ 0")
    if order and not spacing > 0:
        raise surface.commands.get("GRS", ruled).error("a positive spacing GRS of the grooves")
    return Grating(int(order), 1e-3 / spacing, math.atan2(-x, y)) if order else None
