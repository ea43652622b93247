"""Files of shims: motions, gains, plot, and the configuration of a run with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...core.plotting import png_bytes
from ...measure.correlation_plots import correlation_columns
from ...pipeline.experiment import Experiment
from ...pipeline.run_folder import stamp_of
from ..product import write_products
from .shim import Shims, StateMetrics, shimmed_configuration


def shim_metrics(shims: Shims) -> dict[str, Any]:
    """Return motions and means as plain numbers; keys end in their unit."""
    motions = {name: (m.dz * 1e6, m.rx * 1e6, m.ry * 1e6) for name, m in shims.motions.items()}
    named = {name: dict(zip(("dz_um", "rx_urad", "ry_urad"), values, strict=True)) for name, values in motions.items()}

    def states(metrics: Mapping[str, StateMetrics]) -> dict[str, dict[str, float]]:
        return {
            state: {
                "mean_fwhm_arcsec": m.fwhm,
                "rms_g": m.rms_g,
                "rms_xi_plus_g": m.rms_xi_g,
                "mean_t_arcsec2": m.size,
                "rms_e": m.rms_e,
                "rms_xi_plus": m.rms_xi,
            }
            for state, m in metrics.items()
        }

    focus = asdict(shims.focus)
    return {
        "merit": shims.merit,
        "parts": shims.parts,
        "focus": {"dz_um": focus["dz"] * 1e6, "rx_urad": focus["rx"] * 1e6, "ry_urad": focus["ry"] * 1e6},
        "motions": named,
        "at_fitted_places": states(shims.fitted),
        "at_other_places": states(shims.checked),
    }


def write_shims(shims: Shims, folder: Path, experiment: Experiment) -> tuple[str, ...]:
    """Write motions, gains, correlations, plot and the configuration with the shims; return the names of the files."""
    motions = shims.motions.values()
    columns = {
        "part": (np.array(list(shims.motions)), "", "raft or CCD"),
        "dz_um": (np.array([m.dz for m in motions]) * 1e6, "um", "piston along +z"),
        "rx_urad": (np.array([m.rx for m in motions]) * 1e6, "urad", "rotation about x; lifts the side at larger y"),
        "ry_urad": (np.array([m.ry for m in motions]) * 1e6, "urad", "rotation about y; lowers the side at larger x"),
    }
    return write_products(
        folder,
        {
            "shims.ecsv": ("motions beside the focus of the whole focal plane", columns),
            "correlations.ecsv": (
                "xi of g of adaptive moments, of each state",
                correlation_columns(shims.correlations),
            ),
        },
        {"shims.png": png_bytes(shims.plot())},
        {"shims.json": shim_metrics(shims)},
        stamp_of(experiment).meta(),
        shimmed_configuration(experiment.config, shims),
        "the run with the focus and the shims among its moved rafts and CCDs.",
    )
