"""Pictures of a stack of visits: ellipticities over the sky, and their correlations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.number_text import counted
from ...core.plotting import BLUE, GREY, ORANGE, new_figure, png_bytes, styled
from ...core.units import ARCMIN
from ...measure.correlation_plots import draw_correlation, log_axes
from ...measure.focal_plane_axes import draw_compass, draw_key_whisker, draw_whiskers, key_ellipticity, whiskers
from .null_result import NullTest, amplitude, density_slope, shot_noise
from .stack import PsfStack
from .stack_metrics import StackCorrelations

_STYLES = {
    "psf": (BLUE, "o", "PSF"),
    "residual_stars": (GREY, "s", "PSF - model, at the stars"),
    "residual_places": (ORANGE, "^", "PSF - model, where no star is"),
}
_GALAXY_STYLES = {
    "model": (BLUE, "o", "galaxies, PSF of the models"),
    "true": (GREY, "s", "galaxies, true PSF"),
    "difference": (ORANGE, "^", "difference of the two"),
    "expected": ("black", "D", "expected from the errors of the models"),
}
#: Most whiskers of a panel.
_MOST = 2500


def ellipticity_picture(stacks: Mapping[int, PsfStack]) -> bytes:
    """Draw whiskers of the PSF of the first and the last stack, and of the residual in the last (Fig. 15)."""
    first, last = stacks[min(stacks)], stacks[max(stacks)]
    panels = [(first, "PSF", first.e1, first.e2)] if first is not last else []
    panels += [
        (last, "PSF", last.e1, last.e2),
        (last, "mean of the models", last.model_e1, last.model_e2),
        (last, "PSF - model", last.residual_e1, last.residual_e2),
    ]
    key = key_ellipticity(np.concatenate([np.hypot(panels[0][2], panels[0][3])]))
    with styled():
        rows = len(panels) // 2 if len(panels) > 3 else 1
        figure = new_figure(5.2 * len(panels) / rows, 5.4 * rows, "compressed")
        axes_grid = figure.subplots(rows, len(panels) // rows, squeeze=False, sharex=True, sharey=True)
        edge = 1.05 / ARCMIN * max(float(np.abs([s.x, s.y]).max()) for s in (first, last))
        for axes, (stack, quantity, e1, e2) in zip(axes_grid.flat, panels, strict=True):
            drawn_rows = np.s_[:: max(1, len(stack) // _MOST)]
            scale = 0.06 * edge / key
            ends = whiskers(
                stack.x[drawn_rows] / ARCMIN, stack.y[drawn_rows] / ARCMIN, e1[drawn_rows], e2[drawn_rows], scale
            )
            draw_whiskers(axes, ends, "black", 0.6)
            axes.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal")
            rms = np.sqrt(np.nanmean(e1**2 + e2**2))
            axes.set_title(f"{quantity}, {counted(stack.visits, 'visit')}: rms |e| {rms:.1e}", loc="left")
            draw_key_whisker(axes, key, scale, 1.0)
            draw_compass(axes, *stack.sky_directions)
        for axes in axes_grid[-1]:
            axes.set_xlabel("x of the stack [arcmin]")
        for axes in axes_grid[:, 0]:
            axes.set_ylabel("y of the stack [arcmin]")
        return png_bytes(figure)


def correlation_picture(correlated: Mapping[int, StackCorrelations], moments: str = "e") -> bytes:
    """Draw xi+ of each stack: of the PSF, and of the residuals at stars and between them (Fig. 16).

    It is that of the weighted e, as in the paper, or of g of the adaptive moments.
    """
    end = "_g" if moments == "g" else ""
    with styled():
        figure = new_figure(4.2 * len(correlated) + 1.0, 4.8)
        panels = figure.subplots(1, len(correlated), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (visits, correlations) in zip(panels, correlated.items(), strict=True):
            for kind, style in _STYLES.items():
                draw_correlation(axes, correlations[f"{kind}{end}"], "plus", *style)
            log_axes(axes, counted(visits, "visit"))
            axes.set_xlabel("separation [arcmin]")
        name = "g, adaptive moments" if moments == "g" else "weighted e"
        panels[0].set_ylabel(f"$|\\xi_+|$ of {name}: filled positive, open negative")
        low, high = panels[0].get_ylim()
        panels[0].set_ylim(max(low, 1e-10), 2.0 * high)
        panels[0].legend(loc="best")
        return png_bytes(figure)


def null_test_picture(results: Mapping[int, NullTest]) -> bytes:
    """Draw xi+ of unsheared galaxies, and the contribution of the PSF models to it (Fig. 17), by both methods."""
    methods = {
        "Gaussians": [result.correlations for result in results.values()],
        "functionals": [result.shear_correlations for result in results.values()],
    }
    methods = {method: correlated for method, correlated in methods.items() if all(correlated)}
    with styled():
        figure = new_figure(4.2 * len(results) + 1.0, 4.4 * len(methods) + 0.4)
        panels = figure.subplots(len(methods), len(results), sharex=True, sharey=True, squeeze=False)
        for row, (method, correlated) in zip(panels, methods.items(), strict=True):
            for axes, result, correlation_of_kind in zip(row, results.values(), correlated, strict=True):
                for kind, style in _GALAXY_STYLES.items():
                    if kind in correlation_of_kind:
                        draw_correlation(axes, correlation_of_kind[kind], "plus", *style)
                log_axes(axes, f"{method}, {counted(result.visits, 'visit')}: {result.density:.0f} usable per arcmin²")
            row[0].set_ylabel("$|\\xi_+|$: filled positive, open negative")
        for axes in panels[-1]:
            axes.set_xlabel("separation [arcmin]")
        low, high = panels[0, 0].get_ylim()
        panels[0, 0].set_ylim(max(low, 1e-10), 2.0 * high)
        for row in panels:
            row[0].legend(loc="best")
        return png_bytes(figure)


def density_picture(results: Mapping[int, NullTest]) -> bytes:
    """Draw the mean amplitude of xi+ against the density of usable galaxies, with the shot noise (Fig. 18)."""
    density = np.array([r.density for r in results.values()])
    amplitudes, shot_noises = (np.array([of(r) for r in results.values()]) for of in (amplitude, shot_noise))
    with styled():
        figure = new_figure(5.6, 4.6)
        axes = figure.subplots()
        axes.plot(density, shot_noises, "-", color="0.5", label="shot noise")
        axes.plot(density, amplitudes, "o", color=BLUE, label="mean $|\\xi_+|$ of the galaxies")
        for result, x, y in zip(results.values(), density, amplitudes, strict=True):
            # Beside the point, towards the middle of the axes.
            ahead, side = (-6, "right") if x > np.sqrt(density.min() * density.max()) else (6, "left")
            label = counted(result.visits, "visit")
            axes.annotate(label, (x, y), xytext=(ahead, -10), textcoords="offset points", ha=side, fontsize=8)
        slope = density_slope(density, amplitudes)
        title = "no slope: fewer than three stacks" if slope is None else f"slope {slope.value:.2f} ± {slope.error:.2f}"
        log_axes(axes, f"{title}; paper: -0.97 ± 0.06")
        axes.set(xlabel="usable galaxies per arcmin²", ylabel="amplitude")
        axes.legend(loc="best")
        return png_bytes(figure)
