"""Baselines: stored metrics of a telescope, and the check of their present values.

A design team keeps a baseline in its repository. A check in its CI then fails when a change of a prescription, a glass,
a configuration or pachon itself changes a metric.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import ConfigError, PachonError
from ...core.set_keys import OPTION, with_set_keys
from ...core.version import VERSION
from ...models.io.bundled import BUNDLED
from ...models.io.prescription import load_telescope
from ...models.io.yaml.writer import telescope_to_yaml
from ...models.telescope import Telescope
from ...pipeline.config import Configuration, digest, load_configuration, with_options
from ...pipeline.config_hash import (
    hashed_camera,
    hashed_heights,
    hashed_photometry,
    hashed_reconstruction,
    hashed_states,
)
from ...pipeline.defaults import configured_telescope, with_paper_model
from ...pipeline.experiment import Experiment
from ..metrics.camera import CAMERA
from ..metrics.metric import REASONS, Metric, MetricGroup
from ..metrics.optics import OPTICS
from ..metrics.scene import Scene, make_plan
from .check import BaselineCheck, Deviation
from .file import Baseline, BaselineMetric, read_baseline, rounded
from .requirements import Requirements, check_used, given_limit, given_tolerance

#: End of the names of baselines.
SUFFIX = ".baseline.json"
_BUNDLED = Path(__file__).parent / "bundled"
# What metrics depend on, and where the file has its stamp.
_STAMPS = {"pachon": "pachon", "prescription": "model_sha256", "configuration": "configuration_sha256"}


def bundled_baselines() -> tuple[Path, ...]:
    """Return the files of the bundled baselines."""
    return tuple(sorted(_BUNDLED.glob(f"*{SUFFIX}")))


@removed_arguments(checked="baseline.with_sources(...) of the result")
@check_arguments
def make_baseline(
    model: str,
    folder: str | os.PathLike[str] = "",
    configuration: str | os.PathLike[str] | None = None,
    *,
    fields: np.ndarray | None = None,
    wavelengths: Sequence[float] | None = None,
    ccds: Sequence[str] | None = None,
    pupil: Sequence[tuple[float, float]] | None = None,
    requirements: Requirements | None = None,
    settings: Sequence[str] = (),
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[Baseline, dict[str, str]]:
    """Compute a baseline.

    Parameters
    ----------
    model : str
        Bundled telescope, or path of its file.
    folder : str or path
        Folder of the baseline, from which it names other files; the current one by default.
    configuration : str or path, optional
        Run configuration, for the metrics of focal plane, PSF and reconstruction. Its telescope is replaced by `model`.
    fields : ndarray, shape [n, 2], optional
        Field angles [rad]; five over the field of view by default.
    wavelengths : sequence of float, optional
        Wavelengths [m]; the edges of the band and the default by default.
    ccds : sequence of str, optional
        CCDs at whose centres the PSF is taken; the first is modelled. Five of the camera by default.
    pupil : sequence of (x, y), optional
        Points of the entrance pupil, in units of its radius; four by default.
    requirements : Requirements, optional
        Tolerances in place of those of rounding, and limits.
    settings : sequence of str, optional
        Other values of keys of the configuration, such as ``"stars.truth=50"``; the baseline keeps them.
    threads : int, optional
        Number of threads; results do not depend on it.
    progress : callable, optional
        Called with 1 after each group of metrics.

    Returns
    -------
    baseline : Baseline
    left_out : dict of str to str
        Groups of metrics that cannot be computed for this telescope, and the reason.

    Raises
    ------
    PachonError
        If the telescope or the configuration cannot be read, no metric can be computed, or a tolerance or a limit
        applies to none of them.
    """
    requirements = Requirements() if requirements is None else requirements
    tolerance_rules, limit_rules = requirements.tolerance_rules, requirements.limit_rules
    telescope, folder = load_telescope(model), Path(folder)
    configuration = None if configuration is None else Path(configuration)
    if configuration is None:
        _refuse_settings(settings)
        experiment = None
    else:
        run = with_set_keys(load_configuration(configuration), settings)
        experiment = _experiment(run, configuration, _absolute_path(model, Path()), telescope)
    plan = make_plan(telescope, experiment, fields, wavelengths, ccds, pupil)
    scene = Scene(telescope if experiment is None else experiment.telescope, experiment, plan, threads)
    measurements, left_out = _measured_metrics(scene, OPTICS if experiment is None else {**OPTICS, **CAMERA}, progress)
    if not measurements:
        raise ConfigError(f"{model}: no metric can be computed ({next(iter(left_out.values()))})")

    def stored(name: str, value: float, tolerance: float, metric: Metric) -> BaselineMetric:
        stated_tolerance = given_tolerance(tolerance_rules, name, metric.unit, value, tolerance)
        return BaselineMetric(
            # Digits of the metric's own tolerance: a given one says what matters, not what is known.
            value=rounded(value, tolerance),
            unit=metric.unit,
            tolerance=tolerance if stated_tolerance is None else stated_tolerance,
            limit=given_limit(limit_rules, name, metric.unit),
            reason=metric.reason if stated_tolerance is None else "given",
        )

    for rules in (tolerance_rules, limit_rules):
        check_used(rules, measurements, left_out)

    metrics = {name: stored(name, *measurement) for name, measurement in measurements.items()}
    baseline = Baseline(
        **_input_stamps(telescope, experiment),
        model=_relative_path(model, folder, BUNDLED),
        configuration=None if configuration is None else _relative_path(str(configuration), folder, ()),
        settings=tuple(settings),
        plan=plan,
        reasons={key: text for key, text in REASONS.items() if any(m.reason == key for m in metrics.values())},
        figures=metrics,
    )
    return baseline, left_out


@check_arguments
def check_baseline(
    path: str | os.PathLike[str],
    model: str | os.PathLike[str] | Telescope | None = None,
    configuration: str | os.PathLike[str] | None = None,
    *,
    settings: Sequence[str] = (),
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> BaselineCheck:
    """Compare the metrics of a baseline with their present values.

    Parameters
    ----------
    path : str or path
        The baseline.
    model : str, path or Telescope, optional
        Telescope in place of the baseline's own.
    configuration : str or path, optional
        Run configuration in place of the baseline's own, with its settings.
    settings : sequence of str, optional
        Other values of keys of the configuration, such as ``"stars.truth=50"``; they win over those of the baseline.
    threads, progress
        As in :func:`make_baseline`.

    Raises
    ------
    PachonError
        If the baseline, the telescope or the configuration cannot be read.
    """
    path = Path(path)
    baseline = read_baseline(path)
    name, telescope, experiment = _checked_telescope(path, baseline, model, configuration, settings)
    scene = Scene(telescope if experiment is None else experiment.telescope, experiment, baseline.plan, threads)
    stored = {key.partition(" ")[0] for key in baseline.figures}
    groups = {key: group for key, group in {**OPTICS, **CAMERA}.items() if key in stored}
    measurements, problems = _measured_metrics(scene, groups, progress)

    def deviation(key: str, metric: BaselineMetric) -> Deviation:
        present_value = measurements[key][0] if key in measurements else None
        problem = None if key in measurements else problems.get(key.partition(" ")[0], "no such metric")
        against, limit = metric.checked_against, metric.limit
        return Deviation(key, metric.unit, metric.value, metric.tolerance, present_value, against, problem, limit)

    deviations = sorted((deviation(*item) for item in baseline.figures.items()), key=lambda d: (-d.ratio, d.name))
    present_stamps = _input_stamps(telescope, experiment)
    changed = tuple(name for name, key in _STAMPS.items() if present_stamps[key] != getattr(baseline, key))
    return BaselineCheck(str(path), name, tuple(deviations), _input_changes(baseline, changed), changed)


def updated_baseline(
    path: Path, *, threads: int | None = None, progress: Callable[[int], None] | None = None
) -> tuple[Baseline, BaselineCheck]:
    """Replace the metrics of a baseline that are out of tolerance; return it and the check.

    Plan, tolerances, limits and reasons stay, as do metrics within their tolerances. Replaced metrics lose their
    independent source.
    """
    baseline = read_baseline(path)
    check = check_baseline(path, threads=threads, progress=progress)
    metrics = dict(baseline.figures)
    for d in check.moved:
        if d.found is None:
            raise ConfigError(f"figures.{d.name}: {d.problem}; remove its line, or save the baseline anew", file=path)
        update = {"value": rounded(d.found, d.tolerance), "checked_against": None}
        metrics[d.name] = metrics[d.name].model_copy(update=update)
    _, telescope, experiment = _checked_telescope(path, baseline)
    return baseline.model_copy(update={**_input_stamps(telescope, experiment), "figures": metrics}), check


def _measured_metrics(
    scene: Scene, groups: Mapping[str, MetricGroup[Scene]], progress: Callable[[int], None] | None
) -> tuple[dict[str, tuple[float, float, Metric]], dict[str, str]]:
    """Return finite values, tolerances and metrics by name, and the problems of groups that fail."""
    measurements: dict[str, tuple[float, float, Metric]] = {}
    problems: dict[str, str] = {}
    for name, group in groups.items():
        try:
            values = {key: value for key, value in group.compute(scene).items() if np.isfinite(value)}
            metrics = {key: group.metric(key) for key in values}
            of_angles = scene.telescope.design_data.afocal
            measurements |= {
                key: (v, m.tolerance_of(scene, v), m.in_angles if of_angles else m)
                for (key, v), m in zip(values.items(), metrics.values(), strict=True)
            }
        except PachonError as error:
            problems[name] = str(error)
        if progress is not None:
            progress(1)
    return measurements, problems


def prescription_hash(telescope: Telescope) -> str:
    """Return the SHA-256 of a prescription as pachon writes it, independent of its file."""
    return hashlib.sha256(telescope_to_yaml(telescope).encode()).hexdigest()


def _checked_telescope(
    path: Path,
    baseline: Baseline,
    model: str | os.PathLike[str] | Telescope | None = None,
    configuration: str | os.PathLike[str] | None = None,
    settings: Sequence[str] = (),
) -> tuple[str, Telescope, Experiment | None]:
    """Return the name of the telescope to check, itself, and the experiment with it."""
    stored_model = _absolute_path(baseline.model, path.parent)
    if isinstance(model, Telescope):
        name, source, telescope = model.name, stored_model, model
    else:
        name = baseline.model if model is None else os.fspath(model)
        source = stored_model if model is None else _absolute_path(name, Path())
        try:
            telescope = load_telescope(source)
        except PachonError as error:
            raise (error.within(subject="model").within(file=path) if model is None else error) from None
    if configuration is not None:
        file = Path(configuration)
        run = with_set_keys(load_configuration(file), settings)
        return name, telescope, _experiment(run, file, source, telescope)
    if baseline.configuration is None:
        _refuse_settings(settings)
        return name, telescope, None
    file = path.parent / baseline.configuration
    try:
        stored_run = with_set_keys(load_configuration(file), baseline.settings)
    except PachonError as error:
        raise error.within(subject="configuration").within(file=path) from None
    run = with_set_keys(stored_run, settings)
    try:
        return name, telescope, _experiment(run, file, source, telescope)
    except PachonError as error:
        raise error.within(subject="configuration").within(file=path) from None


def _refuse_settings(settings: Sequence[str]) -> None:
    """Raise ConfigError if there are values of keys without a configuration to have them."""
    if settings:
        raise ConfigError(f"{OPTION} {settings[0]}: expected a configuration, such as --config run.yaml")


def _experiment(run: Configuration, file: Path, model: str, telescope: Telescope) -> Experiment:
    """Return the experiment of the configuration of a file with this telescope and the long-exposure engine."""
    engine = "long_exposure" if run.atmosphere.enabled else None
    try:
        # Kriging looks for its covariance in steps that rounding may change; metrics need a model of one solution.
        config = with_options(with_paper_model(run), telescope=model, psf__engine=engine)
        experiment = Experiment.from_config(config, file.parent)
        telescope = configured_telescope(telescope, experiment.config, experiment.site)
        return replace(experiment, telescope=telescope)
    except PachonError as error:
        raise ConfigError(f"{file}: {error}") from None


def _input_stamps(telescope: Telescope, experiment: Experiment | None) -> dict[str, Any]:
    """Return version and hashes of telescope and configuration."""
    hashed = None
    if experiment is not None:
        content = experiment.config.as_dict()
        # The telescope has a hash of its own, and paths differ between machines.
        del content["telescope"], content["ccds"]
        content["atmosphere"]["site"] = Path(content["atmosphere"]["site"]).name
        content = hashed_photometry(hashed_camera(content), experiment.config)
        content["focal_plane"] = hashed_heights(content["focal_plane"])
        content["active_optics"] = hashed_states(content["active_optics"])
        content["reconstruction"] = hashed_reconstruction(content["reconstruction"])
        hashed = digest(content)
    return {"pachon": VERSION, "model_sha256": prescription_hash(telescope), "configuration_sha256": hashed}


def _input_changes(baseline: Baseline, changed: Sequence[str]) -> tuple[str, ...]:
    """Return a line for each input that has changed."""
    return tuple(
        f"pachon: {baseline.pachon} -> {VERSION}"
        if name == "pachon"
        else f"the {name} is not the one that the baseline was made from"
        for name in changed
    )


def _absolute_path(name: str, folder: Path) -> str:
    """Return a bundled name as it is, and the path of a file as an absolute one."""
    return name if name in BUNDLED else str((folder / name).resolve())


def _relative_path(name: str, folder: Path, bundled: Sequence[str]) -> str:
    """Return a bundled name as it is, and the path of a file relative to a folder."""
    return name if name in bundled else Path(os.path.relpath(Path(name).resolve(), folder.resolve())).as_posix()
