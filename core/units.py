"""Angles in radians, and conversion of numbers or astropy quantities to arrays in SI."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy import units as u

from .errors import DomainError

#: One arcsecond, one arcminute [rad].
ARCSEC = np.pi / 648000
ARCMIN = 60.0 * ARCSEC


def _si(value: Any, unit: u.UnitBase, name: str) -> np.ndarray:
    if isinstance(value, u.Quantity):
        try:
            value = value.to_value(unit)
        except u.UnitConversionError as error:
            raise DomainError(f"{name} = {value}: expected a unit that converts to {unit}") from error
    elif isinstance(value, (tuple, list)) and any(isinstance(v, u.Quantity) for v in value):
        return np.stack([_si(v, unit, name) for v in value])
    # The text is made where it is needed: that of a large array takes longer than many a trace.
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DomainError(f"{name} = {value!r}: expected a number in {unit} or a quantity") from error


def real_array(values: Any, expectation: str) -> np.ndarray:
    """Return real numbers as a float64 array; DomainError with the expectation where they are none."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DomainError(expectation) from error


def require_positive(value: Any, name: str, unit: str = "") -> float:
    """Return a finite, positive float, or raise :class:`DomainError` naming the argument."""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not (np.isfinite(number) and number > 0.0):
        raise DomainError(f"{name} = {value!r}: expected a positive, finite number{' of ' + unit if unit else ''}")
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
