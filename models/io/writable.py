"""Checks before writing: pickups that the values meet, links with a place, telescopes that lens files can hold."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ...core.errors import PrescriptionError
from ..links import Pickup, Solve
from ..surface import Interaction
from ..telescope import Telescope
from ..thickness import thickness
from .zemax.file import Findings

#: Relative difference from a pickup that rounding in files makes.
_ROUNDING = 1e-6


def require_sequential(telescope: Telescope, file: str) -> None:
    """Raise a PrescriptionError for a telescope without a detector at its end, or with meshes; `file` is for it."""
    if telescope.surfaces[-1].interaction != Interaction.DETECTOR:
        raise PrescriptionError(f"{file} needs a detector as its last surface")
    if telescope.obstructions:
        raise PrescriptionError(f"obstruction {telescope.obstructions[0].name}: {file} cannot hold meshes")


def report_unheld(
    telescope: Telescope, links: Iterable[Pickup | Solve], file: str, *, lenient: bool, others: Iterable[str] = ()
) -> None:
    """Raise a PrescriptionError, if lenient a warning, for links, coatings and others without a place in `file`."""
    coated = [f"coating of {s.name}" for s in telescope.surfaces if s.coating is not None]
    if names := ", ".join([*(link.address for link in links), *coated, *others]):
        Findings(lenient).report(PrescriptionError(f"{names}: {file} has no place for it"), "left out")


def require_met(telescope: Telescope) -> Telescope:
    """Return a telescope; a PrescriptionError where a value of its file is not that of its pickup."""
    for pickup in telescope.design_data.pickups:
        if (expected := unmet_pickup(telescope, pickup)) is not None:
            raise PrescriptionError(f"{pickup.address}: expected {expected}")
    return telescope


def unmet_pickup(telescope: Telescope, pickup: Pickup) -> str | None:
    """Return what a pickup should have made of a telescope that does not meet it, None where it does."""
    follower, source = (telescope.surface(name) for name in (pickup.surface, pickup.source))
    if pickup.quantity == "glass":
        return None if follower.medium_after == source.medium_after else f"the glass of {pickup.source}"
    if pickup.quantity == "thickness":
        names = telescope.surface_names
        here, there = (thickness(telescope, names.index(s.name)) for s in (follower, source))
    else:
        key = "conic" if pickup.quantity == "conic" else "radius"
        here, there = (s.shape.parameters.get(key, 0.0 if key == "conic" else math.inf) for s in (follower, source))
    wanted = pickup.scale * there + pickup.offset
    if here == wanted or abs(here - wanted) <= _ROUNDING * max(abs(wanted), abs(here)):
        return None
    return f"{wanted:.9g}, not {here:.9g}"
