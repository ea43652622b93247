"""Operands with exact derivatives from chief rays, and any function of a telescope."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.telescope import Telescope
from ...raytrace.adjoint.backward_pass import image_gradient
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from .aimed_rays import AimedRays, pupil_diameter
from .jacobian import ParameterColumns
from .operand import GoalOperand, Operand, angles_of, operand_kind, wavelength_of
from .parabasal import group_focal_length, parabasal_focal_length

#: Angle [rad] between the two chief rays of the image scale; distortion enters as its square.
_SMALL_FIELD = 1e-4


def _landing(columns: ParameterColumns, fields: np.ndarray, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return landing points of chief rays of some fields [rad] [m], [2, n], and derivatives [2, n, n_parameter]."""
    columns.telescope.check_field(*fields.T)
    request = Request.of(columns.telescope, fields, wavelength, sampling=CHIEF_RAY)
    aimed = AimedRays(columns, request, wavelength, CHIEF_RAY.points)
    forward = aimed.forward()
    return forward.image, aimed.derivatives(forward, image_gradient(forward))


def _near_axis() -> np.ndarray:
    """Return two field points near the axis [rad], shape [2, 2]."""
    return _SMALL_FIELD * np.array([[-0.5, 0.0], [0.5, 0.0]])


def _scale(landing: np.ndarray, change: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the distance of two landing points over the tangent of their angle, and its derivatives."""
    apart = np.diff(landing, axis=1)[:, 0]
    length = float(np.hypot(*apart))
    per_angle = 1.0 / (2.0 * np.tan(0.5 * _SMALL_FIELD))
    return per_angle * length, per_angle / length * apart @ np.diff(change, axis=1)[:, 0]


@dataclass(frozen=True)
class _ExactOperand(GoalOperand):
    """Operand whose number and derivatives are computed together, from chief rays."""

    @property
    def exact(self) -> bool:
        return True

    def measure(self, telescope: Telescope) -> float:
        return self.gradient(ParameterColumns.at(telescope, ()))[0]


@operand_kind("focal_length", "m")
@check_arguments
@dataclass(frozen=True)
class FocalLength(_ExactOperand):
    """Effective focal length, of parallel rays close to the axis: the paraxial one, wherever the detector is.

    Of a telescope whose surfaces do not share one axis it is that about the chief ray of the axis. :class:`ImageScale`
    is the scale on a detector that may be out of focus.

    Parameters
    ----------
    value : float, optional
        Wanted focal length [m]; negative where the image of a distant object is upright.
    weight : float
        An error of 1 mm counts as `weight` times 1 mm of rms spot or wavefront.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    meridian : {"x", "y"}, optional
        Plane of the rays; by default that of y, or of x where there is no power along y.
    first, last : str, optional
        Names of the surfaces between which, both included, it is the focal length; of all by default. These surfaces
        share one axis, and derivatives are taken by differences.
    minimum, maximum : float, optional
        Limits [m], in place of a value.
    """

    value: float | None = None
    weight: float = 1.0
    wavelength: float | None = None
    meridian: Literal["x", "y"] | None = dataclasses.field(default=None, kw_only=True)
    first: str | None = dataclasses.field(default=None, kw_only=True)
    last: str | None = dataclasses.field(default=None, kw_only=True)

    @property
    def exact(self) -> bool:  # noqa: D102
        return self.first is None and self.last is None

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        if self.exact:
            return super().measure(telescope)
        wavelength = wavelength_of(self.wavelength, telescope)
        return group_focal_length(telescope, (self.first, self.last), wavelength, self.meridian)

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:  # noqa: D102
        return parabasal_focal_length(columns, wavelength_of(self.wavelength, columns.telescope), self.meridian)


@operand_kind("f_number", "1")
@check_arguments
@dataclass(frozen=True)
class FNumber(_ExactOperand):
    """Focal ratio: :class:`FocalLength` over the diameter of the entrance pupil, the image of a stop of stated size.

    Parameters
    ----------
    value : float, optional
        Wanted focal ratio.
    weight : float
        An error of 1 counts as `weight` times 1 m of rms spot or wavefront.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    minimum, maximum : float, optional
        Limits, in place of a value.
    """

    value: float | None = None
    weight: float = 1.0
    wavelength: float | None = None

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:  # noqa: D102
        length, change = parabasal_focal_length(columns, wavelength_of(self.wavelength, columns.telescope))
        diameter, by_diameter = pupil_diameter(columns)
        number = length / diameter
        return number, change / diameter - number * by_diameter / diameter


@operand_kind("image_scale", "m")
@check_arguments
@dataclass(frozen=True)
class ImageScale(_ExactOperand):
    """Scale on the detector: distance of two chief rays near the axis over the tangent of their angle.

    It differs from the paraxial focal length where the detector is not in the paraxial focus. Of an afocal telescope it
    is the size of the angular magnification.

    Parameters
    ----------
    value : float, optional
        Wanted scale [m].
    weight : float
        An error of 1 mm counts as `weight` times 1 mm of rms spot or wavefront.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    minimum, maximum : float, optional
        Limits [m], in place of a value.
    """

    value: float | None = None
    weight: float = 1.0
    wavelength: float | None = None

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:  # noqa: D102
        wavelength = wavelength_of(self.wavelength, columns.telescope)
        return _scale(*_landing(columns, _near_axis(), wavelength))


@operand_kind("chief_ray", "m")
@check_arguments
@dataclass(frozen=True)
class ChiefRay(_ExactOperand):
    """Landing point of a chief ray on the detector, along one axis.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad].
    axis : {"x", "y"}
        Axis of the detector.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.Operand` [m].
    """

    field: tuple[float, float]
    axis: Literal["x", "y"] = "y"
    wavelength: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:  # noqa: D102
        field = np.array([angles_of(self.field)])
        landing, change = _landing(columns, field, wavelength_of(self.wavelength, columns.telescope))
        row = "xy".index(self.axis)
        return float(landing[row, 0]), change[row, 0]


@operand_kind("distortion", "1")
@check_arguments
@dataclass(frozen=True)
class RelativeDistortion(_ExactOperand):
    """Distance of a chief ray's landing point from that of the axis over ``f tan(theta)``, f along the field, minus 1.

    Parameters
    ----------
    field : tuple of float, shape (2,)
        Field angles [rad], not those of the axis.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    value, minimum, maximum, weight : float
        As in :class:`~.operand.Operand`; pure numbers, 0.01 is one per cent. Tables and files have percent.
    """

    in_percent: ClassVar[bool] = True

    field: tuple[float, float]
    wavelength: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.field):
            raise DomainError(f"operand {self.label}: expected a field off the axis")

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:  # noqa: D102
        near = _near_axis()
        fields = np.array([*near, *near[:, ::-1], angles_of(self.field)])
        landing, change = _landing(columns, fields, wavelength_of(self.wavelength, columns.telescope))
        # The place without distortion, from the scales along x and along y.
        slopes = np.tan(fields[4]) / (2.0 * np.tan(0.5 * _SMALL_FIELD))
        weights = np.array([-slopes[0], slopes[0], -slopes[1], slopes[1]])
        perfect, by_perfect = landing[:, :4] @ weights, np.einsum("inp,n->ip", change[:, :4], weights)
        away = landing[:, 4] - landing[:, :4].mean(axis=1)
        by_away = change[:, 4] - change[:, :4].mean(axis=1)
        ratio = float(np.hypot(*away) / np.hypot(*perfect))
        return ratio - 1.0, ratio * (away / (away @ away) @ by_away - perfect / (perfect @ perfect) @ by_perfect)


@check_arguments
@dataclass(frozen=True)
class Target(Operand):
    """Any function of a telescope, with derivatives from central differences.

    Parameters
    ----------
    function : callable
        Function of a telescope that returns the number.
    value : float, optional
        Wanted value.
    weight : float
        Factor from the number to an rms spot or wavefront [m].
    step : float
        Effect on wavefront or spots [m] of the step of a variable for the differences.
    minimum, maximum : float, optional
        Limits, in place of a value.
    """

    kind: ClassVar[str] = "function"
    unit: ClassVar[str] = "1"

    function: Callable[[Telescope], float]
    value: float | None = None
    weight: float = 1.0
    step: float = 1e-5
    minimum: float | None = dataclasses.field(default=None, kw_only=True)
    maximum: float | None = dataclasses.field(default=None, kw_only=True)

    def measure(self, telescope: Telescope) -> float:  # noqa: D102
        return float(self.function(telescope))
