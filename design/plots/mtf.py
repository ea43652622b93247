"""The picture of modulation transfer: a panel for each of a few fields, or all fields in one."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.plotting import BLUE, RED, new_figure, styled
from ..drawing import field_label, second_scale
from ..images.mtf import Mtf

#: Panels in a row.
_MOST = 3


def mtf_figure(result: Mtf) -> Figure:
    """Draw tangential and sagittal contrast, the limit of diffraction and what rays alone would give."""
    count = len(result.fields)
    rows = -(-count // _MOST)
    columns = -(-count // rows)
    with styled():
        figure = new_figure(max(3.5 * columns, 5.5), 2.6 * rows + 1.0)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes in panels[count:]:
            axes.set_axis_off()
        for i, axes in enumerate(panels[:count]):
            _draw_field(axes, result, i)
        for i, axes in enumerate(panels[:count]):
            if i % columns == 0:
                axes.set_ylabel("contrast")
            if i + columns >= count:
                axes.set_xlabel("spatial frequency [cycles/mm]")
                axes.tick_params(labelbottom=True)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3 if columns > 1 else 2)
        waves = ", ".join(f"{w * 1e9:.4g}" for w in result.wavelengths)
        figure.suptitle(f"{result.telescope}: modulation transfer, {waves} nm", fontsize=11)
        return figure


def _draw_field(axes: Axes, result: Mtf, i: int) -> None:
    frequency = result.frequency * 1e-3
    for name, color, solid, limit, rays in (
        ("tangential", BLUE, result.tangential, result.tangential_limit, result.geometric_tangential),
        ("sagittal", RED, result.sagittal, result.sagittal_limit, result.geometric_sagittal),
    ):
        axes.plot(frequency, limit[i], color=color, linewidth=0.8, alpha=0.55, label=f"{name}, perfect wavefront")
        axes.plot(frequency, rays[i], color=color, linewidth=0.8, linestyle=(0, (1, 1.5)), label=f"{name}, rays alone")
        axes.plot(frequency, solid[i], color=color, linewidth=1.5, label=name)
    axes.set(xlim=(0.0, frequency[-1]), ylim=(0.0, 1.0))
    axes.grid(True, color="0.92", linewidth=0.6)
    half = result.frequency_at(0.5)[i] * 1e-3
    axes.text(
        0.97,
        0.95,
        f"{field_label(result.fields[i])}\n50 % at {half[0]:.3g} (t), {half[1]:.3g} (s)",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=8,
    )
    if i < _MOST:
        arcsec_per_mm = float(np.rad2deg(result.plate_scale[i].mean())) * 3600e-3
        second_scale(axes, 1.0 / arcsec_per_mm, "cycles per arc second")
