"""Result of a tolerance study, and the picture of its costliest tolerances."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.plotting import BLUE, GREY, RED, figure_at, plain_text, styled
from ...core.result import Result
from ...design.optimize.yields import Yield
from ...models.parameters.tolerances import Tolerance
from .merits import ToleranceMerit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Tolerances in a picture, the costliest.
SHOWN = 25


@dataclass(frozen=True)
class ToleranceStudy(Result):
    """Results of a tolerance study.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    merit : ToleranceMerit
        The merit; numbers below are in SI.
    method : str
        "linear", "quadratic" or "traced".
    tolerances : tuple of Tolerance
        The tolerances.
    compensators : tuple of str
        Degrees of freedom that follow each deviation.
    units, compensator_units : tuple of str
        Units of deviations and compensators.
    nominal : float
        Merit of the telescope as designed, compensated.
    lower, upper : ndarray, shape [n_tolerance]
        Merit at minus and plus the size of each tolerance, compensated, traced.
    inverse : ndarray, shape [n_tolerance]
        Size of each tolerance whose worse end costs the loss; NaN where none within a factor of 1e4 does.
    loss : float
        Relative loss of the merit of these.
    deviations : ndarray, shape [n, n_tolerance]
        Drawn deviations.
    moves : ndarray, shape [n, n_compensator]
        Compensators of each draw.
    draws : ndarray, shape [n]
        Merit of each draw; NaN where its light is lost.
    requirement : float, optional
        Requirement on the merit.
    """

    _table = ("lower", "upper", "inverse", "cost")
    _row_type = Tolerance

    telescope: str
    merit: ToleranceMerit
    method: str
    tolerances: tuple[Tolerance, ...]
    compensators: tuple[str, ...]
    units: tuple[str, ...]
    compensator_units: tuple[str, ...]
    nominal: float
    lower: np.ndarray
    upper: np.ndarray
    inverse: np.ndarray
    loss: float
    deviations: np.ndarray
    moves: np.ndarray
    draws: np.ndarray
    requirement: float | None = field(default=None)

    def _columns(self) -> dict[str, Any]:
        rows = {"name": [t.name for t in self.tolerances], "size": [t.size for t in self.tolerances]}
        return rows | {"units": list(self.units)} | super()._columns()

    def _meta(self) -> dict[str, Any]:
        return {"telescope": self.telescope, "merit": self.merit.name, "method": self.method, "nominal": self.nominal}

    def _label(self) -> str:
        return f"{self.telescope}, {len(self.tolerances)} tolerances, {len(self.draws)} telescopes drawn"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the change of the merit at the ends of the costliest tolerances, and in the draws, with its error."""
        return _draw(self, ax)

    @property
    def cost(self) -> np.ndarray:
        """Loss of the merit at the worse end of each tolerance, shape [n_tolerance]; infinite where light is lost."""
        ends = self.merit.loss(np.stack([self.lower, self.upper]), self.nominal)
        return np.max(np.where(np.isnan(ends), np.inf, ends), axis=0)

    @property
    def offenders(self) -> np.ndarray:
        """Indices of the tolerances, the costliest first."""
        return np.argsort(-self.cost, kind="stable")

    @cached_property
    def effects(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean merit of the draws with the lowest and the highest third of each deviation less that of the others.

        Both arrays are [2, n_tolerance], lowest third first: the difference, and its standard error; NaN where a group
        has less than two telescopes with light.
        """
        lit_draws = np.isfinite(self.draws)
        effect, error = np.full((2, 2, self.deviations.shape[1]), np.nan)
        for i, column in enumerate(self.deviations.T):
            low, high = np.quantile(column, (1 / 3, 2 / 3))
            for end, third in enumerate((column <= low, column >= high)):
                inner, outer = self.draws[lit_draws & third], self.draws[lit_draws & ~third]
                if min(len(inner), len(outer)) >= 2:
                    effect[end, i] = inner.mean() - outer.mean()
                    error[end, i] = np.sqrt(inner.var(ddof=1) / len(inner) + outer.var(ddof=1) / len(outer))
        return effect, error

    @check_arguments
    def at_most(self, fraction: float) -> float:
        """Return the merit that a fraction (0 to 1) of the telescopes reaches; lost ones are worst."""
        worst = -np.inf if self.merit.larger else np.inf
        merits = np.where(np.isnan(self.draws), worst, self.draws)
        part = 1.0 - fraction if self.merit.larger else fraction
        return float(np.quantile(merits, part, method="lower" if self.merit.larger else "higher"))

    @check_arguments
    def yield_at(self, requirement: float) -> Yield:
        """Return the fraction of the telescopes that meet a requirement on the merit, with its binomial error."""
        return Yield.of(self.draws, requirement, larger=self.merit.larger)


def _draw(study: ToleranceStudy, ax: Axes | Figure | None) -> Figure:
    shown = study.offenders[:SHOWN][::-1]
    scale = study.merit.scale
    with styled():
        figure = figure_at(ax, 9.6, 1.5 + 0.24 * len(shown))
        axes, drawn = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1.0))
        rows = np.arange(len(shown))
        for values, color, name, height in (
            (study.lower, BLUE, "lower end", 0.7),
            (study.upper, RED, "upper end", 0.4),
        ):
            change = scale * (values[shown] - study.nominal)
            axes.barh(rows, change, height=height, color=color, alpha=0.8, label=name)
            for row in rows[np.isnan(change)]:
                axes.text(0.0, row, " light is lost", va="center", fontsize=7)
        name_rows(axes, study, shown)
        axes.axvline(0.0, color=GREY, linewidth=0.8)
        axes.set_xlabel(f"change of the {study.merit.title}{merit_unit(study)},\nthe tolerance alone")
        axes.legend(loc="lower right")
        effect, error = (scale * v[:, shown] for v in study.effects)
        for end, color, name in ((0, BLUE, "lowest third"), (1, RED, "highest third")):
            bars = {"markersize": 3.5, "elinewidth": 1.0, "capsize": 2.0, "color": color, "label": name}
            drawn.errorbar(effect[end], rows + (0.15 if end else -0.15), xerr=error[end], fmt="o", **bars)
        drawn.axvline(0.0, color=GREY, linewidth=0.8)
        drawn.set_xlabel(f"less the mean of the other draws{merit_unit(study)},\nall tolerances at once")
        drawn.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        title = f"{len(shown)} of {len(study.tolerances)} tolerances, the costliest on top"
        figure.suptitle(study_title(study, title), fontsize="medium")
        return figure


def name_rows(axes: Axes, study: ToleranceStudy, shown: np.ndarray) -> None:
    """Write names and sizes of tolerances at the rows of axes."""
    labels = [
        f"{plain_text(t.name)} ± {t.size:.3g}{'' if u == '1' else f' {u}'}"
        for t, u in ((study.tolerances[i], study.units[i]) for i in shown)
    ]
    axes.set_yticks(np.arange(len(shown)), labels)


def merit_unit(study: ToleranceStudy) -> str:
    """Return the unit of the merit for a label."""
    return f" [{study.merit.unit}]".replace("um", "µm").replace("urad", "µrad") if study.merit.unit else ""


def study_title(study: ToleranceStudy, text: str) -> str:
    """Return the title of a picture of a study."""
    return f"{plain_text(study.telescope)}: {plain_text(text)}"
