"""Operands of the prescription: thicknesses, edges, total length, sag, back focus; derivatives by differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.first_order import first_order, footprints
from ...models.paraxial import with_moved_pupil
from ...models.shapes.shape import Plane, Rotational
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ...models.thickness import front_surface, light_axis, thickness
from ..layout.sections import outer_radius
from .operand import GoalOperand, operand_kind
from .parabasal import surface_range


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
        aperture or, without one, of the paraxial light of the whole field; of a plane without either, that of the
        other surface, and of two such planes the axis.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    surface: str
    radius: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        first = front_surface(telescope, self.surface)
        pair = telescope.surfaces[first : first + 2]
        if self.radius is None:
            # A plane without aperture, such as that of a stop, has no edge of its own.
            radii = [clear_radius(telescope, surface.name) for surface in pair]
            radius = max((radius for radius in radii if np.isfinite(radius)), default=np.inf)
            if np.isinf(radius) and all(isinstance(surface.shape, Plane) for surface in pair):
                radius = 0.0
        else:
            radius = self.radius
        ends = []
        for surface in pair:
            sag = float(surface.shape.sag(0.0, radius)) if np.isfinite(radius) else np.nan
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


@operand_kind("thickness_sum", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ThicknessSum(GoalOperand):
    """Sum of the thicknesses [m] behind surfaces, from one to another, both included; signs as in lens files.

    Parameters
    ----------
    first, last : str, optional
        Names of the surfaces; by default the first, and the last in front of the detector.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    first: str | None = None
    last: str | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        gaps = _gaps(telescope, self.first or telescope.surface_names[0], self.last or telescope.surface_names[-2])
        heights = [s.vertex[2] for s in telescope.surfaces[gaps.start : gaps.stop + 1]]
        return heights[0] - heights[-1]


@operand_kind("total_track", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class TotalTrack(GoalOperand):
    """Length along z [m] that holds the vertices of all surfaces, from the first one to the detector."""

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        return float(np.ptp([s.vertex[2] for s in telescope.surfaces]))


@operand_kind("overall_length", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class OverallLength(GoalOperand):
    """Length along z [m] that holds the vertices of all mirrors and lens surfaces."""

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        first, last = surface_range(telescope, None, None)
        return float(np.ptp([s.vertex[2] for s in telescope.surfaces[first : last + 1]]))


@operand_kind("curvature", "1/m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class Curvature(GoalOperand):
    """Curvature [1/m] of a surface with the sign of lens files: positive where its centre is behind it.

    Parameters
    ----------
    surface : str
        Name of the surface.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [1/m].
    """

    surface: str

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        return -telescope.surface(self.surface).shape.curvature + 0.0


@operand_kind("conic", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ConicConstant(GoalOperand):
    """Conic constant of a surface.

    Parameters
    ----------
    surface : str
        Name of the surface.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    surface: str

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        shape = telescope.surface(self.surface).shape
        return float(shape.conic) if isinstance(shape, Rotational) else 0.0


@operand_kind("thickness_limit", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ThicknessLimit(GoalOperand):
    """Least or largest thickness [m] of glass or air between two surfaces, on the axis or at the edge.

    Glass is any medium but that in front of the telescope. Edges are those of :class:`EdgeThickness`.

    Parameters
    ----------
    extreme : {"least", "largest"}
        Which of the thicknesses.
    place : {"center", "edge"}
        Where they are taken.
    medium : {"glass", "air", "any"}
        What they are of.
    first, last : str, optional
        Names of the surfaces in front of the first and the last thickness; by default those of all between the first
        and the last mirror or lens surface.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    extreme: Literal["least", "largest"]
    place: Literal["center", "edge"]
    medium: Literal["glass", "air", "any"]
    first: str | None = None
    last: str | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        surfaces, ambient = telescope.surfaces, telescope.medium_before
        gaps = [
            i
            for i in _gaps(telescope, self.first, self.last)
            if self.medium == "any" or (surfaces[i].medium_after != ambient) == (self.medium == "glass")
        ]
        if not gaps:
            raise DomainError(f"operand {self.label}: expected {self.medium} between these surfaces")
        if self.place == "center":
            sizes = [thickness(telescope, i) for i in gaps]
        else:
            sizes = [EdgeThickness(surfaces[i].name, value=0.0).measure(telescope) for i in gaps]
        return min(sizes) if self.extreme == "least" else max(sizes)


def _gaps(telescope: Telescope, first: str | None, last: str | None) -> range:
    """Return the indices of the surfaces in front of thicknesses, those of given names included."""
    start, end = surface_range(telescope, first, last)
    # The last mirror or lens surface ends the last thickness, where no other is named.
    gaps = range(start, end if last is None else end + 1)
    if gaps.stop >= len(telescope.surfaces) or not gaps:
        names = telescope.surface_names
        raise DomainError(f"surfaces {names[start]} to {names[end]}: expected thicknesses behind them")
    return gaps


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
