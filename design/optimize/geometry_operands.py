"""Operands of the prescription: thicknesses, edges, total length, sag, back focus; derivatives by differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.first_order import first_order, footprints
from ...models.paraxial import with_moved_pupil
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ...models.thickness import front_surface, light_axis, thickness
from ..layout.sections import outer_radius
from .operand import GoalOperand, operand_kind


@operand_kind("center_thickness", "m")
@check_arguments
@dataclass(frozen=True)
class CenterThickness(GoalOperand):
    """Distance [m] of a surface from the next one, along the light.

    Parameters
    ----------
    surface : str
        Name of the surface in front, or of a group of two surfaces.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    surface: str

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        return thickness(telescope, front_surface(telescope, self.surface))


@operand_kind("edge_thickness", "m")
@check_arguments
@dataclass(frozen=True)
class EdgeThickness(GoalOperand):
    """Distance [m] of a surface from the next one along the light, at a distance from the axis.

    Parameters
    ----------
    surface : str
        Name of the surface in front, or of a group of two surfaces.
    radius : float, optional
        Distance from the axis [m]; by default the larger clear radius of the two surfaces, which is that of the
        aperture or, without one, of the paraxial light of the whole field.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    surface: str
    radius: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        first = front_surface(telescope, self.surface)
        pair = telescope.surfaces[first : first + 2]
        radius = max(clear_radius(telescope, s.name) for s in pair) if self.radius is None else self.radius
        ends = []
        for surface in pair:
            sag = float(surface.shape.sag(0.0, radius))
            if not np.isfinite(sag):
                raise DomainError(f"operand {self.label}: {surface.name} has no edge at {radius:.6g} m from its axis")
            ends.append(surface.to_telescope([0.0, radius, sag]))
        return float(light_axis(telescope, first) @ (ends[1] - ends[0]))


@operand_kind("total_length", "m")
@check_arguments
@dataclass(frozen=True)
class TotalLength(GoalOperand):
    """Way along the axis [m] from the first surface to the detector, or between two surfaces: the sum of thicknesses.

    Parameters
    ----------
    first, last : str, optional
        Names of the surfaces.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    first: str | None = None
    last: str | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        names = telescope.surface_names
        start = 0 if self.first is None else names.index(telescope.surface(self.first).name)
        end = len(names) - 1 if self.last is None else names.index(telescope.surface(self.last).name)
        if not start < end:
            raise DomainError(f"operand {self.label}: expected the last surface behind the first one")
        vertices = np.array([s.vertex for s in telescope.surfaces[start : end + 1]])
        return float(np.linalg.norm(np.diff(vertices, axis=0), axis=1).sum())


@operand_kind("sag", "m")
@check_arguments
@dataclass(frozen=True)
class SagAt(GoalOperand):
    """Height [m] of a surface over its vertex plane at a distance from its axis, along its y axis.

    Parameters
    ----------
    surface : str
        Name of the surface.
    radius : float
        Distance from the axis [m].
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    surface: str
    radius: float

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        sag = float(telescope.surface(self.surface).shape.sag(0.0, self.radius))
        if not np.isfinite(sag):
            raise DomainError(f"operand {self.label}: the surface does not reach {self.radius:.6g} m from its axis")
        return sag


@operand_kind("back_focus", "m")
@check_arguments
@dataclass(frozen=True)
class BackFocus(GoalOperand):
    """Way [m] from the last mirror or lens surface to the paraxial focus, of a centred telescope.

    Parameters
    ----------
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        return first_order(telescope, self.wavelength).back_focus


def clear_radius(telescope: Telescope, name: str) -> float:
    """Return the clear radius [m] of a surface: of its aperture, or of the paraxial light of the whole field.

    The light is that through the stop, wherever a change has moved its image. Surfaces without effect, and those of a
    decentred telescope, have the radius of the aperture alone; without one it is infinite.
    """
    radius = outer_radius(telescope.surface(name).aperture)
    if np.isfinite(radius):
        return radius
    acting = [s.name for s in telescope.surfaces if s.interaction in (Interaction.MIRROR, Interaction.REFRACT)]
    try:
        return float(footprints(with_moved_pupil(telescope), telescope.field_radius)[acting.index(name)])
    except (ValueError, DomainError):
        return np.inf
