"""Points of a tolerance study: telescopes as designed, at either end of a tolerance, or drawn; computed in batches."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ...core.errors import PachonError
from ...core.workers import worker_name
from ...design.optimize.toleranced_merit import TolerancedMerit
from ..sweep.store import PointResult, SweepPoint
from .merits import ToleranceMerit

#: Kinds of points in the store.
NOMINAL, LOWER, UPPER, INVERSE, DRAW = "nominal", "lower end", "upper end", "inverse", "draw"
#: Precision of an inverse sensitivity, a binary logarithm, and the largest factor from the tolerance to it.
_PRECISION, _FARTHEST = 1e-3, 1e4


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
        found = []
        for point, values in zip(batch.points, batch.values, strict=True):
            start = time.perf_counter()
            if point.parameters["kind"] == INVERSE:
                number = {"size": self._inverse(int(point.parameters["tolerance"]))}
            else:
                number = {"merit": self.at(values)}
            found.append(PointResult(point.number, number, None, time.perf_counter() - start, worker_name()))
        return found

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

    def _inverse(self, index: int) -> float:
        """Return the size of one tolerance whose worse end costs the loss; NaN where none within reach does.

        Brent's method on the logarithm, between sizes a factor of two apart from the size of the tolerance on.
        """
        n = len(self.built.tolerances)
        nominal = self.at(self.values_of(np.zeros((1, n)))[0])
        allowed = self.loss * abs(nominal)

        def excess(power: float) -> float:
            ends = np.zeros((2, n))
            ends[:, index] = start * 2.0**power * np.array([-1.0, 1.0])
            losses = self.merit.loss(np.array([self.at(v) for v in self.values_of(ends)]), nominal)
            # A telescope that loses its light costs more than any that does not.
            return float(np.max(np.where(np.isnan(losses), _FARTHEST * allowed, losses))) - allowed

        start, low = self.built.tolerances[index].size, 0.0
        step = 1.0 if excess(low) < 0 else -1.0
        while (excess(low + step) < 0) == (step > 0):
            low += step
            if abs(low) > np.log2(_FARTHEST):
                return np.nan
        return start * 2.0 ** float(brentq(excess, *sorted((low, low + step)), xtol=_PRECISION))
