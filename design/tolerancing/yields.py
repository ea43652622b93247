"""Yield: fraction of drawn telescopes that meet a requirement, with its binomial error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.result import Values


@dataclass(frozen=True)
class Yield(Values):
    """Fraction of telescopes that meet a requirement.

    Attributes
    ----------
    requirement : float
        Requirement, in the unit of the merit.
    fraction : float
        Fraction that meets it.
    low, high : float
        Limits of the fraction at one standard deviation, Wilson's score interval: E. B. Wilson, J. Am. Stat. Assoc. 22,
        209 (1927).
    """

    requirement: float
    fraction: float
    low: float
    high: float

    @classmethod
    def of(cls, merits: np.ndarray, requirement: float, *, larger: bool = False) -> Yield:
        """Return the yield of merits, NaN for lost telescopes; with `larger`, at least the requirement is wanted."""
        met = merits >= requirement if larger else merits <= requirement
        n, p = len(merits), float(met.mean())
        middle = (p + 0.5 / n) / (1.0 + 1.0 / n)
        half = np.sqrt(p * (1.0 - p) / n + 0.25 / n**2) / (1.0 + 1.0 / n)
        return cls(requirement, p, float(middle - half), float(middle + half))
