"""Lags on the sky on rings and spokes, between which covariances over the field are interpolated."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
import scipy.sparse

from .moment_covariance import ExposedAir

# Rings and spokes.
_RINGS = 18
_SPOKES = 20
# First scale of the rings, in the angle of the pupil at the highest layer.
_FIRST_RING = 0.3


class PolarLags(NamedTuple):
    """Rings of lags at exp(step k) - 1 in units of the first scale, and spokes evenly over half a turn.

    Opposite lags have equal covariances. The ring before the last lies at the farthest lag, or within a step of it.
    """

    unit: float  #: first scale [rad]
    step: float
    rings: int
    spokes: int

    @classmethod
    def of(cls, air: ExposedAir, reach: float, rings: int = _RINGS, spokes: int = _SPOKES) -> Self:
        """Return those of an exposure up to a lag [rad]."""
        highest = max(air.altitudes, default=0.0)
        unit = _FIRST_RING * air.diameter / highest if highest else reach
        return cls(unit, math.log1p(reach / unit) / (rings - 2), rings, spokes)

    @property
    def radius(self) -> np.ndarray:
        """Radii of the rings [rad], from zero, [ring]."""
        return self.unit * np.expm1(self.step * np.arange(self.rings))

    @property
    def lags(self) -> np.ndarray:
        """Lags [rad], [n, 2]: that of zero, which is the first ring, and those of the others, ring by ring."""
        angle = math.pi * np.arange(self.spokes) / self.spokes
        lags = self.radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.concatenate([lags[0, :1], lags[1:].reshape(-1, 2)])

    def table(self, values: np.ndarray) -> np.ndarray:
        """Return values at :attr:`lags` [n, ...] by rings and spokes, [ring, spoke, ...]."""
        first = np.repeat(values[:1], self.spokes, axis=0)
        return np.concatenate([first, values[1:]]).reshape(self.rings, self.spokes, *values.shape[1:])

    def interpolation(self, places: np.ndarray) -> scipy.sparse.csr_matrix:
        """Return weights [n, n_lag] of values at :attr:`lags` in those at places [n, 2] [rad].

        They are Lagrange's cubics in ring and spoke, as in :func:`.read_lags`.
        """
        ring = np.log1p(np.hypot(*places.T) / self.unit) / self.step
        spoke = np.arctan2(places[:, 1], places[:, 0]) / np.pi * self.spokes
        before_ring, before_spoke = np.minimum(ring.astype(int), self.rings - 3), np.floor(spoke).astype(int)
        around = np.arange(-1, 3)
        # On the other side of the centre the rings come in reverse, with the same values.
        rings = np.abs(before_ring[:, None] + around)[:, :, None]
        spokes = ((before_spoke[:, None] + around) % self.spokes)[:, None]
        columns = np.where(rings == 0, 0, 1 + (rings - 1) * self.spokes + spokes)
        weight = _cubic(ring - before_ring)[:, :, None] * _cubic(spoke - before_spoke)[:, None]
        shape = (len(places), 1 + (self.rings - 1) * self.spokes)
        starts = np.arange(0, 16 * len(places) + 1, 16)
        return scipy.sparse.csr_matrix((weight.ravel().astype(np.float32), columns.ravel(), starts), shape=shape)


def _cubic(part: np.ndarray) -> np.ndarray:
    """Return weights of the four values around places between the second and the third, [n, 4]."""
    t = part
    return np.stack(
        [
            t * (t - 1.0) * (2.0 - t) / 6.0,
            (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
            t * (t + 1.0) * (2.0 - t) / 2.0,
            t * (t + 1.0) * (t - 1.0) / 6.0,
        ],
        axis=1,
    )
