"""Files of an active-optics loop: tables of visits, states and estimates, summary, pictures, configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.files import write_bytes, write_json
from ...core.products import Columns, write_ecsv
from ...core.version import VERSION
from .loop import Alignment
from .plots import donut_picture, quality_picture, state_picture
from .store import CONFIG_NAME

#: A loop has converged where misalignment adds at most so many times the floor.
CONVERGED = 1.2


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
