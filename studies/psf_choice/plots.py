"""Plots of the study of PSF models, with error bars over the CCDs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from ...core.plotting import new_figure, png_bytes, styled
from ...measure.focal_plane_axes import AWAY, LEFT_OUT, OBSERVED, RESIDUAL, TRUTH
from ...reconstruction.psf_model.recipe import BASES
from .plan import FOCAL_PLANE, NOISE_FREE, POLYNOMIALS, PROCESSES, Case
from .study import Study

_HOW = {
    "equal": (OBSERVED, "o", "equal weights"),
    "snr": (LEFT_OUT, "s", "weights (S/N)$^2$"),
    "softened": (AWAY, "D", "softened weights"),
    **{name: ("#7b4a1e", "X", label) for name, label in PROCESSES.items()},
    "no_telescope": ("0.5", "P", FOCAL_PLANE["no_telescope"]),
    "focal_plane": ("#c2307f", "v", FOCAL_PLANE["focal_plane"]),
}
_BASIS = dict(zip(BASES, ((OBSERVED, "o"), (AWAY, "s"), (LEFT_OUT, "D")), strict=False))
_RMS = "rms of one component of g, no star"
# Upper limit of the axis over the base: fits with as many terms as stars diverge.
_LIMIT = 4.0
_QUIET = (0, (1, 1.5))


def stars_plot(result: Study) -> bytes:
    """Draw the residual of g at the holdout positions against the number of stars, by order and weighting."""
    plan = result.plan
    colors = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, len(plan.orders)))
    with styled():
        figure = new_figure(13.0, 4.8)
        panels = figure.subplots(1, 3, sharex=True, sharey=True)
        for axes, how in zip(panels, POLYNOMIALS, strict=True):
            for order, color in zip(plan.orders, colors, strict=True):
                cases = [(n, replace(plan.base, stars=n, order=order, interpolation=how)) for n in plan.stars]
                _draw_line(axes, result, cases, "rms_g_away", color, "o", f"order {order}")
                _draw_line(axes, result, cases, "noise_law_g_away", color, "", None, (0, (4, 2)))
                if how == "equal":
                    quiet = [(n, replace(c, snr=NOISE_FREE)) for n, c in cases]
                    _draw_line(axes, result, quiet, "rms_g_away", color, "", None, _QUIET)
            _logarithmic_axes(axes, plan.stars, "stars of a CCD", _HOW[how][2])
        panels[0].set_ylabel(_RMS)
        _limit_axis(panels[0], result)
        panels[0].plot([], [], color="0.4", linestyle=(0, (4, 2)), linewidth=0.9, label="noise alone, in theory")
        panels[0].plot([], [], color="0.4", linestyle=_QUIET, linewidth=0.9, label="stars without noise")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=8)
        figure.suptitle(f"How many stars, which order (stars {plan.base.noise_text})", x=0.01, ha="left")
        return png_bytes(figure)


def choices_plot(result: Study) -> bytes:
    """Draw the effect of order, components, basis, interpolation and S/N, and residuals in common to CCDs."""
    plan, base = result.plan, result.plan.base
    with styled():
        figure = new_figure(17.0, 9.0)
        panels = figure.subplots(2, 4)
        _draw_orders(panels[0, 0], result)
        _draw_components(panels[0, 1], result)
        _draw_bases(panels[0, 2], result)
        _draw_snrs(panels[0, 3], result)
        for axes, key, ylabel in (
            (panels[1, 0], "rms_g_away", _RMS),
            (panels[1, 1], "rms_dt_g_away", "rms of dT/T, no star"),
        ):
            for how in (*POLYNOMIALS, *plan.without_polynomials):
                color, marker, label = _HOW[how]
                best = [(n, c) for n in plan.stars if (c := result.best_order(n, how))]
                text = f"{label}, best order" if how in POLYNOMIALS else label
                _draw_line(axes, result, best, key, color, marker, text)
            by_default = [(n, replace(plan.default, stars=n)) for n in plan.stars]
            _draw_line(axes, result, by_default, key, RESIDUAL, "*", f"default: {plan.default}")
            paper = [(n, replace(base, stars=n)) for n in plan.stars]
            _draw_line(axes, result, paper, key, TRUTH, "x", f"{_HOW[base.interpolation][2]}, order {base.order}")
            _logarithmic_axes(axes, plan.stars, "stars of a CCD", "interpolation" + (": T" if "dt" in key else ": g"))
            axes.set_ylabel(ylabel)
        _limit_axis(panels[1, 0], result)
        _draw_common_residuals(
            panels[1, 2], result, "mean_g", "rms over CCDs of their mean of g", "what a CCD has in common"
        )
        _draw_common_residuals(
            panels[1, 3],
            result,
            "xi_plus_g",
            "$|\\xi_+|$ of g, 10' to 3 deg; open: negative",
            "correlation between CCDs",
        )
        for axes in panels.flat:
            # Room for the legend above the curves, on a logarithmic scale.
            low, high = axes.get_ylim()
            axes.set_ylim(low, high * (high / low) ** 0.45)
            axes.legend(loc="upper right", fontsize=7)
        return png_bytes(figure)


def _draw_orders(axes: Axes, result: Study) -> None:
    """Draw the residual at the stars and at the holdout positions against the order."""
    plan, base = result.plan, result.plan.base
    cases = [(order, replace(base, order=order)) for order in plan.orders]
    for kind, color, marker, observed_or_truth, where in (
        ("at_stars", RESIDUAL, "D", "observed", "at the stars"),
        ("away", AWAY, "^", "truth", "no star"),
    ):
        _draw_line(axes, result, cases, f"rms_g_{kind}", color, marker, f"{observed_or_truth} - model, {where}")
        _draw_line(
            axes, result, cases, f"noise_law_g_{kind}", color, "", f"noise alone, {where}, in theory", (0, (4, 2))
        )
    quiet = [(order, replace(c, snr=NOISE_FREE)) for order, c in cases]
    _draw_line(axes, result, quiet, "rms_g_away", TRUTH, "", "truth - model, stars without noise", _QUIET)
    _log_values(axes)
    axes.set_xticks(plan.orders)
    axes.set(xlabel="order of the polynomials", ylabel="rms of one component of g")
    axes.set_title(f"order: {base.stars} stars, {_HOW[base.interpolation][2]}", loc="left")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)


def _draw_components(axes: Axes, result: Study) -> None:
    plan, base = result.plan, result.plan.base
    _draw_against(axes, result, "components", plan.components)
    quiet = [(k, replace(base, components=k, snr=NOISE_FREE)) for k in plan.components]
    _draw_line(axes, result, quiet, "rms_g_away", TRUTH, "", f"order {base.order}, stars without noise", _QUIET)
    _logarithmic_axes(axes, plan.components, "components", f"components: {base.stars} stars")
    axes.set_ylabel(_RMS)


def _draw_snrs(axes: Axes, result: Study) -> None:
    plan, base = result.plan, result.plan.base
    _draw_against(axes, result, "snr", plan.snrs)
    _logarithmic_axes(axes, plan.snrs, "S/N of the faintest star", f"S/N: {base.stars} stars")
    axes.set_ylabel(_RMS)


def _draw_against(axes: Axes, result: Study, key: str, values: Sequence[float]) -> None:
    """Draw the residual against one property of the cases, for each interpolation at the base's and the best order."""
    base = result.plan.base
    for how in (*POLYNOMIALS, *result.plan.without_polynomials):
        color, marker, label = _HOW[how]
        orders = dict.fromkeys((base.order, _best_order(result, how)) if how in POLYNOMIALS else (base.order,))
        for order, line in zip(orders, ("-", (0, (4, 2))), strict=False):
            way = replace(base, order=order, interpolation=how)
            cases = [(v, replace(way, **{key: v})) for v in values]  # type: ignore[arg-type]
            text = f"{label}, order {order}" if how in POLYNOMIALS else label
            _draw_line(axes, result, cases, "rms_g_away", color, marker, text, line)


def _draw_bases(axes: Axes, result: Study) -> None:
    plan, base = result.plan, result.plan.base
    for basis in BASES:
        color, marker = _BASIS[basis]
        cases = [(n, replace(base, basis=basis, stars=n)) for n in plan.stars]
        _draw_line(axes, result, cases, "rms_g_away", color, marker, basis)
        quiet = [(n, replace(c, snr=NOISE_FREE)) for n, c in cases]
        _draw_line(axes, result, quiet, "rms_g_away", color, "", f"{basis}, stars without noise", _QUIET)
    _logarithmic_axes(axes, plan.stars, "stars of a CCD", f"basis: {_HOW[base.interpolation][2]}, order {base.order}")
    axes.set_ylabel(_RMS)
    _limit_axis(axes, result)


def _draw_common_residuals(axes: Axes, result: Study, key: str, label: str, title: str) -> None:
    """Draw residuals in common to a CCD, or to several, at the stars and at the holdout positions."""
    plan, base = result.plan, result.plan.base
    softened = result.best_order(base.stars, "softened")
    ways: dict[str, tuple[Case, Any]] = {f"order {base.order}, {_HOW[base.interpolation][2]}": (base, "-")}
    if softened is not None:
        ways[f"order {softened.order}, softened weights"] = (softened, (0, (4, 2)))
    if plan.focal_plane:
        ways[FOCAL_PLANE["focal_plane"]] = (replace(base, interpolation="focal_plane"), _QUIET)
    for name, (way, line) in ways.items():
        cases = [(n, replace(way, stars=n)) for n in plan.stars]
        for kind, color, marker, where in (("at_stars", RESIDUAL, "D", "at the stars"), ("away", AWAY, "^", "no star")):
            ending = "_long" if key == "xi_plus_g" else ""
            _draw_line(axes, result, cases, f"{key}_{kind}{ending}", color, marker, f"{where}: {name}", line)
    _logarithmic_axes(axes, plan.stars, "stars of a CCD", title)
    axes.set_ylabel(label)


def _best_order(result: Study, how: str) -> int:
    best = result.best_order(result.plan.base.stars, how)
    return result.plan.base.order if best is None else best.order


def _draw_line(
    axes: Axes,
    result: Study,
    cases: Iterable[tuple[float, Case]],
    key: str,
    color: Any,
    marker: str,
    label: str | None,
    linestyle: Any = "-",
) -> None:
    """Draw a metric of the fitted cases against their values, negative ones as open markers."""
    rows = [
        (x, case_metrics) for x, case in cases if (case_metrics := result.metrics.get(case.normalised())) is not None
    ]
    points = np.array(
        [(x, case_metrics[key], case_metrics.get(f"error_{key}", np.nan)) for x, case_metrics in rows]
    ).reshape(-1, 3)
    # Residuals of a perfect fit are rounding errors, and are left out.
    x, value, error = points[np.isfinite(points[:, 1]) & (np.abs(points[:, 1]) > 1e-12)].T
    size = np.abs(value)
    axes.plot(x, size, color=color, linestyle=linestyle, linewidth=1.0, marker="", zorder=2)
    if marker:
        # On a logarithmic scale an error bar cannot go through zero: it ends at a tenth of the value instead.
        bars = [np.minimum(error, 0.9 * size), error]
        finite = np.isfinite(error)
        axes.errorbar(
            x[finite], size[finite], [b[finite] for b in bars], fmt="none", ecolor=color, elinewidth=0.8, alpha=0.7
        )
    for sign_mask, face in ((value > 0.0, color), (value < 0.0, "white")):
        axes.plot(
            x[sign_mask],
            size[sign_mask],
            linestyle="",
            marker=marker,
            color=color,
            markersize=4.0,
            markerfacecolor=face,
        )
    axes.plot([], [], color=color, linestyle=linestyle, linewidth=1.0, marker=marker, markersize=4.0, label=label)


def _logarithmic_axes(axes: Axes, ticks: Sequence[float], label: str, title: str) -> None:
    axes.set_xscale("log")
    _log_values(axes)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel(label)
    axes.set_title(title, loc="left")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _log_values(axes: Axes) -> None:
    axes.set_yscale("log")
    if not np.isfinite(axes.dataLim.minposy):
        axes.set_ylim(1e-4, 1e-1)  # nothing to draw, of which no limits can be made


def _limit_axis(axes: Axes, result: Study) -> None:
    base = result.metrics.get(result.plan.base)
    low, high = axes.get_ylim()
    if base is not None:
        axes.set_ylim(low, min(high, _LIMIT * base["rms_g_away"]))
