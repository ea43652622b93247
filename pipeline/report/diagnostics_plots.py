"""Plots of the diagnostics: residuals of each CCD over the focal plane, and rho statistics against separation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize

from ...core.plotting import new_figure, png_bytes, styled
from ...models.camera.camera import Camera
from ..measure.rho_statistics import RhoStatistics
from .focal_plane_axes import (
    ccd_corners,
    draw_key_whisker,
    draw_outlines,
    draw_whiskers,
    frame_axes,
    key_ellipticity,
    whiskers,
)
from .statistics_plots import draw_correlation

_TITLES = {
    "residual": "at the stars: observed - model",
    "left_out": "at stars left out: observed - model",
    "away": "where no star is: truth - model",
}
_RHO_STYLES = {
    "rho1": ("#c8322b", "D", "$\\rho_1 = \\langle\\delta e^*\\,\\delta e\\rangle$"),
    "rho2": ("#1f6fbf", "s", "$\\rho_2 = \\langle e^*\\,\\delta e\\rangle$"),
    "rho3": ("#e08a00", "^", "$\\rho_3 = \\langle (e\\,\\delta T/T)^* (e\\,\\delta T/T)\\rangle$"),
    "rho4": ("#7a4fb5", "v", "$\\rho_4 = \\langle\\delta e^* (e\\,\\delta T/T)\\rangle$"),
    "rho5": ("#3a3a3a", "o", "$\\rho_5 = \\langle e^* (e\\,\\delta T/T)\\rangle$"),
}


def residual_plot(camera: Camera, figures: Mapping[str, np.ndarray]) -> bytes:
    """Draw the residuals of each CCD: rms and mean ellipticity above, mean size below; the same scale across a row.

    Parameters
    ----------
    camera : Camera
        Camera.
    figures : mapping of str to array
        Columns of the table of CCDs, see :func:`~pachon.pipeline.measure.diagnostics.diagnose`.
    """
    indices = [camera.ccd_index(str(name)) for name in figures["ccd"]]
    corners = ccd_corners(camera, indices)
    low, high = corners.min(axis=(0, 1)) - 8.0, corners.max(axis=(0, 1)) + 8.0
    across = float((high[0] - low[0]) / (high[1] - low[1]))
    means = np.concatenate([np.hypot(figures[f"mean_e1_{k}"], figures[f"mean_e2_{k}"]) for k in _TITLES])
    key = key_ellipticity(means)
    scale = 0.7 * camera.half_size * 1e3 / key
    worst = _largest(np.concatenate([figures[f"rms_e_{k}"] for k in _TITLES]))
    sizes = _largest(np.abs(np.concatenate([figures[f"mean_dt_{k}"] for k in ("residual", "away")])))
    with styled():
        figure = new_figure(12.5, min(max(2 * 3.6 / across, 2.6) + 1.4, 9.5))
        rows = figure.subplots(2, 3, squeeze=False)
        above = _shades("viridis", 0.0, worst)
        below = _shades("RdBu_r", -sizes, sizes)
        for i, (kind, title) in enumerate(_TITLES.items()):
            axes = rows[0, i]
            _draw_ccds(axes, camera, indices, figures[f"rms_e_{kind}"], above)
            ends = whiskers(
                figures["x_mm"], figures["y_mm"], figures[f"mean_e1_{kind}"], figures[f"mean_e2_{kind}"], scale
            )
            draw_whiskers(axes, ends, "white", 2.6)
            draw_whiskers(axes, ends, "black", 1.2)
            frame_axes(axes, (low[0], high[0], low[1], high[1]), x_label=kind == "left_out", y_label=i == 0)
            axes.set_title(title, loc="left", fontsize=8.5)
            draw_key_whisker(axes, key, scale, 1.0)
        for i, kind in ((0, "residual"), (2, "away")):
            axes = rows[1, i]
            _draw_ccds(axes, camera, indices, figures[f"mean_dt_{kind}"], below)
            frame_axes(axes, (low[0], high[0], low[1], high[1]), y_label=i == 0)
            axes.set_title(_TITLES[kind], loc="left", fontsize=8.5)
        rows[1, 1].set_axis_off()
        rows[1, 1].annotate(
            "Above: colour, rms of one component of e;\nwhisker, mean residual of the CCD.\n"
            "Below: mean of $(T - T_{model})/T$, $T = Q_{11} + Q_{22}$.",
            (0.5, 0.5),
            xycoords="axes fraction",
            ha="center",
            va="center",
            fontsize=8.5,
        )
        figure.colorbar(above, ax=list(rows[0]), fraction=0.03, pad=0.01, extend="max").set_label("rms of e")
        figure.colorbar(below, ax=list(rows[1]), fraction=0.03, pad=0.01, extend="both").set_label("mean $\\delta T/T$")
        return png_bytes(figure)


def _largest(values: np.ndarray) -> float:
    """Return the 98th percentile of finite values, or one where it is zero."""
    finite = values[np.isfinite(values)]
    largest = float(np.quantile(finite, 0.98)) if finite.size else 0.0
    return largest if largest > 0.0 else 1.0


def _shades(name: str, low: float, high: float) -> ScalarMappable:
    return ScalarMappable(Normalize(low, high), name)


def _draw_ccds(axes: Axes, camera: Camera, indices: list[int], values: np.ndarray, shades: ScalarMappable) -> None:
    corners = ccd_corners(camera, indices)
    axes.add_collection(PolyCollection(list(corners), facecolors=shades.to_rgba(values), edgecolors="none"))
    draw_outlines(axes, camera, range(len(camera)), "0.75", 0.4)


def rho_plot(rho: Mapping[str, RhoStatistics]) -> bytes:
    """Draw the rho statistics (as Jarvis et al. 2016 group them): at the stars above, where no star is below.

    Parameters
    ----------
    rho : mapping of str to RhoStatistics
        ``residual`` and ``away``.
    """
    with styled():
        figure = new_figure(11.0, 4.1 * len(rho) + 0.5)
        panels = figure.subplots(len(rho), 2, sharex=True, sharey="col", squeeze=False)
        for row, (kind, statistics) in zip(panels, rho.items(), strict=True):
            found = dict(statistics.items())
            for axes, names in zip(row, (("rho1", "rho3", "rho4"), ("rho2", "rho5")), strict=True):
                for name in names:
                    draw_correlation(axes, found[name], "plus", *_RHO_STYLES[name])
                axes.set_xscale("log")
                axes.set_yscale("log")
                axes.grid(True, which="major", color="0.9", linewidth=0.6)
                axes.set_axisbelow(True)
                axes.set_title(_TITLES[kind], loc="left")
                axes.legend(loc="best")
            row[0].set_ylabel("$|\\rho|$: filled positive, open negative")
        for axes in panels[0]:
            low, high = axes.get_ylim()
            axes.set_ylim(max(low, 1e-12), 2.0 * high)
        for axes in panels[-1]:
            axes.set_xlabel("separation [arcmin]")
        return png_bytes(figure)
