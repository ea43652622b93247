"""Files of a tolerance study: tables of sensitivity and draws, summary, plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.files import write_bytes, write_json
from ...core.plotting import BLUE, GREY, ORANGE, RED, label_log_axis, new_figure, png_bytes, styled
from ...core.products import Columns, write_ecsv
from ...core.version import VERSION
from .file import ToleranceFile
from .measurement import moved_by
from .report import tolerance_page
from .result import SHOWN, ToleranceStudy, merit_unit, name_rows, study_title

#: Store of a study in its folder.
STORE_FILE = "points.tolerance"
_PERCENT = (50, 80, 90, 95, 98)
#: Worst offenders in the summary.
_WORST = 20


def tolerance_summary(study: ToleranceStudy) -> dict[str, Any]:
    """Return the figures of a study as plain numbers, merits in the unit of the study."""
    scale, draws = study.criterion.scale, study.merit
    finite = draws[np.isfinite(draws)]
    summary: dict[str, Any] = {
        "telescope": study.telescope,
        "merit": study.criterion.name,
        "unit": study.criterion.unit,
        "method": study.method,
        "tolerances": len(study.tolerances),
        "compensators": list(study.compensators),
        "compensator_units": list(study.compensator_units),
        "compensator_rms": np.sqrt((study.moves**2).mean(axis=0)),
        "draws": len(draws),
        "lost": len(draws) - len(finite),
        "nominal": scale * study.nominal,
        "mean": scale * float(finite.mean()) if len(finite) else None,
        "spread": scale * float(finite.std()) if len(finite) else None,
        **{f"reached_by_{percent}_percent": scale * study.at_most(percent / 100.0) for percent in _PERCENT},
        "worst_offenders": [
            {
                "name": study.tolerances[i].name,
                "size": study.tolerances[i].size,
                "unit": study.units[i],
                "lower_end": scale * study.lower[i],
                "upper_end": scale * study.upper[i],
                "size_for_the_loss": study.inverse[i],
            }
            for i in study.offenders[:_WORST]
        ],
        "loss_percent": 100.0 * study.loss,
    }
    if study.requirement is not None:
        met = study.yield_at(study.requirement)
        summary["requirement"] = scale * study.requirement
        summary["yield"] = {"fraction": met.fraction, "low": met.low, "high": met.high}
    return summary


def write_tolerances(study: ToleranceStudy, file: ToleranceFile, folder: Path) -> tuple[str, ...]:
    """Write the files of a study into an existing folder, and return their names."""
    unit, scale = study.criterion.unit, study.criterion.scale
    meta = {"pachon": VERSION, "telescope": study.telescope, "merit": study.criterion.title, "seed": file.seed}
    about, (effect, effect_error) = "merit, compensated", study.effects
    sensitivity: Columns = {
        "name": (np.array([t.name for t in study.tolerances]), "", "tolerance"),
        "size": (np.array([t.size for t in study.tolerances]), "", "largest or standard deviation, in its unit"),
        "unit": (np.array(study.units), "", "unit of the deviation"),
        "distribution": (np.array([t.distribution for t in study.tolerances]), "", ""),
        "lower_end": (scale * study.lower, unit, f"{about}, at minus the size"),
        "upper_end": (scale * study.upper, unit, f"{about}, at plus the size"),
        "cost": (scale * study.cost, unit, "loss at the worse end"),
        "size_for_the_loss": (study.inverse, "", f"size that costs {100 * study.loss:g} per cent of the merit"),
        **{
            name: (scale * values[end], unit, about_draws)
            for end, third in enumerate(("lowest", "highest"))
            for name, values, about_draws in (
                (f"{third}_third", effect, f"mean merit of draws with the {third} third of it less that of the others"),
                (f"{third}_third_error", effect_error, "standard error of that difference"),
            )
        },
    }
    draws: Columns = {"merit": (scale * study.merit, unit, about)}
    for i, name in enumerate(study.compensators):
        draws[moved_by(name)] = (study.moves[:, i], _fits(study.compensator_units[i]), "")
    for i, tolerance in enumerate(study.tolerances):
        draws[tolerance.name] = (study.deviations[:, i], _fits(study.units[i]), "")
    write_ecsv(folder / "sensitivity.ecsv", sensitivity, {"what": "sensitivity to tolerances", **meta})
    write_ecsv(folder / "draws.ecsv", draws, {"what": f"telescopes within tolerances, {study.method}", **meta})
    pictures = {
        "sensitivity.png": png_bytes(study.plot()),
        "inverse.png": inverse_plot(study),
        "draws.png": draws_plot(study),
        "yield.png": yield_plot(study),
    }
    for name, png in pictures.items():
        write_bytes(folder / name, png)
    summary = tolerance_summary(study)
    write_json(folder / "summary.json", {**summary, "pachon": VERSION, "digest": file.digest})
    write_bytes(folder / "report.html", tolerance_page(study, file, summary, tuple(pictures.values())).encode())
    return "report.html", "sensitivity.ecsv", "draws.ecsv", "summary.json", *pictures


def _fits(unit: str) -> str:
    return "" if unit == "1" else unit


def inverse_plot(study: ToleranceStudy) -> bytes:
    """Draw the size that costs the stated loss over the size of each of the costliest tolerances."""
    shown = study.offenders[:SHOWN][::-1]
    ratio = study.inverse[shown] / np.array([study.tolerances[i].size for i in shown])
    finite = np.isfinite(ratio)
    with styled():
        figure = new_figure(8.4, 1.4 + 0.24 * len(shown))
        axes = figure.subplots()
        rows = np.arange(len(shown))
        colors = np.where(ratio < 1.0, RED, BLUE)
        axes.barh(rows[finite], ratio[finite] - 1.0, left=1.0, height=0.6, color=colors[finite], alpha=0.8)
        for row in rows[~finite]:
            axes.text(1.0, row, " no size costs as much", va="center", fontsize=7)
        name_rows(axes, study, shown)
        axes.set_xscale("log")
        label_log_axis(axes.xaxis)
        axes.axvline(1.0, color=GREY, linewidth=0.8)
        axes.grid(True, axis="x", color="0.93", linewidth=0.5)
        axes.set_xlabel(f"size that costs {100 * study.loss:g} % of the {study.criterion.title}, over the tolerance")
        axes.set_title(study_title(study, "inverse sensitivity; red: the tolerance costs more"))
        return png_bytes(figure)


def draws_plot(study: ToleranceStudy) -> bytes:
    """Draw the histogram of the merit over the drawn telescopes, with the requirement."""
    scale = study.criterion.scale
    finite = scale * study.merit[np.isfinite(study.merit)]
    with styled():
        figure = new_figure(6.4, 4.2)
        axes = figure.subplots()
        bins = max(5, min(60, round(len(finite) ** 0.5)))
        axes.hist(finite, bins=bins, color=BLUE, alpha=0.7, label=f"{len(study.merit)} telescopes, {study.method}")
        axes.axvline(scale * study.nominal, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed")
        if study.requirement is not None:
            axes.axvline(scale * study.requirement, color=ORANGE, linewidth=1.2, label="requirement")
        axes.set(xlabel=f"{study.criterion.title}{merit_unit(study)}", ylabel="telescopes")
        axes.legend(loc="best")
        axes.set_title(study_title(study, "Monte Carlo"))
        return png_bytes(figure)


def yield_plot(study: ToleranceStudy) -> bytes:
    """Draw the fraction of the telescopes that meet a requirement, against it, with its binomial error."""
    finite = np.unique(study.merit[np.isfinite(study.merit)])
    at = finite[np.unique(np.linspace(0, len(finite) - 1, min(len(finite), 200)).astype(int))]
    yields = [study.yield_at(float(v)) for v in at]
    scale = study.criterion.scale
    with styled():
        figure = new_figure(6.4, 4.2)
        axes = figure.subplots()
        axes.plot(scale * at, [100 * y.fraction for y in yields], color=BLUE, label=f"{len(study.merit)} telescopes")
        limits = [100 * y.low for y in yields], [100 * y.high for y in yields]
        axes.fill_between(scale * at, *limits, color=BLUE, alpha=0.2, linewidth=0, label="binomial, 1 sigma")
        axes.axvline(scale * study.nominal, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed")
        if study.requirement is not None:
            met = study.yield_at(study.requirement)
            label = f"requirement: {100 * met.fraction:.1f} % ({100 * met.low:.1f} to {100 * met.high:.1f})"
            axes.axvline(scale * study.requirement, color=ORANGE, linewidth=1.2, label=label)
        axes.set_xlabel(f"requirement on the {study.criterion.title}{merit_unit(study)}")
        axes.set_ylabel("telescopes that meet it [%]")
        axes.set_ylim(0, 102)
        axes.grid(True, color="0.93", linewidth=0.5)
        axes.legend(loc="best")
        compensated = f", compensated by {', '.join(study.compensators)}" if study.compensators else ""
        axes.set_title(study_title(study, f"{study.method}{compensated}"))
        return png_bytes(figure)
