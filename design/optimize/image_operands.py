"""Operands of image quality as the analyses have it: foci, contrast, ray and path differences; by differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import field_label
from ...models.telescope import Telescope
from ...raytrace.launch import launch_bundles
from ...raytrace.rays import RayStatus
from ...raytrace.trace import trace
from ...wavefront.opd import wavefront_opd
from ..analyses.field_curvature import field_curvature
from ..images.mtf import mtf
from .operand import GoalOperand, angles_of, direction_of, operand_kind, wavelength_of


@operand_kind("field_focus", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class FieldFocus(GoalOperand):
    """Place [m] of the focus of rays close to the chief ray, behind the detector as light travels.

    That of :func:`pachon.field_curvature`, along the axis of the detector.

    Parameters
    ----------
    direction : {"tangential", "sagittal"}
        In or across the plane of field point and axis.
    field : tuple of float, shape (2,)
        Field angles [rad].
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    direction: Literal["tangential", "sagittal"]
    field: tuple[float, float]
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, telescope)
        foci = field_curvature(telescope, [angles_of(self.field)], wavelength, threads=1)
        return float(getattr(foci, self.direction)[0, 0])


@operand_kind("contrast", "1", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class Contrast(GoalOperand):
    """Modulation transfer by diffraction at one frequency and field point, that of :func:`pachon.mtf`.

    It costs a full calculation for each derivative; :class:`~.ray_operands.WavefrontMtf` is the estimate that is fast
    and falls steadily.

    Parameters
    ----------
    direction : {"tangential", "sagittal", "mean"}
        Direction of the modulation, or the mean of both.
    field : tuple of float, shape (2,)
        Field angles [rad].
    frequency : float
        Spatial frequency on the detector [cycles/m].
    wavelengths : tuple of float, optional
        Vacuum wavelengths [m]; the telescope's own by default.
    n_pupil : int, optional
        Lattice points across the pupil, as in :func:`pachon.mtf`.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand`.
    """

    direction: Literal["tangential", "sagittal", "mean"]
    field: tuple[float, float]
    frequency: float
    wavelengths: tuple[float, ...] | None = None
    n_pupil: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.frequency > 0:
            raise DomainError(f"operand {self.label}: frequency = {self.frequency!r}: expected a positive number")

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        waves = None if self.wavelengths is None else list(self.wavelengths)
        result = mtf(telescope, [angles_of(self.field)], waves, n_pupil=self.n_pupil, threads=1)
        directions = ("tangential", "sagittal") if self.direction == "mean" else (self.direction,)
        # Beyond the cut-off there is no contrast.
        curves = [getattr(result, direction)[0] for direction in directions]
        return float(np.mean([np.interp(self.frequency, result.frequency, curve, right=0.0) for curve in curves]))


@operand_kind("transverse_aberration", "m", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class TransverseAberration(GoalOperand):
    """Landing point of a ray on the detector less that of the chief ray [m], along its x or y, or their distance.

    The axes are those of the lens file, as of :class:`~.ray_operands.RayCoordinate`. The chief ray is that of the
    telescope's own wavelength, as of ``pachon fans`` at one wavelength.

    Parameters
    ----------
    axis : {"x", "y", "r"}
        Along which axis; "r" is the distance.
    field : tuple of float, shape (2,)
        Field angles [rad].
    pupil : tuple of float, shape (2,)
        Point of the entrance pupil, in units of its radius.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [m].
    """

    axis: Literal["x", "y", "r"]
    field: tuple[float, float]
    pupil: tuple[float, float]
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        light, detector = direction_of(self.field, telescope), telescope.surfaces[-1]
        landings = []
        for wavelength, pupil in (
            (telescope.default_wavelength, (0.0, 0.0)),
            (wavelength_of(self.wavelength, telescope), self.pupil),
        ):
            point = 0.5 * telescope.pupil_diameter * np.array([pupil])
            end = trace(telescope, launch_bundles(telescope, light, wavelength, point), threads=1)
            if end.status[0] > RayStatus.VIGNETTED:
                raise DomainError(f"operand {self.label}: the ray does not reach the detector")
            landings.append(detector.to_local(end.position[0])[:2])
        x, y = landings[1] - landings[0]
        return float({"x": -x, "y": y, "r": np.hypot(x, y)}[self.axis]) + 0.0


@operand_kind("path_difference", "waves", in_files=False)
@check_arguments
@dataclass(frozen=True, kw_only=True)
class PathDifference(GoalOperand):
    """Optical path difference [waves] of a ray against the chief ray, that of :func:`pachon.wavefront_opd`.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad].
    pupil : tuple of float, shape (2,)
        Point of the entrance pupil, in units of its radius.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.GoalOperand` [waves].
    """

    field: tuple[float, float]
    pupil: tuple[float, float]
    wavelength: float | None = None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, telescope)
        x, y = 0.5 * telescope.pupil_diameter * np.array(self.pupil)
        path = wavefront_opd(telescope, angles_of(self.field), wavelength, ([x], [y]), threads=1).value
        if not np.isfinite(path).all():
            raise DomainError(f"operand {self.label}, {field_label(np.array(self.field))}: the ray is not lit")
        return float(np.ravel(path)[0]) / wavelength
