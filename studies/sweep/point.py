"""One point of a sweep: the values of its parameters become a configuration, and that becomes figures.

A parameter is

- a key of the configuration, with dots between sections: ``band``, ``atmosphere.r0_m``, ``focal_plane.raft_um``;
- a motion of a raft or CCD: ``R22.dz_um``, ``R22_S11.rx_urad``, ``R22_S11.ry_urad``;
- a value of the prescription with its unit: ``M2.dz_um``, ``Camera.rx_urad``, ``M1.Z5_nm``, ``M1.radius_m``; see
  :mod:`pachon.design.parameters.parameters`.

Random numbers are common to all points of a replica: heights keep their pattern when a term grows, stars their places,
turbulence and wind theirs, so a difference between two points is the doing of their parameters.
"""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, PachonError, unknown_name
from ...core.schema import known_keys
from ...design.parameters.changes import parse_change
from ...models.camera.camera import Camera, load_camera
from ...pipeline.config import Configuration, configuration_of
from ...pipeline.experiment import Experiment, prepare, resolve
from .compensation import compensated
from .file import SweepFile
from .metrics import check_metrics, measure_metrics
from .store import PointResult, SweepPoint
from .workers import worker_name

_MOTIONS = ("dz_um", "rx_urad", "ry_urad")


@dataclass(frozen=True)
class PointMeasurement:
    """Compute points of a sweep; a picklable function that every worker can be handed.

    Parameters
    ----------
    sweep : SweepFile
        The sweep.
    folder : str
        Folder that relative paths of its configuration start from.
    """

    sweep: SweepFile
    folder: str

    def __call__(self, point: SweepPoint, threads: int) -> PointResult:
        """Compute one point; what cannot be computed is a result too, with one line that says why."""
        start = time.perf_counter()
        metrics, problem = None, None
        try:
            experiment = _with_screens(point_experiment(self.sweep, point, Path(self.folder)))
            experiment, solved = compensated(experiment, self.sweep.compensators, threads)
            metrics = measure_metrics(experiment, self.sweep.metrics, threads)
            metrics |= {f"solved {name}": value for name, value in solved.items()}
        except PachonError as error:
            problem = " ".join(str(error).split())
        return PointResult(point.number, metrics, problem, time.perf_counter() - start, worker_name())


def point_configuration(sweep: SweepFile, parameters: dict[str, Any], seed: int, folder: Path) -> Configuration:
    """Return the resolved configuration of one point.

    Raises
    ------
    PachonError
        If a parameter is unknown, or its value not possible: one line.
    """
    if not isinstance(sweep.base, dict):
        raise ConfigError(f"base = {sweep.base!r}: expected the content of the file; see load_sweep")
    content = deepcopy(sweep.base)
    content["seed"] = seed
    keys = known_keys(Configuration)
    sections = {key.partition(".")[0] for key in keys if "." in key}
    for name, value in parameters.items():
        if name in keys:
            # One wavelength is the whole band, and one CCD all there is.
            alone = name in ("wavelengths_nm", "ccds")
            _set(content, name.split("."), [value] if alone else value)
            continue
        body, _, quantity = name.partition(".")
        if body in _bodies():
            if quantity not in _MOTIONS:
                raise unknown_name(f"motion of {body}", quantity, _MOTIONS)
            _set(content, ["focal_plane", "moved", body, quantity], value)
        elif body in sections or not quantity:
            raise unknown_name("parameter", name, keys)
        else:
            _set(content, ["changes", name], value)
    return resolve(configuration_of(content, f"sweep {sweep.name}"), folder)


def point_experiment(sweep: SweepFile, point: SweepPoint, folder: Path) -> Experiment:
    """Return the telescope, focal plane and atmosphere of one point."""
    return prepare(point_configuration(sweep, point.parameters, point.seed, folder))


def check_sweep(sweep: SweepFile, points: list[SweepPoint], folder: Path) -> None:
    """Check names and values before anything is computed, on the first point and the extremes of each parameter.

    Raises
    ------
    PachonError
        If a parameter, metric or compensator is unknown, or a value not possible: one line.
    """
    check_metrics(sweep.metrics)
    if not points:
        raise ConfigError(f"sweep {sweep.name}: no points to compute")
    tried: set[int] = {points[0].number}
    telescope = point_experiment(sweep, points[0], folder).telescope
    for name in sweep.compensators:
        parse_change(telescope, name)
    for name in points[0].parameters:
        ordered = sorted(points, key=lambda p: (isinstance(p.parameters[name], str), p.parameters[name]))
        for point in (ordered[0], ordered[-1]):
            if point.number not in tried:
                tried.add(point.number)
                point_configuration(sweep, point.parameters, point.seed, folder)


_kept: list[Experiment] = []


def _with_screens(experiment: Experiment) -> Experiment:
    """Return the experiment with the screens of the one before, where they are the same: they take seconds to make."""

    def air(one: Experiment) -> Any:
        return one.config.seed, one.config.atmosphere, one.config.psf.engine

    if experiment.atmosphere is None or not experiment.screen_kinds:
        return experiment
    if _kept and air(_kept[0]) == air(experiment):
        return replace(experiment, atmosphere=_kept[0].atmosphere)
    for before in _kept:
        if before.atmosphere is not None:
            before.atmosphere.release()
    _kept[:] = [experiment]
    return experiment


@lru_cache(maxsize=1)
def _bodies() -> frozenset[str]:
    camera: Camera = load_camera("lsst")
    return frozenset((*camera.raft_names, *camera.ccd_names))


def _set(content: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        content = content.setdefault(part, {})
    content[path[-1]] = value
