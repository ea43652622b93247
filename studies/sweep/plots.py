"""Pictures of a sweep: tornado charts, curves with their spread, maps of pairs, budgets and allowances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from ...core.plotting import figure_of, new_figure, png_bytes, styled
from .analysis import Allowance, Budget, Curve
from .table import SweepTable

_LOW, _HIGH = "#1f6fbf", "#c8322b"
_MARKS = ("#2f8f4e", "#e08a00", "#7a4fb5", "#3a3a3a")
# Parameters of a pair map, at most.
_PAIRS = 4


def tornado_figure(curves: Mapping[str, Sequence[Curve]]) -> bytes:
    """Draw how far each figure moves over the range of each parameter, a panel a figure, the largest on top.

    Parameters
    ----------
    curves : mapping of str to sequence of Curve
        Curves of each figure.
    """
    shown = {metric: [c for c in each if np.isfinite(c.change).any()] for metric, each in curves.items()}
    shown = {metric: each for metric, each in shown.items() if each}
    tallest = max(len(each) for each in shown.values())
    with styled():
        columns = min(2, len(shown))
        rows = -(-len(shown) // columns)
        figure = new_figure(5.6 * columns, (1.15 + 0.36 * tallest) * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        for axes, (metric, each) in zip(panels, shown.items(), strict=False):
            _draw_tornado(axes, metric, each)
        for axes in panels[len(shown) :]:
            axes.axis("off")
        return png_bytes(figure)


def _draw_tornado(axes: Axes, metric: str, curves: Sequence[Curve]) -> None:
    ordered = sorted(curves, key=lambda c: float(np.nanmax(np.abs(c.change))))
    names: dict[str, str] = {}
    for row, curve in enumerate(ordered):
        for sign, color in ((-1, _LOW), (1, _HIGH)):
            side = curve.change[(curve.value - curve.nominal) * sign > 0]
            if side.size:
                end = float(side[np.nanargmax(np.abs(side))]) if np.isfinite(side).any() else 0.0
                axes.barh(row, end, height=0.62, color=color, alpha=0.75)
        for mark, (_, change) in curve.marks.items():
            color = names.setdefault(mark, _MARKS[len(names) % len(_MARKS)])
            axes.plot([change, change], [row - 0.42, row + 0.42], color=color, linewidth=2.2, solid_capstyle="butt")
        low, high = curve.value.min(), curve.value.max()
        axes.annotate(
            f"{low:g} to {high:g}", (1.0, row), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=7, color="0.4",
        )  # fmt: skip
    axes.axvline(0.0, color="0.3", linewidth=0.8)
    axes.set_yticks(range(len(ordered)), [c.parameter for c in ordered])
    axes.set_title(metric, loc="left")
    axes.set_xlabel("change from nominal")
    axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 3))
    axes.grid(True, axis="x", color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    for mark, color in names.items():
        axes.plot([], [], color=color, linewidth=2.2, label=mark)
    if names:
        axes.legend(loc="lower right")


def curves_figure(curves: Sequence[Curve]) -> bytes:
    """Draw one figure against each parameter, others nominal, with the spread over the replicas."""
    with styled():
        columns = min(3, len(curves))
        rows = -(-len(curves) // columns)
        figure = new_figure(3.7 * columns, 2.9 * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False, sharey=True)).ravel()
        for axes, curve in zip(panels, curves, strict=False):
            axes.plot(curve.value, curve.mean, "o-", color=_LOW, markersize=3.0, linewidth=1.2, label="mean")
            if np.isfinite(curve.spread).any():
                low, high = curve.mean - curve.spread, curve.mean + curve.spread
                axes.fill_between(
                    curve.value, low, high, color=_LOW, alpha=0.18, linewidth=0, label="replicas, 1 sigma"
                )
            for i, (mark, (value, _)) in enumerate(curve.marks.items()):
                axes.axvline(value, color=_MARKS[i % len(_MARKS)], linewidth=1.0, linestyle="--", label=mark)
            axes.set_xlabel(curve.parameter)
            axes.grid(True, color="0.92", linewidth=0.6)
        for axes in panels[len(curves) :]:
            axes.axis("off")
        for row in range(rows):
            panels[row * columns].set_ylabel(curves[0].metric)
        panels[0].legend(loc="best")
        return png_bytes(figure)


def pairs_figure(table: SweepTable, metric: str, names: Sequence[str]) -> bytes:
    """Draw one figure over pairs of parameters, a point a point of the sweep."""
    chosen = list(names)[:_PAIRS]
    values = table.metrics[metric]
    with styled():
        n = len(chosen) - 1
        figure = new_figure(2.7 * n + 1.2, 2.5 * n + 0.4)
        grid = figure.subplots(n, n, squeeze=False)
        low, high = np.nanpercentile(values, [2, 98])
        for i in range(n):
            for j in range(n):
                axes = grid[i, j]
                if j > i:
                    axes.axis("off")
                    continue
                x, y = (table.parameters[chosen[k]].astype(float) for k in (j, i + 1))
                dots = axes.scatter(x, y, c=values, s=9, cmap="viridis", vmin=low, vmax=high, linewidths=0)
                if i == n - 1:
                    axes.set_xlabel(chosen[j])
                if j == 0:
                    axes.set_ylabel(chosen[i + 1])
        bar = figure_of(grid[0, 0]).colorbar(dots, ax=grid.ravel().tolist(), fraction=0.03, pad=0.02)
        bar.set_label(metric)
        return png_bytes(figure)


def scatter_figure(table: SweepTable, metric: str, names: Sequence[str]) -> bytes:
    """Draw one figure against each parameter of a random design, with the median and the quartiles in slices."""
    with styled():
        columns = min(3, len(names))
        rows = -(-len(names) // columns)
        figure = new_figure(3.7 * columns, 2.9 * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False, sharey=True)).ravel()
        values = table.metrics[metric]
        for axes, name in zip(panels, names, strict=False):
            x = table.parameters[name].astype(float)
            axes.plot(x, values, ".", color="0.65", markersize=2.5)
            edges = np.quantile(x, np.linspace(0.0, 1.0, 9))
            slices = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, 7)
            middle = [np.median(x[slices == k]) for k in range(8) if (slices == k).any()]
            quartiles = np.array(
                [np.nanpercentile(values[slices == k], [25, 50, 75]) for k in range(8) if (slices == k).any()]
            )
            axes.plot(middle, quartiles[:, 1], "o-", color=_LOW, markersize=3.0, linewidth=1.2, label="median")
            axes.fill_between(
                middle, quartiles[:, 0], quartiles[:, 2], color=_LOW, alpha=0.2, linewidth=0, label="quartiles"
            )
            axes.set_xlabel(name)
            axes.grid(True, color="0.92", linewidth=0.6)
        for axes in panels[len(names) :]:
            axes.axis("off")
        for row in range(rows):
            panels[row * columns].set_ylabel(metric)
        panels[0].legend(loc="best")
        return png_bytes(figure)


def correlations_figure(found: Mapping[str, Mapping[str, tuple[float, float]]]) -> bytes:
    """Draw the rank correlation of each figure with each parameter of a random design as a chart of bars."""
    with styled():
        columns = min(2, len(found))
        rows = -(-len(found) // columns)
        tallest = max(len(each) for each in found.values())
        figure = new_figure(5.2 * columns, (1.0 + 0.34 * tallest) * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        for axes, (metric, each) in zip(panels, found.items(), strict=False):
            ordered = sorted(each, key=lambda name: abs(each[name][0]))
            rho, error = np.array([each[name] for name in ordered]).T
            colors = [_HIGH if r > 0 else _LOW for r in rho]
            axes.barh(range(len(ordered)), rho, xerr=error, height=0.62, color=colors, alpha=0.75, ecolor="0.3")
            axes.set_yticks(range(len(ordered)), ordered)
            axes.set_xlim(-1.05, 1.05)
            axes.axvline(0.0, color="0.3", linewidth=0.8)
            axes.set_title(metric, loc="left")
            axes.set_xlabel("rank correlation with the parameter")
        for axes in panels[len(found) :]:
            axes.axis("off")
        return png_bytes(figure)


def budget_figure(budgets: Sequence[Budget]) -> bytes:
    """Draw how the effects of single causes add up, a column a named set of values, beside all of them at once."""
    names = list(dict.fromkeys(line.parameter for budget in budgets for line in budget.lines))
    with styled():
        figure = new_figure(2.4 + 2.3 * len(budgets), 4.2)
        axes = figure.subplots()
        colors = figure_colors(len(names))
        for i, budget in enumerate(budgets):
            up, down = 0.0, 0.0
            for line in sorted(budget.lines, key=lambda n: names.index(n.parameter)):
                base = up if line.change >= 0 else down
                label = line.parameter if i == 0 else None
                axes.bar(2.0 * i, line.change, 0.7, bottom=base, color=colors[names.index(line.parameter)], label=label)
                up, down = (up + line.change, down) if line.change >= 0 else (up, down + line.change)
            error = budget.together_error if np.isfinite(budget.together_error) else None
            axes.bar(2.0 * i + 0.8, budget.together, 0.7, yerr=error, color="0.75", edgecolor="0.3", ecolor="0.2")
        positions = [p for i in range(len(budgets)) for p in (2.0 * i, 2.0 * i + 0.8)]
        labels = [text for budget in budgets for text in (f"{budget.mark}\none by one", f"{budget.mark}\ntogether")]
        axes.set_xticks(positions, labels, fontsize=7)
        axes.axhline(0.0, color="0.3", linewidth=0.8)
        axes.set_ylabel(f"change of {budgets[0].metric}")
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 3))
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        return png_bytes(figure)


def figure_colors(count: int) -> list[str]:
    """Return so many colours that are easy to tell apart."""
    palette = ("#1f6fbf", "#e08a00", "#2f8f4e", "#c8322b", "#7a4fb5", "#8a6d3b", "#3aa6a6", "#b05a8c")
    return [palette[i % len(palette)] for i in range(count)]


def allowance_figure(curves: Sequence[Curve], allowances: Sequence[Allowance], target: float) -> bytes:
    """Draw the change of xi against the size of each term, in logarithms, and where it meets the target."""
    colors = figure_colors(len(curves))
    with styled():
        figure = new_figure(6.8, 4.4)
        axes = figure.subplots()
        for curve, allowed, color in zip(curves, allowances, colors, strict=True):
            distance, rises = np.abs(curve.value - curve.nominal), curve.change > 0
            label = curve.parameter if np.isnan(allowed.power) else f"{curve.parameter}, power {allowed.power:.2f}"
            axes.plot(
                distance[rises], curve.change[rises], "o-", color=color, markersize=3.0, linewidth=1.1, label=label
            )
            if np.isfinite(allowed.alone):
                axes.plot([allowed.alone], [target], "D", color=color, markersize=5.5)
        axes.axhline(target, color="0.2", linewidth=1.0, linestyle="--", label=f"target {target:g}")
        axes.axhline(target / len(curves), color="0.55", linewidth=1.0, linestyle=":", label="an equal share")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("distance from nominal, in the parameter's own unit")
        axes.set_ylabel(f"change of {curves[0].metric}")
        axes.grid(True, which="both", color="0.93", linewidth=0.5)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        return png_bytes(figure)
