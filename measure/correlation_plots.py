"""Correlations and rho statistics as tables and as plots against separation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, figure_at, png_bytes, styled
from .correlation import Correlation
from .focal_plane_axes import RESIDUAL_TITLES
from .rho_statistics import RhoStatistics

_RHO_STYLES = {
    "rho1": (RED, "D", "$\\rho_1 = \\langle\\delta e^*\\,\\delta e\\rangle$"),
    "rho2": (BLUE, "s", "$\\rho_2 = \\langle e^*\\,\\delta e\\rangle$"),
    "rho3": (ORANGE, "^", "$\\rho_3 = \\langle (e\\,\\delta T/T)^* (e\\,\\delta T/T)\\rangle$"),
    "rho4": (PURPLE, "v", "$\\rho_4 = \\langle\\delta e^* (e\\,\\delta T/T)\\rangle$"),
    "rho5": (GREY, "o", "$\\rho_5 = \\langle e^* (e\\,\\delta T/T)\\rangle$"),
}


class Separated(Protocol):
    """What has separations, and xi+ or xi- with errors at them: ``xi_plus`` and ``error_plus``."""

    @property
    def r_arcmin(self) -> np.ndarray:  # noqa: D102 - described by what has it
        ...


def correlation_columns(correlated: Mapping[str, Correlation]) -> dict[str, tuple[np.ndarray, str, str]]:
    """Return correlations as the columns of one table, one after the other, by the name of each."""
    tables = [c.as_dict() for c in correlated.values()]

    def together(key: str) -> np.ndarray:
        return np.concatenate([c[key] for c in tables])

    kinds = np.repeat(list(correlated), [len(c["r_arcmin"]) for c in tables])
    by = "jackknife over the CCDs" if next(iter(correlated.values())).n_patches else "scatter of the ellipticities"
    return {
        "kind": (kinds, "", "what is correlated"),
        "r_arcmin": (together("r_arcmin"), "arcmin", "mean separation"),
        "xi_plus": (together("xi_plus"), "", "mean of Re(e e'*)"),
        "error_plus": (together("error_plus"), "", f"standard error by {by}"),
        "xi_minus": (together("xi_minus"), "", "mean of Re(e e' exp(-4 i phi))"),
        "error_minus": (together("error_minus"), "", f"standard error by {by}"),
        "pairs": (together("pairs"), "", "pairs of stars"),
    }


def rho_plot(rho: Mapping[str, RhoStatistics]) -> bytes:
    """Draw rho statistics as PNG; see :func:`draw_rho`."""
    return png_bytes(draw_rho(None, rho))


def draw_rho(ax: Axes | Figure | None, rho: Mapping[str, RhoStatistics]) -> Figure:
    """Draw rho statistics, grouped as in Jarvis et al. 2016, one row for each residual or other name."""
    with styled():
        figure = figure_at(ax, 11.0, 4.1 * len(rho) + 0.5)
        panels = figure.subplots(len(rho), 2, sharex=True, sharey="col", squeeze=False)
        for row, (kind, statistics) in zip(panels, rho.items(), strict=True):
            correlations = dict(statistics.items())
            for axes, names in zip(row, (("rho1", "rho3", "rho4"), ("rho2", "rho5")), strict=True):
                for name in names:
                    draw_correlation(axes, correlations[name], "plus", *_RHO_STYLES[name])
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


def draw_correlation(axes: Axes, correlation: Separated, sign: str, color: str, marker: str, label: str) -> None:
    """Draw one correlation of a sign, ``plus`` or ``minus``, with error bars: negative values with open symbols."""
    r = correlation.r_arcmin
    xi, error = getattr(correlation, f"xi_{sign}"), getattr(correlation, f"error_{sign}")
    size = np.abs(xi)
    nonzero = np.isfinite(xi) & (size > 0.0)
    # On a logarithmic scale an error bar cannot go through zero: it ends at a tenth of the value instead.
    below = np.minimum(error, 0.9 * size)
    axes.errorbar(
        r[nonzero], size[nonzero], [below[nonzero], error[nonzero]], fmt="none", ecolor=color, elinewidth=0.7, alpha=0.6
    )
    axes.plot(r[nonzero], size[nonzero], "-", color=color, linewidth=0.6, alpha=0.5)
    for sign_mask, face in ((nonzero & (xi > 0.0), color), (nonzero & (xi < 0.0), "white")):
        axes.plot(
            r[sign_mask],
            size[sign_mask],
            marker,
            color=color,
            markersize=4.5,
            markerfacecolor=face,
            label=label if face == color else None,
        )
