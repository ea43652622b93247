"""Plots of a sweep: tornado charts, curves with their spread, maps of pairs, budgets and allowances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import figure_of, new_figure, plain_text, png_bytes, styled
from .analysis import Allowance, Budget, Curve
from .table import SweepTable

_LOW, _HIGH = "#1f6fbf", "#c8322b"
_MARKS = ("#2f8f4e", "#e08a00", "#7a4fb5", "#3a3a3a")
# Parameters of a pair map, at most.
_PAIRS = 4


def tornado_plot(curves: Mapping[str, Sequence[Curve]]) -> bytes:
    """Draw the change of each metric over the range of each parameter, a panel a metric, the largest on top."""
    shown = {
        metric: [c for c in metric_curves if np.isfinite(c.change).any()] for metric, metric_curves in curves.items()
    }
    shown = {metric: metric_curves for metric, metric_curves in shown.items() if metric_curves}
    tallest = max(len(metric_curves) for metric_curves in shown.values())
    with styled():
        figure, panels = _panels(len(shown), 2, 5.6, 1.15 + 0.36 * tallest)
        for axes, (metric, metric_curves) in zip(panels.flat, shown.items(), strict=False):
            _draw_tornado(axes, metric, metric_curves)
        return png_bytes(figure)


def _panels(count: int, most: int, width: float, height: float, label: str = "") -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels of a size [inch]; with a label they have a common y axis."""
    columns = min(most, count)
    rows = -(-count // columns)
    figure = new_figure(width * columns, height * rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=bool(label))
    for axes in panels.flat[count:]:
        axes.axis("off")
    for axes in panels[:, 0]:
        axes.set_ylabel(label)
    return figure, panels


def _draw_tornado(axes: Axes, metric: str, curves: Sequence[Curve]) -> None:
    ordered = sorted(curves, key=lambda c: float(np.nanmax(np.abs(c.change))))
    names: dict[str, str] = {}
    for row, curve in enumerate(ordered):
        for sign, color in ((-1, _LOW), (1, _HIGH)):
            on_this_side = ((curve.value - curve.nominal) * sign > 0) & np.isfinite(curve.change)
            if on_this_side.any():
                side, errors = curve.change[on_this_side], curve.error[on_this_side]
                farthest = int(np.argmax(np.abs(side)))
                axes.barh(row, side[farthest], height=0.62, color=color, alpha=0.75)
                if np.isfinite(errors[farthest]):
                    # Bars to either side share a row: their errors stand a little apart.
                    bar: dict[str, Any] = {"fmt": "none", "ecolor": "0.15", "elinewidth": 1.0, "capsize": 2.5}
                    axes.errorbar(side[farthest], row + 0.12 * sign, xerr=errors[farthest], **bar)
        for mark, (_, change) in curve.marks.items():
            color = names.setdefault(mark, _MARKS[len(names) % len(_MARKS)])
            axes.plot([change, change], [row - 0.42, row + 0.42], color=color, linewidth=2.2, solid_capstyle="butt")
        low, high = curve.value.min(), curve.value.max()
        axes.annotate(
            f"{low:g} to {high:g}", (1.0, row), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=7, color="0.4",
        )  # fmt: skip
    axes.axvline(0.0, color="0.3", linewidth=0.8)
    axes.set_yticks(range(len(ordered)), [plain_text(c.parameter) for c in ordered])
    axes.set_title(metric, loc="left")
    axes.set_xlabel("change from nominal")
    axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 3))
    axes.grid(True, axis="x", color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    for mark, color in names.items():
        axes.plot([], [], color=color, linewidth=2.2, label=plain_text(mark))
    if names:
        axes.legend(loc="lower right")


def curves_plot(curves: Sequence[Curve]) -> bytes:
    """Draw one metric against each parameter, others nominal, with the spread over the replicas."""
    with styled():
        figure, panels = _panels(len(curves), 3, 3.7, 2.9, curves[0].metric)
        for axes, curve in zip(panels.flat, curves, strict=False):
            axes.plot(curve.value, curve.mean, "o-", color=_LOW, markersize=3.0, linewidth=1.2, label="mean")
            if np.isfinite(curve.spread).any():
                low, high = curve.mean - curve.spread, curve.mean + curve.spread
                axes.fill_between(
                    curve.value, low, high, color=_LOW, alpha=0.18, linewidth=0, label="replicas, 1 sigma"
                )
            for i, (mark, (value, _)) in enumerate(curve.marks.items()):
                axes.axvline(
                    value, color=_MARKS[i % len(_MARKS)], linewidth=1.0, linestyle="--", label=plain_text(mark)
                )
            axes.set_xlabel(plain_text(curve.parameter))
            axes.grid(True, color="0.92", linewidth=0.6)
        panels[0, 0].legend(loc="best")
        return png_bytes(figure)


def pairs_plot(table: SweepTable, metric: str, names: Sequence[str]) -> bytes:
    """Draw one metric over pairs of parameters, a dot a point of the sweep."""
    shown_names = list(names)[:_PAIRS]
    values = table.metrics[metric]
    with styled():
        n = len(shown_names) - 1
        figure = new_figure(2.7 * n + 1.2, 2.5 * n + 0.4)
        grid = figure.subplots(n, n, squeeze=False)
        low, high = np.nanpercentile(values, [2, 98])
        for i in range(n):
            for j in range(n):
                axes = grid[i, j]
                if j > i:
                    axes.axis("off")
                    continue
                x, y = (table.parameters[shown_names[k]].astype(float) for k in (j, i + 1))
                dots = axes.scatter(x, y, c=values, s=9, cmap="viridis", vmin=low, vmax=high, linewidths=0)
                if i == n - 1:
                    axes.set_xlabel(plain_text(shown_names[j]))
                if j == 0:
                    axes.set_ylabel(plain_text(shown_names[i + 1]))
        bar = figure_of(grid[0, 0]).colorbar(dots, ax=grid.ravel().tolist(), fraction=0.03, pad=0.02)
        bar.set_label(metric)
        return png_bytes(figure)


def scatter_plot(table: SweepTable, metric: str, names: Sequence[str]) -> bytes:
    """Draw one metric against each parameter of a random design, with median and quartiles in slices."""
    with styled():
        figure, panels = _panels(len(names), 3, 3.7, 2.9, metric)
        values = table.metrics[metric]
        for axes, name in zip(panels.flat, names, strict=False):
            x = table.parameters[name].astype(float)
            axes.plot(x, values, ".", color="0.65", markersize=2.5)
            edges = np.quantile(x, np.linspace(0.0, 1.0, 9))
            slices = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, 7)
            filled = [slices == k for k in range(8) if (slices == k).any()]
            middle = [np.median(x[inside]) for inside in filled]
            quartiles = np.array([np.nanpercentile(values[inside], [25, 50, 75]) for inside in filled])
            axes.plot(middle, quartiles[:, 1], "o-", color=_LOW, markersize=3.0, linewidth=1.2, label="median")
            axes.fill_between(
                middle, quartiles[:, 0], quartiles[:, 2], color=_LOW, alpha=0.2, linewidth=0, label="quartiles"
            )
            axes.set_xlabel(plain_text(name))
            axes.grid(True, color="0.92", linewidth=0.6)
        panels[0, 0].legend(loc="best")
        return png_bytes(figure)


def correlations_plot(correlations: Mapping[str, Mapping[str, tuple[float, float]]]) -> bytes:
    """Draw the rank correlation of each metric with each parameter of a random design as bars."""
    with styled():
        figure, panels = _panels(len(correlations), 2, 5.2, 1.0 + 0.34 * max(map(len, correlations.values())))
        for axes, (metric, metric_correlations) in zip(panels.flat, correlations.items(), strict=False):
            ordered = sorted(metric_correlations, key=lambda name: abs(metric_correlations[name][0]))
            rho, error = np.array([metric_correlations[name] for name in ordered]).T
            colors = [_HIGH if r > 0 else _LOW for r in rho]
            axes.barh(range(len(ordered)), rho, xerr=error, height=0.62, color=colors, alpha=0.75, ecolor="0.3")
            axes.set_yticks(range(len(ordered)), [plain_text(name) for name in ordered])
            axes.set_xlim(-1.05, 1.05)
            axes.axvline(0.0, color="0.3", linewidth=0.8)
            axes.set_title(metric, loc="left")
            axes.set_xlabel("rank correlation with the parameter")
        return png_bytes(figure)


def budget_plot(budgets: Sequence[Budget]) -> bytes:
    """Draw the sum of single effects beside the effect of all causes together, for each mark."""
    names = list(dict.fromkeys(name for budget in budgets for name in budget.changes))
    with styled():
        figure = new_figure(2.4 + 2.3 * len(budgets), 4.2)
        axes = figure.subplots()
        colors = _colors(len(names))
        for i, budget in enumerate(budgets):
            up, down = 0.0, 0.0
            for name, change in sorted(budget.changes.items(), key=lambda item: names.index(item[0])):
                base = up if change >= 0 else down
                label = plain_text(name) if i == 0 else None
                axes.bar(2.0 * i, change, 0.7, bottom=base, color=colors[names.index(name)], label=label)
                up, down = (up + change, down) if change >= 0 else (up, down + change)
            error = budget.together_error if np.isfinite(budget.together_error) else None
            axes.bar(2.0 * i + 0.8, budget.together, 0.7, yerr=error, color="0.75", edgecolor="0.3", ecolor="0.2")
        positions = [p for i in range(len(budgets)) for p in (2.0 * i, 2.0 * i + 0.8)]
        labels = [f"{plain_text(budget.mark)}\n{how}" for budget in budgets for how in ("one by one", "together")]
        axes.set_xticks(positions, labels, fontsize=7)
        axes.axhline(0.0, color="0.3", linewidth=0.8)
        axes.set_ylabel(f"change of {budgets[0].metric}")
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 3))
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        return png_bytes(figure)


def _colors(count: int) -> list[str]:
    """Return distinct colours."""
    palette = ("#1f6fbf", "#e08a00", "#2f8f4e", "#c8322b", "#7a4fb5", "#8a6d3b", "#3aa6a6", "#b05a8c")
    return [palette[i % len(palette)] for i in range(count)]


def allowance_plot(curves: Sequence[Curve], allowances: Sequence[Allowance], target: float) -> bytes:
    """Draw the change of xi against the size of each term in logarithms, and its intersection with the target."""
    colors = _colors(len(curves))
    with styled():
        figure = new_figure(6.8, 4.4)
        axes = figure.subplots()
        for curve, allowed, color in zip(curves, allowances, colors, strict=True):
            distance, rises = np.abs(curve.value - curve.nominal), curve.change > 0
            power = "" if np.isnan(allowed.power) else f", power {allowed.power:.2f}"
            label = plain_text(curve.parameter) + power
            axes.plot(
                distance[rises], curve.change[rises], "o-", color=color, markersize=3.0, linewidth=1.1, label=label
            )
            if np.isfinite(allowed.alone):
                axes.plot([allowed.alone], [target], "D", color=color, markersize=5.5)
        axes.axhline(target, color="0.2", linewidth=1.0, linestyle="--", label=f"target {target:g}")
        axes.axhline(target / len(curves), color="0.55", linewidth=1.0, linestyle=":", label="an equal share")
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="distance from nominal, in the parameter's own unit",
            ylabel=f"change of {curves[0].metric}",
        )
        axes.grid(True, which="both", color="0.93", linewidth=0.5)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        return png_bytes(figure)
