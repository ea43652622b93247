"""Pickups and solves: values of a design that follow others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from ..core.arguments import check_prescription
from ..core.errors import PrescriptionError

#: What a pickup may take over.
PickedQuantity = Literal["radius", "conic", "thickness", "glass"]
PICKED: tuple[PickedQuantity, ...] = get_args(PickedQuantity)
#: What a solve may ask for.
SolveKind = Literal["marginal_height", "chief_height", "edge_thickness"]
SOLVED: tuple[SolveKind, ...] = get_args(SolveKind)


@check_prescription
@dataclass(frozen=True)
class Pickup:
    """Value of a surface that follows that of another: ``scale`` times that value plus ``offset``.

    Parameters
    ----------
    surface : str
        Surface that follows.
    quantity : {"radius", "conic", "thickness", "glass"}
        Radius of curvature [m], conic constant, thickness behind it along the light [m], or medium behind it.
    source : str
        Surface that is followed.
    scale : float
        Factor; 1 for a glass.
    offset : float
        What is added, in the unit of the quantity; 0 for a glass.

    Raises
    ------
    PrescriptionError
        If a value is not as expected.
    """

    surface: str
    quantity: PickedQuantity
    source: str
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if self.surface == self.source:
            _refuse(f"{self.address}: expected another surface than {self.source} itself")
        if not (math.isfinite(self.scale) and self.scale and math.isfinite(self.offset)):
            _refuse(f"{self.address}: scale = {self.scale!r}, offset = {self.offset!r}: expected finite numbers")
        if self.quantity == "glass" and (self.scale, self.offset) != (1.0, 0.0):
            _refuse(f"{self.address}: expected no scale and no offset for a glass")

    @property
    def address(self) -> str:
        """Name in messages."""
        return f"pickup {self.surface}.{self.quantity}"


@check_prescription
@dataclass(frozen=True)
class Solve:
    """Thickness behind a surface that is solved for.

    Parameters
    ----------
    surface : str
        Surface in front of the thickness.
    kind : {"marginal_height", "chief_height", "edge_thickness"}
        The paraxial marginal ray, or the paraxial chief ray of the edge of the field, has a height at the next surface;
        or the distance of both surfaces at a radius is given.
    value : float
        That height or edge thickness [m]. Heights are along +y of the marginal ray through the top of the pupil, and of
        the chief ray whose slope is upwards.
    radius : float
        Radius of an edge thickness [m].

    Raises
    ------
    PrescriptionError
        If a value is not as expected.
    """

    surface: str
    kind: SolveKind
    value: float = 0.0
    radius: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and math.isfinite(self.radius)):
            _refuse(f"{self.address}: value = {self.value!r}, radius = {self.radius!r}: expected finite numbers")
        if (self.kind == "edge_thickness") != (self.radius > 0):
            _refuse(f"{self.address}: radius = {self.radius!r}: expected a positive one for an edge thickness alone")

    @property
    def address(self) -> str:
        """Name in messages."""
        return f"solve {self.surface}.{self.kind}"


def check_links(pickups: Sequence[Pickup], solves: Sequence[Solve], surface_names: Sequence[str]) -> None:
    """Raise PrescriptionError where surfaces are missing, or a value follows two others."""
    followers: set[tuple[str, str]] = set()
    links: list[Pickup | Solve] = [*pickups, *solves]
    for link in links:
        quantity = link.quantity if isinstance(link, Pickup) else "thickness"
        for name in (link.surface, link.source) if isinstance(link, Pickup) else (link.surface,):
            if name not in surface_names or (quantity == "thickness" and name == surface_names[-1]):
                expected = (
                    "a surface with another one behind it" if quantity == "thickness" else "the name of a surface"
                )
                _refuse(f"{link.address}: {name!r}: expected {expected}")
        if (link.surface, quantity) in followers:
            _refuse(f"{link.address}: its {quantity} follows another value already")
        followers.add((link.surface, quantity))
    followed = {(p.surface, p.quantity): p.source for p in pickups}
    for pickup in pickups:
        place, visited = pickup.source, {pickup.surface}
        while (place, pickup.quantity) in followed:
            if place in visited:
                _refuse(f"{pickup.address}: follows itself through {place}")
            visited.add(place)
            place = followed[place, pickup.quantity]


def _refuse(text: str) -> None:
    raise PrescriptionError(f"design data: {text}")
