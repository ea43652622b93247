"""Baselines: the figures of a telescope as they were, and whether they still are.

A design team keeps a baseline in its repository, and its CI says when a prescription, a glass, a configuration or
pachon itself has changed an answer.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ConfigError, PachonError
from ...design.parameters.changes import apply_changes
from ...models.io.prescription import bundled_names, load_telescope
from ...models.io.yaml.writer import telescope_to_yaml
from ...models.telescope import Telescope
from ...pipeline.config import digest, load_configuration, with_options
from ...pipeline.experiment import Experiment, prepare, resolve
from .file import Baseline, BaselineFigure, read_baseline, rounded
from .metrics import CAMERA, OPTICS, REASONS, Scene, measure
from .plan import make_plan

#: End of the names of baselines.
SUFFIX = ".baseline.json"
_BUNDLED = Path(__file__).parent / "bundled"
#: Figures of a table that are shown unless all are asked for; fewer where none is out.
_SHOWN, _SHOWN_PASSED = 20, 3
_COLUMNS = ("figure", "now", "baseline", "tolerance", "unit", "deviation / tolerance", "checked against")


@dataclass(frozen=True)
class Deviation:
    """One figure against its baseline.

    Attributes
    ----------
    name, unit : str
        Of the figure.
    stored, tolerance : float
        What the baseline has.
    found : float or None
        What it is now; None where it cannot be had.
    checked_against : str or None
        Independent source of the stored figure.
    problem : str or None
        Why it cannot be had.
    """

    name: str
    unit: str
    stored: float
    tolerance: float
    found: float | None
    checked_against: str | None
    problem: str | None = None

    @property
    def ratio(self) -> float:
        """How many tolerances it has moved by; infinite where it cannot be had."""
        return np.inf if self.found is None else abs(self.found - self.stored) / self.tolerance

    def texts(self) -> list[str]:
        """Return what a table shows of it."""
        digits = max(0, 1 - int(np.floor(np.log10(self.tolerance))))
        found = self.problem or "none" if self.found is None else f"{self.found:.{digits}f}"
        ratio = f"{self.ratio:.2f}" if self.ratio < 1e4 else f"{self.ratio:.1e}"
        against = self.checked_against or ""
        return [self.name, found, f"{self.stored:.{digits}f}", f"{self.tolerance:g}", self.unit, ratio, against]


@dataclass(frozen=True)
class BaselineCheck:
    """All figures of a baseline against what they are now.

    Attributes
    ----------
    path, model : str
        The baseline, and the telescope that it was checked with.
    deviations : tuple of Deviation
        Worst first.
    notes : tuple of str
        What else has changed since: version, prescription, configuration.
    """

    path: str
    model: str
    deviations: tuple[Deviation, ...]
    notes: tuple[str, ...]

    @property
    def out(self) -> tuple[Deviation, ...]:
        """Figures beyond their tolerance, worst first."""
        return tuple(d for d in self.deviations if not d.ratio <= 1.0)

    @property
    def passed(self) -> bool:
        """Whether there are none."""
        return not self.out

    @property
    def verdict(self) -> str:
        """One line."""
        count = len(self.deviations)
        if self.passed:
            return f"{self.path}: all {count} figures of {self.model} within their tolerances"
        return f"{self.path}: {len(self.out)} of {count} figures of {self.model} out of tolerance"

    def summary(self) -> dict[str, Any]:
        """Return the figures by name; those of the list are in the order worst first."""
        return {
            "baseline": self.path,
            "model": self.model,
            "passed": self.passed,
            "figures": len(self.deviations),
            "out": len(self.out),
            "notes": list(self.notes),
            "deviations": [
                {
                    "name": d.name,
                    "unit": d.unit,
                    "stored": d.stored,
                    "found": d.found,
                    "tolerance": d.tolerance,
                    "deviation_over_tolerance": d.ratio,
                    "checked_against": d.checked_against,
                    "problem": d.problem,
                }
                for d in self.deviations
            ],
        }

    def text(self, everything: bool = False) -> str:
        """Return the verdict, the notes and the table of the worst figures, or of all."""
        shown = None if everything else _SHOWN_PASSED if self.passed else _SHOWN
        rows = [list(_COLUMNS), *(d.texts() for d in self.deviations[:shown])]
        widths = [max(len(row[k]) for row in rows) for k in range(len(_COLUMNS))]
        table = ["  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([self.verdict, *self.notes, *table])


def bundled_baselines() -> tuple[Path, ...]:
    """Return the files of the baselines that come with pachon."""
    return tuple(sorted(_BUNDLED.glob(f"*{SUFFIX}")))


def make_baseline(
    model: str,
    folder: Path,
    configuration: Path | None = None,
    *,
    fields: np.ndarray | None = None,
    wavelengths: Sequence[float] | None = None,
    ccds: Sequence[str] | None = None,
    pupil: Sequence[tuple[float, float]] | None = None,
    checked: Mapping[str, str] | None = None,
    threads: int | None = None,
    advance: Callable[[], None] | None = None,
) -> tuple[Baseline, dict[str, str]]:
    """Compute a baseline.

    Parameters
    ----------
    model : str
        Bundled telescope, or path of its file.
    folder : Path
        Folder that the baseline will lie in; it names other files from there.
    configuration : Path, optional
        Run configuration, for the figures of focal plane, PSF and reconstruction; its telescope gives way to `model`.
    fields : ndarray, shape [n, 2], optional
        Field angles [rad]; five over the field of view by default.
    wavelengths : sequence of float, optional
        Wavelengths [m]; the edges of the band and the default by default.
    ccds : sequence of str, optional
        CCDs at whose centres the PSF is taken; the first is modelled. Five of the camera by default.
    pupil : sequence of (x, y), optional
        Points of the pupil, in units of its radius; four by default.
    checked : mapping of str to str, optional
        What figures were checked against, by the start of their names.
    threads : int, optional
        Number of threads; no byte depends on it.
    advance : callable, optional
        Called after each kind of figures.

    Returns
    -------
    baseline : Baseline
    left_out : dict of str to str
        Kinds of figures that this telescope does not have, and why.

    Raises
    ------
    PachonError
        If the telescope or the configuration cannot be had, or none of the figures.
    """
    telescope = load_telescope(model)
    experiment = None if configuration is None else _experiment(configuration, _absolute(model, Path()), telescope)
    plan = make_plan(telescope, experiment, fields, wavelengths, ccds, pupil)
    scene = Scene(telescope if experiment is None else experiment.telescope, plan, experiment, threads)
    found, left_out = measure(scene, _kinds(experiment), advance)
    if not found:
        raise ConfigError(f"{model}: no figure can be had of it ({next(iter(left_out.values()))})")

    def against(name: str) -> str | None:
        return next((text for start, text in (checked or {}).items() if name.startswith(start)), None)

    figures = {
        name: BaselineFigure(
            value=rounded(q.value, q.tolerance),
            unit=q.unit,
            tolerance=q.tolerance,
            reason=q.reason,
            checked_against=against(name),
        )
        for name, q in found.items()
    }
    baseline = Baseline(
        **_stamps(telescope, experiment),
        model=_relative(model, folder, bundled_names()),
        configuration=None if configuration is None else _relative(str(configuration), folder, ()),
        plan=plan,
        reasons={key: text for key, text in REASONS.items() if any(f.reason == key for f in figures.values())},
        figures=figures,
    )
    return baseline, left_out


def check_baseline(
    path: Path,
    model: str | os.PathLike[str] | Telescope | None = None,
    configuration: Path | None = None,
    *,
    threads: int | None = None,
    advance: Callable[[], None] | None = None,
) -> BaselineCheck:
    """Compute the figures of a baseline anew and compare them.

    Parameters
    ----------
    path : Path
        The baseline.
    model : str, path or Telescope, optional
        Telescope in place of the baseline's own.
    configuration : Path, optional
        Run configuration in place of the baseline's own.
    threads : int, optional
        Number of threads; no byte depends on it.
    advance : callable, optional
        Called after each kind of figures.

    Raises
    ------
    PachonError
        If the baseline, the telescope or the configuration cannot be read.
    """
    baseline = read_baseline(path)
    name, telescope, experiment = _subject(path, baseline, model, configuration)
    scene = Scene(telescope if experiment is None else experiment.telescope, baseline.plan, experiment, threads)
    kinds = [k for k in (*OPTICS, *CAMERA) if k in {name.partition(" ")[0] for name in baseline.figures}]
    found, problems = measure(scene, kinds, advance)

    def deviation(key: str, figure: BaselineFigure) -> Deviation:
        kind = key.partition(" ")[0]
        now = found[key].value if key in found else None
        problem = None if key in found else problems.get(kind, "no such figure")
        return Deviation(key, figure.unit, figure.value, figure.tolerance, now, figure.checked_against, problem)

    deviations = sorted((deviation(*item) for item in baseline.figures.items()), key=lambda d: (-d.ratio, d.name))
    return BaselineCheck(str(path), name, tuple(deviations), _notes(baseline, _stamps(telescope, experiment)))


def updated_baseline(
    path: Path, *, threads: int | None = None, advance: Callable[[], None] | None = None
) -> tuple[Baseline, BaselineCheck]:
    """Return a baseline with what its figures are now in place of those that are out of tolerance.

    Its plan, tolerances and reasons stay, as do figures within their tolerances: the file changes where an answer has.
    A figure that was replaced is no longer checked against anything.

    Raises
    ------
    PachonError
        If something cannot be read, or a figure cannot be had any more.
    """
    baseline = read_baseline(path)
    check = check_baseline(path, threads=threads, advance=advance)
    figures = dict(baseline.figures)
    for d in check.out:
        if d.found is None:
            raise ConfigError(f"{path}: figures.{d.name}: {d.problem}; remove its line, or save the baseline anew")
        figures[d.name] = figures[d.name].model_copy(
            update={"value": rounded(d.found, d.tolerance), "checked_against": None}
        )
    _, telescope, experiment = _subject(path, baseline, None, None)
    return baseline.model_copy(update={**_stamps(telescope, experiment), "figures": figures}), check


def prescription_hash(telescope: Telescope) -> str:
    """Return the SHA-256 of a prescription as pachon writes it, whatever file it came from."""
    return hashlib.sha256(telescope_to_yaml(telescope).encode()).hexdigest()


def _subject(
    path: Path,
    baseline: Baseline,
    model: str | os.PathLike[str] | Telescope | None,
    configuration: Path | None,
) -> tuple[str, Telescope, Experiment | None]:
    """Return the name of the telescope to check, itself, and the experiment with it."""
    own = _absolute(baseline.model, path.parent)
    if isinstance(model, Telescope):
        name, source, telescope = model.name, own, model
    else:
        name = baseline.model if model is None else os.fspath(model)
        source = own if model is None else _absolute(name, Path())
        try:
            telescope = load_telescope(source)
        except PachonError as error:
            raise (error.within(subject="model").within(file=path) if model is None else error) from None
    if configuration is not None:
        return name, telescope, _experiment(configuration, source, telescope)
    if baseline.configuration is None:
        return name, telescope, None
    try:
        return name, telescope, _experiment(path.parent / baseline.configuration, source, telescope)
    except PachonError as error:
        raise error.within(subject="configuration").within(file=path) from None


def _experiment(configuration: Path, model: str, telescope: Telescope) -> Experiment:
    """Return the experiment of a configuration with this telescope, seen by the engine without luck."""
    base = load_configuration(configuration)
    engine = "long_exposure" if base.atmosphere.enabled else None
    try:
        resolved = resolve(with_options(base, telescope=model, psf__engine=engine), configuration.parent)
        experiment = prepare(resolved)
        return replace(experiment, telescope=apply_changes(telescope, resolved.changes))
    except PachonError as error:
        raise ConfigError(f"{configuration}: {error}") from None


def _kinds(experiment: Experiment | None) -> tuple[str, ...]:
    return OPTICS if experiment is None else (*OPTICS, *CAMERA)


def _stamps(telescope: Telescope, experiment: Experiment | None) -> dict[str, Any]:
    """Return version and hashes of what figures are computed from."""
    hashed = None
    if experiment is not None:
        content = experiment.config.as_dict()
        # The telescope has a hash of its own, and a path is another one on another machine.
        del content["telescope"], content["ccds"]
        content["atmosphere"]["site"] = Path(content["atmosphere"]["site"]).name
        hashed = digest(content)
    return {
        "pachon": version("pachon"),
        "model_sha256": prescription_hash(telescope),
        "configuration_sha256": hashed,
    }


def _notes(baseline: Baseline, now: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a line for each stamp that is another one now."""
    notes = []
    if now["pachon"] != baseline.pachon:
        notes.append(f"pachon: {baseline.pachon} -> {now['pachon']}")
    for key, what in (("model_sha256", "prescription"), ("configuration_sha256", "configuration")):
        if now[key] != getattr(baseline, key):
            notes.append(f"the {what} is not the one that the baseline was made from")
    return tuple(notes)


def _absolute(name: str, folder: Path) -> str:
    """Return a bundled name as it is, and the path of a file as an absolute one."""
    return name if name in bundled_names() else str((folder / name).resolve())


def _relative(name: str, folder: Path, bundled: Sequence[str]) -> str:
    """Return a bundled name as it is, and the path of a file as seen from a folder."""
    return name if name in bundled else Path(os.path.relpath(Path(name).resolve(), folder.resolve())).as_posix()
