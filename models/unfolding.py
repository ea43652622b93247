"""Unfold a telescope: the surfaces along one axis, as they would stand without its flat folding mirrors.

Behind a flat mirror everything is reflected in its plane, so that the axis goes on straight. Heights, curvatures and
indices are then those of the same system without the fold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.errors import DomainError
from .media.medium import Medium
from .paraxial import curvatures_across, require_on_axis
from .shapes.shape import Rotational, Shape
from .surface import Interaction, Surface
from .telescope import Telescope
from .thin_lens import ThinLens

#: Distance from the axis, over the size of the system, and tilt [rad] that rounding of folded frames leaves.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class AxialSurface:
    """A mirror or lens surface on the unfolded axis.

    Curvatures [1/m] and the coefficient of r^4 less that of the sphere [m^-3] count along z, as those of shapes do.
    """

    name: str
    interaction: Interaction
    z: float  #: height of the vertex on the unfolded axis [m]
    curvature: float  #: mean over azimuth
    curvatures: tuple[float, float]  #: along x and y
    fourth_order: float
    medium_after: Medium
    fold: bool = False  #: a flat mirror that turns the axis, and does nothing else
    thin_lens: ThinLens | None = None


@dataclass(frozen=True)
class UnfoldedAxis:
    """The axis of a telescope without its folds."""

    surfaces: tuple[AxialSurface, ...]  #: mirrors and lens surfaces in the order of the light
    heights: dict[str, float]  #: of all surfaces by name [m]

    @property
    def folded(self) -> bool:
        """Whether there are folds."""
        return any(surface.fold for surface in self.surfaces)


def unfolded_axis(telescope: Telescope) -> UnfoldedAxis:
    """Return the axis of a telescope without its flat folding mirrors.

    Heights of what stands in front of the first fold are those in the telescope frame. DomainError if a mirror or lens
    surface is off the axis.
    """
    reflection, offset = np.eye(3), np.zeros(3)
    size = max(telescope.pupil_diameter, *(float(np.abs(s.vertex).max()) for s in telescope.surfaces))
    surfaces: list[AxialSurface] = []
    heights: dict[str, float] = {}
    for surface in telescope.surfaces:
        folded = any(s.fold for s in surfaces)
        vertex = reflection @ np.array(surface.vertex) + offset if folded else np.array(surface.vertex)
        axes = reflection @ surface.matrix
        heights[surface.name] = float(vertex[2])
        if surface.interaction not in (Interaction.MIRROR, Interaction.REFRACT, Interaction.THIN_LENS):
            continue
        if surface.grating is not None:
            raise DomainError(f"surface {surface.name} of {telescope.name}: expected one without grooves on the axis")
        normal = axes[:, 2]
        tilt = float(np.hypot(*normal[:2]))
        if surface.interaction == Interaction.MIRROR and is_flat(surface.shape) and tilt > (_ROUNDING if folded else 0):
            z = _height_on_axis(surface, vertex, normal, telescope.name)
            heights[surface.name] = z
            surfaces.append(
                AxialSurface(
                    surface.name, surface.interaction, z, 0.0, (0.0, 0.0), 0.0, surface.medium_after, fold=True
                )
            )
            householder = np.eye(3) - 2.0 * np.outer(normal, normal)
            offset = householder @ (offset - vertex) + vertex
            reflection = householder @ reflection
            continue
        # A plane across the axis may be moved in itself.
        beside = 0.0 if is_flat(surface.shape) and surface.thin_lens is None else float(np.hypot(*vertex[:2]))
        if not folded and (beside or tilt or normal[2] < 0):
            require_on_axis(surface, telescope.name)
        elif folded and (tilt > _ROUNDING or beside > _ROUNDING * size):
            raise DomainError(f"surface {surface.name} of {telescope.name}: expected one on the axis behind the folds")
        sense = 1.0 if normal[2] > 0 else -1.0
        along_x, along_y = (sense * c for c in curvatures_across(surface, axes))
        surfaces.append(
            AxialSurface(
                surface.name,
                surface.interaction,
                float(vertex[2]),
                sense * surface.shape.curvature,
                (along_x, along_y),
                sense * surface.shape.fourth_order,
                surface.medium_after,
                thin_lens=surface.thin_lens,
            )
        )
    return UnfoldedAxis(tuple(surfaces), heights)


def axial_heights(telescope: Telescope) -> dict[str, float]:
    """Return the heights of all surfaces [m]: on the unfolded axis, or in the telescope frame where there is none."""
    try:
        return unfolded_axis(telescope).heights
    except DomainError:
        return {surface.name: surface.vertex[2] for surface in telescope.surfaces}


def is_flat(shape: Shape) -> bool:
    """Return whether a shape is a plane, however it is stated."""
    return isinstance(shape, Rotational) and shape.curvature == 0.0 and not any(shape.coefficients)


def _height_on_axis(surface: Surface, vertex: np.ndarray, normal: np.ndarray, name: str) -> float:
    """Return where the axis meets a flat mirror [m]."""
    if abs(normal[2]) < _ROUNDING:
        raise DomainError(f"surface {surface.name} of {name}: expected a mirror that the axis meets, not one along it")
    return float(vertex @ normal / normal[2])
