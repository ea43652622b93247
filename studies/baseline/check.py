"""Result of a check: metrics against their baseline."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.plotting import BLUE, GREY, RED, axes_at, plain_text, styled
from ...core.result import Result
from .file import Limit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rows of the table of a cause that are shown by default.
_SHOWN = 20
#: Rows that are shown by default where all metrics pass.
_SHOWN_PASSED = 3
_COLUMNS = ("metric", "now", "baseline", "tolerance", "limit", "unit", "deviation / tolerance", "checked against")
#: Cause of failures besides drift (:attr:`BaselineCheck.drift`): a limit is exceeded.
BROKEN = "requirement broken"
#: Cause of failures besides drift: a metric cannot be computed.
MISSING = "metric missing"


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
    limit : Limit or None
        Requirement of the present value.
    """

    name: str
    unit: str
    stored: float
    tolerance: float
    found: float | None
    checked_against: str | None
    problem: str | None = None
    limit: Limit | None = None

    @property
    def ratio(self) -> float:
        """Change in units of the tolerance; infinite where the metric cannot be computed."""
        return np.inf if self.found is None else abs(self.found - self.stored) / self.tolerance

    @property
    def moved(self) -> bool:
        """True where the metric is out of tolerance, or cannot be computed."""
        return not self.ratio <= 1.0

    @property
    def broken(self) -> bool:
        """True where the present value does not meet its requirement."""
        return self.limit is not None and self.found is not None and not self.limit.holds(self.found)

    def texts(self) -> list[str]:
        """Return its row of a table."""
        digits = max(0, 1 - int(np.floor(np.log10(self.tolerance))))
        value = self.problem or "none" if self.found is None else f"{self.found:.{digits}f}"
        ratio = f"{self.ratio:.2f}" if self.ratio < 1e4 else f"{self.ratio:.1e}"
        against, limit = self.checked_against or "", "" if self.limit is None else str(self.limit)
        return [self.name, value, f"{self.stored:.{digits}f}", f"{self.tolerance:g}", limit, self.unit, ratio, against]


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
    changed : tuple of str
        What has changed since: ``pachon``, ``prescription``, ``configuration``.
    """

    _row_type = Deviation

    path: str
    model: str
    deviations: tuple[Deviation, ...]
    notes: tuple[str, ...]
    changed: tuple[str, ...] = ()

    @property
    def moved(self) -> tuple[Deviation, ...]:
        """Metrics out of tolerance, or that cannot be computed, worst first."""
        return tuple(d for d in self.deviations if d.moved)

    @property
    def out(self) -> tuple[Deviation, ...]:
        """Metrics out of tolerance or beyond their limits, worst first."""
        return tuple(d for d in self.deviations if d.moved or d.broken)

    @property
    def passed(self) -> bool:
        """True where all metrics are within their tolerances and limits."""
        return not self.out

    @property
    def drift(self) -> str:
        """Cause of metrics out of tolerance: inputs that have changed, else the version or the machine."""
        inputs = [name for name in self.changed if name != "pachon"]
        if inputs:
            return f"{' and '.join(inputs)} changed"
        return "pachon changed" if self.changed else "drift of the same inputs (machine, libraries)"

    @property
    def causes(self) -> dict[str, tuple[Deviation, ...]]:
        """Failures by their causes, each once: broken requirements, missing metrics, drift."""
        failures: dict[str, list[Deviation]] = {BROKEN: [], MISSING: [], self.drift: []}
        for d in self.out:
            failures[BROKEN if d.broken else MISSING if d.found is None else self.drift].append(d)
        return {cause: tuple(deviations) for cause, deviations in failures.items() if deviations}

    @property
    def verdict(self) -> str:
        """Result in one line."""
        count, broken = len(self.deviations), sum(d.broken for d in self.deviations)
        if self.passed:
            limits = " and limits" if any(d.limit for d in self.deviations) else ""
            return f"{self.path}: all {count} metrics of {self.model} within their tolerances{limits}"
        parts = [f"{len(self.moved)} of {count} metrics of {self.model} out of tolerance"] if self.moved else []
        parts += [f"{broken} of {count} metrics of {self.model} beyond their limits"] if broken else []
        return f"{self.path}: {', '.join(parts)}"

    def _label(self) -> str:
        return self.verdict

    def _columns(self) -> dict[str, Any]:
        rows = self.deviations
        texts = {
            name: [getattr(d, name) or "" for d in rows] for name in ("name", "unit", "checked_against", "problem")
        }
        values = [np.nan if d.found is None else d.found for d in rows]
        numbers = {name: [getattr(d, name) for d in rows] for name in ("stored", "tolerance", "ratio")}
        return {"name": texts["name"], "unit": texts.pop("unit"), "found": values, **numbers, **texts}

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
        cause = {d.name: name for name, failures in self.causes.items() for d in failures}
        return {
            "baseline": self.path,
            "model": self.model,
            "passed": self.passed,
            "figures": len(self.deviations),
            "out": len(self.out),
            "notes": list(self.notes),
            "causes": {name: len(failures) for name, failures in self.causes.items()},
            "deviations": [
                {
                    **vars(d),
                    "limit": None if d.limit is None else d.limit.model_dump(exclude_none=True),
                    "deviation_over_tolerance": d.ratio,
                    "cause": cause.get(d.name),
                }
                for d in self.deviations
            ],
        }

    @check_arguments
    def text(self, everything: bool = False) -> str:
        """Return verdict, notes and the worst metrics of each cause, or all metrics."""
        lines = [self.verdict, *self.notes]
        if self.passed:
            return "\n".join(lines + _table(self.deviations[: None if everything else _SHOWN_PASSED]))
        groups = self.causes
        if everything:
            groups["within"] = tuple(d for d in self.deviations if not (d.moved or d.broken))
        for name, group in groups.items():
            kinds = Counter(d.name.partition(" ")[0] for d in group)
            lines.append(f"{name}: {', '.join(f'{kind} {count}' for kind, count in kinds.items()) or 'none'}")
            lines += _table(group[: None if everything else _SHOWN])
        return "\n".join(lines)


def _table(deviations: tuple[Deviation, ...]) -> list[str]:
    """Return lines of a table, with a column of limits where there are any."""
    rows = [d.texts() for d in deviations]
    columns = [k for k, name in enumerate(_COLUMNS) if name != "limit" or any(row[k] for row in rows)]
    rows = [[row[k] for k in columns] for row in (list(_COLUMNS), *rows)] if rows else []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows]
