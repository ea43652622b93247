"""Files of an active-optics loop: tables of visits, states and estimates, summary, pictures, configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ...core.files import write_bytes, write_json
from ...core.plotting import BLUE, GREY, ORANGE, RED, label_log_axis, new_figure, plain_text, png_bytes, styled
from ...core.products import Columns, write_ecsv
from ...core.version import VERSION
from .loop import Alignment
from .store import CONFIG_NAME

#: A loop has converged where the wavefront, that of the design included, is at most so many times the floor.
CONVERGED = 1.2
#: Labels of logarithmic axes, as plain numbers.
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
# Donuts of a row of the picture: those of the eight halves.
_ACROSS = 8


def alignment_summary(alignment: Alignment) -> dict[str, Any]:
    """Return the figures of a loop as plain numbers; keys end in their unit."""
    added = np.array([v.added for v in alignment.visits])
    total = np.array([v.wavefront for v in alignment.visits])
    floor = float(np.hypot(alignment.designed.wavefront, alignment.floor))
    below = np.flatnonzero(total <= CONVERGED * floor)
    # The second half of the visits, after the loop has settled.
    late = slice(len(added) // 2, None)
    widths = np.array([v.fwhm for v in alignment.visits]) - alignment.designed.fwhm
    sizes = np.array([v.size for v in alignment.visits]) - alignment.designed.size

    def late_rms(key: str) -> float:
        return float(np.sqrt(np.mean([getattr(v, key) ** 2 for v in alignment.visits[late]])))

    return {
        "visits": len(added),
        "designed_wavefront_nm": 1e9 * alignment.designed.wavefront,
        "designed_fwhm_arcsec": alignment.designed.fwhm,
        "designed_rms_g": alignment.designed.rms_g,
        "designed_t_arcsec2": alignment.designed.size,
        "designed_rms_e": alignment.designed.rms_e,
        "floor_added_nm": 1e9 * alignment.floor,
        "floor_wavefront_nm": 1e9 * floor,
        "first_added_nm": 1e9 * added[0],
        "first_visit_within_1.2_floors": int(below[0]) if below.size else None,
        "late_wavefront_nm": 1e9 * float(np.sqrt(np.mean(total[late] ** 2))),
        "late_worst_wavefront_nm": 1e9 * float(total[late].max()),
        "late_added_nm": 1e9 * float(np.sqrt(np.mean(added[late] ** 2))),
        "late_worst_added_nm": 1e9 * float(added[late].max()),
        "late_fwhm_added_mas": 1e3 * float(widths[late].mean()),
        "late_rms_g": late_rms("rms_g"),
        "late_t_added_arcsec2": float(sizes[late].mean()),
        "late_rms_e": late_rms("rms_e"),
    }


def verdict(summary: dict[str, Any]) -> str:
    """Return the result of a loop in one sentence."""
    first = summary["first_visit_within_1.2_floors"]
    limit = f"{CONVERGED:g} times the floor of {summary['floor_wavefront_nm']:.0f} nm rms, the design's included"
    late = (
        f"in late visits misalignment adds {summary['late_added_nm']:.0f} nm rms, against "
        f"{summary['floor_added_nm']:.0f} nm that no correction can remove"
    )
    if first is None:
        return f"Not aligned: no visit comes within {limit}; {late}."
    if summary["late_worst_wavefront_nm"] <= CONVERGED * summary["floor_wavefront_nm"]:
        return f"Aligned: visit {first} is the first within {limit}, and all late visits are; {late}."
    return f"Not aligned throughout: visit {first} is the first within {limit}, but not all late visits are; {late}."


def write_alignment(alignment: Alignment, folder: Path) -> tuple[str, ...]:
    """Write the files of a loop into an existing folder, and return their names."""
    config = alignment.scene.config
    meta = {"pachon": VERSION, "telescope": alignment.scene.telescope.name, "seed": config.seed}
    meta |= {"degrees_of_freedom": alignment.scene.freedoms_source}
    visit = np.arange(len(alignment.visits))
    columns: Columns = {
        "visit": (visit, "", "number of the visit"),
        "wavefront": (1e9 * np.array([v.wavefront for v in alignment.visits]), "nm", "rms over pupil and field"),
        "added": (1e9 * np.array([v.added for v in alignment.visits]), "nm", "rms beyond the telescope as designed"),
        "expected": (1e9 * alignment.expected, "nm", "rms of what is added that the covariance of the states expects"),
        "fwhm": (np.array([v.fwhm for v in alignment.visits]), "arcsec", "mean FWHM under the mean of turbulence"),
        "rms_g": (np.array([v.rms_g for v in alignment.visits]), "", "rms g of adaptive moments, both components"),
        "t": (np.array([v.size for v in alignment.visits]), "arcsec2", "mean T of adaptive moments"),
        "rms_e": (np.array([v.rms_e for v in alignment.visits]), "", "rms weighted e, both components"),
        "donuts": (alignment.donuts, "", "donuts used"),
    }
    tables = {"visits.ecsv": ("visits of an active-optics loop", columns)}
    for name, description, values in (
        ("states.ecsv", "state of the telescope in each visit", alignment.states),
        ("estimates.ecsv", "estimated state of the telescope in each visit", alignment.estimates),
        ("state_errors.ecsv", "expected rms of the state in each visit", alignment.errors),
    ):
        tables[name] = (description, _by_freedom(alignment, values))
    for file, (subject, content) in tables.items():
        write_ecsv(folder / file, content, {"what": subject, **meta})
    pictures = {"quality.png": quality_picture, "states.png": state_picture, "donuts.png": donut_picture}
    for file, draw in pictures.items():
        write_bytes(folder / file, draw(alignment))
    write_json(folder / "summary.json", {**alignment_summary(alignment), **meta})
    write_bytes(folder / CONFIG_NAME, config.to_yaml().encode())
    return *tables, *pictures, "summary.json", CONFIG_NAME


def _by_freedom(alignment: Alignment, values: np.ndarray) -> Columns:
    """Return columns of the visit and of each degree of freedom, in its unit, of values in tolerances."""
    freedoms, sizes = alignment.scene.freedoms, alignment.scene.tolerances
    columns: Columns = {"visit": (np.arange(len(values)), "", "number of the visit")}
    for i, (name, unit) in enumerate(zip(freedoms.names, freedoms.units, strict=True)):
        columns[name] = (values[:, i] * sizes[i], "" if unit == "1" else unit, "degree of freedom")
    return columns


def quality_picture(alignment: Alignment) -> bytes:
    """Draw wavefront, width and ellipticity that misalignment adds, visit by visit."""
    visit = np.arange(len(alignment.visits))
    designed = alignment.designed
    panels = (
        ("wavefront added [nm rms]", [1e9 * v.added for v in alignment.visits]),
        ("FWHM added [mas]", [1e3 * (v.fwhm - designed.fwhm) for v in alignment.visits]),
        ("rms g of adaptive moments [1e-3]", [1e3 * v.rms_g for v in alignment.visits]),
    )
    with styled():
        figure = new_figure(7.0, 8.0)
        panel_axes = figure.subplots(3, 1, sharex=True)
        for axes, (label, values) in zip(panel_axes, panels, strict=True):
            axes.plot(visit, values, "o-", color=BLUE, markersize=3.0, linewidth=0.8, label="telescope")
            axes.set_ylabel(label)
        for axes, values in ((panel_axes[0], panels[0][1]), (panel_axes[2], panels[2][1])):
            # A telescope without errors adds nothing, and zeros have no logarithm.
            if max(values) > 0.0:
                axes.set_yscale("log")
                label_log_axis(axes.yaxis)
        panel_axes[0].plot(visit, 1e9 * alignment.expected, color=ORANGE, label="expected from the covariance")
        panel_axes[0].axhline(1e9 * alignment.floor, color=GREY, linewidth=0.8, linestyle="--", label="floor")
        panel_axes[1].set_yscale("symlog", linthresh=10.0)
        panel_axes[1].yaxis.set_major_formatter(PLAIN)
        panel_axes[1].axhline(0.0, color=GREY, linewidth=0.8, linestyle="--", label="as designed")
        panel_axes[2].axhline(1e3 * designed.rms_g, color=GREY, linewidth=0.8, linestyle="--", label="as designed")
        for axes in panel_axes:
            axes.legend(fontsize=8)
        panel_axes[1].set_ylim(bottom=-5.0)
        panel_axes[2].set_xlabel("visit")
        panel_axes[2].xaxis.set_major_locator(MaxNLocator(integer=True))
        return png_bytes(figure)


def state_picture(alignment: Alignment) -> bytes:
    """Draw the state of the first visit with its estimate, and that of the last with its expected error."""
    names = [plain_text(name) for name in alignment.scene.freedoms.names]
    place = np.arange(len(names))
    with styled():
        figure = new_figure(min(13.0, 4.0 + 0.17 * len(names)), 6.5)
        first, last = figure.subplots(2, 1, sharex=True)
        first.bar(place, alignment.states[0], color="0.8", label="state")
        first.plot(place, alignment.estimates[0], "o", color=BLUE, markersize=3.5, label="estimate")
        first.set(ylabel="first visit [tolerances]")
        last.bar(place, alignment.states[-1], color="0.8", label="state")
        spread = alignment.errors[-1]
        last.errorbar(place, 0.0 * spread, spread, fmt="none", color=RED, linewidth=0.9, label="expected rms")
        last.set(ylabel=f"visit {len(alignment.states) - 1} [tolerances]")
        last.set_xticks(place, names, rotation=90, fontsize=7)
        for axes in (first, last):
            axes.legend(fontsize=8, ncols=2)
        return png_bytes(figure)


def donut_picture(alignment: Alignment) -> bytes:
    """Draw the donuts of the first and the last visit, and what the fit leaves of them."""
    visits = {"first visit": alignment.first, f"visit {len(alignment.visits) - 1}": alignment.last}
    sensors = alignment.scene.stars.sensors
    shown_stars = np.unique(np.linspace(0, len(sensors) - 1, min(_ACROSS, len(sensors))).astype(int))
    with styled():
        figure = new_figure(1.5 * len(shown_stars), 6.4)
        grid = figure.subplots(4, len(shown_stars), squeeze=False)
        for pair, (title, fit) in enumerate(visits.items()):
            donuts = alignment.scene.config.donuts
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
