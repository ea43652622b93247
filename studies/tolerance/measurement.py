"""Points of a tolerance study: telescopes as designed, at either end of a tolerance, or drawn; computed in batches."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ...core.workers import worker_name
from ...design.tolerancing.toleranced_merit import TolerancedMerit
from ..sweep.store import PointResult, SweepPoint

#: Kinds of points in the store.
NOMINAL = "nominal"
LOWER = "lower end"
UPPER = "upper end"
INVERSE = "inverse"
DRAW = "draw"
#: Numbers of a point in the store: its merit, beside which compensators stand by name; or an inverse sensitivity.
MERIT = "merit"
SIZE = "size"
#: Precision of an inverse sensitivity, a binary logarithm.
_PRECISION = 1e-3
#: Largest factor from a tolerance to its inverse sensitivity.
_FARTHEST = 1e4
#: Half of the range about a predicted inverse sensitivity, a binary logarithm.
_NARROW = 0.1


def moved_by(compensator: str) -> str:
    """Return the name of the motion of a compensator."""
    return f"{compensator} (compensator)"


@dataclass(frozen=True)
class Batch:
    """Points that one worker computes, with deviations of each and compensators to first order, [n, n_freedom]."""

    points: tuple[SweepPoint, ...]
    values: np.ndarray

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"points {self.points[0].number} to {self.points[-1].number}"


@dataclass(frozen=True)
class ToleranceMeasurement:
    """Compute the merit of points; a picklable function for every kind of worker."""

    toleranced: TolerancedMerit
    loss: float  #: relative loss of an inverse sensitivity

    def __call__(self, batch: Batch, threads: int) -> list[PointResult]:
        """Compute a batch of points."""
        del threads  # one telescope has too few rays to share
        results = []
        for point, values in zip(batch.points, batch.values, strict=True):
            start = time.perf_counter()
            if point.parameters["kind"] == INVERSE:
                number = {SIZE: self._inverse(int(point.parameters["tolerance"]))}
            else:
                settled, merit = self.toleranced.settled(values)
                moves = zip(self.toleranced.compensators, settled[len(self.toleranced.tolerances) :], strict=True)
                number = {MERIT: merit, **{moved_by(n): float(v) for n, v in moves}}
            results.append(PointResult(point.number, number, None, time.perf_counter() - start, worker_name()))
        return results

    def _inverse(self, index: int) -> float:
        """Return the size of one tolerance whose worse end costs the loss; NaN where none within reach does.

        Brent's method on the logarithm, within a narrow range about what the linear residuals predict, or between sizes
        a factor of two apart from the size of the tolerance on.
        """
        toleranced = self.toleranced
        nominal = toleranced.traced_nominal
        allowed = self.loss * abs(nominal)
        excesses: dict[float, float] = {}

        def excess(power: float) -> float:
            if power not in excesses:
                ends = np.zeros((2, len(toleranced.tolerances)))
                ends[:, index] = start * 2.0**power * np.array([-1.0, 1.0])
                merits = [toleranced.settled(values)[1] for values in toleranced.compensated(ends)]
                losses = toleranced.criterion.loss(np.array(merits), nominal)
                # A telescope that loses its light costs more than any that does not.
                excesses[power] = float(np.max(np.where(np.isnan(losses), _FARTHEST * allowed, losses))) - allowed
            return excesses[power]

        start = toleranced.tolerances[index].size
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
        fixed, change = self.toleranced.fixed, self.toleranced.by_deviation[:, index]
        square, along = float(change @ change), abs(float(fixed @ change))
        if self.toleranced.criterion.function is not None or not square > 0.0:
            return np.nan
        gain = ((1.0 + self.loss) ** 2 - 1.0) * float(fixed @ fixed)
        return float((np.sqrt(along**2 + square * gain) - along) / square)
