"""Points of a sweep over a telescope without a camera: values of its prescription, and metrics of its optics.

The configuration may state `telescope`, `wavelengths_nm` and `changes`; a parameter is one of these keys, or a value of
the prescription with its unit.
"""

from __future__ import annotations

from copy import deepcopy
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...core.errors import ConfigError, unknown_name
from ...core.files import path_beside
from ...core.units import angular
from ...models.io.bundled import BUNDLED
from ...models.io.prescription import load_telescope, prescription_digest
from ...models.parameters.changes import apply_changes, parse_change
from ...models.telescope import Telescope
from ...pipeline.config import Configuration, configuration_of
from ..metrics.telescope import TELESCOPE_METRICS, TelescopeScene
from .compensation import solved_compensators
from .file import Point, SweepFile

#: Keys of the configuration that apply to a telescope without a camera.
KEYS = ("telescope", "wavelengths_nm", "changes", "seed")


def has_no_camera(sweep: SweepFile, parameters: Point, folder: Path) -> bool:
    """Return whether the telescope of a point has no camera."""
    base = sweep.base if isinstance(sweep.base, dict) else {}
    name = parameters.get("telescope", base.get("telescope"))
    if not isinstance(name, str):
        return False
    path = telescope_path(name, folder)
    return _without_camera(path, prescription_digest(path) if Path(path).is_file() else "")


def point_metrics(sweep: SweepFile, parameters: Point, folder: Path, threads: int) -> dict[str, float]:
    """Return the metrics of one point, compensators solved for the smallest spots."""
    telescope, config = point_telescope(sweep, parameters, folder)
    fields = None if sweep.fields_deg is None else np.deg2rad(sweep.fields_deg)
    waves = None if config.wavelengths_nm is None else np.array(config.wavelengths_nm) * 1e-9
    solved: dict[str, float] = {}
    if sweep.compensators:
        telescope, solved = solved_compensators(telescope, sweep.compensators, "spots", fields, waves, threads)
    scene = TelescopeScene(telescope, fields, waves, threads)
    metrics: dict[str, float] = {}
    for name in dict.fromkeys(sweep.metrics):
        metrics |= TELESCOPE_METRICS[name].compute(scene)
    if telescope.design_data.afocal:
        metrics = {angular(name): value for name, value in metrics.items()}
    return metrics | {f"solved {name}": value for name, value in solved.items()}


def point_telescope(sweep: SweepFile, parameters: Point, folder: Path) -> tuple[Telescope, Configuration]:
    """Return the telescope and the configuration of one point; other keys are an error."""
    content = deepcopy(sweep.base) if isinstance(sweep.base, dict) else {}
    for name, value in parameters.items():
        if name in KEYS:
            content[name] = [value] if name == "wavelengths_nm" else value
        else:
            content.setdefault("changes", {})[name] = value
    for key in content:
        if key not in KEYS:
            raise ConfigError(f"base.{key}: expected {', '.join(KEYS)} alone, for a telescope without a camera")
    config = configuration_of(content, f"sweep {sweep.name}")
    telescope = load_telescope(telescope_path(config.telescope or "", folder))
    return apply_changes(telescope, config.changes), config


def check_telescope_sweep(sweep: SweepFile, parameters: Point, folder: Path) -> None:
    """Check the names of metrics and compensators, and the values of one point."""
    for name in sweep.metrics:
        if name not in TELESCOPE_METRICS:
            raise unknown_name("metric of a telescope without a camera", name, TELESCOPE_METRICS)
    telescope, _ = point_telescope(sweep, parameters, folder)
    for name in sweep.compensators:
        parse_change(telescope, name, "compensators")
    if sweep.fields_deg is not None:
        telescope.check_field(*np.deg2rad(sweep.fields_deg).T)


def telescope_path(name: str, folder: Path) -> str:
    """Return a bundled name as it is, and the path of a file from a folder."""
    return name if name in BUNDLED else path_beside(folder, name)


@lru_cache(maxsize=64)
def _without_camera(path: str, digest: str) -> bool:
    """Return whether the telescope in a file of that digest has no camera: points of a sweep share the answer."""
    del digest  # part of the key
    return load_telescope(path).camera is None
