"""Plots of ellipticities: their scatter; correlations and rho statistics against separation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, figure_at, new_figure, png_bytes, styled
from ..ccd_product import CcdStars
from ...measure.correlation import Correlation
from ...measure.rho_statistics import RhoStatistics
from ..summary import ellipticities
from .focal_plane_axes import AWAY, CCD_MODEL, LEFT_OUT, OBSERVED, RESIDUAL, RESIDUAL_TITLES, TRUTH

_LABELS = {
    "truth": (TRUTH, "o", "noise-free PSFs, at holdout positions"),
    "observed": (OBSERVED, "s", "observed stars"),
    "residual": (RESIDUAL, "D", "observed - model, at the stars"),
    "left_out": (LEFT_OUT, "v", "observed - model fitted without the star"),
    "away": (AWAY, "^", "noise-free - model, at holdout positions"),
}
_RHO_STYLES = {
    "rho1": (RED, "D", "$\\rho_1 = \\langle\\delta e^*\\,\\delta e\\rangle$"),
    "rho2": (BLUE, "s", "$\\rho_2 = \\langle e^*\\,\\delta e\\rangle$"),
    "rho3": (ORANGE, "^", "$\\rho_3 = \\langle (e\\,\\delta T/T)^* (e\\,\\delta T/T)\\rangle$"),
    "rho4": (PURPLE, "v", "$\\rho_4 = \\langle\\delta e^* (e\\,\\delta T/T)\\rangle$"),
    "rho5": (GREY, "o", "$\\rho_5 = \\langle e^* (e\\,\\delta T/T)\\rangle$"),
}


def scatter_plot(products: Sequence[CcdStars]) -> bytes:
    """Draw the ellipticity components before and after the model is subtracted (Jee & Tyson 2011, Fig. 13)."""
    panels = (
        ("at the observed stars", "observed", "observed", "residual"),
        ("at the holdout positions", "noise-free", "truth", "away"),
    )
    with styled():
        figure = new_figure(10.0, 5.2)
        both = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, (title, label, before, after) in zip(both, panels, strict=True):
            for kind, name in ((before, label), (after, f"{label} - model")):
                e1, e2 = ellipticities(products, kind)
                _draw_cloud(axes, e1, e2, _LABELS[kind][0], name)
            axes.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
            axes.axvline(0.0, color="0.7", linewidth=0.6, zorder=0)
            axes.set(aspect="equal", xlabel="$e_1$: $(a-b)/(a+b)$ along x")
            axes.set_title(title, loc="left")
            axes.legend(loc="upper right")
        both[0].set_ylabel("$e_2$: along the diagonal x = y")
        values = np.concatenate([ellipticities(products, kind) for *_, kind, _ in panels], axis=1)
        edge = 1.1 * float(np.nanmax(np.abs(values)))
        both[0].set(xlim=(-edge, edge), ylim=(-edge, edge))
        return png_bytes(figure)


def _draw_cloud(axes: Axes, e1: np.ndarray, e2: np.ndarray, color: str, name: str) -> None:
    finite = np.isfinite(e1) & np.isfinite(e2)
    rms = np.sqrt(0.5 * np.mean(e1[finite] ** 2 + e2[finite] ** 2)) if finite.any() else np.nan
    # Many points would hide those below them.
    alpha = min(0.6, 600.0 / max(len(e1), 1) + 0.05)
    axes.plot(e1, e2, ".", color=color, markersize=3.5, alpha=alpha, markeredgewidth=0)
    axes.plot([], [], "o", color=color, markersize=3.0, label=f"{name}: rms {rms:.2g}")


#: xi+ in the paper, by kind of ellipticity.
_PAPER = ((3e-5, "paper: observed"), (1e-8, "paper: residual at the stars"))


def correlation_plot(correlated: dict[str, Correlation], paper: bool = True) -> bytes:
    """Draw xi+ and xi- against separation (Jee & Tyson 2011, Fig. 14): filled symbols positive, open ones negative.

    With ``paper`` lines are at the values of the paper, which are the LSST's.
    """
    with styled():
        figure = new_figure(11.5, 5.4)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, sign in zip(panels, ("plus", "minus"), strict=True):
            for kind, correlation in correlated.items():
                draw_correlation(axes, correlation, sign, *_LABELS[kind])
            log_axes(axes, f"$\\xi_{'+' if sign == 'plus' else '-'}$")
            axes.set_xlabel("separation [arcmin]")
        panels[0].set_ylabel("$|\\xi|$ of the ellipticity")
        low, high = panels[0].get_ylim()
        panels[0].set_ylim(max(low, 1e-10), high * 2)
        for value, text in _PAPER if paper else ():
            if panels[0].get_ylim()[0] < value < panels[0].get_ylim()[1]:
                panels[0].axhline(value, color="0.45", linewidth=0.8, linestyle=(0, (2, 2)), zorder=0)
                panels[0].annotate(
                    text,
                    (0.99, value),
                    xycoords=("axes fraction", "data"),
                    fontsize=7,
                    color="0.35",
                    ha="right",
                    va="bottom",
                )
        handles, labels = panels[0].get_legend_handles_labels()
        filled = panels[0].plot([], [], "o", color="0.4", markersize=4.5)[0]
        hollow = panels[0].plot([], [], "o", color="0.4", markersize=4.5, markerfacecolor="white")[0]
        handles, labels = [*handles, filled, hollow], [*labels, "positive", "negative"]
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        return png_bytes(figure)


def models_plot(correlated: Mapping[str, Correlation]) -> bytes:
    """Draw xi+ of the residuals of a focal-plane model beside those of the CCDs' own models."""
    with styled():
        figure = new_figure(11.5, 5.0)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, kind in zip(panels, ("residual", "away"), strict=True):
            color, marker, _ = _LABELS[kind]
            draw_correlation(axes, correlated[kind], "plus", color, marker, "model of the focal plane")
            draw_correlation(axes, correlated[f"{kind}_ccd"], "plus", CCD_MODEL, "s", "models CCD by CCD")
            log_axes(axes, RESIDUAL_TITLES[kind])
            axes.set_xlabel("separation [arcmin]")
            axes.legend(loc="best")
        panels[0].set_ylabel("$|\\xi_+|$: filled positive, open negative")
        low, high = panels[0].get_ylim()
        panels[0].set_ylim(max(low, 1e-10), 2.0 * high)
        return png_bytes(figure)


def rho_plot(rho: Mapping[str, RhoStatistics]) -> bytes:
    """Draw rho statistics as PNG; see :func:`draw_rho`."""
    return png_bytes(draw_rho(None, rho))


def draw_rho(ax: Axes | Figure | None, rho: Mapping[str, RhoStatistics]) -> Figure:
    """Draw rho statistics, grouped as in Jarvis et al. 2016, one row for each residual or other name."""
    with styled():
        figure = figure_at(ax, 11.0, 4.1 * len(rho) + 0.5)
        panels = figure.subplots(len(rho), 2, sharex=True, sharey="col", squeeze=False)
        for row, (kind, statistics) in zip(panels, rho.items(), strict=True):
            found = dict(statistics.items())
            for axes, names in zip(row, (("rho1", "rho3", "rho4"), ("rho2", "rho5")), strict=True):
                for name in names:
                    draw_correlation(axes, found[name], "plus", *_RHO_STYLES[name])
                log_axes(axes, RESIDUAL_TITLES.get(kind, kind))
                axes.legend(loc="best")
            row[0].set_ylabel("$|\\rho|$: filled positive, open negative")
        for axes in panels[0]:
            low, high = axes.get_ylim()
            axes.set_ylim(max(low, 1e-12), 2.0 * high)
        for axes in panels[-1]:
            axes.set_xlabel("separation [arcmin]")
        return figure


def log_axes(axes: Axes, title: str) -> None:
    """Give axes logarithmic scales, a grid and a title."""
    axes.set(xscale="log", yscale="log", axisbelow=True)
    axes.set_title(title, loc="left")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)


def draw_correlation(axes: Axes, correlation: Correlation, sign: str, color: str, marker: str, label: str) -> None:
    """Draw one correlation of a sign, ``plus`` or ``minus``, with error bars: negative values with open symbols."""
    r = correlation.r_arcmin
    xi, error = getattr(correlation, f"xi_{sign}"), getattr(correlation, f"error_{sign}")
    size = np.abs(xi)
    some = np.isfinite(xi) & (size > 0.0)
    # On a logarithmic scale an error bar cannot go through zero: it ends at a tenth of the value instead.
    below = np.minimum(error, 0.9 * size)
    axes.errorbar(r[some], size[some], [below[some], error[some]], fmt="none", ecolor=color, elinewidth=0.7, alpha=0.6)
    axes.plot(r[some], size[some], "-", color=color, linewidth=0.6, alpha=0.5)
    for chosen, face in ((some & (xi > 0.0), color), (some & (xi < 0.0), "white")):
        axes.plot(
            r[chosen],
            size[chosen],
            marker,
            color=color,
            markersize=4.5,
            markerfacecolor=face,
            label=label if face == color else None,
        )
