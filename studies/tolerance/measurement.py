"""Points of a tolerance study: telescopes as designed, at either end of a tolerance, or drawn; computed in batches."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from ...core.errors import PachonError
from ...core.workers import worker_name
from ...design.optimize.toleranced_merit import TolerancedMerit
from ..sweep.store import PointResult, SweepPoint
from .merits import ToleranceMerit

#: Kinds of points in the store.
NOMINAL, LOWER, UPPER, INVERSE, DRAW = "nominal", "lower end", "upper end", "inverse", "draw"
#: Precision of an inverse sensitivity, a binary logarithm.
_PRECISION = 1e-3
#: Largest factor from the tolerance to an inverse sensitivity.
_FARTHEST = 1e4
#: Half of the range about a predicted inverse sensitivity, a binary logarithm.
_NARROW = 0.1


@dataclass(frozen=True)
class Batch:
    """Points that one worker computes, with deviations and compensators of each, shape [n, n_degree_of_freedom]."""

    points: tuple[SweepPoint, ...]
    values: np.ndarray

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"points {self.points[0].number} to {self.points[-1].number}"


@dataclass(frozen=True)
class ToleranceMeasurement:
    """Compute the merit of points; a picklable function for every kind of worker."""

    built: TolerancedMerit
    merit: ToleranceMerit
    loss: float  #: relative loss of an inverse sensitivity

    def __call__(self, batch: Batch, threads: int) -> list[PointResult]:
        """Compute a batch of points."""
        del threads  # one telescope has too few rays to share
        results = []
        for point, values in zip(batch.points, batch.values, strict=True):
            start = time.perf_counter()
            if point.parameters["kind"] == INVERSE:
                number = {"size": self._inverse(int(point.parameters["tolerance"]))}
            else:
                number = {"merit": self.at(values)}
            results.append(PointResult(point.number, number, None, time.perf_counter() - start, worker_name()))
        return results

    def at(self, values: np.ndarray) -> float:
        """Return the merit at deviations and compensators, in SI; NaN where there is no such telescope."""
        if not values.any():
            return self.merit.measure(self.built.telescope)
        try:
            telescope = self.built.telescope_at(values)
        except PachonError:
            return np.nan
        return self.merit.measure(telescope)

    def values_of(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations [n, n_tolerance] with their compensators behind."""
        return np.concatenate([deviations, self.built.moves(deviations)], axis=1)

    @cached_property
    def nominal(self) -> float:
        """Merit as designed, compensated."""
        return self.at(self.values_of(np.zeros((1, len(self.built.tolerances))))[0])

    def _inverse(self, index: int) -> float:
        """Return the size of one tolerance whose worse end costs the loss; NaN where none within reach does.

        Brent's method on the logarithm, within a narrow range about what the linear residuals predict, or between sizes
        a factor of two apart from the size of the tolerance on.
        """
        nominal = self.nominal
        allowed = self.loss * abs(nominal)
        excess_at: dict[float, float] = {}

        def excess(power: float) -> float:
            if power not in excess_at:
                ends = np.zeros((2, len(self.built.tolerances)))
                ends[:, index] = start * 2.0**power * np.array([-1.0, 1.0])
                losses = self.merit.loss(np.array([self.at(v) for v in self.values_of(ends)]), nominal)
                # A telescope that loses its light costs more than any that does not.
                excess_at[power] = float(np.max(np.where(np.isnan(losses), _FARTHEST * allowed, losses))) - allowed
            return excess_at[power]

        start = self.built.tolerances[index].size
        predicted = np.log2(self._predicted(index) / start)
        low, high = predicted - _NARROW, predicted + _NARROW
        if not (abs(predicted) < np.log2(_FARTHEST) and excess(low) < 0.0 <= excess(high)):
            step = 1.0 if excess(0.0) < 0 else -1.0
            last = 0.0
            while (excess(last + step) < 0) == (step > 0):
                last += step
                if abs(last) > np.log2(_FARTHEST):
                    return np.nan
            low, high = sorted((last, last + step))
        return start * 2.0 ** float(brentq(excess, low, high, xtol=_PRECISION))

    def _predicted(self, index: int) -> float:
        """Return that size by linear residuals; NaN for merits other than theirs, and where there is none."""
        fixed, change = self.built.fixed, self.built.left[:, index]
        square, along = float(change @ change), abs(float(fixed @ change))
        if self.merit.own is not None or not square > 0.0:
            return np.nan
        gain = ((1.0 + self.loss) ** 2 - 1.0) * float(fixed @ fixed)
        return float((np.sqrt(along**2 + square * gain) - along) / square)
