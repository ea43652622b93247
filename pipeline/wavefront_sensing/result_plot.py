"""Picture of fitted donuts: stamps, models, residuals and Zernikes with their errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...core.plotting import new_figure, plain_text, styled
from ...core.units import arcseconds
from ...design.drawing import field_colors
from ...design.metrics.field_zernikes import name_terms
from .flags import DonutFlag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .result import DonutFit

#: Donuts of one picture unless others are asked for.
_SHOWN = 6
#: Range of the residuals over their standard deviation.
_RANGE = 5.0


def draw_donuts(fit: DonutFit, donuts: slice | list[int] | None) -> Figure:
    """Draw a fit; see :meth:`DonutFit.plot`."""
    chosen = np.arange(len(fit))[slice(_SHOWN) if donuts is None else donuts]
    n = len(chosen)
    with styled():
        figure = new_figure(max(7.0, 1.9 * n + 0.8), 9.2)
        upper, lower = figure.subfigures(2, 1, height_ratios=(1.75, 1.0))
        panels = upper.subplots(3, n, squeeze=False, sharex=True, sharey=True)
        for column, i in enumerate(chosen):
            image, model = fit.images[i], fit.model[i]
            top = float(np.nanpercentile(image, 99.5)) if np.isfinite(image).any() else 1.0
            noise = np.sqrt(np.maximum(np.abs(model), 1.0) + np.nanvar(fit.residuals[i][model < 0.05 * top]) if fit.usable[i] else 1.0)
            pull = np.where(fit.used[i], fit.residuals[i] / noise, np.nan)
            shown = panels[0, column].imshow(image, cmap="viridis", vmin=0.0, vmax=top)
            panels[1, column].imshow(model, cmap="viridis", vmin=0.0, vmax=top)
            spread = panels[2, column].imshow(pull, cmap="RdBu_r", vmin=-_RANGE, vmax=_RANGE)
            x, y = np.rad2deg(fit.fields[i])
            flag = DonutFlag(int(fit.flags[i])).reasons
            panels[0, column].set_title(f"({x:.3g}, {y:.3g})°" + (f"\n{flag}" if flag else ""), fontsize=8)
            if fit.usable[i]:
                seeing = float(arcseconds(fit.fwhm[i]))
                quality = fit.chi2[i] / fit.n_pixels[i]
                panels[2, column].set_xlabel(f'FWHM {seeing:.2f}"\nchi2/pixel {quality:.2f}', fontsize=8)
        for row, name in enumerate(("image", "model", "residual / noise")):
            panels[row, 0].set_ylabel(name)
        upper.colorbar(shown, ax=panels[:2], fraction=0.02, pad=0.01, label="electrons")
        upper.colorbar(spread, ax=panels[2], fraction=0.02, pad=0.01)
        bars = lower.subplots()
        width = 0.85 / n
        for column, (i, color) in enumerate(zip(chosen, field_colors(n), strict=True)):
            x, y = np.rad2deg(fit.fields[i])
            bars.bar(
                fit.noll + (column - 0.5 * (n - 1)) * width,
                fit.zernikes[i] * 1e9,
                width,
                yerr=fit.errors[i] * 1e9,
                color=color,
                error_kw={"linewidth": 0.7},
                label=f"({x:.3g}, {y:.3g})°",
            )
        name_terms(bars, fit.noll)
        bars.set_ylabel("coefficient = rms over the annulus [nm]")
        bars.legend(loc="best", ncols=3, fontsize=7)
        waves = ", ".join(f"{w * 1e9:.4g}" for w in fit.wavelengths)
        figure.suptitle(f"{plain_text(fit.telescope)}: donuts at {waves} nm, wavefront beyond the telescope's own", fontsize=11)
        return figure
