"""Files of an active-optics loop: tables of visits, states and estimates, summary, pictures, configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ...core.files import write_bytes, write_json
from ...core.plotting import BLUE, GREY, ORANGE, RED, new_figure, plain_text, png_bytes, styled
from ...core.products import Columns, write_ecsv
from ...core.version import VERSION
from .loop import Alignment
from .store import CONFIG_NAME

#: A loop has converged where misalignment adds at most so many times the floor.
CONVERGED = 1.2
#: Labels of logarithmic axes, as plain numbers.
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
# Donuts of a row of the picture: those of the eight halves.
_ACROSS = 8


def alignment_summary(found: Alignment) -> dict[str, Any]:
    """Return the figures of a loop as plain numbers; keys end in their unit."""
    added = np.array([v.added for v in found.visits])
    total = np.array([v.wavefront for v in found.visits])
    floor = float(np.hypot(found.designed.wavefront, found.floor))
    below = np.flatnonzero(total <= CONVERGED * floor)
    # The second half of the visits, after the loop has settled.
    late = slice(len(added) // 2, None)
    widths = np.array([v.fwhm for v in found.visits]) - found.designed.fwhm
    ellipticity = np.array([v.ellipticity for v in found.visits])
    return {
        "visits": len(added),
        "designed_wavefront_nm": 1e9 * found.designed.wavefront,
        "designed_fwhm_arcsec": found.designed.fwhm,
        "designed_rms_e": found.designed.ellipticity,
        "floor_added_nm": 1e9 * found.floor,
        "floor_wavefront_nm": 1e9 * floor,
        "first_added_nm": 1e9 * added[0],
        "first_visit_within_1.2_floors": int(below[0]) if below.size else None,
        "late_wavefront_nm": 1e9 * float(np.sqrt(np.mean(total[late] ** 2))),
        "late_worst_wavefront_nm": 1e9 * float(total[late].max()),
        "late_added_nm": 1e9 * float(np.sqrt(np.mean(added[late] ** 2))),
        "late_worst_added_nm": 1e9 * float(added[late].max()),
        "late_fwhm_added_mas": 1e3 * float(widths[late].mean()),
        "late_rms_e": float(np.sqrt(np.mean(ellipticity[late] ** 2))),
    }


def write_alignment(found: Alignment, folder: Path) -> tuple[str, ...]:
    """Write the files of a loop into an existing folder, and return their names."""
    config = found.scene.config
    meta = {"pachon": VERSION, "telescope": found.scene.telescope.name, "seed": config.seed}
    meta |= {"degrees_of_freedom": found.scene.freedoms_source}
    visit = np.arange(len(found.visits))
    columns: Columns = {
        "visit": (visit, "", "number of the visit"),
        "wavefront": (1e9 * np.array([v.wavefront for v in found.visits]), "nm", "rms over pupil and field"),
        "added": (1e9 * np.array([v.added for v in found.visits]), "nm", "rms beyond the telescope as designed"),
        "expected": (1e9 * found.expected, "nm", "rms of what is added that the covariance of the states expects"),
        "fwhm": (np.array([v.fwhm for v in found.visits]), "arcsec", "mean FWHM under the mean of turbulence"),
        "rms_e": (np.array([v.ellipticity for v in found.visits]), "", "rms ellipticity, both components"),
        "donuts": (found.donuts, "", "donuts used"),
    }
    tables = {"visits.ecsv": ("visits of an active-optics loop", columns)}
    for name, description, values in (
        ("states.ecsv", "state of the telescope in each visit", found.states),
        ("estimates.ecsv", "estimated state of the telescope in each visit", found.estimates),
        ("state_errors.ecsv", "expected rms of the state in each visit", found.errors),
    ):
        tables[name] = (description, _by_freedom(found, values))
    for file, (subject, content) in tables.items():
        write_ecsv(folder / file, content, {"what": subject, **meta})
    pictures = {"quality.png": quality_picture, "states.png": state_picture, "donuts.png": donut_picture}
    for file, draw in pictures.items():
        write_bytes(folder / file, draw(found))
    write_json(folder / "summary.json", {**alignment_summary(found), **meta})
    write_bytes(folder / CONFIG_NAME, config.to_yaml().encode())
    return *tables, *pictures, "summary.json", CONFIG_NAME


def _by_freedom(found: Alignment, values: np.ndarray) -> Columns:
    """Return columns of the visit and of each degree of freedom, in its unit, of values in tolerances."""
    freedoms, sizes = found.scene.freedoms, found.scene.tolerances
    columns: Columns = {"visit": (np.arange(len(values)), "", "number of the visit")}
    for i, (name, unit) in enumerate(zip(freedoms.names, freedoms.units, strict=True)):
        columns[name] = (values[:, i] * sizes[i], "" if unit == "1" else unit, "degree of freedom")
    return columns


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
