"""Operands: numbers of a telescope that an optimisation holds at a value or within limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import ConfigError, DomainError
from ...core.units import radians
from ...models.telescope import Telescope
from ...raytrace.rays import field_direction
from .jacobian import ParameterColumns

#: Classes of operands by their kinds, as in files; :mod:`~.operand_names` has the names of Zemax and CODE V.
OPERANDS: dict[str, type[GoalOperand]] = {}
#: Units that numbers are shown in, by their unit in SI.
_MESSAGE_UNITS = {"m": ("mm", 1e-3), "rad": ("deg", float(np.deg2rad(1.0)))}
#: Unit of ratios in percent, with its size.
PERCENT = ("percent", 0.01)
#: Fields of the goal, and of how it is computed; the others say which number it is.
_GOAL = ("value", "minimum", "maximum", "weight", "step")
_Kind = TypeVar("_Kind", bound="type[GoalOperand]")


def operand_kind(kind: str, unit: str, *, in_files: bool = True) -> Callable[[_Kind], _Kind]:
    """Return a decorator that registers a class of operands under a kind, with the unit of its number.

    Those that are not `in_files` have other names there.
    """

    def register(cls: _Kind) -> _Kind:
        cls.kind, cls.unit = kind, unit
        if in_files:
            OPERANDS[kind] = cls
        return cls

    return register


@dataclass(frozen=True)
class StatedName:
    """Name of an operand in another program, and the unit of its number with its size in SI."""

    name: str
    unit: str
    size: float
    #: Fields of the operand that the name implies.
    implied: tuple[str, ...] = ()


class Operand:
    """Base of operands: a number of a telescope with its goal, the fields of :class:`GoalOperand`."""

    kind: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    #: Whether the number, a ratio, is shown and stored in percent.
    in_percent: ClassVar[bool] = False

    value: float | None
    minimum: float | None
    maximum: float | None
    weight: float
    #: Name under which it was stated, where that is not its kind.
    stated: StatedName | None = None
    #: Effect [m] on wavefront or spots of the step of a variable, where derivatives are taken by differences.
    step: float = 1e-6

    def __post_init__(self) -> None:
        limits = self.minimum is not None or self.maximum is not None
        if (self.value is not None) == limits:
            raise ConfigError(f"operand {self.label}: expected either a value, or a minimum, a maximum or both")
        for name in ("value", "minimum", "maximum", "weight"):
            number = getattr(self, name)
            if number is not None and not np.isfinite(number):
                raise DomainError(f"operand {self.label}: {name} = {number!r}: expected a finite number")
        for name, numbers in self.quantity:
            floats = [n for n in (numbers if isinstance(numbers, tuple) else (numbers,)) if isinstance(n, float)]
            if not np.isfinite(floats).all():
                raise DomainError(f"operand {self.label}: {name} = {numbers!r}: expected finite numbers")
        if self.weight <= 0:
            raise DomainError(f"operand {self.label}: weight = {self.weight!r}: expected a positive number")
        if self.minimum is not None and self.maximum is not None and not self.minimum < self.maximum:
            unit, size = self.shown_unit
            low, high = (f"{limit / size:g} {unit}".rstrip() for limit in (self.minimum, self.maximum))
            raise DomainError(
                f"operand {self.label}: minimum = {low}, maximum = {high}: expected the minimum below the maximum"
            )

    @property
    def quantity(self) -> tuple[tuple[str, Any], ...]:
        """Names and values of the fields that say which number it is."""
        names = (f.name for f in dataclasses.fields(cast(Any, self)) if f.name not in _GOAL and f.repr)
        return tuple((name, getattr(self, name)) for name in names)

    @property
    def label(self) -> str:
        """Name in messages and tables, such as "edge_thickness(L1)"."""
        name, implied = (self.kind, ()) if self.stated is None else (self.stated.name, self.stated.implied)
        fields = [(key, v) for key, v in self.quantity if v is not None and not callable(v) and key not in implied]
        texts = [_FIELD_TEXTS.get(key, _shown)(v) for key, v in fields]
        return f"{name}({', '.join(texts)})" if texts else name

    def goal_text(self, unit: float = 1.0) -> str:
        """Return the wanted value or the limits as text, in a unit of a size in SI."""
        if self.value is not None:
            return f"= {self.value / unit:.6g}"
        limits = ((">=", self.minimum), ("<=", self.maximum))
        return ", ".join(f"{sign} {number / unit:.6g}" for sign, number in limits if number is not None)

    @property
    def shown_unit(self) -> tuple[str, float]:
        """Unit that the number is shown in, and its size in SI: the stated one, or mm, degrees and percent."""
        if self.stated is not None:
            return self.stated.unit, self.stated.size
        if self.in_percent:
            return PERCENT
        return _MESSAGE_UNITS.get(self.unit, ("" if self.unit == "1" else self.unit, 1.0))

    @property
    def stored_unit(self) -> tuple[str, float]:
        """Unit that the number is stored in, and its size in SI: that of SI, or percent."""
        return PERCENT if self.in_percent else (self.unit, 1.0)

    @property
    def message_goal(self) -> str:
        """Name with the wanted value or the limits, in the unit that it is shown in."""
        unit, size = self.shown_unit
        return f"{self.label} {self.goal_text(size)} {unit}".rstrip()

    @property
    def exact(self) -> bool:
        """Whether :meth:`gradient` returns derivatives; otherwise they are taken by differences."""
        return False

    def bound(self, telescope: Telescope) -> Self:
        """Return the operand with what it takes from the telescope at the start, such as the rays that are lit."""
        return self

    def measure(self, telescope: Telescope) -> float:
        """Return the number, in SI."""
        raise NotImplementedError

    def gradient(self, columns: ParameterColumns) -> tuple[float, np.ndarray]:
        """Return the number, in SI, and its derivatives, shape [n_parameter]."""
        raise NotImplementedError

    def residual(self, number: float) -> tuple[float, float]:
        """Return the residual [m] that a number leaves, and its derivative with respect to the number."""
        goal = self.value
        if goal is None:
            low = -np.inf if self.minimum is None else self.minimum
            high = np.inf if self.maximum is None else self.maximum
            goal = float(np.clip(number, low, high))
        off = number - goal
        return self.weight * off, self.weight if off or self.value is not None else 0.0

    def residuals(self, telescope: Telescope) -> np.ndarray:
        """Return the residual [m], shape [1]."""
        return np.array([self.residual(self.measure(telescope))[0]])

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual [m], shape [1], and its derivatives, shape [1, n_parameter]; of exact operands."""
        number, change = self.gradient(columns)
        residual, slope = self.residual(number)
        return np.array([residual]), slope * change[None]


@dataclass(frozen=True, kw_only=True)
class GoalOperand(Operand):
    """A number of a telescope, with a wanted value or limits.

    Parameters
    ----------
    value : float, optional
        Wanted value.
    minimum, maximum : float, optional
        Limits, in place of a value; the operand has no effect between them.
    weight : float
        A deviation of 1, in the unit of the number, counts as `weight` times 1 m of rms spot or wavefront.

    Raises
    ------
    ConfigError
        If neither a value nor a limit is given, or both are.
    DomainError
        If the minimum is not below the maximum, or a number is not finite.
    """

    value: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    weight: float = 1.0
    stated: StatedName | None = dataclasses.field(default=None, repr=False, compare=False, kw_only=True)


def check_operands(operands: tuple[Operand, ...]) -> None:
    """Raise a ConfigError where two operands state one number twice, or goals that no telescope can meet at once.

    A minimum and a maximum of one number may stand in two operands.
    """
    by_number: dict[tuple[Any, ...], list[Operand]] = {}
    for operand in operands:
        previous_operands = by_number.setdefault((operand.kind, operand.quantity), [])
        for previous in previous_operands:
            intervals = [_interval(previous), _interval(operand)]
            if max(low for low, _ in intervals) > min(high for _, high in intervals):
                raise ConfigError(
                    f"operands {previous.message_goal} and {operand.message_goal} contradict each other: "
                    "expected goals that one telescope can meet"
                )
            pairs = [(getattr(previous, name), getattr(operand, name)) for name in ("minimum", "maximum")]
            if None not in (previous.value, operand.value) or any(None not in pair for pair in pairs):
                raise ConfigError(f"operand {operand.label} is given twice: expected each number once")
        previous_operands.append(operand)


def _interval(operand: Operand) -> tuple[float, float]:
    """Return the range that the goal of an operand allows."""
    if operand.value is not None:
        return operand.value, operand.value
    low = -np.inf if operand.minimum is None else operand.minimum
    return low, np.inf if operand.maximum is None else operand.maximum


def direction_of(field: ArrayLike, telescope: Telescope) -> np.ndarray:
    """Return the unit vector of the light of one field point [rad], shape [1, 3], that the telescope covers."""
    x, y = angles_of(field)
    telescope.check_field(x, y)
    return field_direction(x, y)[None]


def angles_of(field: ArrayLike) -> tuple[float, float]:
    """Return the two angles [rad] of a field point."""
    angles = radians(field, "field")
    if angles.shape != (2,):
        raise DomainError(f"field of shape {list(angles.shape)}: expected two angles, x and y")
    return float(angles[0]), float(angles[1])


def wavelength_of(wavelength: float | None, telescope: Telescope) -> float:
    """Return a wavelength [m]; the telescope's own where none is given."""
    return telescope.default_wavelength if wavelength is None else wavelength


def _degrees(field: tuple[float, float]) -> str:
    return " ".join(f"{np.rad2deg(v):.4g}" for v in field) + " deg"


def _nanometres(wavelengths: float | tuple[float, ...]) -> str:
    numbers = wavelengths if isinstance(wavelengths, tuple) else (wavelengths,)
    return " ".join(f"{1e9 * v:.5g}" for v in numbers) + " nm"


def _per_millimetre(frequency: float) -> str:
    return f"{1e-3 * frequency:.4g}/mm"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(_shown(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


#: Texts of fields that have a unit of their own in labels.
_FIELD_TEXTS: dict[str, Callable[[Any], str]] = {
    "field": _degrees,
    "frequency": _per_millimetre,
    "wavelength": _nanometres,
    "wavelengths": _nanometres,
}
