"""Files of an attribution: metrics, correlations, plot, configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.files import write_bytes, write_json
from ...core.products import write_ecsv
from ...pipeline.config import Configuration, to_yaml
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import SEPARATION_RANGES
from ...pipeline.measure.diagnostics import correlation_columns
from ...pipeline.run_folder import CONFIG_NAME, stamp_of
from .attribution import Attribution
from .plots import attribution_plot


def write_attribution(result: Attribution, folder: Path, config: Configuration) -> tuple[str, ...]:
    """Write metrics, correlations, plot and configuration; return the names of the files."""
    stamp = stamp_of(Experiment.from_config(config))
    meta = {"pachon": stamp.version, "config_hash": stamp.config_hash, "seed": stamp.seed}
    cases = list(result.metrics)
    keys = list(dict.fromkeys(key for each in result.metrics.values() for key in each))
    columns = {"off": (np.array(cases), "", "cause that is switched off, or full")}
    for key in keys:
        values = np.array([result.metrics[case].get(key, np.nan) for case in cases])
        columns[key] = (values, "arcsec" if key.endswith("arcsec") else "", _meaning(key))
    everything = {f"{case} {kind}": c for case, each in result.correlations.items() for kind, c in each.items()}
    write_ecsv(folder / "attribution.ecsv", columns, {"what": "the same stars without one cause", **meta})
    write_ecsv(folder / "correlations.ecsv", correlation_columns(everything), {"what": "xi of each case", **meta})
    write_bytes(folder / "attribution.png", attribution_plot(result.metrics, result.correlations))
    write_json(folder / "attribution.json", {"figures": result.metrics, **meta})
    heading = (f"pachon {stamp.version}: the case with everything on.",)
    write_bytes(folder / CONFIG_NAME, to_yaml(config, heading).encode())
    return "attribution.ecsv", "correlations.ecsv", "attribution.png", "attribution.json", CONFIG_NAME


def _meaning(key: str) -> str:
    for start, words in (("change_", "full case less this one: "), ("error_", "jackknife error of the change: ")):
        if key.startswith(start):
            return words + _meaning(key.removeprefix(start))
    if key.startswith("xi_plus_"):
        low, high = SEPARATION_RANGES[key.rpartition("_")[2]]
        return f"mean xi+ of {key.split('_')[2]}, {low:g} to {high:g} arcmin"
    return "median FWHM" if key == "fwhm_arcsec" else key.replace("_", " ") + ", one component"
