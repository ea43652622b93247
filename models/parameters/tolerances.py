"""Tolerances of degrees of freedom, and random draws within them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, check_unique
from ...core.random_streams import stream
from ...core.units import require_count, require_seed

DISTRIBUTIONS = ("uniform", "normal", "truncated", "end_point")


@check_arguments
@dataclass(frozen=True)
class Tolerance:
    """Tolerance of one degree of freedom.

    Parameters
    ----------
    name : str
        Name of the degree of freedom, or address of the parameter.
    size : float
        Largest deviation to either side ("uniform", "end_point"), or standard deviation of the normal distribution
        before truncation. In the unit of the degree of freedom.
    distribution : {"uniform", "normal", "truncated", "end_point"}
        Distribution of the deviations; "end_point" is either limit, with equal probability.
    limit : float, optional
        Largest deviation of a truncated distribution, in the same unit.

    Raises
    ------
    ConfigError
        If the distribution is unknown, or a limit is missing or not needed.
    DomainError
        If a number is not positive and finite.
    """

    name: str
    size: float
    distribution: Literal["uniform", "normal", "truncated", "end_point"] = "uniform"
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
        """Return ``n`` deviations, shape [n]; the first ones do not depend on ``n`` or on other tolerances."""
        uniform = stream(require_seed(seed), "tolerance", self.name).uniform(size=require_count(n, "n", 1))
        if self.distribution == "uniform":
            return self.size * (2.0 * uniform - 1.0)
        if self.distribution == "end_point":
            return np.where(uniform < 0.5, -self.size, self.size)
        low = 0.0 if self.limit is None else ndtr(-self.limit / self.size)
        # The generator may return 0, where the normal quantile is infinite.
        return self.size * ndtri(np.maximum(low + (1.0 - 2.0 * low) * uniform, np.finfo(float).tiny))


def draw(tolerances: Iterable[Tolerance], seed: int, n: int = 1) -> np.ndarray:
    """Return deviations within tolerances, shape [n, n_tolerance], each in the unit of its degree of freedom.

    Each tolerance has a random stream of its own, by its name, so the draws of the others do not depend on it.
    """
    tolerances = tuple(tolerances)
    if not tolerances:
        raise ConfigError("tolerances = []: expected at least one")
    check_unique("tolerance", [t.name for t in tolerances])
    return np.stack([t.draw(seed, n) for t in tolerances], axis=1)
