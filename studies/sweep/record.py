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
    """Result of one point.

    Attributes
    ----------
    number : int
        Number of the point.
    metrics : dict of str to float, or None
        Metrics by name; None where the point could not be computed.
    problem : str or None
        Reason why it could not be computed, in one line.
    seconds : float
        Time of the computation.
    worker : str
        Machine and process of the computation.
    """

    number: int
    metrics: dict[str, float] | None
    problem: str | None
    seconds: float
    worker: str
