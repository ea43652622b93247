r"""Covariance of the contribution of turbulence to a PSF shape, between positions on the focal plane.

A turbulent layer at height H, blown by a wind V, affects the PSFs of stars alike whose light crosses the same air
during an exposure T: of stars up to V T / H apart along the wind, but only D / H across it (D: pupil diameter). So the
covariance is a sum of a few anisotropic components and a constant, the part common to all stars,

.. math:: C(d) = c + \sum_j a_j e^{-|M_j d|} + \text{(terms of each CCD)},

where :math:`M_j` is a 2 x 2 matrix. Terms of each CCD (a step, a slope and ripples) are added where the optics are not
modelled, since steps of the height then show at the borders of CCDs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

#: Names of the terms of each CCD.
CCD_TERMS = ("step", "slope", "ripple")
#: Correlation length of the ripples of a CCD, in sides of a CCD.
RIPPLE_LENGTH = 0.3
#: Number of anisotropic components: a third changes likelihood and errors by less than their scatter.
COMPONENTS = 2


@dataclass(frozen=True, eq=False)
class Places:
    """Positions on the focal plane, and the CCD of each.

    Attributes
    ----------
    xy : ndarray, shape [n, 2]
        Positions on the detector [m].
    ccd : ndarray of int, shape [n]
        Number of the CCD.
    uv : ndarray, shape [n, 2]
        Positions from the centre of the CCD, in halves of its side.
    amplitude : ndarray, shape [n], or None
        What turbulence adds to shapes there, over its mean over the field; None for 1 everywhere.
    """

    xy: np.ndarray
    ccd: np.ndarray
    uv: np.ndarray
    amplitude: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, chosen: np.ndarray | slice) -> Places:
        amplitude = None if self.amplitude is None else self.amplitude[chosen]
        return Places(self.xy[chosen], self.ccd[chosen], self.uv[chosen], amplitude)

    def amplitudes_with(self, other: Places) -> np.ndarray | float:
        """Return products of the amplitudes here and at other places, [n, m]; 1 where neither have any."""
        if self.amplitude is None or other.amplitude is None:
            assert self.amplitude is other.amplitude, "both or neither have amplitudes"
            return 1.0
        return np.outer(self.amplitude, other.amplitude)

    @property
    def squares(self) -> np.ndarray | float:
        """Squares of the amplitudes, [n]; 1 without any."""
        return 1.0 if self.amplitude is None else self.amplitude**2


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance function of one shape parameter (e1, e2 or the logarithm of the size).

    Attributes
    ----------
    constant : float
        Variance of the part that all stars share; large, so that their mean is free.
    amplitude : ndarray, shape [n_component]
        Variance of each anisotropic component.
    matrix : ndarray, shape [n_component, 2, 2]
        :math:`M_j`, upper triangular [1/m].
    ccd : ndarray, shape [3]
        Variance of a step, of a slope per half side, and of ripples of each CCD (:data:`CCD_TERMS`).
    nugget : float
        Variance of each star beside its stated noise.
    """

    constant: float
    amplitude: np.ndarray
    matrix: np.ndarray
    ccd: np.ndarray
    nugget: float

    @property
    def variance(self) -> float:
        """Variance at the centre of a CCD about the part that all stars share."""
        return float(self.amplitude.sum() + self.ccd[0] + self.ccd[2])

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lengths along and across [m], and direction of the first [rad], 0 to pi, of each component."""
        _, falls, rows = np.linalg.svd(self.matrix)
        angle = np.arctan2(rows[:, 1, 1], rows[:, 1, 0]) % np.pi
        return 1.0 / falls[:, 1], 1.0 / falls[:, 0], angle

    def between(self, one: Places, other: Places) -> np.ndarray:
        """Return the covariance between two sets of places, without the nugget, shape [n, m]."""
        difference = one.xy[:, None] - other.xy
        total = np.zeros(difference.shape[:2])
        for amplitude, matrix in zip(self.amplitude, self.matrix, strict=True):
            total += amplitude * np.exp(-_scaled_distance(difference, matrix))
        if self.ccd.any():
            for variance, term in zip(self.ccd, ccd_terms(one, other), strict=True):
                total += variance * term
        return self.constant + one.amplitudes_with(other) * total

    def root(self, places: Places, noise: np.ndarray) -> np.ndarray:
        """Return the lower Cholesky factor of the covariance of stars, nugget and noise variances [n] included."""
        matrix = self.between(places, places)
        matrix[np.diag_indices(len(places))] += noise + self.nugget
        return scipy.linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)

    def at(self, places: Places) -> np.ndarray:
        """Return the variance at places, shape [n]."""
        slope = self.ccd[1] * (places.uv**2).sum(axis=1)
        return np.asarray(self.constant + places.squares * (self.variance + slope))


def ccd_terms(one: Places, other: Places) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the correlations of :data:`CCD_TERMS` between two sets of places, each of shape [n, m]."""
    same = (one.ccd[:, None] == other.ccd).astype(np.float64)
    slope = same * (one.uv @ other.uv.T)
    squares = ((one.uv[:, None] - other.uv) ** 2).sum(axis=2)
    return same, slope, same * np.exp(-np.sqrt(squares) / (2.0 * RIPPLE_LENGTH))


def _scaled_distance(difference: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return |M d| of differences [..., 2] for an upper triangular M."""
    u = matrix[0, 0] * difference[..., 0] + matrix[0, 1] * difference[..., 1]
    v = matrix[1, 1] * difference[..., 1]
    return np.sqrt(u * u + v * v)
