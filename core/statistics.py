"""Means of values of which some are not finite."""

from __future__ import annotations

import numpy as np


def finite_mean(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def finite_median(values: np.ndarray) -> float:
    """Return the median of the finite values; NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of the finite values; NaN where there are none."""
    return float(np.sqrt(finite_mean(values**2)))
