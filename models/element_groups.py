"""Groups of the surfaces of each lens, for prescriptions that name none."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count

from .media.medium import Medium
from .surface import Interaction, Surface


def element_groups(surfaces: Sequence[Surface], medium_before: Medium) -> dict[str, tuple[str, ...]]:
    """Return the surfaces of each lens by name: L1, L2... in the order of the light.

    A lens reaches from where light leaves the medium in front of the telescope to where it is back in it, so cemented
    elements are one. Planes without effect within it move along. Light that comes back through a lens meets surfaces of
    another name, which are another lens.
    """
    lenses: list[tuple[str, ...]] = []
    inside: list[str] = []
    medium = medium_before
    for surface in surfaces:
        entering = medium == medium_before and surface.medium_after != medium_before
        medium = surface.medium_after
        if (inside or entering) and surface.interaction != Interaction.DETECTOR:
            inside.append(surface.name)
        if inside and medium == medium_before:
            lenses.append(tuple(inside))
            inside = []
    surface_names = {s.name for s in surfaces}
    lens_names = (name for name in (f"L{number}" for number in count(1)) if name not in surface_names)
    return {next(lens_names): members for members in lenses}
