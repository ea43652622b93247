"""Result of a check: metrics against their baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.plotting import BLUE, GREY, RED, axes_at, plain_text, styled
from ...core.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rows of a table that are shown by default; fewer where all metrics pass.
_SHOWN, _SHOWN_PASSED = 20, 3
_COLUMNS = ("metric", "now", "baseline", "tolerance", "unit", "deviation / tolerance", "checked against")


@dataclass(frozen=True)
class Deviation:
    """One metric against its baseline.

    Attributes
    ----------
    name, unit : str
        Metric, and the unit of its values.
    stored : float
        Value of the baseline.
    tolerance : float
        Largest change that passes.
    found : float or None
        Present value; None where it cannot be computed.
    checked_against : str or None
        Independent source of the stored value.
    problem : str or None
        Reason why it cannot be computed.
    """

    name: str
    unit: str
    stored: float
    tolerance: float
    found: float | None
    checked_against: str | None
    problem: str | None = None

    @property
    def ratio(self) -> float:
        """Change in units of the tolerance; infinite where the metric cannot be computed."""
        return np.inf if self.found is None else abs(self.found - self.stored) / self.tolerance

    def texts(self) -> list[str]:
        """Return its row of a table."""
        digits = max(0, 1 - int(np.floor(np.log10(self.tolerance))))
        found = self.problem or "none" if self.found is None else f"{self.found:.{digits}f}"
        ratio = f"{self.ratio:.2f}" if self.ratio < 1e4 else f"{self.ratio:.1e}"
        against = self.checked_against or ""
        return [self.name, found, f"{self.stored:.{digits}f}", f"{self.tolerance:g}", self.unit, ratio, against]


@dataclass(frozen=True)
class BaselineCheck(Result):
    """All metrics of a baseline against their present values.

    Attributes
    ----------
    path, model : str
        The baseline, and the telescope that it was checked with.
    deviations : tuple of Deviation
        Worst first.
    notes : tuple of str
        Other changes since: version, prescription, configuration.
    """

    _row_type = Deviation

    path: str
    model: str
    deviations: tuple[Deviation, ...]
    notes: tuple[str, ...]

    @property
    def out(self) -> tuple[Deviation, ...]:
        """Metrics out of tolerance, worst first."""
        return tuple(d for d in self.deviations if not d.ratio <= 1.0)

    @property
    def passed(self) -> bool:
        """True where all metrics are within their tolerances."""
        return not self.out

    @property
    def verdict(self) -> str:
        """Result in one line."""
        count = len(self.deviations)
        if self.passed:
            return f"{self.path}: all {count} metrics of {self.model} within their tolerances"
        return f"{self.path}: {len(self.out)} of {count} metrics of {self.model} out of tolerance"

    def _label(self) -> str:
        return self.verdict

    def _columns(self) -> dict[str, Any]:
        rows = self.deviations
        texts = {
            name: [getattr(d, name) or "" for d in rows] for name in ("name", "unit", "checked_against", "problem")
        }
        found = [np.nan if d.found is None else d.found for d in rows]
        numbers = {name: [getattr(d, name) for d in rows] for name in ("stored", "tolerance", "ratio")}
        return {"name": texts["name"], "unit": texts.pop("unit"), "found": found, **numbers, **texts}

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the change of each metric in units of its tolerance, the worst twenty."""
        worst = [d for d in self.deviations if np.isfinite(d.ratio)][:20]
        with styled():
            figure, axes = axes_at(ax, 6.4, 1.2 + 0.22 * len(worst))
            colors = [BLUE if d.ratio <= 1.0 else RED for d in worst]
            axes.barh(np.arange(len(worst)), [d.ratio for d in worst], color=colors, height=0.7)
            axes.axvline(1.0, color=GREY, linewidth=0.8)
            axes.set_yticks(np.arange(len(worst)), [plain_text(d.name) for d in worst])
            axes.invert_yaxis()
            axes.set(xlabel="change over tolerance", title=plain_text(self.model))
            return figure

    def _summary(self) -> dict[str, Any]:
        """Return the result as plain numbers, deviations worst first."""
        return {
            "baseline": self.path,
            "model": self.model,
            "passed": self.passed,
            "figures": len(self.deviations),
            "out": len(self.out),
            "notes": list(self.notes),
            "deviations": [{**vars(d), "deviation_over_tolerance": d.ratio} for d in self.deviations],
        }

    @check_arguments
    def text(self, everything: bool = False) -> str:
        """Return verdict, notes and a table of the worst metrics, or of all."""
        shown = None if everything else _SHOWN_PASSED if self.passed else _SHOWN
        rows = [list(_COLUMNS), *(d.texts() for d in self.deviations[:shown])]
        widths = [max(len(row[k]) for row in rows) for k in range(len(_COLUMNS))]
        table = ["  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([self.verdict, *self.notes, *table])
