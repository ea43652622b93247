"""Thicknesses: distances between surfaces along the light, and their changes, which move all that is behind."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..core.errors import DomainError
from .surface import Interaction, Vector
from .telescope import Telescope

#: Distance of the next vertex from the reflected axis of a fold mirror, over that from its own axis, at most. It is 1
#: of a mirror that is out of alignment, and 0 of a fold that is in alignment.
_OF_FOLDS = 0.5
#: Cosine of the angle between the axis of a mirror and that of its light from which it is no fold.
_UPRIGHT = 1.0 - 1e-12


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

    Light comes along -z of the first surface, and each mirror turns it back. Behind a fold mirror or a tilted plate,
    whose own axis is that of nothing, it is the axis in front of it, after reflection by a mirror, where the next
    vertex lies on that.
    """
    surface, following = telescope.surfaces[index], telescope.surfaces[index + 1 :]
    mirrors = sum(s.interaction == Interaction.MIRROR for s in telescope.surfaces[: index + 1])
    axis: np.ndarray = surface.matrix[:, 2]
    axis = axis if mirrors % 2 else -axis
    offsets = (np.subtract(s.vertex, surface.vertex) for s in following)
    ahead = next((offset for offset in offsets if offset.any()), axis)
    aside = _distance_from(axis, ahead)
    if aside == 0.0:
        return axis
    if surface.interaction != Interaction.MIRROR:
        # A plate is tilted in the light that the surfaces in front of it have led there.
        earlier = telescope.surfaces[:index]
        otherwise = [i for i, s in enumerate(earlier) if not np.array_equal(s.matrix[:, 2], surface.matrix[:, 2])]
        incoming_axis = _light_axis_at(telescope, otherwise[-1] if otherwise else -1)
        return incoming_axis if _distance_from(incoming_axis, ahead) < _OF_FOLDS * aside else axis
    # A lens may stand in the light that a grating has turned, a tilted plate may not: the mirror in front of it tells.
    front_mirrors = (i for i in range(index)[::-1] if telescope.surfaces[i].interaction == Interaction.MIRROR)
    lights = {index - 1, next(front_mirrors, -1)}
    incoming = (_light_axis_at(telescope, i) for i in sorted(lights))
    reflected = min((v - 2.0 * (v @ axis) * axis for v in incoming), key=lambda v: _distance_from(v, ahead))
    return reflected if _distance_from(reflected, ahead) < _OF_FOLDS * aside else axis


def _light_axis_at(telescope: Telescope, index: int) -> np.ndarray:
    """Return :func:`light_axis`; that of the light in front of the telescope for -1."""
    return light_axis(telescope, index) if index >= 0 else np.array([0.0, 0.0, -1.0])


def is_fold(telescope: Telescope, index: int) -> bool:
    """Return whether a surface, by its index, is a mirror that leads the light from its own axis to the next vertex."""
    if telescope.surfaces[index].interaction != Interaction.MIRROR:
        return False
    return abs(light_axis(telescope, index) @ telescope.surfaces[index].matrix[:, 2]) < _UPRIGHT


def _distance_from(axis: np.ndarray, offset: np.ndarray) -> float:
    """Return the distance [m] of a point at an offset from a line along a unit vector."""
    return float(np.linalg.norm(offset - (offset @ axis) * axis))


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
