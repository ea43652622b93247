"""Pictures of what degrees of freedom do: the sensitivity matrix, and the way of an optimisation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...core.plotting import BLUE, GREY, new_figure, styled

if TYPE_CHECKING:
    from ..optimize.optimize import Optimum
    from ..optimize.sensitivity import Sensitivity


def sensitivity_figure(result: Sensitivity) -> Figure:
    """Draw which Zernike terms each degree of freedom makes, rms over the field, and the singular values."""
    first = min(4, result.matrix.shape[1])
    size = np.sqrt((result.matrix[:, first - 1 :] ** 2).mean(axis=0))
    largest = size.max(axis=0)
    with styled():
        names = [p.address for p in result.parameters]
        figure = new_figure(min(14.0, 4.5 + 0.22 * len(names)), 4.6)
        axes, modes = figure.subplots(1, 2, width_ratios=[2.2, 1.0])
        shown = np.log10(np.maximum(size / np.where(largest > 0, largest, 1.0), 1e-4))
        last = result.matrix.shape[1]
        box = (-0.5, len(names) - 0.5, first - 0.5, last + 0.5)
        image = axes.imshow(shown, extent=box, cmap="viridis", aspect="auto", vmin=-4.0, vmax=0.0)
        bar = figure.colorbar(image, ax=axes, label="of the largest term of each", ticks=range(-4, 1))
        bar.ax.set_yticklabels([f"$10^{{{k}}}$" if k else "1" for k in range(-4, 1)])
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8 if len(names) <= 24 else 5)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel("Noll index")
        axes.set_title(f"{result.telescope}, {result.wavelength * 1e9:g} nm: rms over {len(result.fields)} fields")
        values, _ = result.modes()
        modes.semilogy(np.arange(1, len(values) + 1), values, "o-", color=BLUE, markersize=3.5, linewidth=0.9)
        modes.xaxis.set_major_locator(MaxNLocator(integer=True))
        modes.grid(True, which="major", linewidth=0.3)
        modes.set_xlabel("mode")
        modes.set_ylabel("singular value, each parameter scaled to 1")
        modes.set_title("what can be told apart")
        return figure


def optimum_figure(result: Optimum) -> Figure:
    """Draw the merit step by step, and the change of each variable in terms of what it does."""
    with styled():
        names = [p.address for p in result.variables]
        figure = new_figure(8.4, max(3.2, 1.4 + 0.24 * len(names)))
        steps, bars = figure.subplots(1, 2)
        steps.semilogy(range(len(result.history)), result.history * 1e6, "o-", color=BLUE, markersize=4)
        steps.xaxis.set_major_locator(MaxNLocator(integer=True))
        steps.grid(True, which="major", linewidth=0.3)
        steps.set_xlabel("step")
        steps.set_ylabel(f"rms of {result.merit_name} [µm]")
        places = np.arange(len(names))
        bars.barh(places, np.abs(result.changes) * result.effect * 1e6, color=GREY, height=0.7)
        bars.set_yticks(places, names)
        bars.invert_yaxis()
        bars.set_xlabel("change of each times its effect, rms [µm]")
        steps.set_title(result.telescope.name)
        return figure
