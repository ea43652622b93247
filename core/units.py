"""Angles in radians, and conversion of numbers or astropy quantities to SI."""

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
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DomainError(f"{name} = {value!r}: expected a number in {unit} or a quantity") from error


def radians(value: Any, name: str) -> np.ndarray:
    """Return an angle in radians as a float64 array; plain numbers are radians already."""
    return _si(value, u.rad, name)


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
