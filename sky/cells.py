"""Square cells of the tangent plane, each with random streams of its own, and regions made of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import DomainError
from ..core.random_streams import natural_number, stream
from ..core.units import ARCMIN, radians, require_positive

#: Side of a cell [rad].
SIDE = ARCMIN
#: Regions are refused beyond this distance from the pointing [rad]: the tangent plane does not reach far.
REACH = math.radians(20.0)


@dataclass(frozen=True)
class Cell:
    """One square of the tangent plane, from (column, row) times the side to the next multiples."""

    column: int
    row: int

    def stream(self, seed: int, *purpose: str) -> np.random.Generator:
        """Return the random stream of the cell for one purpose."""
        return stream(seed, *purpose, natural_number(self.column), natural_number(self.row))

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return xi and eta [rad] of places in the cell, given as fractions of its side."""
        return (self.column + x) * SIDE, (self.row + y) * SIDE


@dataclass(frozen=True)
class Region:
    """Rectangle of the tangent plane."""

    xi: tuple[float, float]  #: least and greatest [rad]
    eta: tuple[float, float]

    @classmethod
    def around(cls, half_width: Any) -> Region:
        """Return the square around the pointing of a given half-width, in rad or as a Quantity."""
        half = require_positive(radians(half_width, "half_width"), "half_width", "radians")
        return cls.between((-half, half), (-half, half))

    @classmethod
    def between(cls, xi: Any, eta: Any) -> Region:
        """Return the rectangle between the two values of xi and of eta, in rad or as Quantities."""
        ranges = []
        for name, value in (("xi", xi), ("eta", eta)):
            ends = radians(value, name)
            if ends.shape != (2,) or not np.all(np.abs(ends) <= REACH) or not ends[0] < ends[1]:
                raise DomainError(f"{name} = {value}: expected (least, greatest) within {math.degrees(REACH):.0f} deg")
            ranges.append((float(ends[0]), float(ends[1])))
        return cls(*ranges)

    @property
    def area(self) -> float:
        """Area on the tangent plane [rad^2]."""
        return (self.xi[1] - self.xi[0]) * (self.eta[1] - self.eta[0])

    def cells(self) -> Iterator[Cell]:
        """Return the cells that the region touches, row by row."""
        columns, rows = (range(math.floor(a / SIDE), math.ceil(b / SIDE)) for a, b in (self.xi, self.eta))
        return (Cell(column, row) for row in rows for column in columns)

    def contains(self, xi: np.ndarray, eta: np.ndarray) -> np.ndarray:
        """Return which places lie in the region, lower and left edges included."""
        return (xi >= self.xi[0]) & (xi < self.xi[1]) & (eta >= self.eta[0]) & (eta < self.eta[1])


def poisson_arrivals(rng: np.random.Generator, mean: float) -> np.ndarray:
    """Draw the points of a Poisson process of rate 1 between 0 and `mean`, rising.

    Those of a smaller mean are the first of those of a larger one.
    """
    points = np.zeros(0)
    while points.size == 0 or points[-1] < mean:
        start = points[-1] if points.size else 0.0
        # One long sum in order, so that rounding does not depend on where it is cut.
        steps = rng.exponential(size=int(mean - start + 5.0 * math.sqrt(mean)) + 16)
        points = np.concatenate([points, np.cumsum(np.concatenate([[start], steps]))[1:]])
    return points[points < mean]
