"""Elements of a telescope: pieces of glass, cemented ones together, as groups that move as one."""

from __future__ import annotations

from dataclasses import replace

from ...models.surface import Interaction
from ...models.telescope import Telescope


def with_elements(telescope: Telescope) -> tuple[Telescope, tuple[str, ...]]:
    """Return the telescope with a group for each element, and the names of these groups.

    An element begins where light enters a medium other than that in front of the telescope, and ends where it is back
    in that medium. Its group is one that the telescope has, or a new one: E1, E2...
    """
    runs: list[list[str]] = []
    inside = False
    for surface in telescope.surfaces:
        if surface.interaction == Interaction.REFRACT:
            glass = surface.medium_after != telescope.medium_before
            if glass and not inside:
                runs.append([])
            if glass or inside:
                runs[-1].append(surface.name)
            inside = glass
        elif inside:
            runs[-1].append(surface.name)
    groups = dict(telescope.groups)
    known = {members: name for name, members in groups.items()}
    names = []
    for run in map(tuple, runs):
        if run not in known:
            taken = {*groups, *telescope.surface_names}
            known[run] = next(name for i in range(1, len(taken) + 2) if (name := f"E{i}") not in taken)
            groups[known[run]] = run
        names.append(known[run])
    return replace(telescope, groups=groups), tuple(names)
