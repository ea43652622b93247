"""What a sweep says: effects of single parameters, how they add, and what each may be for a stated xi.

Points with one seed have random numbers in common, so an effect is taken within each replica first, and its mean and
its standard error over the replicas after that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata

from .file import SweepFile
from .table import SweepTable

#: Points that vary one numeric parameter at least so many times have a curve.
_CURVE = 2


@dataclass(frozen=True)
class Curve:
    """One figure against one parameter, all others nominal.

    Attributes
    ----------
    parameter, metric : str
        What is varied, and what is measured.
    value : ndarray, shape [n]
        Values of the parameter, ascending.
    mean, error : ndarray, shape [n]
        Mean of the figure over the replicas, and the standard error of its change from nominal; NaN with one replica.
    spread : ndarray, shape [n]
        Standard deviation of the figure over the replicas; NaN with one.
    change : ndarray, shape [n]
        Mean change from the nominal point.
    marks : dict of str to (value, change)
        The named values that are among them.
    nominal : float
        Value of the nominal point.
    """

    parameter: str
    metric: str
    value: np.ndarray
    mean: np.ndarray
    error: np.ndarray
    spread: np.ndarray
    change: np.ndarray
    marks: dict[str, tuple[float, float]]
    nominal: float


@dataclass(frozen=True)
class BudgetLine:
    """Effect of one cause on one figure at one mark.

    Attributes
    ----------
    parameter : str
        The cause.
    value : float
        Its value there.
    change, error : float
        Change of the figure by it alone, and the standard error over the replicas.
    share : float
        Of the sum of all single changes.
    """

    parameter: str
    value: float
    change: float
    error: float
    share: float


@dataclass(frozen=True)
class Budget:
    """How single effects add at one mark.

    Attributes
    ----------
    metric, mark : str
        What is measured, and at which named values.
    lines : tuple of BudgetLine
        Largest effect first.
    total : float
        Sum of the single changes.
    together, together_error : float
        Change with all of them at once, and its standard error; NaN where that was not computed.
    """

    metric: str
    mark: str
    lines: tuple[BudgetLine, ...]
    total: float
    together: float
    together_error: float


@dataclass(frozen=True)
class Allowance:
    """What one parameter may be for a target.

    Attributes
    ----------
    parameter : str
        The parameter.
    power : float
        Exponent of the change against the distance from nominal, fitted over the curve.
    alone : float
        Distance from nominal at which it reaches the target alone; NaN where it never does within twice the curve.
    shared : float
        The same for an equal share of the target between all parameters.
    """

    parameter: str
    power: float
    alone: float
    shared: float


def curves(table: SweepTable, sweep: SweepFile, metric: str) -> list[Curve]:
    """Return one curve for each numeric parameter that was varied one at a time."""
    found = []
    nominal = {name: p.nominal for name, p in sweep.parameters.items()}
    for name, parameter in sweep.parameters.items():
        if not _numeric(table, name):
            continue
        others = [n for n in table.parameters if n != name and n in nominal]
        alone = np.ones(len(table), dtype=bool)
        for other in others:
            alone &= table.parameters[other] == nominal[other]
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
        found.append(Curve(name, metric, values, mean, error, spread, mean_change, marks, float(parameter.nominal)))
    return found


def budget(table: SweepTable, sweep: SweepFile, metric: str, mark: str) -> Budget | None:
    """Return how the effects of all parameters with that mark add; None where there are none."""
    marked = {name: p.marks[mark] for name, p in sweep.parameters.items() if mark in p.marks}
    lines = []
    for curve in curves(table, sweep, metric):
        if mark in curve.marks:
            value, change = curve.marks[mark]
            error = float(curve.error[curve.value == value][0])
            lines.append(BudgetLine(curve.parameter, value, change, error, np.nan))
    if not lines:
        return None
    total = sum(line.change for line in lines)
    lines = [BudgetLine(n.parameter, n.value, n.change, n.error, n.change / total if total else np.nan) for n in lines]
    nominal = {name: p.nominal for name, p in sweep.parameters.items()}
    changes = []
    for seed in np.unique(table.seed):
        with_all = _at(table, {**nominal, **marked}, seed, metric)
        without = _at(table, nominal, seed, metric)
        changes.append(with_all - without)
    together, _, error = (float(v[0]) for v in _over_replicas(np.array(changes)[:, None]))
    ordered = tuple(sorted(lines, key=lambda line: -abs(line.change)))
    return Budget(metric, mark, ordered, float(total), together, error)


def allowances(found: Sequence[Curve], target: float) -> list[Allowance]:
    """Return what each parameter may be for a figure not to grow by more than a target.

    The change is taken as a power of the distance from nominal, fitted to the larger half of the curve, where it stands
    out of what other causes do.
    """
    each = []
    for curve in found:
        distance = np.abs(curve.value - curve.nominal)
        outer = (distance >= 0.5 * distance.max()) & (curve.change > 0)
        if outer.sum() < 2 or len(np.unique(distance[outer])) < 2:
            each.append(Allowance(curve.parameter, np.nan, np.nan, np.nan))
            continue
        power, intercept = np.polyfit(np.log(distance[outer]), np.log(curve.change[outer]), 1)
        bounds = []
        for goal in (target, target / len(found)):
            reach = float(np.exp((np.log(goal) - intercept) / power)) if power > 0 else np.nan
            # A power law says nothing far beyond what was computed.
            bounds.append(reach if reach <= 2.0 * distance.max() else np.nan)
        each.append(Allowance(curve.parameter, float(power), *bounds))
    return each


def rank_correlations(table: SweepTable, metric: str) -> dict[str, tuple[float, float]]:
    """Return Spearman's rank correlation of a figure with each numeric parameter, and its standard error.

    For random designs, in which all parameters vary at once.
    """
    found = {}
    good = np.isfinite(table.metrics[metric])
    for name in table.parameters:
        if not _numeric(table, name) or good.sum() < 4:
            continue
        values = table.parameters[name][good].astype(float)
        if np.ptp(values) == 0.0 or np.ptp(table.metrics[metric][good]) == 0.0:
            continue
        rho = float(np.corrcoef(rankdata(values), rankdata(table.metrics[metric][good]))[0, 1])
        found[name] = (rho, float((1.0 - rho**2) / np.sqrt(good.sum() - 1)))
    return found


def summary(table: SweepTable, sweep: SweepFile) -> dict[str, Any]:
    """Return what the report says as plain numbers."""
    marks = list(dict.fromkeys(mark for p in sweep.parameters.values() for mark in p.marks))
    figures: dict[str, Any] = {}
    for metric in table.metrics:
        found = curves(table, sweep, metric)
        entry: dict[str, Any] = {
            "range": [float(np.nanmin(table.metrics[metric])), float(np.nanmax(table.metrics[metric]))]
            if np.isfinite(table.metrics[metric]).any()
            else None,
            "largest_change": {c.parameter: float(c.change[np.nanargmax(np.abs(c.change))]) for c in found},
            "rank_correlation": {name: rho for name, (rho, _) in rank_correlations(table, metric).items()},
        }
        for mark in marks:
            added = budget(table, sweep, metric, mark)
            if added is not None:
                entry[f"budget_{mark}"] = {
                    **{line.parameter: line.change for line in added.lines},
                    "sum": added.total,
                    "together": added.together,
                }
        if sweep.xi_target is not None and metric.startswith("xi"):
            entry["allowance"] = {
                a.parameter: {"power": a.power, "alone": a.alone, "shared": a.shared}
                for a in allowances(found, sweep.xi_target)
            }
        figures[metric] = entry
    return {
        "name": sweep.name,
        "points": len(table),
        "failed": int((table.problem != "").sum()),
        "replicas": sweep.design.replicas,
        "metrics": figures,
    }


def _numeric(table: SweepTable, name: str) -> bool:
    return all(isinstance(v, (int, float, np.number)) and not isinstance(v, bool) for v in table.parameters[name])


def _over_replicas(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, standard deviation and standard error of the mean over the first axis, missing values left out."""
    count = np.isfinite(values).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, np.nansum(values, axis=0) / count, np.nan)
        squares = np.nansum((values - mean) ** 2, axis=0)
        spread = np.where(count > 1, np.sqrt(squares / (count - 1)), np.nan)
        return mean, spread, spread / np.sqrt(count)


def _at(table: SweepTable, point: dict[str, Any], seed: int, metric: str) -> float:
    """Return the figure of one point; NaN where it was not computed."""
    here = table.seed == seed
    for name, value in point.items():
        if name in table.parameters:
            here &= table.parameters[name] == value
    return float(table.metrics[metric][here][0]) if here.any() else np.nan
