"""Files of a tolerance study: tables of sensitivity and draws, summary, plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.files import write_bytes, write_json
from ...core.plotting import png_bytes
from ...core.products import Columns, write_ecsv
from ...core.version import VERSION
from .file import ToleranceFile
from .plots import draws_plot, inverse_plot, yield_plot
from .report import tolerance_page
from .result import ToleranceStudy

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
        draws[f"{name} (compensator)"] = (study.moves[:, i], _fits(study.compensator_units[i]), "")
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
