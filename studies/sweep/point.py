"""Points of a sweep: parameter values become a configuration, and that becomes metrics.

A parameter is

- a key of the configuration, with dots between sections: ``band``, ``atmosphere.r0_m``, ``focal_plane.raft_um``;
- a motion of a raft or CCD of the point's camera: ``R22.dz_um``, ``R22_S11.rx_urad``, ``R22_S11.ry_urad``;
- a value of the prescription with its unit: ``M2.dz_um``, ``Camera.rx_urad``, ``M1.Z5_nm``, ``M1.radius_m``; see
  :mod:`pachon.models.parameters.parameters`.

A telescope without a camera has metrics of the optics alone: see :mod:`pachon.studies.sweep.telescope_point`.

Random numbers are common to all points of a replica. Heights keep their pattern when a term grows, stars their
positions, turbulence and wind their course. A difference between two points is then an effect of their parameters. With
screens another Fried parameter, or zenith angle, makes other turbulence: which modes are on which screen follows it.
"""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, PachonError, unknown_name
from ...core.schema import known_keys
from ...core.workers import worker_name
from ...models.parameters.changes import parse_change
from ...pipeline.config import Configuration, configuration_of
from ...pipeline.defaults import resolve
from ...pipeline.experiment import Experiment
from ...pipeline.screen_cache import with_cached_screens
from ..metrics.scene import Scene
from ..metrics.stars import STARS
from ..metrics.telescope import TELESCOPE_METRICS
from .compensation import compensated
from .file import Point, SweepFile
from .store import PointResult, SweepPoint
from .telescope_point import check_telescope_sweep, has_no_camera, point_metrics

_MOTIONS = ("dz_um", "rx_urad", "ry_urad")


@dataclass(frozen=True)
class PointMeasurement:
    """Compute the metrics of points; a picklable function for every kind of worker."""

    sweep: SweepFile
    folder: str  #: from which relative paths of the configuration start

    def __call__(self, point: SweepPoint, threads: int) -> PointResult:
        """Compute one point; where that fails, the result holds one line with the reason."""
        start = time.perf_counter()
        metrics, problem = None, None
        try:
            metrics = self._metrics(point, threads)
        except PachonError as error:
            problem = " ".join(str(error).split())
        return PointResult(point.number, metrics, problem, time.perf_counter() - start, worker_name())

    def _metrics(self, point: SweepPoint, threads: int) -> dict[str, float]:
        if has_no_camera(self.sweep, point.parameters, Path(self.folder)):
            return point_metrics(self.sweep, point.parameters, Path(self.folder), threads)
        experiment = with_cached_screens(point_experiment(self.sweep, point, Path(self.folder)))
        experiment, solved = compensated(experiment, self.sweep.compensators, threads)
        scene = Scene(experiment.telescope, experiment, threads=threads)
        metrics: dict[str, float] = {}
        for name in dict.fromkeys(self.sweep.metrics):
            metrics |= STARS[name].compute(scene)
        return metrics | {f"solved {name}": value for name, value in solved.items()}


def point_configuration(sweep: SweepFile, parameters: Point, seed: int, folder: Path) -> Configuration:
    """Return the configuration of one point; defaults stay open."""
    if not isinstance(sweep.base, dict):
        raise ConfigError(f"base = {sweep.base!r}: expected the content of the file; see load_sweep")
    content = deepcopy(sweep.base)
    content["seed"] = seed
    keys = known_keys(Configuration)
    sections = {key.partition(".")[0] for key in keys if "." in key}
    changes = {}
    for name, value in parameters.items():
        section, _, quantity = name.partition(".")
        if name in keys:
            # One wavelength is the whole band, and one CCD all there is.
            alone = name in ("wavelengths_nm", "ccds")
            _set_value(content, name.split("."), [value] if alone else value)
        elif section in sections or not quantity:
            raise unknown_name("parameter", name, keys)
        else:
            changes[name] = value
    camera = resolve(configuration_of(content, f"sweep {sweep.name}"), folder).camera if changes else None
    for name, value in changes.items():
        body, _, quantity = name.partition(".")
        if camera is None or body not in (*camera.raft_names, *camera.ccd_names):
            _set_value(content, ["changes", name], value)
        elif quantity in _MOTIONS:
            _set_value(content, ["focal_plane", "moved", body, quantity], value)
        else:
            raise unknown_name(f"motion of {body}", quantity, _MOTIONS)
    return configuration_of(content, f"sweep {sweep.name}")


def point_experiment(sweep: SweepFile, point: SweepPoint, folder: Path) -> Experiment:
    """Return the telescope, focal plane and atmosphere of one point."""
    return Experiment.from_config(point_configuration(sweep, point.parameters, point.seed, folder), folder)


def check_sweep(sweep: SweepFile, points: list[SweepPoint], folder: Path) -> None:
    """Check names and values, on the first point and the extremes of each parameter."""
    if not points:
        raise ConfigError(f"sweep {sweep.name}: no points to compute")
    camera_free = has_no_camera(sweep, points[0].parameters, folder)
    if not sweep.metrics:
        raise ConfigError(f"metrics = []: expected some of {', '.join(TELESCOPE_METRICS if camera_free else STARS)}")
    if sweep.fields_deg is not None and not camera_free:
        raise ConfigError("fields_deg: expected for a telescope without a camera alone")
    for name in sweep.metrics:
        if not camera_free and name not in STARS:
            raise unknown_name("metric", name, STARS)
    tried: set[int] = {points[0].number}
    if camera_free:
        check_telescope_sweep(sweep, points[0].parameters, folder)
    else:
        telescope = point_experiment(sweep, points[0], folder).telescope
        for name in sweep.compensators:
            parse_change(telescope, name)
    for name in points[0].parameters:
        ordered = sorted(points, key=lambda p: (isinstance(p.parameters[name], str), p.parameters[name]))
        for point in (ordered[0], ordered[-1]):
            if point.number not in tried:
                tried.add(point.number)
                if camera_free:
                    check_telescope_sweep(sweep, point.parameters, folder)
                else:
                    point_experiment(sweep, point, folder)


def _set_value(content: dict[str, Any], path: list[str], value: Any) -> None:
    for key in path[:-1]:
        content = content.setdefault(key, {})
    content[path[-1]] = value
