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

#: Classes of operands by their kinds, as in files.
OPERANDS: dict[str, type[GoalOperand]] = {}
#: Fields of the goal, and of how it is computed; the others say which number it is.
_GOAL = ("value", "minimum", "maximum", "weight", "step")
_Kind = TypeVar("_Kind", bound="type[GoalOperand]")


def operand_kind(kind: str, unit: str) -> Callable[[_Kind], _Kind]:
    """Return a decorator that registers a class of operands under a kind, with the unit of its number."""

    def register(cls: _Kind) -> _Kind:
        cls.kind, cls.unit = kind, unit
        OPERANDS[kind] = cls
        return cls

    return register


class Operand:
    """Base of operands: a number of a telescope with its goal, the fields of :class:`GoalOperand`."""

    kind: ClassVar[str] = ""
    unit: ClassVar[str] = ""

    value: float | None
    minimum: float | None
    maximum: float | None
    weight: float
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
        if self.weight <= 0:
            raise DomainError(f"operand {self.label}: weight = {self.weight!r}: expected a positive number")
        if self.minimum is not None and self.maximum is not None and not self.minimum < self.maximum:
            raise DomainError(
                f"operand {self.label}: minimum = {self.minimum:g}, maximum = {self.maximum:g}: "
                "expected the minimum below the maximum"
            )

    @property
    def quantity(self) -> tuple[tuple[str, Any], ...]:
        """Names and values of the fields that say which number it is."""
        names = (f.name for f in dataclasses.fields(cast(Any, self)) if f.name not in _GOAL and f.repr)
        return tuple((name, getattr(self, name)) for name in names)

    @property
    def label(self) -> str:
        """Name in messages and tables, such as "edge_thickness(L1)"."""
        stated = [(name, v) for name, v in self.quantity if v is not None and not callable(v)]
        texts = [_degrees(v) if name == "field" else _shown(v) for name, v in stated]
        return f"{self.kind}({', '.join(texts)})" if texts else self.kind

    def goal_text(self, unit: float = 1.0) -> str:
        """Return the wanted value or the limits as text, in a unit of a size in SI."""
        if self.value is not None:
            return f"= {self.value / unit:.6g}"
        limits = ((">=", self.minimum), ("<=", self.maximum))
        return ", ".join(f"{sign} {number / unit:.6g}" for sign, number in limits if number is not None)

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


def check_operands(operands: tuple[Operand, ...]) -> None:
    """Raise a ConfigError where two operands state one number."""
    keys: list[tuple[Any, ...]] = []
    for operand in operands:
        key = (operand.kind, operand.quantity)
        if key in keys:
            raise ConfigError(f"operand {operand.label} is given twice: expected each number once")
        keys.append(key)


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


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(_shown(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
