"""Plots of a tolerance study: costs and limits of single tolerances, the drawn merits, and the yield curve."""

from __future__ import annotations

import numpy as np

from ...core.plotting import BLUE, GREY, ORANGE, RED, new_figure, png_bytes, styled
from .result import SHOWN, ToleranceStudy, merit_unit, name_rows, study_title


def inverse_plot(study: ToleranceStudy) -> bytes:
    """Draw the size that costs the stated loss over the size of each of the costliest tolerances."""
    shown = study.offenders[:SHOWN][::-1]
    ratio = study.inverse[shown] / np.array([study.tolerances[i].size for i in shown])
    finite = np.isfinite(ratio)
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

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
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
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
