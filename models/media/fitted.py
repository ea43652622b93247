"""Dispersion formulas fitted to media that have none, for files that hold formulas alone."""

from __future__ import annotations

import numpy as np

from .dispersion import Dispersion
from .medium import Medium

#: Powers of the squared wavelength in the formula ``extended_3``, in the order of its coefficients.
_POWERS = np.array([0, 1, 2, -1, -2, -3, -4, -5, -6])
#: Chebyshev nodes in the inverse square of the wavelength, along which indices of glasses are smooth.
_NODES = 100


def fitted_dispersion(medium: Medium, wavelength_range: tuple[float, float]) -> tuple[Dispersion, float]:
    """Return the formula ``extended_3`` nearest to a medium between two wavelengths [m], and its largest deviation.

    Least squares in the squared index. The deviation is that of the index at points between the nodes; rounding alone
    where the medium follows such a formula, about 1e-9 of a glass whose index and Abbe number were changed.
    """
    low, high = wavelength_range
    ends = np.array([high, low]) ** -2.0

    def wavelengths(count: int) -> np.ndarray:
        along = 0.5 - 0.5 * np.cos((np.arange(count) + 0.5) * np.pi / count)
        return np.asarray((ends[0] + (ends[1] - ends[0]) * along) ** -0.5)

    w = wavelengths(_NODES)
    # In units of a middle wavelength all powers are of the order of one.
    middle = low * high
    columns = (w**2 / middle)[:, None] ** _POWERS
    size = np.abs(columns).max(axis=0)
    solution = np.linalg.lstsq(columns / size, medium.index(w) ** 2, rcond=1e-15)[0] / size
    coefficients = solution * (middle * 1e12) ** -_POWERS.astype(float)
    dispersion = Dispersion("extended_3", tuple(coefficients.tolist()), (low, high), medium.name)
    between = wavelengths(2 * _NODES + 1)
    return dispersion, float(np.abs(dispersion.index(between) - medium.index(between)).max())
