"""Validation of files: all problems of a prescription, configuration, sweep or table of heights at once, with lines."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from ..core.arguments import check_arguments
from ..core.errors import (
    ConfigError,
    HeightWarning,
    PachonError,
    PrescriptionError,
    PrescriptionNote,
    PrescriptionWarning,
)
from ..core.json_schema import json_schema
from ..core.schema import problems_of
from ..core.yaml_reader import line_of, read_mapping
from ..design.analyses.coatings import Coatings, CoatingsFile
from ..design.optimize.optimize_file import OptimizeFile, load_optimization
from ..imaging.config import ImagesConfig, load_images_configuration
from ..models.camera.focal_plane import FocalPlane
from ..models.io.camera_file import CameraFile, is_camera, read_camera
from ..models.io.prescription import ENDINGS, load_telescope
from ..models.io.site_file import SiteFile, load_site
from ..models.io.yaml.reader import MAX_BYTES, Prescription
from ..models.parameters.degrees_of_freedom_file import DegreesOfFreedomFile, load_degrees_of_freedom
from ..pipeline.config import Configuration, load_configuration, with_run
from ..pipeline.experiment import Experiment
from ..pipeline.listed_visit import check_bands
from ..pipeline.named_files import read_run
from .alignment.config import AlignConfig, load_align_configuration
from .alignment.scene import AlignmentScene
from .night.config import NightConfig, load_night_configuration
from .sweep.file import SweepFile, load_sweep
from .sweep.point import check_sweep
from .sweep.sweep import check_room, numbered_points
from .tolerance.file import ToleranceFile, load_tolerances
from .visits.config import VisitsConfig, load_visits_configuration

#: Endings of YAML files, and of tables of heights.
_YAML, _TABLES = (".yaml", ".yml"), (".csv", ".ecsv", ".fits", ".fit", ".fz", ".txt", ".dat")


@dataclass(frozen=True)
class FileKind:
    """A kind of YAML file: its model, its errors, and its loader for checks across keys."""

    name: SchemaKind
    model: type[BaseModel]
    load: Callable[[Path], Any]
    error: type[PachonError] = ConfigError
    prepare: Callable[[dict[str, Any], Path], dict[str, Any]] = lambda content, path: content


def _load_run(path: Path) -> None:
    Experiment.from_config(load_configuration(path), path.parent)


def _load_images(path: Path) -> None:
    load_images_configuration(path).experiment(path.parent)


def _load_visits(path: Path) -> None:
    folder = path.parent
    config = load_visits_configuration(path).with_named_list(folder)
    config.experiment(folder)
    config.plan(config.run.seed)


def _load_night(path: Path) -> None:
    config, folder = load_night_configuration(path), path.parent
    # The command may name another list, without which nothing is known of bands.
    if config.visits.list is not None and (folder / config.visits.list).is_file():
        check_bands(config.run, config.read_list(folder), folder)


def _load_align(path: Path) -> None:
    AlignmentScene.of(load_align_configuration(path), path.parent)


def _load_sweep(path: Path) -> None:
    sweep = load_sweep(path)
    check_room(sweep, path)
    check_sweep(sweep, numbered_points(sweep, path.parent), path.parent)


def _with_base(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the content of a sweep with that of the configuration that it names."""
    base = content.get("base")
    return {**content, "base": read_run(path.parent / base, path.parent)} if isinstance(base, str) else content


def _load_tolerances(path: Path) -> None:
    # The command gives the telescope where the file does not.
    load_tolerances(path, "telescope")


class _BaseOfSweep(BaseModel):
    """Configuration that a sweep starts from, which its model leaves open: parameters add to it."""

    base: Configuration


SchemaKind = Literal[
    "prescription",
    "run",
    "sweep",
    "images",
    "visits",
    "night",
    "align",
    "site",
    "coatings",
    "tolerances",
    "optimization",
    "degrees_of_freedom",
    "camera",
]
#: Chosen by what stands under its keys: runs name CCDs too.
CAMERA = FileKind("camera", CameraFile, read_camera, PrescriptionError)
#: Chosen by the list under its visits: stacks have visits too.
NIGHT = FileKind("night", NightConfig, _load_night, prepare=with_run)
#: In the order in which the others are chosen where a file could be of two kinds.
KINDS = (
    FileKind("prescription", Prescription, load_telescope, PrescriptionError),
    FileKind("run", Configuration, _load_run),
    FileKind("sweep", SweepFile, _load_sweep, prepare=_with_base),
    FileKind("images", ImagesConfig, _load_images, prepare=with_run),
    FileKind("visits", VisitsConfig, _load_visits, prepare=with_run),
    NIGHT,
    FileKind("align", AlignConfig, _load_align),
    FileKind("site", SiteFile, load_site, PrescriptionError),
    FileKind("coatings", CoatingsFile, Coatings.read),
    FileKind("tolerances", ToleranceFile, _load_tolerances),
    FileKind("optimization", OptimizeFile, load_optimization),
    FileKind("degrees_of_freedom", DegreesOfFreedomFile, load_degrees_of_freedom, PrescriptionError),
    CAMERA,
)


@dataclass(frozen=True)
class Validation:
    """Problems of a file.

    Attributes
    ----------
    path : str
        The file.
    kind : str
        What it was taken for, by its ending and keys: a name of :data:`KINDS`, "lens file" or "heights".
    problems : tuple of PachonError
        Every problem, with the line in :attr:`~pachon.PachonError.place` where it is known.
    notes : tuple of str
        How parts of a lens file are read that are no faults of it, such as solves that are not kept.
    """

    path: str
    kind: str
    problems: tuple[PachonError, ...]
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return the problems as JSON has them."""
        return {
            "file": self.path,
            "kind": self.kind,
            "problems": [{"place": p.place, "key": p.key, "problem": p.problem} for p in self.problems],
            "notes": list(self.notes),
        }


@check_arguments
def validate_file(path: str | os.PathLike[str]) -> Validation:
    """Find all problems of a file.

    Prescriptions (YAML, Zemax, CODE V), run configurations, sweeps, configurations of images, visits, nights and
    alignment, sites, coatings, tolerances, optimisations, degrees of freedom, cameras, and tables of CCD heights; which
    of them it is, its ending and its keys tell.
    Values that contradict one another are reported once everything else is in order.

    Parameters
    ----------
    path : str or path
        The file.

    Raises
    ------
    ConfigError
        If it is of no kind that is known.
    """
    file = Path(path)
    ending = file.suffix.lower()
    if ending in _YAML:
        return _yaml_file(file)
    if ending in ENDINGS:
        return _lens_file(file)
    if ending in _TABLES:
        return Validation(str(file), "heights", tuple(_loading_problems(FocalPlane.from_file, file)))
    raise ConfigError(f"expected a file that ends in {', '.join((*ENDINGS, *_TABLES))}", file=file)


@check_arguments
def file_schema(kind: SchemaKind) -> dict[str, Any]:
    """Return the JSON schema of a kind of YAML file, for editors.

    Parameters
    ----------
    kind : str
        "prescription", "run", "sweep", "images", "visits", "night", "align", "site", "coatings", "tolerances",
        "optimization", "degrees_of_freedom" or "camera".

    Raises
    ------
    ConfigError
        If there is no such kind.
    """
    (file_kind,) = (k for k in KINDS if k.name == kind)
    return json_schema(file_kind.model, f"pachon {kind}")


def _yaml_file(path: Path) -> Validation:
    try:
        content = read_mapping(path, ConfigError, max_bytes=MAX_BYTES)
    except PachonError as error:
        return Validation(str(path), "YAML", (error,))
    if "opticalSystem" in content:
        return _lens_file(path)
    kind = CAMERA if is_camera(content) else _kind_by_keys(content, path)
    problems = _schema_problems(kind, content, path)
    if not problems:
        problems = _loading_problems(kind.load, path)
    return Validation(str(path), kind.name, tuple(_with_line(error, path) for error in problems))


def _kind_by_keys(content: dict[str, Any], path: Path) -> FileKind:
    """Return the kind with most of the keys; where two have as many, the one with fewer others."""
    visits = content.get("visits")
    if isinstance(visits, dict) and "list" in visits:
        return NIGHT
    kind = max((k for k in KINDS if k is not CAMERA), key=lambda k: (len(set(content) & _keys(k)), -len(_keys(k))))
    if not set(content) & _keys(kind):
        raise ConfigError(f"none of the keys of a {', '.join(k.name for k in KINDS)} is in it", file=path)
    return kind


def _keys(kind: FileKind) -> set[str]:
    return {field.alias or name for name, field in kind.model.model_fields.items()}


def _schema_problems(kind: FileKind, content: dict[str, Any], path: Path) -> list[PachonError]:
    """Return the problems of single keys; of prescriptions also those of single media and surfaces."""
    try:
        prepared = kind.prepare(deepcopy(content), path)
    except PachonError as error:
        return [error]
    context = {"folder": path.parent}
    schema_problems = problems_of(kind.model, prepared, str(path), kind.error, context)
    if kind.model is SweepFile and isinstance(prepared.get("base"), dict):
        schema_problems += problems_of(_BaseOfSweep, {"base": prepared["base"]}, str(path))
    if schema_problems or kind.model is not Prescription:
        return schema_problems
    prescription = Prescription.model_validate(prepared, context=context)
    return [error.within(file=path) for error in prescription.problems()]


def _lens_file(path: Path) -> Validation:
    """Return the warnings of a lenient reader, and the error that ends it; its notes apart."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrescriptionWarning)
        error: list[PachonError] = []
        try:
            load_telescope(path, lenient=True)
        except PachonError as problem:
            error = [problem]
    prescription_warnings = [w for w in caught if issubclass(w.category, PrescriptionWarning)]
    notes = [w for w in prescription_warnings if issubclass(w.category, PrescriptionNote)]
    faults = [PrescriptionError(str(w.message)) for w in prescription_warnings if w not in notes]
    return Validation(str(path), "lens file", (*faults, *error), tuple(str(w.message) for w in notes))


def _loading_problems(load: Callable[[Path], Any], path: Path) -> list[PachonError]:
    """Return warnings of heights, and the error that ends the loading of a file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", HeightWarning)
        error: list[PachonError] = []
        try:
            load(path)
        except PachonError as problem:
            error = [problem.within(file=path)]
    return [*(PrescriptionError(str(w.message)) for w in caught if issubclass(w.category, HeightWarning)), *error]


def _with_line(error: PachonError, path: Path) -> PachonError:
    """Return an error of a key with the line of the key, where the file has it."""
    if error.place is not None or not error.key or error.file != str(path):
        return error
    line = line_of(path, error.key)
    place = None if line is None else f"line {line}"
    return type(error)(error.problem, subject=error.subject, file=error.file, place=place, key=error.key)
