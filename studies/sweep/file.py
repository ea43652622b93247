"""Sweep files: YAML with a base configuration, parameters, a design and metrics.

::

    name: raft_heights
    base: {psf: {engine: long_exposure}, stars: {observed: 20}}    # a configuration, or the path of its file
    parameters:
      focal_plane.raft_um: {nominal: 0, range: [0, 13], marks: {specification: 4.8, simulated: 6.5}}
      M2.dz_um: {nominal: 0, normal: [0, 20]}
      band: {nominal: r, values: [g, r, i]}
    design: {kind: one_at_a_time, points: 9}
    metrics: [fwhm, rms_e, xi_raw]
    compensators: [Camera.dz_um]

A parameter is a key of the configuration, a raft or CCD with a motion (``R22.dz_um``, ``R22_S11.rx_urad``), or a value
of the prescription (``M2.dz_um``, ``M1.Z5_nm``): see :mod:`pachon.studies.sweep.point`.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, error_context
from ...core.schema import Count, Real, Section, Whole, checked, plain_number, validated, whole_number_keys
from ...core.set_keys import set_key_errors, set_keys
from ...core.yaml_reader import read_mapping
from ...models.io.prescription import prescription_digest
from ...pipeline.config import Configuration, digest
from ...pipeline.named_files import FILES, read_run, with_named_files, with_path

#: Values of the parameters of one point by name.
Point = dict[str, Any]
#: Folder of the bundled sweeps.
EXAMPLES = Path(__file__).parent / "examples"


Value = Annotated[
    float | str | bool | int,
    checked(
        lambda value: plain_number(value) if _is_value(value) else None,
        "a finite number, a text, true or false",
    ),
]


def _is_value(value: object) -> bool:
    return isinstance(value, str | bool | int) or (isinstance(value, float) and math.isfinite(value))


class SweptParameter(Section):
    """The values that one parameter takes: a list, a range, or a normal distribution."""

    nominal: Value | None = Field(None, description="value where the parameter is not varied")
    values: tuple[Value, ...] | None = Field(None, description="the values themselves")
    range: tuple[Real, Real] | None = Field(None, description="lowest and highest value, evenly likely between")
    normal: tuple[Real, Real] | None = Field(None, description="mean and standard deviation")
    points: Annotated[int, Field(strict=True, ge=2)] | None = Field(
        None, description="points along the range in a grid or one at a time; the design's own by default"
    )
    marks: dict[str, Real] = Field(default_factory=dict, description="named values that the report points out")


class Design(Section):
    """Combinations of values that are computed."""

    kind: Literal["one_at_a_time", "grid", "monte_carlo", "latin_hypercube", "sobol", "table"] = Field(
        "one_at_a_time", description="how points are chosen"
    )
    points: Count = Field(5, description="points of a random design, or along each range of a grid or one at a time")
    seed: Whole = Field(1, description="seed of a random design")
    file: str | None = Field(None, description="ECSV table of the points, a column a parameter, for kind table")
    replicas: Count = Field(
        1, description="times each point is computed, each time with another seed of heights, turbulence and stars"
    )


#: Keys of the configuration whose whole numbers are odd.
ODD_KEYS = frozenset({"psf.stamp"})


@cache
def whole_keys() -> frozenset[str]:
    """Return the keys of the configuration whose values are whole numbers."""
    return frozenset(whole_number_keys(Configuration))


# Parameters whose values may name files.
_FILE_PARAMETERS = {f"{section}.{key}" if section else key for section, key in FILES}


class SweepFile(Section):
    """Content of a sweep file."""

    name: str = Field("sweep", description="name in the report")
    base: dict[str, Any] | str = Field(default_factory=dict, description="configuration to start from, or its file")
    parameters: dict[str, SweptParameter] = Field(default_factory=dict, description="varied parameters")
    design: Design = Design()
    metrics: tuple[str, ...] = Field(("fwhm", "rms_e", "xi_raw"), description="groups of metrics of each point")
    fields_deg: Annotated[tuple[tuple[Real, Real], ...], Field(min_length=1)] | None = Field(
        None, description="field angles of a telescope without a camera [deg]"
    )
    compensators: tuple[str, ...] = Field((), description="motions solved for the sharpest image before measuring")
    xi_target: Annotated[Real, Field(gt=0)] | None = Field(
        None, description="xi+ that the report shares out between the causes"
    )
    _folder: Path = PrivateAttr(default=Path())

    @property
    def digest(self) -> str:
        """SHA-256 of the sweep, including the contents of the files that it names."""
        named: list[Any] = [self.design.file]
        telescope = None
        if isinstance(self.base, dict):
            telescope = self.base.get("telescope")
            for section, key in FILES[1:]:
                content = self.base.get(section) if section else self.base
                named.append(content.get(key) if isinstance(content, dict) else None)
        for name in _FILE_PARAMETERS - {"telescope"}:
            named += self._values(name)
        contents = {path: hashlib.sha256(file.read_bytes()).hexdigest() for path, file in self._existing_files(named)}
        telescopes = [telescope, *self._values("telescope")]
        contents |= {path: prescription_digest(str(file)) for path, file in self._existing_files(telescopes)}
        # A key that is not given leaves the digests of older sweeps as they were.
        left_out = {"fields_deg"} if self.fields_deg is None else set()
        return digest({"sweep": self.model_dump(mode="json", exclude=left_out), "files": contents})

    def _values(self, name: str) -> list[Any]:
        """Return the values of a parameter, if it is one."""
        parameter = self.parameters.get(name)
        return [] if parameter is None else [parameter.nominal, *(parameter.values or ())]

    def _existing_files(self, names: Iterable[Any]) -> Iterator[tuple[str, Path]]:
        """Yield those names that are paths of files, from the folder of the sweep on, and the files."""
        for name in names:
            if isinstance(name, str) and (self._folder / name).is_file():
                yield name, self._folder / name


@check_arguments
def load_sweep(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> SweepFile:
    """Read a sweep file and the configuration that it names; ConfigError of one line with file, key and value.

    `settings` are other values of some keys: ``key=value`` each, dots between sections.
    """
    path = Path(path)
    content = read_mapping(path, ConfigError)
    if isinstance(content.get("base"), str):
        content["base"] = read_run(path.parent / content["base"], path.parent)
    content = set_keys(SweepFile, content, settings)
    folder = path.parent
    content["design"] = with_path(content.get("design", {}), "file", folder)
    content["base"] = with_named_files(content.get("base", {}), folder)
    with set_key_errors(settings):
        sweep = read_sweep(content, str(path))
    sweep._folder = folder
    return sweep


def read_sweep(content: dict[str, Any], source: str) -> SweepFile:
    """Return the sweep that plain mappings describe; `source` names them in error messages."""
    sweep = validated(SweepFile, content, source)
    with error_context(file=source):
        _check(sweep)
    return sweep


def _check(sweep: SweepFile) -> None:
    """Check values that depend on each other."""
    table = sweep.design.kind == "table"
    if table and sweep.design.file is None:
        raise ConfigError("design.file is missing: kind table expects the path of an ECSV table of points")
    if not table and sweep.design.file is not None:
        raise ConfigError(f"design.file = {sweep.design.file}: expected with kind table only")
    if not table and not sweep.parameters:
        raise ConfigError("parameters = {}: expected at least one parameter to vary")
    for name, parameter in sweep.parameters.items():
        place = f"parameters.{name}"
        stated_keys = [key for key in ("values", "range", "normal") if getattr(parameter, key) is not None]
        if len(stated_keys) != 1 and not table:
            stated_text = " and ".join(stated_keys) or "none of them"
            raise ConfigError(f"{place} has {stated_text}: expected one of values, range, normal")
        if parameter.values is not None and not parameter.values:
            raise ConfigError(f"{place}.values = []: expected at least one value")
        if parameter.range is not None and not parameter.range[0] < parameter.range[1]:
            low, high = parameter.range
            raise ConfigError(f"{place}.range = [{low:g}, {high:g}]: expected the lower value first, then a higher one")
        if name in whole_keys():
            stated = {f"range[{i}]": end for i, end in enumerate(parameter.range or ())}
            stated |= {f"marks.{mark}": value for mark, value in parameter.marks.items()}
            for key, value in stated.items():
                if value % 1.0 or (name in ODD_KEYS and value % 2.0 == 0.0):
                    expected = "an odd number" if name in ODD_KEYS else "a whole number"
                    raise ConfigError(f"{place}.{key} = {value:g}: expected {expected}")
        if parameter.normal is not None and not parameter.normal[1] > 0:
            raise ConfigError(f"{place}.normal = {list(parameter.normal)}: expected a standard deviation above 0")
        if parameter.nominal is None and sweep.design.kind == "one_at_a_time":
            text = "one at a time needs the value that others are varied around"
            raise ConfigError(f"{place}.nominal is missing: {text}")
