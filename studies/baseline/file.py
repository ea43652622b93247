"""File of a baseline: metrics of a telescope with units and tolerances, and their origin.

Metrics stand one a line in the order of their names, with two digits beyond the tolerance. The difference of two
versions of the file then shows the effect of a change of the design.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ...core.arguments import check_arguments
from ...core.ccd_names import refuse_mirrored_names
from ...core.errors import ConfigError
from ...core.files import read_bytes, write_bytes
from ...core.number_text import counted
from ...core.schema import Positive, Real, Section, validated
from ..metrics.scene import Plan

FORMAT = "pachon baseline"
#: Versions of the format: 4 has limits or settings, unknown to an older pachon, and is written for these alone.
#: Those of 1 and 2 are 3 and 4 with the CCDs of the LSST named as in a mirror, and are read where they name none.
VERSIONS = (3, 4)
_OLDER_VERSIONS = (1, 2)


class Limit(Section):
    """Requirement of a metric, in its unit: the largest or the least accepted value, or both."""

    max: Real | None = Field(None, description="largest accepted value")
    min: Real | None = Field(None, description="least accepted value")

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.max is None and self.min is None:
            raise ValueError("expected max or min")
        return self

    def holds(self, value: float) -> bool:
        """Return whether a value is within the limit."""
        return (self.max is None or value <= self.max) and (self.min is None or value >= self.min)

    def __str__(self) -> str:
        bounds = (("<=", self.max), (">=", self.min))
        return ", ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)


class BaselineMetric(Section):
    """A stored metric."""

    value: Real = Field(description="value of the metric")
    unit: str = Field(description="unit; empty for a pure number")
    tolerance: Positive = Field(description="largest accepted change, in the same unit")
    limit: Limit | None = Field(None, description="requirement that the present value must meet, in the same unit")
    reason: str = Field(description="reason of the tolerance: a key of reasons")
    checked_against: str | None = Field(None, description="independent source of the value, and its agreement")


class Baseline(Section):
    """Metrics of a telescope, and their origin."""

    format: Literal["pachon baseline"] = Field("pachon baseline", description="name of the format")
    version: int = Field(VERSIONS[0], description="version of the format")
    pachon: str = Field(description="version of pachon that computed the metrics")
    model: str = Field(description="bundled telescope, or path of its file from the folder of this one")
    model_sha256: str = Field(description="SHA-256 of the prescription as pachon writes it")
    configuration: str | None = Field(None, description="path of the run configuration from the folder of this file")
    settings: tuple[str, ...] = Field((), description="other values of keys of the configuration, KEY=VALUE each")
    configuration_sha256: str | None = Field(None, description="SHA-256 of the configuration with all defaults")
    plan: Plan
    reasons: dict[str, str] = Field(description="reasons of the tolerances")
    figures: Annotated[dict[str, BaselineMetric], Field(min_length=1)] = Field(description="the metrics by name")

    @check_arguments
    def with_sources(self, sources: Mapping[str, str]) -> Baseline:
        """Return the baseline with independent sources of metrics, by the start of their names."""

        def checked(name: str, metric: BaselineMetric) -> BaselineMetric:
            source = next((text for start, text in sources.items() if name.startswith(start)), metric.checked_against)
            return metric.model_copy(update={"checked_against": source})

        metrics = {name: checked(name, metric) for name, metric in self.figures.items()}
        return self.model_copy(update={"figures": metrics})

    def __repr__(self) -> str:
        return f"<Baseline of {self.model}: {counted(len(self.figures), 'metric')}>"


@check_arguments
def read_baseline(path: str | os.PathLike[str]) -> Baseline:
    """Read a baseline; ConfigError if it is no JSON, no baseline or of another version of the format."""
    raw = read_bytes(Path(path), ConfigError)
    try:
        content = json.loads(raw.decode(), object_pairs_hook=_mapping)
    except json.JSONDecodeError as error:
        raise ConfigError(f"no JSON (line {error.lineno}, column {error.colno}: {error.msg})", file=path) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"no JSON ({error})", file=path) from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        file_format = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise ConfigError(
            f"format = {file_format!r}: expected {FORMAT!r}, as pachon baseline save writes it", file=path
        )
    if content.get("version") in _OLDER_VERSIONS:
        plan = content.get("plan")
        refuse_mirrored_names((plan.get("ccds") or () if isinstance(plan, dict) else ()), None, Path(path), ConfigError)
    elif content.get("version") not in VERSIONS:
        file_version, writer = content.get("version"), content.get("pachon")
        problem = (
            f"version = {file_version!r}: expected {VERSIONS[0]} or {VERSIONS[1]};"
            f" the file was written by pachon {writer}"
        )
        raise ConfigError(problem, file=path, key="version")
    baseline = validated(Baseline, content, str(path))
    for name, figure in baseline.figures.items():
        if figure.reason not in baseline.reasons:
            reason_names = ", ".join(baseline.reasons)
            raise ConfigError(f"figures.{name}.reason = {figure.reason!r}: expected one of {reason_names}", file=path)
    return baseline


@check_arguments
def write_baseline(path: str | os.PathLike[str], baseline: Baseline) -> None:
    """Write a baseline, whole or not at all; ProductError if it cannot be written."""
    write_bytes(Path(path), baseline_text(baseline).encode())


def baseline_text(baseline: Baseline) -> str:
    """Return the file's text."""
    content = baseline.model_dump(mode="json", exclude={"figures"})
    has_limits = any(metric.limit is not None for metric in baseline.figures.values())
    content["version"] = VERSIONS[has_limits or bool(baseline.settings)]
    lines = [f" {_json(key)}: {_json_block(value)}," for key, value in content.items() if value not in (None, [])]
    figures = [
        f"  {_json(name)}: {_json(baseline.figures[name].model_dump(mode='json', exclude_none=True))}"
        for name in sorted(baseline.figures)
    ]
    return "\n".join(["{", *lines, ' "figures": {', ",\n".join(figures), " }", "}"]) + "\n"


def rounded(value: float, tolerance: float) -> float:
    """Return a value with two digits beyond its tolerance, and zero without a minus sign."""
    return round(value, 2 - math.floor(math.log10(tolerance))) + 0.0


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _json_block(value: Any) -> str:
    """Return JSON of one line, of a mapping one line for each key."""
    if not isinstance(value, dict):
        return _json(value)
    return "{\n" + ",\n".join(f"  {_json(k)}: {_json(v)}" for k, v in value.items()) + "\n }"


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r} occurs twice")
    return dict(pairs)
