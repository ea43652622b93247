"""The picture of a through-focus run."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import new_figure, styled
from ..drawing import FEW, field_colors, field_label
from ..metrics.through_focus import ThroughFocus


def through_focus_figure(result: ThroughFocus) -> Figure:
    """Draw rms radius [um], rms wavefront [waves] and Strehl ratio against the height of the detector [um]."""
    wavelength = float(result.wavelengths.mean())
    waves = result.rms_wavefront / wavelength
    panels = [
        (result.rms_radius * 1e6, "rms spot radius [µm]", result.best_spot),
        (waves, f"rms wavefront [waves at {wavelength * 1e9:.4g} nm]", result.best_wavefront),
        (result.strehl, "Strehl ratio (tilt taken off)", np.full(len(waves), np.nan)),
    ]
    with styled():
        figure = new_figure(12.0, 4.4)
        for axes, (values, label, best) in zip(figure.subplots(1, 3), panels, strict=True):
            _draw_curves(axes, result, values, best)
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        figure.suptitle(
            f"{result.telescope}: through focus; the spots of all fields together are smallest at "
            f"{result.best_common * 1e6:+.3g} µm",
            fontsize=11,
        )
        return figure


def _draw_curves(axes: Axes, result: ThroughFocus, values: np.ndarray, best: np.ndarray) -> None:
    heights = result.defocus * 1e6
    few = len(result.fields) <= FEW
    for row, field, color, height in zip(
        values, result.fields, field_colors(len(result.fields)), best * 1e6, strict=True
    ):
        axes.plot(heights, row, color=color, linewidth=1.4, label=field_label(field) if few else None)
        if heights[0] <= height <= heights[-1]:
            axes.plot(height, np.interp(height, heights, row), "o", color=color, markersize=4.0)
    axes.axvline(0.0, color="0.6", linewidth=0.7)
    axes.axvline(
        result.best_common * 1e6, color="0.3", linewidth=0.9, linestyle=(0, (4, 3)), label="best for all together"
    )
    axes.set_xlim(heights[0], heights[-1])
    axes.set_xlabel("height of the detector above its place [µm]")
    axes.grid(True, color="0.92", linewidth=0.6)
