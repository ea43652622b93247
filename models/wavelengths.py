"""Checks of wavelengths and of the ranges that models cover."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.errors import DomainError, PrescriptionError
from ..core.units import metres


def check_wavelength_range(wavelength_range: tuple[float, float]) -> None:
    """Raise PrescriptionError unless a range of wavelengths [m] is two finite numbers, rising from above zero."""
    if len(wavelength_range) != 2 or not np.all(np.isfinite(wavelength_range)):
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 2 finite numbers")
    if not 0 < wavelength_range[0] < wavelength_range[1]:
        raise PrescriptionError(f"wavelength_range = {wavelength_range!r}: expected 0 < shortest < longest")


def wavelengths_within(wavelength: Any, wavelength_range: tuple[float, float], model: str) -> np.ndarray:
    """Return wavelengths [m] as a float64 array, or raise DomainError where one is out of the range of a model."""
    w = metres(wavelength, "wavelength")
    low, high = wavelength_range
    # One part in 1e12 is what conversions between units may add to a limit.
    outside = ~((w >= low * (1 - 1e-12)) & (w <= high * (1 + 1e-12)))
    if np.any(outside):
        raise DomainError(f"{nanometres(w, outside)}: expected {low * 1e9:.6g} to {high * 1e9:.6g} nm for {model}")
    return w


def nanometres(wavelength: np.ndarray, which: np.ndarray) -> str:
    """Return the text for the first of some wavelengths [m]."""
    return f"wavelength = {np.atleast_1d(wavelength)[np.atleast_1d(which)][0] * 1e9:.6g} nm"
