"""Thicknesses: distances between surfaces along the light, and their changes, which move all that is behind."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..core.errors import DomainError
from .surface import Interaction, Vector
from .telescope import Telescope

#: Distance from an axis, over that along it, which rounding of angles in files makes.
_ASIDE = 1e-9


def front_surface(telescope: Telescope, target: str) -> int:
    """Return the index of the surface in front of the thickness of a surface, or of an element of two.

    Raises
    ------
    UnknownNameError
        If there is no such surface or group.
    DomainError
        If nothing is behind the surface, or the group is not two surfaces, one behind the other.
    """
    names = telescope.surface_names
    if target in telescope.groups:
        first, *back_surfaces = (names.index(member) for member in telescope.groups[target])
        if back_surfaces != [first + 1]:
            raise DomainError(f"parameter '{target}.thickness': expected a group of two surfaces, front and back")
        return first
    index = names.index(telescope.surface(target).name)
    if index + 1 == len(names):
        raise DomainError(f"parameter '{target}.thickness': expected a surface with another one behind it")
    return index


def light_axis(telescope: Telescope, index: int) -> np.ndarray:
    """Return the unit vector along the axis of a surface in the direction of the light behind it, shape [3].

    Light comes along -z of the first surface, and each mirror turns it back. Behind a fold mirror, whose own axis is
    that of nothing, it is the axis in front of it after reflection, where the next vertex lies on that.
    """
    surface, following = telescope.surfaces[index], telescope.surfaces[index + 1 :]
    mirrors = sum(s.interaction == Interaction.MIRROR for s in telescope.surfaces[: index + 1])
    axis: np.ndarray = surface.matrix[:, 2]
    axis = axis if mirrors % 2 else -axis
    if surface.interaction != Interaction.MIRROR:
        return axis
    offsets = (np.subtract(s.vertex, surface.vertex) for s in following)
    ahead = next((offset for offset in offsets if offset.any()), axis)
    if _is_along(ahead, axis):
        return axis
    incoming = light_axis(telescope, index - 1) if index else np.array([0.0, 0.0, -1.0])
    reflected: np.ndarray = incoming - 2.0 * (incoming @ axis) * axis
    return reflected if _is_along(ahead, reflected) else axis


def _is_along(offset: np.ndarray, axis: np.ndarray) -> bool:
    """Return whether an offset [m] is along a unit vector, either way."""
    aside = offset - (offset @ axis) * axis
    return float(np.linalg.norm(aside)) <= _ASIDE * float(np.linalg.norm(offset))


def thickness(telescope: Telescope, index: int) -> float:
    """Return the distance [m] from the vertex of a surface to the next one, along the light."""
    vertex, next_vertex = (np.array(s.vertex) for s in telescope.surfaces[index : index + 2])
    return float(light_axis(telescope, index) @ (next_vertex - vertex))


def impossible_glasses(telescope: Telescope) -> list[int]:
    """Return the surfaces in front of glass of negative thickness on the axis, up to the first that is tilted.

    A negative distance in air is none: dummy surfaces and virtual images have one.
    """
    indices = []
    for i, surface in enumerate(telescope.surfaces[:-1]):
        if surface.matrix[2, 2] != 1.0 or telescope.surfaces[i + 1].matrix[2, 2] != 1.0:
            break
        if surface.medium_after != telescope.medium_before and thickness(telescope, i) < 0.0:
            indices.append(i)
    return indices


def impossible_thicknesses(telescope: Telescope) -> list[str]:
    """Return a text for each of the :func:`impossible_glasses`."""
    problems: list[str] = []
    name, unit = telescope.length_unit
    for i in impossible_glasses(telescope):
        surface = telescope.surfaces[i]
        glass, distance = surface.medium_after.name or "glass", thickness(telescope, i)
        problems.append(f"surface {surface.name}: {glass} of thickness {distance / unit:.6g} {name}: expected from 0")
    return problems


def with_thicknesses(telescope: Telescope, start: Telescope, changes: Iterable[tuple[int, float]]) -> Telescope:
    """Return the telescope with thicknesses behind some surfaces, by their indices, changed by lengths [m].

    The surfaces behind each are shifted along its axis in the telescope `start`, before other changes. The pivot of a
    group goes with the first of its surfaces. A thickness that becomes negative is a DomainError.
    """
    shifts = np.zeros((len(telescope.surfaces), 3))
    for index, change in changes:
        before = thickness(start, index)
        if before >= 0 > before + change:
            names = start.surface_names[index : index + 2]
            raise DomainError(
                f"thickness of {names[0]} = {before + change:.6g} m: expected {names[1]} to stay behind it"
            )
        shifts[index + 1 :] += change * light_axis(start, index)
    surfaces = tuple(
        replace(s, vertex=_shifted(s.vertex, shift)) if shift.any() else s
        for s, shift in zip(telescope.surfaces, shifts, strict=True)
    )
    frames, names = dict(telescope.group_frames), telescope.surface_names
    for group, members in telescope.groups.items():
        first = min(names.index(member) for member in members)
        vertex, axes = frames[group]
        frames[group] = _shifted(vertex, shifts[first]), axes
    return replace(telescope, surfaces=surfaces, group_frames=frames)


def _shifted(vertex: Vector, shift: np.ndarray) -> Vector:
    x, y, z = (float(v) for v in np.array(vertex) + shift)
    return x, y, z
