r"""Covariance of the slopes of turbulence, as tables against the distance of two points.

With the spectrum W of the path, the slopes along x and y of two points a distance :math:`\rho` apart have the
covariance

.. math:: S = \begin{pmatrix} A + B \cos 2\phi & B \sin 2\phi \\ B \sin 2\phi & A - B \cos 2\phi \end{pmatrix}, \quad
          A = \tfrac12 \int k^2 W J_0(k \rho) \, d^2\nu, \quad B = -\tfrac12 \int k^2 W J_2(k \rho) \, d^2\nu,

with :math:`k = 2 \pi \nu` and the direction :math:`\phi` from one point to the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import j0, j1

from .layer_screens import SLOPE_LAG
from .turbulence import path_spectrum

#: Step of the tables [m]: a ninth of the radian of the shortest mode that counts as slope; the nearest value is taken.
_STEP = 0.0125
#: Step of the integrals between which cubic splines interpolate [m].
_COARSE_STEP = 0.05
#: Distance beyond which slopes are independent [outer scales]: their covariance falls as exp(-2 pi rho / L0).
_REACH = 1.3
#: Largest distance of the tables [m], which an outer scale beyond 200 m would exceed.
_LONGEST = 250.0
#: Covariance over the variance that counts as none. Fourth powers of far less would be denormal, which takes processors
#: ten times as long.
_NEGLIGIBLE = 1e-3
#: Frequencies of the integrals: a multiple of the first, and so many a cycle of the longest table.
_NODES = 512
_NODES_PER_CYCLE = 6.0
# Distances whose integrals are taken at a time, which bounds the memory.
_BATCH = 256


@dataclass(frozen=True, eq=False)
class SlopeCovariance:
    """Tables of A and of B over the square of the distance, at multiples of ``step``."""

    step: float  #: [m]
    isotropic: np.ndarray  #: A [rad^2], [n]
    directed: np.ndarray  #: B over the square of the distance [rad^2/m^2], [n]

    @property
    def reach(self) -> float:
        """Distance at which the tables end [m]; slopes farther apart are independent."""
        return self.step * (len(self.isotropic) - 1)


@lru_cache(maxsize=16)
def slope_covariance(r0: float, outer_scale: float, cutoff: float) -> SlopeCovariance:
    """Return the covariance of slopes of all turbulence up to a cut-off [rad/m].

    ``r0`` and ``outer_scale`` [m] are as those of an atmosphere. The slopes are those of the low screens, taken over
    :data:`SLOPE_LAG`.
    """
    table, scale = _of_one_metre(outer_scale, cutoff), r0 ** (-5.0 / 3.0)
    return replace(table, isotropic=scale * table.isotropic, directed=scale * table.directed)


@lru_cache(maxsize=16)
def _of_one_metre(outer_scale: float, cutoff: float) -> SlopeCovariance:
    """Return that of a Fried parameter of 1 m."""
    reach = min(_REACH * outer_scale, _LONGEST)
    distance = _COARSE_STEP * np.arange(math.ceil(reach / _COARSE_STEP) + 1)
    highest = cutoff / (2.0 * math.pi)
    node, weight = _nodes(_NODES * max(1, math.ceil(_NODES_PER_CYCLE * highest * reach / _NODES)))
    # The square root spreads the knee of the spectrum at 1/L0 over many nodes.
    root = 0.5 * (node + 1.0)
    nu = highest * root**2
    k = 2.0 * math.pi * nu
    power = path_spectrum(nu, 1.0, outer_scale) * (k * np.sinc(nu * SLOPE_LAG)) ** 2
    power *= 2.0 * math.pi * nu * (highest * root * weight)
    isotropic, directed = np.empty(len(distance)), np.empty(len(distance))
    for first in range(0, len(distance), _BATCH):
        part = slice(first, first + _BATCH)
        x = np.maximum(k * distance[part, None], 1e-4)
        bessel = j0(x)
        isotropic[part] = 0.5 * (bessel @ power)
        # J2 / x^2 is 1/8 at zero.
        over_square = np.where(x > 0.02, (2.0 * j1(x) / x - bessel) / x**2, 0.125 - x**2 / 96.0)
        directed[part] = -0.5 * (over_square @ (power * k**2))
    fine = _STEP * np.arange(round(distance[-1] / _STEP) + 1)
    # Even functions: no slope at zero.
    ends = ((1, 0.0), (2, 0.0))
    same, other = (CubicSpline(distance, values, bc_type=ends)(fine) for values in (isotropic, directed))
    negligible = (np.abs(same) < _NEGLIGIBLE * same[0]) & (np.abs(other) * fine**2 < _NEGLIGIBLE * same[0])
    end = int(np.flatnonzero(~negligible)[-1]) + 1
    # A zero ends the tables.
    same[end:], other[end:] = 0.0, 0.0
    return SlopeCovariance(_STEP, same[: end + 1], other[: end + 1])


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return so many nodes and weights of Gauss and Legendre; eigenvalues, which take longer than the integrals."""
    return np.polynomial.legendre.leggauss(count)
