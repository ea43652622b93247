"""Points of a sweep and their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class SweepPoint:
    """A point to compute: its number, the values of its parameters, and the seed of its random numbers."""

    number: int
    parameters: dict[str, Any]
    seed: int


@dataclass(frozen=True)
class PointResult:
    """Result of one point."""

    number: int
    metrics: dict[str, float] | None  #: None where the point could not be computed
    problem: str | None  #: reason why it could not be computed, in one line
    seconds: float  #: time of the computation
    worker: str  #: machine and process of the computation
