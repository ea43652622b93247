"""Angles in radians, and conversion of numbers or astropy quantities to arrays in SI."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy import units as u

from .errors import DomainError, shown

#: One arcsecond, one arcminute [rad].
ARCSEC = np.pi / 648000
ARCMIN = 60.0 * ARCSEC
#: Arrays that lose their unit or mask where NumPy makes one array of several.
_APART = (u.Quantity, np.ma.MaskedArray)


def real_numbers(values: Any) -> Any:
    """Return real numbers as an array of their own type, masked ones as NaN; None where they are anything else.

    Quantities, and lists of them, keep their unit. Boolean values, times, complex numbers, texts and objects are none.
    """
    if type(values) is np.ndarray:
        return values if values.dtype.kind in "iuf" else None
    if isinstance(values, (tuple, list)) and any(isinstance(v, _APART) for v in values):
        found = [real_numbers(v) for v in values]
        return None if any(v is None for v in found) else found
    if getattr(values, "unit", None) is not None and not isinstance(values, u.Quantity):
        # Columns of tables.
        values = values.quantity
    if hasattr(values, "mask") and hasattr(values, "filled"):
        if values.dtype.kind not in "iuf":
            return None
        masked = np.any(values.mask)
        values = values.astype(np.float64).filled(np.nan) if masked else values.filled(0)
    if not isinstance(values, u.Quantity):
        try:
            values = np.asarray(values)
        except (TypeError, ValueError, OverflowError):
            return None
    return values if values.dtype.kind in "iuf" else None


def _si(value: Any, unit: u.UnitBase, name: str) -> np.ndarray:
    numbers = real_numbers(value)
    # The text is made where it is needed: that of a large array takes longer than many a trace.
    if numbers is None:
        raise DomainError(f"{name} = {shown(value)}: expected a number in {unit} or a quantity")
    if isinstance(numbers, list):
        numbers = [_si(v, unit, name) for v in numbers]
    elif isinstance(numbers, u.Quantity):
        try:
            numbers = numbers.to_value(unit)
        except u.UnitConversionError:
            raise DomainError(f"{name} = {shown(value)}: expected a unit that converts to {unit}") from None
    try:
        return np.asarray(numbers, dtype=np.float64)
    except ValueError:
        raise DomainError(f"{name} = {shown(value)}: expected numbers of one shape in {unit}") from None


def real_array(values: Any, expectation: str) -> np.ndarray:
    """Return real numbers as a float64 array; DomainError with the expectation where they are none."""
    try:
        return _si(values, u.dimensionless_unscaled, "")
    except DomainError:
        raise DomainError(expectation) from None


def require_positive(value: Any, name: str, unit: str = "") -> float:
    """Return a finite, positive float, or raise :class:`DomainError` naming the argument."""
    try:
        numbers = real_array(value, "")
    except DomainError:
        numbers = np.array(np.nan)
    number = float(numbers.item()) if numbers.size == 1 else np.nan
    if not (np.isfinite(number) and number > 0.0):
        raise DomainError(f"{name} = {shown(value)}: expected a positive, finite number{' of ' + unit if unit else ''}")
    return number


def radians(value: Any, name: str) -> np.ndarray:
    """Return an angle in radians as a float64 array; plain numbers are radians already."""
    return _si(value, u.rad, name)


def positive_angle(value: Any, name: str) -> float:
    """Return a finite, positive angle in radians; plain numbers are radians already."""
    return require_positive(radians(value, name), name, "radians")


def metres(value: Any, name: str) -> np.ndarray:
    """Return a length in metres as a float64 array; plain numbers are metres already."""
    return _si(value, u.m, name)


def arcseconds(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] in arc seconds."""
    return np.rad2deg(angle) * 3600.0


def field_label(field: np.ndarray) -> str:
    """Return a field point [rad] as error messages name it, in degrees."""
    x, y = np.rad2deg(field)
    return f"field = ({x:.6g}, {y:.6g}) deg"
