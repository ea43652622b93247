"""Plots of ellipticities: their scatter; correlations and rho statistics against separation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from ...core.plotting import new_figure, png_bytes, styled
from ...measure.correlation import Correlation
from ...measure.correlation_plots import draw_correlation, log_axes
from ...measure.focal_plane_axes import AWAY, CCD_MODEL, LEFT_OUT, OBSERVED, RESIDUAL, RESIDUAL_TITLES, TRUTH
from ...reconstruction.ccd_product import CcdStars
from ..summary import ellipticities

_LABELS = {
    "truth": (TRUTH, "o", "noise-free PSFs, at holdout positions"),
    "observed": (OBSERVED, "s", "observed stars"),
    "residual": (RESIDUAL, "D", "observed - model, at the stars"),
    "left_out": (LEFT_OUT, "v", "observed - model fitted without the star"),
    "away": (AWAY, "^", "noise-free - model, at holdout positions"),
}


def scatter_plot(products: Sequence[CcdStars]) -> bytes:
    """Draw the ellipticity components before and after the model is subtracted (Jee & Tyson 2011, Fig. 13)."""
    panels = (
        ("at the observed stars", "observed", "observed", "residual"),
        ("at the holdout positions", "noise-free", "truth", "away"),
    )
    with styled():
        figure = new_figure(10.0, 5.2)
        axes_pair = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, (title, label, before, after) in zip(axes_pair, panels, strict=True):
            for kind, name in ((before, label), (after, f"{label} - model")):
                e1, e2 = ellipticities(products, kind)
                _draw_cloud(axes, e1, e2, _LABELS[kind][0], name)
            axes.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
            axes.axvline(0.0, color="0.7", linewidth=0.6, zorder=0)
            axes.set(aspect="equal", xlabel="$e_1$: $(a-b)/(a+b)$ along x")
            axes.set_title(title, loc="left")
            axes.legend(loc="upper right")
        axes_pair[0].set_ylabel("$e_2$: along the diagonal x = y")
        values = np.concatenate([ellipticities(products, kind) for *_, kind, _ in panels], axis=1)
        edge = 1.1 * float(np.nanmax(np.abs(values)))
        axes_pair[0].set(xlim=(-edge, edge), ylim=(-edge, edge))
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


def correlation_plot(
    correlated: Mapping[str, Correlation], paper: bool = True, ellipticity: str = "weighted e"
) -> bytes:
    """Draw xi+ and xi- against separation (Jee & Tyson 2011, Fig. 14): filled symbols positive, open ones negative.

    `ellipticity` is what is correlated, in words. With ``paper`` lines are at the values of the paper, the LSST's.
    """
    with styled():
        figure = new_figure(11.5, 5.4)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, sign in zip(panels, ("plus", "minus"), strict=True):
            for kind, correlation in correlated.items():
                draw_correlation(axes, correlation, sign, *_LABELS[kind])
            log_axes(axes, f"$\\xi_{'+' if sign == 'plus' else '-'}$")
            axes.set_xlabel("separation [arcmin]")
        panels[0].set_ylabel(f"$|\\xi|$ of {ellipticity}")
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
