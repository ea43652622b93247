"""Result of a check: metrics against their baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.arguments import check_arguments

#: Rows of a table that are shown by default; fewer where all metrics pass.
_SHOWN, _SHOWN_PASSED = 20, 3
_COLUMNS = ("metric", "now", "baseline", "tolerance", "unit", "deviation / tolerance", "checked against")


@dataclass(frozen=True)
class Deviation:
    """One metric against its baseline."""

    name: str
    unit: str
    stored: float  #: value of the baseline
    tolerance: float
    found: float | None  #: present value; None where it cannot be computed
    checked_against: str | None  #: independent source of the stored value
    problem: str | None = None  #: reason why it cannot be computed

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
class BaselineCheck:
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

    def summary(self) -> dict[str, Any]:
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
