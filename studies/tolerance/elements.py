"""Elements of a telescope: pieces of glass, cemented ones together, as groups that move as one."""

from __future__ import annotations

from dataclasses import replace

from ...models.element_groups import element_groups
from ...models.telescope import Telescope


def with_elements(telescope: Telescope) -> tuple[Telescope, tuple[str, ...]]:
    """Return the telescope with a group for each element, and the names of these groups.

    Elements are those of :func:`~pachon.models.element_groups.element_groups`. The group of one is that which the
    telescope has, or a new one: L1, L2...
    """
    groups = dict(telescope.groups)
    group_names = {members: name for name, members in groups.items()}
    names = []
    for members in element_groups(telescope.surfaces, telescope.medium_before).values():
        if members not in group_names:
            used_names = {*groups, *telescope.surface_names}
            group_names[members] = next(
                name for i in range(1, len(used_names) + 2) if (name := f"L{i}") not in used_names
            )
            groups[group_names[members]] = members
        names.append(group_names[members])
    return replace(telescope, groups=groups), tuple(names)
