"""Mean square radius of spots against the height of the detector.

Behind the last surface rays are straight: landing points move in proportion to the height, and the mean square radius
is a parabola in it, whose minimum is known without a search.
"""

from __future__ import annotations

import numpy as np


def spot_parabola(place: np.ndarray, slope: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the mean square radius about the centroid as a parabola in the height of the detector.

    Parameters
    ----------
    place : ndarray, shape [..., n_ray, 2]
        Landing points on the detector [m]; those without light may be NaN.
    slope : ndarray, shape [..., n_ray, 2]
        How far they move for each metre that the detector moves along its z axis.
    weight : ndarray, shape [..., n_ray]
        Light of the rays, 0 for those that do not arrive; some of each spot must.

    Returns
    -------
    ndarray, shape [..., 3]
        Coefficients of the powers 0, 1 and 2 of the height.
    """
    weight = weight / weight.sum(axis=-1, keepdims=True)
    lit = weight[..., None] > 0.0

    def centered(values: np.ndarray) -> np.ndarray:
        values = np.where(lit, values, 0.0)
        return values - np.einsum("...p,...pi->...i", weight, values)[..., None, :]

    place, slope = centered(place), centered(slope)

    def mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("...p,...pi,...pi->...", weight, a, b))

    return np.stack([mean(place, place), 2.0 * mean(place, slope), mean(slope, slope)], axis=-1)


def lowest_height(parabola: np.ndarray) -> np.ndarray:
    """Return the height at which parabolas [..., 3] are lowest [m], infinite or NaN for parallel light."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-parabola[..., 1] / (2.0 * parabola[..., 2]))
