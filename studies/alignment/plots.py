"""Pictures of an active-optics loop: quality visit by visit, states, and donuts."""

from __future__ import annotations

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ...core.plotting import BLUE, GREY, ORANGE, RED, new_figure, plain_text, png_bytes, styled
from .loop import Alignment

#: Labels of logarithmic axes, as plain numbers.
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
# Donuts of a row of the picture: those of the eight halves.
_ACROSS = 8


def quality_picture(found: Alignment) -> bytes:
    """Draw wavefront, width and ellipticity that misalignment adds, visit by visit."""
    visit = np.arange(len(found.visits))
    designed = found.designed
    panels = (
        ("wavefront added [nm rms]", [1e9 * v.added for v in found.visits]),
        ("FWHM added [mas]", [1e3 * (v.fwhm - designed.fwhm) for v in found.visits]),
        ("rms ellipticity [1e-3]", [1e3 * v.ellipticity for v in found.visits]),
    )
    with styled():
        figure = new_figure(7.0, 8.0)
        panel_axes = figure.subplots(3, 1, sharex=True)
        for axes, (label, values) in zip(panel_axes, panels, strict=True):
            axes.plot(visit, values, "o-", color=BLUE, markersize=3.0, linewidth=0.8, label="telescope")
            axes.set_ylabel(label)
        for axes in panel_axes[[0, 2]]:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(PLAIN)
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel_axes[0].plot(visit, 1e9 * found.expected, color=ORANGE, label="expected from the covariance")
        panel_axes[0].axhline(1e9 * found.floor, color=GREY, linewidth=0.8, linestyle="--", label="floor")
        panel_axes[1].set_yscale("symlog", linthresh=10.0)
        panel_axes[1].yaxis.set_major_formatter(PLAIN)
        panel_axes[1].axhline(0.0, color=GREY, linewidth=0.8, linestyle="--", label="as designed")
        panel_axes[2].axhline(
            1e3 * designed.ellipticity, color=GREY, linewidth=0.8, linestyle="--", label="as designed"
        )
        for axes in panel_axes:
            axes.legend(fontsize=8)
        panel_axes[1].set_ylim(bottom=-5.0)
        panel_axes[2].set_xlabel("visit")
        panel_axes[2].xaxis.set_major_locator(MaxNLocator(integer=True))
        return png_bytes(figure)


def state_picture(found: Alignment) -> bytes:
    """Draw the state of the first visit with its estimate, and that of the last with its expected error."""
    names = [plain_text(name) for name in found.scene.freedoms.names]
    place = np.arange(len(names))
    with styled():
        figure = new_figure(min(13.0, 4.0 + 0.17 * len(names)), 6.5)
        first, last = figure.subplots(2, 1, sharex=True)
        first.bar(place, found.states[0], color="0.8", label="state")
        first.plot(place, found.estimates[0], "o", color=BLUE, markersize=3.5, label="estimate")
        first.set(ylabel="first visit [tolerances]")
        last.bar(place, found.states[-1], color="0.8", label="state")
        spread = found.errors[-1]
        last.errorbar(place, 0.0 * spread, spread, fmt="none", color=RED, linewidth=0.9, label="expected rms")
        last.set(ylabel=f"visit {len(found.states) - 1} [tolerances]")
        last.set_xticks(place, names, rotation=90, fontsize=7)
        for axes in (first, last):
            axes.legend(fontsize=8, ncols=2)
        return png_bytes(figure)


def donut_picture(found: Alignment) -> bytes:
    """Draw the donuts of the first and the last visit, and what the fit leaves of them."""
    visits = {"first visit": found.first, f"visit {len(found.visits) - 1}": found.last}
    sensors = found.scene.stars.sensors
    shown_stars = np.unique(np.linspace(0, len(sensors) - 1, min(_ACROSS, len(sensors))).astype(int))
    with styled():
        figure = new_figure(1.5 * len(shown_stars), 6.4)
        grid = figure.subplots(4, len(shown_stars), squeeze=False)
        for pair, (title, fit) in enumerate(visits.items()):
            donuts = found.scene.config.donuts
            sigma = np.sqrt(np.maximum(fit.model, 0.0) + donuts.sky + donuts.read_noise**2)
            for column, star in enumerate(shown_stars):
                image, residual = grid[2 * pair : 2 * pair + 2, column]
                image.imshow(fit.images[star], origin="lower", cmap="gray")
                residual.imshow(fit.residuals[star] / sigma[star], origin="lower", cmap="RdBu_r", vmin=-5.0, vmax=5.0)
                for axes in (image, residual):
                    axes.set(xticks=[], yticks=[])
                if pair == 0:
                    image.set_title(sensors[star], fontsize=8)
            grid[2 * pair, 0].set_ylabel(title, fontsize=8)
            grid[2 * pair + 1, 0].set_ylabel("residual, ±5 σ", fontsize=8)
        return png_bytes(figure)
