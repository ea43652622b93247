"""Result of an optimisation: telescopes, variables and operands before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.number_text import counted
from ...core.plotting import BLUE, GREY, figure_at, plain_text, styled
from ...core.result import Result, Values
from ...models.parameters.parameters import Parameter
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from .before_after import draw_before_after
from .held_operands import deviation
from .operand import Operand

#: Relative difference of two merits that rounding makes.
_ROUNDING = 1e-9

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class OperandChange(Values):
    """An operand before and after an optimisation.

    Attributes
    ----------
    operand : Operand
        The operand.
    configuration : str
        Name of the telescope.
    start, end : float
        Number before and after, in SI.
    allowed : float
        Deviation from value or limit within which the operand is held, in SI.
    """

    operand: Operand
    configuration: str
    start: float
    end: float
    allowed: float

    @property
    def goal(self) -> str:
        """Wanted value or limits as text."""
        return self.operand.goal_text()

    @property
    def deviation(self) -> float:
        """By how much the number after is above the value or the maximum, negative below the minimum."""
        return deviation(self.operand, self.end)

    @property
    def holds(self) -> bool:
        """Whether the number after is the wanted value, or within the limits."""
        return abs(self.deviation) <= self.allowed

    def stored(self) -> dict[str, Any]:
        """Return the operand as it is stored: in SI, ratios that are named percentages in percent."""
        unit, size = self.operand.stored_unit
        return {
            "operand": self.operand.label,
            "configuration": self.configuration,
            "unit": unit,
            "goal": self.operand.goal_text(size),
            "start": self.start / size,
            "end": self.end / size,
            "deviation": self.deviation / size,
            "holds": self.holds,
        }


@dataclass(frozen=True)
class Optimum(Result):
    """Result of an optimisation.

    Attributes
    ----------
    telescopes : tuple of Telescope
        The optimised telescope of each configuration.
    start_telescopes : tuple of Telescope
        The telescopes before.
    fields : tuple of ndarray, shape [n_field, 2]
        Field angles [rad] of each configuration.
    wavelengths : tuple of ndarray, shape [n_wave]
        Vacuum wavelengths [m] of each configuration.
    variables : tuple of Parameter
        Free parameters.
    addresses : tuple of str
        Their addresses; those of one configuration alone with its name and a colon in front.
    changes : ndarray, shape [n_variable]
        Change of each, in its own unit.
    start_values, values : ndarray, shape [n_variable]
        Values before and after; those of motions are relative to the start.
    merit_name : str
        "spots" or "wavefront".
    merits : ndarray, shape [2]
        Rms of the merit alone [m], without operands, before and after: measured on the telescopes as they are saved,
        of the light that arrives in each, with rays that fill the stop. Spots are those of :func:`pachon.spots`, of
        as many rays as it takes, or as are stated.
    remeasured : ndarray, shape [2, 2]
        The same, and behind it that with rays as the design data state them; NaN where no light arrives.
    history : ndarray, shape [n_step + 1]
        Rms of merit and operands [m] before the first step and after each.
    operands : tuple of OperandChange
        Operands before and after.
    effect : ndarray, shape [n_variable]
        Rms change of the residuals per unit of each variable [m], at the solution.
    covariance : ndarray, shape [n_variable, n_variable]
        Covariance of the variables, with the final residuals as noise, without combinations of no effect.
    collinear : tuple of str
        Combinations of variables without effect, such as "M1.radius - 0.998 M1.curvature".
    message : str
        Why the solver stopped.
    vignetting : tuple of (ndarray, shape [n_field, 5], or None)
        Vignetting factors of the fields of each configuration.
    """

    _table = ("start_values", "values", "changes", "uncertainty", "effect")
    _row_type = Parameter

    telescopes: tuple[Telescope, ...]
    start_telescopes: tuple[Telescope, ...]
    fields: tuple[np.ndarray, ...]
    wavelengths: tuple[np.ndarray, ...]
    variables: tuple[Parameter, ...]
    addresses: tuple[str, ...]
    changes: np.ndarray
    start_values: np.ndarray
    values: np.ndarray
    merit_name: str
    merits: np.ndarray
    remeasured: np.ndarray
    history: np.ndarray
    operands: tuple[OperandChange, ...]
    effect: np.ndarray
    covariance: np.ndarray
    collinear: tuple[str, ...]
    message: str
    vignetting: tuple[np.ndarray | None, ...]

    @property
    def telescope(self) -> Telescope:
        """The optimised telescope, of several configurations the first."""
        return self.telescopes[0]

    @property
    def filled_stops(self) -> tuple[str, ...]:
        """Stops that the rays fill, though the design data state no ray aiming: those inside their telescopes."""
        filled = (t.design_data.stop for t in self.start_telescopes if following_stop(t) is not t)
        return tuple(dict.fromkeys(name for name in filled if name is not None))

    @property
    def is_better(self) -> bool:
        """Whether the merit alone is not above that of the start."""
        return bool(self.merits[1] <= (1.0 + _ROUNDING) * self.merits[0])

    @property
    def operands_not_held(self) -> tuple[OperandChange, ...]:
        """Operands that are off their value or limits at the end."""
        return tuple(change for change in self.operands if not change.holds)

    @property
    def uncertainty(self) -> np.ndarray:
        """Standard deviation of each variable, in its own unit, shape [n_variable]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def step_effects(self) -> np.ndarray:
        """Effect of the change of each variable at the solution, rms [m], shape [n_variable]."""
        return np.abs(self.changes) * self.effect

    @property
    def in_angles(self) -> bool:
        """Whether the merit is an angle: spots of telescopes whose image is at infinity; radians stand for metres."""
        return self.merit_name == "spots" and all(t.design_data.afocal for t in self.telescopes)

    @property
    def _unit(self) -> str:
        return "rad" if self.in_angles else "m"

    def _label(self) -> str:
        start, end = self.history[0], self.history[-1]
        variables = counted(len(self.variables), "variable")
        return f"{self.telescope.name}, {variables}, rms {start:.4g} -> {end:.4g} {self._unit}"

    def _columns(self) -> dict[str, Any]:
        names = {"address": list(self.addresses), "unit": [p.unit or "1" for p in self.variables]}
        return names | super()._columns()

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit."""
        return {
            "telescope": self.telescope.name,
            "configurations": [t.name for t in self.telescopes],
            "merit": self.merit_name,
            f"rms_start_{self._unit}": self.merits[0],
            f"rms_end_{self._unit}": self.merits[1],
            f"rms_start_with_operands_{self._unit}": self.history[0],
            f"rms_end_with_operands_{self._unit}": self.history[-1],
            **self._remeasured_items(),
            "steps": len(self.history) - 1,
            "variables": list(self.addresses),
            "units": [p.unit or "1" for p in self.variables],
            "start_values": self.start_values,
            "values": self.values,
            "changes": self.changes,
            "uncertainty": self.uncertainty,
            f"effect_{self._unit}_per_unit": self.effect,
            "operands": [change.stored() for change in self.operands],
            "operands_not_held": [change.operand.label for change in self.operands_not_held],
            "collinear": list(self.collinear),
            "message": self.message,
        }

    def _remeasured_items(self) -> dict[str, Any]:
        """Return which stops inside rays fill, and the merit of rays that the design data state."""
        if not self.filled_stops:
            return {}
        start, end = self.remeasured[:, 1]
        unaimed = {f"rms_start_without_aiming_{self._unit}": start, f"rms_end_without_aiming_{self._unit}": end}
        return {"rays_fill": list(self.filled_stops), **unaimed}

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw merit and effects of the variables, and the telescope with its spots before and after."""
        with styled():
            above = max(3.2, 1.4 + 0.24 * len(self.addresses))
            figure = figure_at(ax, 10.4, above + 6.4)
            parts: Any = figure.subfigures(2, 1, height_ratios=[above, 6.4])
            course, designs = parts
            steps, bars = course.subplots(1, 2)
            self._draw_course(steps, bars)
            draw_before_after(
                designs,
                (following_stop(self.start_telescopes[0]), following_stop(self.telescope)),
                self.fields[0],
                self.wavelengths[0],
                self.vignetting[0],
            )
            return figure

    def _draw_course(self, steps: Axes, bars: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        steps.semilogy(range(len(self.history)), self.history * 1e6, "o-", color=BLUE, markersize=4)
        steps.xaxis.set_major_locator(MaxNLocator(integer=True))
        steps.grid(True, which="major", linewidth=0.3)
        name = f"rms of {self.merit_name}" + (" and operands" if self.operands else "")
        steps.set(xlabel="step", ylabel=f"{name} [µ{self._unit}]", title=plain_text(self.telescope.name))
        places = np.arange(len(self.addresses))
        bars.barh(places, self.step_effects * 1e6, color=GREY, height=0.7)
        bars.set_yticks(places, [plain_text(name) for name in self.addresses])
        bars.invert_yaxis()
        bars.set_xlabel(f"change of each times its effect, rms [µ{self._unit}]")
