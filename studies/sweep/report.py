"""Report of a sweep: an HTML file with plots, and the metrics as JSON."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...core.errors import ProductError
from ...core.file_names import file_name
from ...core.files import make_folder, write_bytes, write_json
from ...core.page import Picture, render, with_digits, with_error
from ...pipeline.report.report import TEMPLATES
from . import plots
from .analysis import Budget, Curve, allowances, budget, curves, in_order, rank_correlations, summary, verdict
from .file import SweepFile
from .store import SweepStore
from .table import SweepTable, described_metric, described_parameter, read_table

# Number of metrics with plots of their own; all are in the tornado chart and in the table.
_SHOWN = 4
# Least number of points of a random design for slices.
_ENOUGH = 24


def write_report(store: SweepStore, folder: Path) -> Path:
    """Write ``report.html``, ``summary.json`` and the plots of a sweep, and return the path of the report."""
    table, sweep = read_table(store), store.sweep
    if not len(table) or not table.metrics:
        raise ProductError(f"{store.path}: no point has been computed yet")
    make_folder(folder)
    metrics = summary(table, sweep)
    pictures = sweep_pictures(table, sweep)
    for name, picture in pictures:
        write_bytes(folder / f"{file_name(name)}.png", picture.data)
    write_json(folder / "summary.json", {**metrics, "pachon": store.about["pachon"], "digest": store.about["digest"]})
    page = render(
        TEMPLATES,
        "sweep.html",
        sweep=sweep,
        summary=metrics,
        verdict=verdict(metrics),
        pictures=[picture for _, picture in pictures],
        pachon=store.about["pachon"],
        points=len(store.points()),
        rows=_metric_rows(table, sweep),
        parameters={name: described_parameter(name) for name in sweep.parameters},
        problems=[(int(n), p) for n, p in zip(table.number, table.problem, strict=True) if p][:20],
    )
    report = folder / "report.html"
    write_bytes(report, page.encode())
    return report


def sweep_pictures(table: SweepTable, sweep: SweepFile) -> list[tuple[str, Picture]]:
    """Return the plots for the design of a sweep, with the names of their files."""
    drawn = {metric: curves(table, sweep, metric) for metric in in_order(table.metrics)}
    drawn = {metric: metric_curves for metric, metric_curves in drawn.items() if metric_curves}
    pictures = list(_one_at_a_time(table, sweep, drawn)) if drawn else []
    numeric = [n for n, v in table.parameters.items() if v.dtype.kind in "fi" and len(np.unique(v)) > 2]
    if sweep.design.kind != "one_at_a_time" and len(table) >= _ENOUGH and numeric:
        pictures += _random_pictures(table, numeric)
    return pictures


def _one_at_a_time(table: SweepTable, sweep: SweepFile, drawn: dict[str, list[Curve]]) -> Iterator[tuple[str, Picture]]:
    text = (
        "Change of each metric from its nominal value over the range of each parameter, others nominal: blue below the "
        "nominal value of the parameter, red above. Vertical strokes are the marks. Error bars: standard error of the "
        "mean over the replicas, which share their random numbers with the nominal point; none with one replica. Grey: "
        "range of the parameter, in the unit at the end of its name. The last tables define parameters and metrics."
    )
    yield "tornado", Picture("What matters most", plots.tornado_plot(drawn), text)
    for metric in list(drawn)[:_SHOWN]:
        text = (
            f"{_defined(metric)} Against each parameter, the others nominal; the band is the spread over the replicas."
        )
        yield f"curves_{metric}", Picture(f"{metric}, one at a time", plots.curves_plot(drawn[metric]), text)
    marks = list(dict.fromkeys(mark for p in sweep.parameters.values() for mark in p.marks))
    correlated = [m for m in drawn if m.startswith("xi")]
    for metric in correlated:
        budgets = [b for mark in marks if (b := budget(table, sweep, metric, mark)) is not None]
        if budgets:
            picture = Picture(f"Error budget of {metric}", plots.budget_plot(budgets), _budget_text(budgets))
            yield f"budget_{metric}", picture
    if sweep.xi_target is not None:
        # A metric that no parameter raises, such as xi of a single CCD, cannot be drawn on logarithmic axes.
        for metric in (m for m in correlated if any(np.any(curve.change > 0) for curve in drawn[m])):
            allowed = allowances(drawn[metric], sweep.xi_target)
            allowance_texts = (f"{a.parameter}: {with_error(a.alone, a.error * a.alone)} alone, "
                    f"{with_error(a.shared, a.error * a.shared)} with an equal share"
                    for a in allowed if np.isfinite(a.alone))  # fmt: skip
            title = f"Allowance of each term for {metric} below {sweep.xi_target:g}"
            plot = plots.allowance_plot(drawn[metric], allowed, sweep.xi_target)
            text = (
                f"{_defined(metric)} Distance of each parameter from nominal that raises it by the target (diamonds), "
                "or by an equal share of it, with the standard error over the replicas. Power: exponent of the change "
                "against the distance. "
                + ("; ".join(allowance_texts) or "No term reaches the target within twice its range")
                + "."
            )
            yield f"allowance_{metric}", Picture(title, plot, text)


def _defined(metric: str) -> str:
    """Return the definition of a metric as a sentence."""
    unit, text = described_metric(metric)
    return f"{metric}: {text}{f' [{unit}]' if unit else ''}." if text else f"{metric}."


def _budget_text(budgets: list[Budget]) -> str:
    """Return a sentence on the sum of the effects at each mark."""
    texts = []
    for effects in budgets:
        if np.isfinite(effects.together) and effects.total:
            apart = abs(effects.together - effects.total)
            # Equal within two standard errors, or a tenth for one replica.
            limit, rounding = 2.0 * effects.difference_error, 1e-9 * abs(effects.total)
            same = apart <= (max(limit, rounding) if np.isfinite(limit) else 0.1 * abs(effects.total))
            texts.append(
                f"{effects.mark}: single effects sum to {with_digits(effects.total, effects.together_error)}, all at "
                f"once make {with_error(effects.together, effects.together_error)}: "
                + ("they add, as far as this tells." if same else "they do not simply add.")
            )
    return (
        f"{_defined(budgets[0].metric)} Its change at each named value of all parameters, one by one and together "
        "(grey, with the standard error over the replicas). Independent errors add in their squares, which xi is made "
        "of. "
    ) + " ".join(texts)


def _random_pictures(table: SweepTable, numeric: list[str]) -> Iterator[tuple[str, Picture]]:
    ranks = {metric: rank_correlations(table, metric) for metric in in_order(table.metrics)}
    ranks = {metric: metric_ranks for metric, metric_ranks in ranks.items() if metric_ranks}
    if not ranks:
        return
    text = "Spearman's rank correlation of each metric with each parameter, all of them varied at once."
    yield "ranks", Picture("What matters most", plots.correlations_plot(ranks), text)
    for metric in list(ranks)[:_SHOWN]:
        names = sorted(ranks[metric], key=lambda n: -abs(ranks[metric][n][0]))
        text = (
            f"{_defined(metric)} Dots are points; the line joins the medians of eight slices, the band their quartiles."
        )
        yield f"scatter_{metric}", Picture(metric, plots.scatter_plot(table, metric, names), text)
        if len(names) > 1:
            text = f"{metric} over pairs of the parameters that it depends on most."
            yield f"pairs_{metric}", Picture(f"{metric} over pairs", plots.pairs_plot(table, metric, names), text)


def _metric_rows(table: SweepTable, sweep: SweepFile) -> list[dict[str, str]]:
    """Return range and median of each metric, and its scatter over the replicas, with the digits that it allows."""
    rows = []
    for name, values in table.metrics.items():
        if not np.isfinite(values).any():
            continue
        spreads = [c.spread[np.isfinite(c.spread)] for c in curves(table, sweep, name)]
        finite_values = np.concatenate([np.empty(0), *spreads])
        scatter = float(np.median(finite_values)) if finite_values.size else np.nan
        low, middle, high = (float(f(values)) for f in (np.nanmin, np.nanmedian, np.nanmax))
        texts = {"low": low, "median": middle, "high": high}
        rows.append(
            {"name": name, "unit": described_metric(name).unit, "meaning": described_metric(name).text}
            | {"scatter": f"{scatter:.1e}" if scatter > 0.0 else "-"}
            | {key: with_digits(value, scatter) for key, value in texts.items()}
        )
    return rows
