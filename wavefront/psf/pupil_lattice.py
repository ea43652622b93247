"""A square lattice of points in an annular pupil."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PupilLattice:
    """Points of a square lattice that lie in an annular pupil, symmetric about its centre.

    The gradient of the low screens has no modes beyond the cut-off, so on a lattice finer than half their wavelength
    sums over the pupil of the gradient and its squares are exact but for the rim; random points would be noisier.
    """

    spacing: float  #: distance of neighbouring points [m]
    column: np.ndarray  #: of each point, counted from the first column, [n_pupil] int
    row: np.ndarray  #: of each point, counted from the first row, [n_pupil] int
    origin: float  #: coordinate of the first column and row [m]

    @classmethod
    def fill(cls, diameter: float, obscuration: float, spacing: float) -> PupilLattice:
        """Return the lattice of a given spacing [m] in an annulus of given diameter [m] and linear obscuration."""
        count = 2 * math.ceil(0.5 * diameter / spacing)
        origin = -0.5 * (count - 1) * spacing
        line = origin + spacing * np.arange(count)
        radius = np.hypot(line, line[:, None])
        row, column = np.nonzero((radius < 0.5 * diameter) & (radius >= 0.5 * obscuration * diameter))
        return cls(spacing, column, row, origin)

    @property
    def size(self) -> int:
        """Columns, and rows, of the lattice."""
        return round(1.0 - 2.0 * self.origin / self.spacing)

    @property
    def points(self) -> np.ndarray:
        """Pupil coordinates [m], shape [n_pupil, 2]."""
        return self.origin + self.spacing * np.stack([self.column, self.row], axis=-1)

    def weights(self, diameter: float, obscuration: float) -> np.ndarray:
        """Return weights, 1 on the mean, that make sums over the points integrals over the annulus up to fourth order.

        A rim that cuts through a coarse lattice leaves its points a little too far in or out; of all weights under
        which every monomial of the coordinates up to the fourth order has its mean over the annulus, these are nearest
        to 1. The annulus is the one that the lattice fills.
        """
        x, y = self.points.T / (0.5 * diameter)
        # The mean of x^a y^b: over the angle (a-1)!! (b-1)!! / (a+b)!! for even a and b, over the radius r^(a+b).
        angle = {(0, 0): 1.0, (2, 0): 0.5, (0, 2): 0.5, (4, 0): 0.375, (0, 4): 0.375, (2, 2): 0.125}
        inner = obscuration**2
        radius = {0: 1.0, 2: (1.0 - inner**2) / (2.0 * (1.0 - inner)), 4: (1.0 - inner**3) / (3.0 * (1.0 - inner))}
        powers = [(a, b) for a in range(5) for b in range(5 - a)]
        means = np.array([angle[a, b] * radius[a + b] if (a, b) in angle else 0.0 for a, b in powers])
        monomials = np.array([x**a * y**b for a, b in powers])
        deficit = means * len(x) - monomials.sum(axis=1)
        # Least squares of so wide a matrix crash in LAPACK from some 1e5 points on; those of its triangle are the same.
        basis, triangle = np.linalg.qr(monomials.T)
        return np.asarray(1.0 + basis @ np.linalg.lstsq(triangle.T, deficit, rcond=None)[0])
