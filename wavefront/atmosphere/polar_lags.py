"""Lags on the sky on rings and spokes, between which covariances over the field are interpolated."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

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
