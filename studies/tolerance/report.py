"""Page of a tolerance study: one HTML file with everything in it, pictures included, that prints well."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...core.page import Picture, render, with_digits, with_error
from ...core.version import VERSION
from .file import ToleranceFile
from .result import ToleranceStudy

#: How the merit of a drawn telescope is found.
_METHODS = {
    "traced": "each traced with all its deviations",
    "linear": "from residuals linear in the deviations",
    "quadratic": "from a quadratic in the deviations",
}
#: Tolerances in the table, the costliest.
_SHOWN = 50


def tolerance_page(
    study: ToleranceStudy, file: ToleranceFile, summary: dict[str, Any], pictures: tuple[bytes, ...]
) -> str:
    """Return the page of a study with its pictures (PNG): sensitivity, inverse sensitivity, draws, yield."""
    title = study.criterion.title
    loss, at = f"{summary['loss_percent']:g} %", "at least" if study.criterion.larger else "at most"
    captions = (
        (
            "Sensitivity",
            f"Left: change of the {title} where one tolerance stands at its lower or upper end, the others at zero, "
            "after compensation. Right: mean over the drawn telescopes with the lowest, or the highest, third of the "
            "deviation less that of the other telescopes, with the standard error of the difference; all tolerances "
            "act at once there.",
        ),
        (
            "Inverse sensitivity",
            f"Size of each tolerance whose worse end alone costs {loss} of the {title} as designed, over the size of "
            "the tolerance. Below 1 the tolerance is looser than that.",
        ),
        ("Monte Carlo", f"Histogram of the {title} of the drawn telescopes, all tolerances at once, compensated."),
        (
            "Yield",
            f"Fraction of the telescopes whose {title} is {at} the requirement on the horizontal axis. The band is "
            "Wilson's interval of one standard deviation.",
        ),
    )
    return render(
        Path(__file__).parent / "templates",
        "tolerance.html",
        summary=summary,
        verdict=verdict(summary),
        title=title,
        unit=study.criterion.unit,
        definition=study.criterion.definition,
        method=_METHODS[study.method],
        found=_drawn(summary),
        pictures=[Picture(name, data, shows) for (name, shows), data in zip(captions, pictures, strict=True)],
        rows=_rows(study),
        left=max(0, len(study.tolerances) - _SHOWN),
        compensators=_compensators(study),
        seed=file.seed,
        pachon=VERSION,
    )


def verdict(summary: dict[str, Any]) -> str:
    """Return the result of a study in one sentence."""
    unit = f" {summary['unit']}" if summary["unit"] else ""
    draws, lost = summary["draws"], summary["lost"]
    costliest = ""
    for offender in summary["worst_offenders"][:1]:
        # An end without light is NaN, which costs most.
        if any(offender[end] != summary["nominal"] for end in ("lower_end", "upper_end")):
            costliest = f"; {offender['name']} costs most"
    dark = f"; {lost} without light" if lost else ""
    telescopes = "the one telescope drawn" if draws == 1 else f"{draws} telescopes drawn"
    if "yield" in summary:
        met = f"{100 * summary['yield']['fraction']:.1f} % of {telescopes}"
        verb = "meets" if draws == 1 else "meet"
        return f"{met} {verb} the requirement of {summary['requirement']:g}{unit}{dark}{costliest}."
    if lost == draws:
        return f"No light arrives in any of {telescopes}{costliest}."
    median, high = (summary[f"reached_by_{percent}_percent"] for percent in (50, 95))
    texts = [f"{value:.4g}{unit}" if math.isfinite(value) else "no light" for value in (median, high)]
    design = f"{summary['nominal']:.4g}{unit}"
    if draws == 1:
        return f"The one telescope drawn reaches {texts[0]}, where the design has {design}{costliest}."
    reached = f"half reach {texts[0]} and 95 % {texts[1]}"
    return f"Of {telescopes}, {reached}, where the design has {design}{dark}{costliest}."


def _drawn(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return name and value of the statistics of the drawn telescopes, to the digits that their number allows."""
    if summary["mean"] is None:
        return []
    unit = f" {summary['unit']}" if summary["unit"] else ""
    count = summary["draws"] - summary["lost"]
    error = summary["spread"] / math.sqrt(count)
    rows = [
        ("mean of the drawn telescopes, and its standard error", with_error(summary["mean"], error) + unit),
        # Of a normal distribution, that of the standard deviation is smaller by the root of two.
        ("standard deviation of them", with_digits(summary["spread"], error / math.sqrt(2.0)) + unit),
    ]
    for key, value in summary.items():
        if key.startswith("reached_by_"):
            text = with_digits(value, error) + unit if math.isfinite(value) else "light is lost"
            rows.append((f"reached by {key.split('_')[2]} % of them", text))
    return rows


def _rows(study: ToleranceStudy) -> list[tuple[str, ...]]:
    """Return the cells of the costliest tolerances."""
    scale, (effect, error) = study.criterion.scale, study.effects
    rows = []
    for i in study.offenders[:_SHOWN]:
        tolerance, unit = study.tolerances[i], "" if study.units[i] == "1" else f" {study.units[i]}"
        merits = [scale * v for v in (study.lower[i], study.upper[i], study.cost[i])]
        drawn = [
            f"{scale * effect[end, i]:.2g} ± {scale * error[end, i]:.1g}" if np.isfinite(error[end, i]) else "-"
            for end in range(2)
        ]
        inverse = f"{study.inverse[i]:.3g}{unit}" if np.isfinite(study.inverse[i]) else "-"
        kind = tolerance.distribution.replace("_", " ")
        numbers = ["light is lost" if not np.isfinite(v) else f"{v:.4g}" for v in merits]
        rows.append((tolerance.name, f"{tolerance.size:.3g}{unit}", kind, *numbers, inverse, *drawn))
    return rows


def _compensators(study: ToleranceStudy) -> list[tuple[str, ...]]:
    """Return name, root mean square and largest motion of each compensator."""
    rows = []
    for name, unit, moves in zip(study.compensators, study.compensator_units, study.moves.T, strict=True):
        text = "" if unit == "1" else f" {unit}"
        sizes = np.sqrt((moves**2).mean()), np.quantile(np.abs(moves), 0.9), np.abs(moves).max()
        rows.append((name, *(f"{size:.3g}{text}" for size in sizes)))
    return rows
