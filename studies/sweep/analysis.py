"""Analysis of a sweep: effects of single parameters, their sum, and allowances for a target of xi.

Points with one seed have random numbers in common. An effect is therefore taken within each replica first, then its
mean and standard error over the replicas.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata

from ...core.number_text import counted
from .file import Point, SweepFile
from .table import SweepTable, described_metric, is_compensator

#: Least number of values of a parameter for a curve.
_CURVE = 2


@dataclass(frozen=True)
class Curve:
    """One metric against one parameter, all others nominal; arrays have shape [n]."""

    parameter: str
    metric: str
    #: Values of the parameter, ascending.
    value: np.ndarray
    #: Mean of the metric over the replicas.
    mean: np.ndarray
    #: Standard deviation over the replicas; NaN with one replica.
    spread: np.ndarray
    #: Mean change from the nominal point, and its standard error over the replicas; NaN with one replica.
    change: np.ndarray
    error: np.ndarray
    #: Value and change of the marks among the values.
    marks: dict[str, tuple[float, float]]
    #: Nominal value of the parameter.
    nominal: float


@dataclass(frozen=True)
class Budget:
    """Single effects on one metric at one mark, and their sum."""

    metric: str
    mark: str
    #: Change by each parameter alone, the largest first, and their sum.
    changes: dict[str, float]
    total: float
    #: Change with all effects at once, and its standard error; NaN where it was not computed.
    together: float
    together_error: float
    #: Standard error of the sum less that change, which replicas have in common; NaN with one replica.
    difference_error: float


@dataclass(frozen=True)
class Allowance:
    """Allowed distance of one parameter from nominal, for a target of a metric."""

    parameter: str
    #: Exponent of the change against the distance from nominal.
    power: float
    #: Distance at which the parameter alone reaches the target; NaN where beyond twice the curve.
    alone: float
    #: The same for an equal fraction of the target for each parameter.
    shared: float
    #: Relative standard error of both distances; NaN with one replica.
    error: float


def curves(table: SweepTable, sweep: SweepFile, metric: str) -> list[Curve]:
    """Return a curve for each numeric parameter that was varied one at a time."""
    one_at_a_time_curves = []
    nominal = {name: p.nominal for name, p in sweep.parameters.items()}
    for name, parameter in sweep.parameters.items():
        if not _is_numeric(table, name):
            continue
        other_parameters = [n for n in table.parameters if n != name and n in nominal]
        alone = np.ones(len(table), dtype=bool)
        for parameter_name in other_parameters:
            alone &= table.parameters[parameter_name] == nominal[parameter_name]
        alone &= np.isfinite(table.metrics[metric])
        values = np.unique(table.parameters[name][alone].astype(float))
        if len(values) < _CURVE or parameter.nominal is None or float(parameter.nominal) not in values:
            continue
        seeds = np.unique(table.seed)
        grid = np.full((len(seeds), len(values)), np.nan)
        at = np.searchsorted(values, table.parameters[name][alone].astype(float))
        grid[np.searchsorted(seeds, table.seed[alone]), at] = table.metrics[metric][alone]
        change = grid - grid[:, [int(np.searchsorted(values, float(parameter.nominal)))]]
        mean, spread, _ = _over_replicas(grid)
        mean_change, _, error = _over_replicas(change)
        marks = {
            mark: (value, float(mean_change[values == value][0]))
            for mark, value in parameter.marks.items()
            if value in values
        }
        one_at_a_time_curves.append(
            Curve(name, metric, values, mean, spread, mean_change, error, marks, float(parameter.nominal))
        )
    return one_at_a_time_curves


def budget(table: SweepTable, sweep: SweepFile, metric: str, mark: str) -> Budget | None:
    """Return the budget of all parameters with a mark; None where there are none."""
    marked = {name: p.marks[mark] for name, p in sweep.parameters.items() if mark in p.marks}
    alone = {curve.parameter: curve.marks[mark][1] for curve in curves(table, sweep, metric) if mark in curve.marks}
    if not alone:
        return None
    nominal = {name: p.nominal for name, p in sweep.parameters.items()}
    changes, differences = [], []
    for seed in np.unique(table.seed):
        without = _metric_at(table, nominal, seed, metric)
        changes.append(_metric_at(table, {**nominal, **marked}, seed, metric) - without)
        single = [_metric_at(table, {**nominal, name: marked[name]}, seed, metric) - without for name in alone]
        differences.append(sum(single) - changes[-1])
    together, _, error = (float(v[0]) for v in _over_replicas(np.array(changes)[:, None]))
    difference_error = float(_over_replicas(np.array(differences)[:, None])[2][0])
    ordered = dict(sorted(alone.items(), key=lambda item: -abs(item[1])))
    return Budget(metric, mark, ordered, float(sum(alone.values())), together, error, difference_error)


def allowances(metric_curves: Sequence[Curve], target: float) -> list[Allowance]:
    """Return the allowance of each parameter for a growth of the metric up to a target.

    The change is a power of the distance from nominal, fitted to the outer half of the curve, where it is largest. The
    error is to first order, from that of the change at the farthest point.
    """
    allowances_of_curves = []
    for curve in metric_curves:
        distance = np.abs(curve.value - curve.nominal)
        outer = (distance >= 0.5 * distance.max()) & (curve.change > 0)
        if outer.sum() < 2 or len(np.unique(distance[outer])) < 2:
            allowances_of_curves.append(Allowance(curve.parameter, np.nan, np.nan, np.nan, np.nan))
            continue
        power, intercept = np.polyfit(np.log(distance[outer]), np.log(curve.change[outer]), 1)
        bounds = []
        for goal in (target, target / len(metric_curves)):
            reach = float(np.exp((np.log(goal) - intercept) / power)) if power > 0 else np.nan
            # The power law holds near the computed points only.
            bounds.append(reach if reach <= 2.0 * distance.max() else np.nan)
        # Replicas move the whole curve: its relative error over the power is that of the distance.
        last = int(np.flatnonzero(outer)[np.argmax(distance[outer])])
        error = float(curve.error[last] / curve.change[last] / power) if power > 0 else np.nan
        alone, shared = bounds
        allowances_of_curves.append(Allowance(curve.parameter, float(power), alone, shared, error))
    return allowances_of_curves


def rank_correlations(table: SweepTable, metric: str) -> dict[str, tuple[float, float]]:
    """Return Spearman's rank correlation of a metric with each numeric parameter, and its standard error."""
    correlations = {}
    good = np.isfinite(table.metrics[metric])
    for name in table.parameters:
        if not _is_numeric(table, name) or good.sum() < 4:
            continue
        values = table.parameters[name][good].astype(float)
        if np.ptp(values) == 0.0 or np.ptp(table.metrics[metric][good]) == 0.0:
            continue
        rho = float(np.corrcoef(rankdata(values), rankdata(table.metrics[metric][good]))[0, 1])
        correlations[name] = (rho, float((1.0 - rho**2) / np.sqrt(good.sum() - 1)))
    return correlations


def summary(table: SweepTable, sweep: SweepFile) -> dict[str, Any]:
    """Return the content of the report as plain numbers."""
    marks = list(dict.fromkeys(mark for p in sweep.parameters.values() for mark in p.marks))
    metrics: dict[str, Any] = {}
    for metric in table.metrics:
        metric_curves = curves(table, sweep, metric)
        entry: dict[str, Any] = {
            "range": [float(np.nanmin(table.metrics[metric])), float(np.nanmax(table.metrics[metric]))]
            if np.isfinite(table.metrics[metric]).any()
            else None,
            "largest_change": {c.parameter: float(c.change[np.nanargmax(np.abs(c.change))]) for c in metric_curves},
            "rank_correlation": {name: rho for name, (rho, _) in rank_correlations(table, metric).items()},
        }
        for mark in marks:
            added = budget(table, sweep, metric, mark)
            if added is not None:
                entry[f"budget_{mark}"] = {
                    **added.changes,
                    "sum": added.total,
                    "together": added.together,
                    "together_error": added.together_error,
                }
        if sweep.xi_target is not None and metric.startswith("xi"):
            entry["allowance"] = {
                a.parameter: {"power": a.power, "alone": a.alone, "shared": a.shared, "error": a.error}
                for a in allowances(metric_curves, sweep.xi_target)
            }
        metrics[metric] = entry
    return {
        "name": sweep.name,
        "points": len(table),
        "failed": int((table.problem != "").sum()),
        "replicas": sweep.design.replicas,
        "metrics": metrics,
    }


def in_order(metrics: Iterable[str]) -> list[str]:
    """Return metrics in the order of reports: correlations, the purpose of most sweeps, first, compensators last."""
    return sorted(metrics, key=lambda name: (is_compensator(name), not name.startswith("xi"), name))


def verdict(summary: dict[str, Any]) -> str:
    """Return the result of a sweep in one sentence: the parameter that matters most for its first metric."""
    failed, points = summary["failed"], summary["points"]
    lost = f" {failed} of {points} points could not be computed." if failed else ""
    metrics = {metric: entry for metric, entry in summary["metrics"].items() if entry["range"] is not None}
    if not metrics:
        return f"No metric has a value at any of the {points - failed} computed points.{lost}"
    for metric in in_order(metrics):
        unit = described_metric(metric)[0]
        for key, form, words in (
            ("largest_change", ".3g", "which it changes by up to"),
            ("rank_correlation", ".2f", "with a rank correlation of"),
        ):
            effects = {name: size for name, size in metrics[metric][key].items() if np.isfinite(size) and size}
            if not effects:
                continue
            (first, size), *smaller_effects = sorted(effects.items(), key=lambda item: -abs(item[1]))
            of_unit = f" {unit}" if unit and key == "largest_change" else ""
            second = (
                f"; next is {smaller_effects[0][0]} with {smaller_effects[0][1]:+{form}}{of_unit}"
                if smaller_effects
                else ""
            )
            matters = "matters most for" if len(metrics[metric][key]) > 1 else "is the one parameter of"
            return f"{first} {matters} {metric}, {words} {size:+{form}}{of_unit}{second}.{lost}"
        low, high = metrics[metric]["range"]
        if low < high and not (metrics[metric]["largest_change"] or metrics[metric]["rank_correlation"]):
            # Few points, or parameters that are no numbers.
            span = f"{metric} goes from {low:.4g} to {high:.4g}{f' {unit}' if unit else ''}"
            return f"{span} over the {counted(points - failed, 'computed point')}, which do not tell why.{lost}"
    return f"No parameter changes a metric over the {counted(points - failed, 'computed point')}.{lost}"


def _is_numeric(table: SweepTable, name: str) -> bool:
    return all(isinstance(v, (int, float, np.number)) and not isinstance(v, bool) for v in table.parameters[name])


def _over_replicas(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, standard deviation and standard error over the first axis, without missing values."""
    count = np.isfinite(values).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, np.nansum(values, axis=0) / count, np.nan)
        squares = np.nansum((values - mean) ** 2, axis=0)
        spread = np.where(count > 1, np.sqrt(squares / (count - 1)), np.nan)
        return mean, spread, spread / np.sqrt(count)


def _metric_at(table: SweepTable, point: Point, seed: int, metric: str) -> float:
    """Return the metric of one point; NaN where it was not computed."""
    matching_rows = table.seed == seed
    for name, value in point.items():
        if name in table.parameters:
            matching_rows &= table.parameters[name] == value
    return float(table.metrics[metric][matching_rows][0]) if matching_rows.any() else np.nan
