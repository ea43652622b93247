"""Operands of first-order optics and of Seidel and chromatic sums; of centred telescopes, derivatives by differences.

The entrance pupil is where the stop is imaged in the lens as it becomes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.first_order import FirstOrder, first_order, seidel_sums
from ...models.paraxial import ParaxialSurfaces, with_moved_pupil
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ..metrics.principal_rays import principal_rays
from .operand import GoalOperand, operand_kind, wavelength_of

#: Wavefront at the rims of pupil and field over Seidel sum: W040, W131, W222, W220P, W311.
_WAVEFRONT_OF_SUM = {"spherical": 1 / 8, "coma": 1 / 2, "astigmatism": 1 / 2, "Petzval": 1 / 4, "distortion": 1 / 2}


@dataclass(frozen=True, kw_only=True)
class _FirstOrderOperand(GoalOperand):
    """A number of :class:`~pachon.models.first_order.FirstOrder`, or of it and the telescope.

    Parameters
    ----------
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:
        pupil_followed = with_moved_pupil(telescope)
        number = self._of(first_order(pupil_followed, self.wavelength), pupil_followed)
        if not math.isfinite(number):
            raise DomainError(f"operand {self.label}: expected a telescope where it is finite")
        return number + 0.0

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        raise NotImplementedError


@operand_kind("paraxial_image_height", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ParaxialImageHeight(_FirstOrderOperand):
    """Height [m] of the paraxial image of the edge of the field, in the paraxial image plane."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        slope = math.tan(telescope.field_radius)
        if math.isinf(telescope.object_distance):
            return optics.focal_length * slope
        return -optics.magnification * slope * (telescope.object_distance - telescope.stop_z)


@operand_kind("magnification", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class Magnification(_FirstOrderOperand):
    """Height of the paraxial image over that of the object; 0 of an object at infinity."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return optics.magnification


@operand_kind("angular_magnification", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class AngularMagnification(_FirstOrderOperand):
    """Slope of the paraxial chief ray behind the telescope over that in front of it."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return optics.angular_magnification


@operand_kind("entrance_pupil_position", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class EntrancePupilPosition(_FirstOrderOperand):
    """Place [m] of the entrance pupil behind the first surface, along the light that enters."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return telescope.surfaces[0].vertex[2] - optics.entrance_pupil_z


@operand_kind("entrance_pupil_diameter", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class EntrancePupilDiameter(_FirstOrderOperand):
    """Diameter [m] of the entrance pupil."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return optics.entrance_pupil_diameter


@operand_kind("exit_pupil_position", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ExitPupilPosition(_FirstOrderOperand):
    """Place [m] of the exit pupil behind the detector, along the light that enters."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return telescope.surfaces[-1].vertex[2] - optics.exit_pupil_z


@operand_kind("exit_pupil_diameter", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ExitPupilDiameter(_FirstOrderOperand):
    """Diameter [m] of the exit pupil."""

    def _of(self, optics: FirstOrder, telescope: Telescope) -> float:
        return optics.exit_pupil_diameter


@operand_kind("working_f_number", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class WorkingFNumber(GoalOperand):
    """Working focal ratio ``1 / (2 n sin u)`` of the real marginal rays of the axis, the mean of both meridians.

    Parameters
    ----------
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, telescope)
        directions = principal_rays(telescope, [(0.0, 0.0)], wavelength).marginal_direction[0]
        # Half the angle between opposite rays, from the chord between their unit vectors.
        sines = 0.5 * np.linalg.norm(directions[::2] - directions[1::2], axis=-1)
        if not (sines > 0.0).all():
            raise DomainError(f"operand {self.label}: expected marginal rays that converge")
        index = float(telescope.surfaces[-2].medium_after.index(wavelength))
        return float(np.mean(1.0 / (2.0 * index * sines)))


@operand_kind("seidel", "waves", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class SeidelWavefront(GoalOperand):
    """Third-order wavefront at the rims of pupil and field [waves], of one surface or of all, as of ``pachon seidel``.

    Parameters
    ----------
    aberration : {"spherical", "coma", "astigmatism", "Petzval", "distortion"}
        The aberration: W040, W131, W222, W220P or W311.
    surface : str, optional
        Name of a mirror or lens surface; the sum over all by default.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [waves].
    """

    aberration: Literal["spherical", "coma", "astigmatism", "Petzval", "distortion"]
    surface: str | None = None
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, telescope)
        sums = seidel_sums(with_moved_pupil(telescope), wavelength)
        rows = sums.total if self.surface is None else sums.contributions[_acting_place(self, sums.names, telescope)]
        column = list(_WAVEFRONT_OF_SUM).index(self.aberration)
        return float(rows[column]) * _WAVEFRONT_OF_SUM[self.aberration] / wavelength


def _acting_place(operand: SeidelWavefront, names: tuple[str, ...], telescope: Telescope) -> int:
    name = telescope.surface(operand.surface or "").name
    if name not in names:
        raise DomainError(f"operand {operand.label}: expected a mirror or lens surface")
    return names.index(name)


@dataclass(frozen=True, kw_only=True)
class _ColorOperand(GoalOperand):
    """Difference between two wavelengths.

    Parameters
    ----------
    wavelengths : tuple of float, optional
        Two vacuum wavelengths [m]; the shortest and the longest of the telescope's band by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    wavelengths: tuple[float, float] | None = None

    def measure(self, telescope: Telescope) -> float:
        ends = self.wavelengths or telescope.band or telescope.wavelength_range
        for end in ends:
            telescope.check_wavelength(end)
        first, second = (self._of(with_moved_pupil(telescope), float(end)) for end in ends)
        return first - second

    def _of(self, telescope: Telescope, wavelength: float) -> float:
        raise NotImplementedError


@operand_kind("axial_color", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class AxialColor(_ColorOperand):
    """Paraxial focus of the first wavelength less that of the second [m], along the light at the detector."""

    def _of(self, telescope: Telescope, wavelength: float) -> float:
        mirrors = sum(s.interaction == Interaction.MIRROR for s in telescope.surfaces)
        return first_order(telescope, wavelength).image_z * (1.0 if mirrors % 2 else -1.0)


@operand_kind("lateral_color", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class ParaxialLateralColor(_ColorOperand):
    """Height of the paraxial chief ray of the edge of the field on the detector, first less second wavelength [m].

    The chief rays go through the middle of the entrance pupil of the telescope's own wavelength.
    """

    def _of(self, telescope: Telescope, wavelength: float) -> float:
        surfaces = ParaxialSurfaces.of(telescope, telescope.surface_names[0])
        slope, reach = math.tan(telescope.field_radius), telescope.stop_z - telescope.surfaces[0].vertex[2]
        if telescope.design_data.telecentric:
            height = -slope * (telescope.object_distance - telescope.stop_z)
            return float(surfaces.trace(height, 0.0, wavelength)[0][-1])
        return float(surfaces.trace(slope * reach, slope, wavelength)[0][-1])
