r"""State of the telescope from the wavefronts of its donuts: a Kalman filter.

The wavefront of the donuts is z = S x + noise, with the state x, degrees of freedom in units of their tolerances, and
the sensitivity matrix S. The covariance P of the state before a visit, that of the noise R (photons, and the wavefront
of the turbulence, which donuts share) and the gain g give the estimate and what is left after the correction:

.. math:: K = P S^T (S P S^T + R)^{-1}, \quad \hat x = K z, \quad
          P' = (1 - g K S) P (1 - g K S)^T + g^2 K R K^T + D,

with the covariance D of the drift until the next visit (Kalman 1960, J. Basic Eng. 82, 35; Joseph's form). P is the
regularisation: combinations that donuts say little about are moved little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of one visit, in units of the tolerances."""

    state: np.ndarray  #: maximum of the posterior, [n]
    covariance: np.ndarray  #: of the state after correction and drift, before the next visit, [n, n]


def estimate_state(
    wavefront: np.ndarray,
    noise: np.ndarray,
    sensitivity: np.ndarray,
    covariance: np.ndarray,
    drift: np.ndarray,
    gain: float,
) -> Estimate:
    """Estimate the state from one visit, and the covariance of what a correction leaves.

    Parameters
    ----------
    wavefront : ndarray, shape [n_data]
        Zernikes of the donuts [m]; none leave the state as it is expected, at zero.
    noise : ndarray, shape [n_data, n_data]
        Covariance of their errors [m^2].
    sensitivity : ndarray, shape [n_data, n]
        Derivatives [m per tolerance].
    covariance, drift : ndarray, shape [n, n]
        Covariances of the state before the visit, and of its drift until the next.
    gain : float
        Fraction of the estimate that is taken off.
    """
    across = covariance @ sensitivity.T
    # Wavefronts in nanometres: their covariance in square metres would be near the rounding of a solver.
    scale = 1e9
    kalman = scale * np.linalg.solve(scale**2 * (sensitivity @ across + noise), scale * across.T).T
    retained = np.eye(len(covariance)) - gain * kalman @ sensitivity
    after = retained @ covariance @ retained.T + gain**2 * kalman @ noise @ kalman.T + drift
    return Estimate(kalman @ wavefront, after)


def steady_covariance(
    noise: np.ndarray, sensitivity: np.ndarray, covariance: np.ndarray, drift: np.ndarray, gain: float, visits: int
) -> np.ndarray:
    """Return the covariance of the state after so many visits with the same noise, as :func:`estimate_state`."""
    nothing = np.zeros(len(noise))
    for _ in range(visits):
        covariance = estimate_state(nothing, noise, sensitivity, covariance, drift, gain).covariance
    return covariance
