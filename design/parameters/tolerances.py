"""Tolerances: how far each degree of freedom may be off, and random draws within them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from ...core.errors import ConfigError, DomainError
from ...core.random_streams import stream

DISTRIBUTIONS = ("uniform", "normal", "truncated")


@dataclass(frozen=True)
class Tolerance:
    """How far one degree of freedom may be off.

    Parameters
    ----------
    name : str
        Name of the degree of freedom, or address of the parameter.
    size : float
        "uniform": largest deviation, to either side. Else the standard deviation (of the normal distribution before it
        is truncated). In the unit of the degree of freedom.
    distribution : {"uniform", "normal", "truncated"}
        How deviations are distributed.
    limit : float, optional
        Where a truncated distribution ends, to either side, in the same unit.

    Raises
    ------
    ConfigError
        If there is no such distribution, or a limit is given to one that is not truncated, or missing.
    DomainError
        If a number is not positive and finite.
    """

    name: str
    size: float
    distribution: Literal["uniform", "normal", "truncated"] = "uniform"
    limit: float | None = None

    def __post_init__(self) -> None:
        if self.distribution not in DISTRIBUTIONS:
            raise ConfigError(
                f"tolerance {self.name!r}: distribution = {self.distribution!r}: "
                f"expected one of {', '.join(DISTRIBUTIONS)}"
            )
        if (self.limit is not None) != (self.distribution == "truncated"):
            raise ConfigError(
                f"tolerance {self.name!r}: limit = {self.limit!r}: expected with 'truncated', and only there"
            )
        for key, value in (("size", self.size), ("limit", 1.0 if self.limit is None else self.limit)):
            if not (np.isfinite(value) and value > 0):
                raise DomainError(f"tolerance {self.name!r}: {key} = {value!r}: expected a positive number")

    @property
    def spread(self) -> float:
        """Standard deviation of the deviations, in the unit of the degree of freedom."""
        if self.limit is not None:
            edge = self.limit / self.size
            density = np.exp(-0.5 * edge**2) / np.sqrt(2.0 * np.pi)
            return self.size * float(np.sqrt(1.0 - 2.0 * edge * density / (2.0 * ndtr(edge) - 1.0)))
        return self.size / np.sqrt(3.0) if self.distribution == "uniform" else self.size

    def draw(self, seed: int, n: int) -> np.ndarray:
        """Return ``n`` deviations, shape [n]; the first of more are those of fewer, whatever else is drawn."""
        share = stream(seed, "tolerance", self.name).uniform(size=n)
        if self.distribution == "uniform":
            return self.size * (2.0 * share - 1.0)
        low = 0.0 if self.limit is None else ndtr(-self.limit / self.size)
        # A generator may hand out 0, which no normal deviation belongs to.
        return self.size * ndtri(np.maximum(low + (1.0 - 2.0 * low) * share, np.finfo(float).tiny))


def draw(tolerances: Iterable[Tolerance], seed: int, n: int = 1) -> np.ndarray:
    """Draw deviations within tolerances.

    Each tolerance has a random stream of its own, by its name: leaving one out, or drawing more, leaves the others as
    they were.

    Parameters
    ----------
    tolerances : iterable of Tolerance
        The tolerances.
    seed : int
        Seed, not negative.
    n : int
        Number of telescopes to draw.

    Returns
    -------
    ndarray, shape [n, n_tolerance]
        Deviations, each in the unit of its degree of freedom.

    Raises
    ------
    ConfigError
        If there is no tolerance, or two have one name.
    DomainError
        If the number or the seed is not a whole number in range.
    """
    chosen = tuple(tolerances)
    names = [t.name for t in chosen]
    if not chosen:
        raise ConfigError("tolerances = []: expected at least one")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"tolerance {name!r} occurs more than once: expected unique names")
    for key, value, least in (("n", n, 1), ("seed", seed, 0)):
        if int(value) != value or value < least:
            raise DomainError(f"{key} = {value!r}: expected a whole number of at least {least}")
    return np.stack([t.draw(seed, int(n)) for t in chosen], axis=1)
