"""Files of an attribution: metrics, correlations, plot, configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from ...core.plotting import new_figure, png_bytes, styled
from ...measure.correlation import SEPARATION_RANGES, Correlation, SeparationRange
from ...measure.correlation_plots import correlation_columns, log_axes
from ...measure.focal_plane_axes import AWAY, RESIDUAL, TRUTH
from ...pipeline.config import Configuration
from ...pipeline.experiment import Experiment
from ...pipeline.run_folder import stamp_of
from ..product import write_products
from .attribution import Attribution
from .causes import FULL


def write_attribution(result: Attribution, folder: Path, config: Configuration) -> tuple[str, ...]:
    """Write metrics, correlations, plot and configuration; return the names of the files."""
    keys = list(dict.fromkeys(key for case_metrics in result.metrics.values() for key in case_metrics))
    columns = {"off": (np.array(list(result.metrics)), "", "cause that is switched off, or full")}
    for key in keys:
        values = np.array([case.get(key, np.nan) for case in result.metrics.values()])
        columns[key] = (values, "arcsec" if key.endswith("arcsec") else "", _metric_description(key))
    correlation_tables = {
        file: (
            f"xi of {words}, of each case",
            correlation_columns(
                {f"{case} {kind}": xi for case, kinds in by_case.items() for kind, xi in kinds.items()}
            ),
        )
        for file, words, by_case in (
            ("correlations_g.ecsv", "g of adaptive moments", result.correlations_g),
            ("correlations.ecsv", "the weighted e", result.correlations),
        )
        if any(by_case.values())
    }
    return write_products(
        folder,
        {
            "attribution.ecsv": ("the same stars without one cause", columns),
            **correlation_tables,
        },
        {"attribution.png": attribution_plot(result.metrics, result.correlations_g)},
        {"attribution.json": {"figures": result.metrics, "left_out": result.left_out}},
        stamp_of(Experiment.from_config(config)).meta(),
        config,
        "the case with everything on.",
    )


def _metric_description(key: str) -> str:
    for start, words in (("change_", "full case less this one: "), ("error_", "jackknife error of the change: ")):
        if key.startswith(start):
            return words + _metric_description(key.removeprefix(start))
    if key.startswith("xi_plus_"):
        low, high = SEPARATION_RANGES[cast("SeparationRange", key.rpartition("_")[2])]
        kind = key.removeprefix("xi_plus_").rpartition("_")[0]
        ellipticity = "g" if kind.startswith("g_") else "the weighted e"
        kind = kind.removeprefix("g_").replace("_ccd", " of the CCDs' own models")
        return f"mean xi+ of {ellipticity}, {kind}, {low:g} to {high:g} arcmin"
    if key == "fwhm_arcsec":
        return "median FWHM"
    if key.startswith("rms_dt_g_"):
        return f"rms of (T - T model)/T of adaptive moments, {key.removeprefix('rms_dt_g_').replace('_', ' ')}"
    ellipticity = "g of adaptive moments" if key.startswith(("rms_g_", "rms_residual_g_")) else "the weighted e"
    words = key.removeprefix("rms_").replace("residual_g_", "residual_").removeprefix("g_").removeprefix("e_")
    return f"rms of one component of {ellipticity}, {words.replace('_', ' ')}"


def attribution_plot(
    metrics: Mapping[str, Mapping[str, float]], correlations: Mapping[str, Mapping[str, Correlation]]
) -> bytes:
    """Draw rms of g and of its residuals as bars, and xi+ of g as curves, for each case."""
    cases = list(metrics)
    number = np.arange(len(cases))
    # Ten dark colours, then ten light ones: there are up to twelve cases.
    shades = matplotlib.colormaps["tab20"]((2 * number + number // 10) % 20)
    colors = dict(zip(cases, shades, strict=True)) | {FULL: "black"}
    with styled():
        figure = new_figure(12.5, 3.4 + 0.42 * len(cases) + 3.4)
        panels = figure.subplots(2, 2, height_ratios=[1.2 + 0.42 * len(cases), 4.6])
        for axes, keys in zip(
            panels[0],
            (
                (("rms_g_truth", TRUTH, "noise-free PSFs"),),
                (
                    ("rms_residual_g_at_stars", RESIDUAL, "observed - model, at the stars"),
                    ("rms_residual_g_away", AWAY, "noise-free - model, at holdout positions"),
                ),
            ),
            strict=True,
        ):
            _draw_bars(axes, metrics, keys)
        panels[0, 0].set_title("rms of one component of g: noise-free PSFs", loc="left")
        panels[0, 1].set_title("rms of one component of the residual of g", loc="left")
        for axes, kind, title in (
            (panels[1, 0], "truth", "$|\\xi_+|$ of g, noise-free PSFs"),
            (panels[1, 1], "away", "$|\\xi_+|$ of g, noise-free - model, at holdout positions"),
        ):
            for case, case_correlations in correlations.items():
                # Images narrower than a pixel have no adaptive moments, and so no correlation of g.
                if kind in case_correlations:
                    _draw_curve(axes, case_correlations[kind], colors[case], case)
            log_axes(axes, f"{title}; open: negative")
            axes.set_xlabel("separation [arcmin]")
        handles, labels = panels[1, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(cases)))
        return png_bytes(figure)


def _title(case: str) -> str:
    return "everything on" if case == FULL else f"{case.replace('_', ' ')} off"


def _draw_bars(axes: Axes, metrics: Mapping[str, Mapping[str, float]], keys: tuple[tuple[str, str, str], ...]) -> None:
    rows = np.arange(len(metrics))
    height = 0.7 / len(keys)
    for i, (key, color, label) in enumerate(keys):
        values = [case_metrics[key] for case_metrics in metrics.values()]
        axes.barh(rows + (i - 0.5 * (len(keys) - 1)) * height, values, 0.9 * height, color=color, label=label)
        axes.axvline(metrics[FULL][key], color=color, linewidth=0.8, linestyle=(0, (3, 2)))
    axes.set_yticks(rows, [_title(case) for case in metrics])
    axes.invert_yaxis()
    axes.set_xlim(0.0)
    if len(keys) > 1:
        axes.legend(loc="lower right", frameon=True, framealpha=0.9, edgecolor="none")


def _draw_curve(axes: Axes, correlation: Correlation, color: object, case: str) -> None:
    r, xi = correlation.r_arcmin, correlation.xi_plus
    nonzero = np.isfinite(xi) & (xi != 0.0)
    width = 1.8 if case == FULL else 0.9
    axes.plot(r[nonzero], np.abs(xi[nonzero]), "-", color=color, linewidth=width, label=_title(case))
    for sign_mask, face in ((nonzero & (xi > 0.0), color), (nonzero & (xi < 0.0), "white")):
        axes.plot(r[sign_mask], np.abs(xi[sign_mask]), "o", color=color, markersize=3.5, markerfacecolor=face)
