"""Result of a tolerance study, and the picture of its costliest tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.plotting import BLUE, GREY, RED, figure_at, plain_text, styled
from ...core.result import Result
from ...design.tolerancing.monte_carlo import MonteCarlo
from ...models.parameters.tolerances import Tolerance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Tolerances in a picture, the costliest.
SHOWN = 25


@dataclass(frozen=True)
class ToleranceStudy(MonteCarlo):
    """Results of a tolerance study: a Monte Carlo, and each tolerance alone.

    Attributes
    ----------
    lower, upper : ndarray, shape [n_tolerance]
        Merit at minus and plus the size of each tolerance, compensated, traced.
    inverse : ndarray, shape [n_tolerance]
        Size of each tolerance whose worse end costs the loss; NaN where none within a factor of 1e4 does.
    loss : float
        Relative loss of the merit of these.
    requirement : float, optional
        Requirement on the merit.
    """

    _table = ("lower", "upper", "inverse", "cost")
    _row_type = Tolerance

    lower: np.ndarray
    upper: np.ndarray
    inverse: np.ndarray
    loss: float
    requirement: float | None = None

    def _columns(self) -> dict[str, Any]:
        rows = {"name": [t.name for t in self.tolerances], "size": [t.size for t in self.tolerances]}
        return rows | {"units": list(self.units)} | super()._columns()

    def _meta(self) -> dict[str, Any]:
        names = {"telescope": self.telescope, "merit": self.merit_name}
        return names | {"method": self.method, "nominal": self.nominal}

    def _summary(self) -> dict[str, Any]:
        return Result._summary(self)

    def _label(self) -> str:
        return f"{self.telescope}, {len(self.tolerances)} tolerances, {len(self.merit)} telescopes drawn"

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the change of the merit at the ends of the costliest tolerances, and in the draws, with its error."""
        return _draw(self, ax)

    @property
    def cost(self) -> np.ndarray:
        """Loss of the merit at the worse end of each tolerance, shape [n_tolerance]; infinite where light is lost."""
        ends = self.criterion.loss(np.stack([self.lower, self.upper]), self.nominal)
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
        finite = np.isfinite(self.merit)
        effect, error = np.full((2, 2, self.deviations.shape[1]), np.nan)
        for i, column in enumerate(self.deviations.T):
            low, high = np.quantile(column, (1 / 3, 2 / 3))
            for end, third in enumerate((column <= low, column >= high)):
                inner, outer = self.merit[finite & third], self.merit[finite & ~third]
                if min(len(inner), len(outer)) >= 2:
                    effect[end, i] = inner.mean() - outer.mean()
                    error[end, i] = np.sqrt(inner.var(ddof=1) / len(inner) + outer.var(ddof=1) / len(outer))
        return effect, error


def _draw(study: ToleranceStudy, ax: Axes | Figure | None) -> Figure:
    shown = study.offenders[:SHOWN][::-1]
    scale = study.criterion.scale
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
        axes.set_xlabel(f"change of the {study.criterion.title}{merit_unit(study)},\nthe tolerance alone")
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
    return f" [{study.criterion.unit}]".replace("um", "µm").replace("urad", "µrad") if study.criterion.unit else ""


def study_title(study: ToleranceStudy, text: str) -> str:
    """Return the title of a picture of a study."""
    return f"{plain_text(study.telescope)}: {plain_text(text)}"
