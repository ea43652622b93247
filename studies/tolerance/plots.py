"""Plots of a tolerance study: costs of single tolerances, and the yield curve."""

from __future__ import annotations

import numpy as np

from ...core.plotting import BLUE, GREY, ORANGE, RED, new_figure, plain_text, png_bytes, styled
from .study import ToleranceStudy

#: Tolerances in the picture, the costliest.
_SHOWN = 25


def sensitivity_plot(study: ToleranceStudy) -> bytes:
    """Draw the change of the merit at either end of the costliest tolerances."""
    shown = study.offenders[:_SHOWN][::-1]
    scale = study.merit.scale
    with styled():
        figure = new_figure(8.4, 1.4 + 0.24 * len(shown))
        axes = figure.subplots()
        rows = np.arange(len(shown))
        for values, color, name, height in (
            (study.lower, BLUE, "lower end", 0.7),
            (study.upper, RED, "upper end", 0.4),
        ):
            change = scale * (values[shown] - study.nominal)
            axes.barh(rows, change, height=height, color=color, alpha=0.8, label=name)
            for row in rows[np.isnan(change)]:
                axes.text(0.0, row, " light is lost", va="center", fontsize=7)
        labels = [
            f"{plain_text(t.name)} ± {t.size:.3g}{'' if u == '1' else f' {u}'}"
            for t, u in ((study.tolerances[i], study.units[i]) for i in shown)
        ]
        axes.set_yticks(rows, labels)
        axes.axvline(0.0, color=GREY, linewidth=0.8)
        axes.set_xlabel(f"change of the {study.merit.title}{_unit(study)}, compensated")
        axes.set_title(_title(study, f"{len(shown)} of {len(study.tolerances)} tolerances, the costliest on top"))
        axes.legend(loc="lower right")
        return png_bytes(figure)


def yield_plot(study: ToleranceStudy) -> bytes:
    """Draw the fraction of the telescopes that meet a requirement, against it, with its binomial error."""
    finite = np.unique(study.draws[np.isfinite(study.draws)])
    at = finite[np.unique(np.linspace(0, len(finite) - 1, min(len(finite), 200)).astype(int))]
    yields = [study.yield_at(float(v)) for v in at]
    scale = study.merit.scale
    with styled():
        figure = new_figure(6.4, 4.2)
        axes = figure.subplots()
        axes.plot(scale * at, [100 * y.fraction for y in yields], color=BLUE, label=f"{len(study.draws)} telescopes")
        limits = [100 * y.low for y in yields], [100 * y.high for y in yields]
        axes.fill_between(scale * at, *limits, color=BLUE, alpha=0.2, linewidth=0, label="binomial, 1 sigma")
        axes.axvline(scale * study.nominal, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed")
        if study.requirement is not None:
            found = study.yield_at(study.requirement)
            label = f"requirement: {100 * found.fraction:.1f} % ({100 * found.low:.1f} to {100 * found.high:.1f})"
            axes.axvline(scale * study.requirement, color=ORANGE, linewidth=1.2, label=label)
        axes.set(xlabel=f"requirement on the {study.merit.title}{_unit(study)}", ylabel="telescopes that meet it [%]")
        axes.set_ylim(0, 102)
        axes.grid(True, color="0.93", linewidth=0.5)
        axes.legend(loc="best")
        compensated = f", compensated by {', '.join(study.compensators)}" if study.compensators else ""
        axes.set_title(_title(study, f"{study.method}{compensated}"))
        return png_bytes(figure)


def _unit(study: ToleranceStudy) -> str:
    return f" [{study.merit.unit}]".replace("um", "µm") if study.merit.unit else ""


def _title(study: ToleranceStudy, text: str) -> str:
    return f"{plain_text(study.telescope)}: {plain_text(text)}"
