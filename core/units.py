"""Angles in radians, and conversion of numbers or astropy quantities to arrays in SI."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import DomainError, shown

#: One arcsecond, one arcminute [rad].
ARCSEC = np.pi / 648000
ARCMIN = 60.0 * ARCSEC
#: Largest number, so that its powers stay finite.
_LARGEST = 1e50
#: Most numbers of one argument: 8 GB, and seconds for each look at all of them.
_MOST_NUMBERS = 10**9


def is_quantity(value: Any) -> bool:
    """Return whether a value is an astropy quantity.

    astropy takes a third of a second to import, and without it there are no quantities.
    """
    units = sys.modules.get("astropy.units")
    return units is not None and isinstance(value, units.Quantity)


def real_numbers(values: Any) -> Any:
    """Return real numbers as an array of their own type, masked ones as NaN; None where they are anything else.

    Quantities, lists of them and columns of tables keep their unit. Boolean values, times, complex numbers, texts and
    objects are none.
    """
    if type(values) is np.ndarray:
        return values if values.dtype.kind in "iuf" else None
    if isinstance(values, (tuple, list)) and any(map(_has_unit_or_mask, values)):
        elements = [real_numbers(v) for v in values]
        return None if any(v is None for v in elements) else elements
    if hasattr(values, "mask") and hasattr(values, "filled"):
        if values.dtype.kind not in "iuf":
            return None
        masked = np.any(values.mask)
        values = values.astype(np.float64).filled(np.nan) if masked else values.filled(0)
    if getattr(values, "unit", None) is None:
        try:
            values = np.asarray(values)
        except (TypeError, ValueError, OverflowError):
            return None
    return values if values.dtype.kind in "iuf" else None


def _has_unit_or_mask(value: Any) -> bool:
    """Return whether NumPy would lose unit or mask of a value where it makes one array of several."""
    return isinstance(value, np.ma.MaskedArray) or is_quantity(value)


def has_unit(value: Any) -> bool:
    """Return whether a value is a quantity, a column with a unit, or a sequence of them."""
    if isinstance(value, (tuple, list)):
        return any(map(has_unit, value))
    return getattr(value, "unit", None) is not None


def in_unit(value: Any, unit: str, name: str) -> np.ndarray:
    """Return numbers in a unit, or quantities that convert to it, as a float64 array; "" is no unit."""
    numbers = real_numbers(value)
    # The text is made where it is needed: that of a large array takes longer than many a trace.
    if numbers is None:
        raise DomainError(f"{name} = {shown(value)}: expected a number in {unit} or a quantity")
    if isinstance(numbers, list):
        numbers = [in_unit(v, unit, name) for v in numbers]
    elif hasattr(numbers, "unit") and (unit or is_quantity(numbers)):
        # The unit of a column of pure numbers, such as pixels or magnitudes, says what they count.
        from astropy import units as u

        # Tables of results have places in pixels, which are pure numbers to what takes them.
        unit = "pix" if not unit and numbers.unit == u.pix else unit
        try:
            numbers = u.Quantity(numbers, copy=None).to_value(unit)
        except u.UnitConversionError:
            raise DomainError(f"{name} = {shown(value)}: expected a unit that converts to {unit}") from None
    try:
        return np.asarray(numbers, dtype=np.float64)
    except ValueError:
        raise DomainError(f"{name} = {shown(value)}: expected numbers of one shape in {unit}") from None


def real_array(values: Any, expectation: str) -> np.ndarray:
    """Return real numbers as a float64 array; DomainError with the expectation where they are none."""
    try:
        return pure_numbers(values, "")
    except DomainError:
        raise DomainError(expectation) from None


def pure_numbers(values: Any, name: str) -> np.ndarray:
    """Return real numbers without a unit as a float64 array."""
    try:
        return in_unit(values, "", name)
    except DomainError:
        raise DomainError(f"{name} = {shown(values)}: expected real numbers without a unit") from None


def require_positive(value: Any, name: str, unit: str = "") -> float:
    """Return a finite, positive float, or raise :class:`DomainError` naming the argument."""
    try:
        numbers = real_array(value, "")
    except DomainError:
        numbers = np.array(np.nan)
    number = float(numbers.item()) if numbers.size == 1 else np.nan
    if not 0.0 < number < _LARGEST:
        raise DomainError(f"{name} = {shown(value)}: expected a positive, finite number{' of ' + unit if unit else ''}")
    return number


def require_within(value: Any, name: str, least: float, most: float, unit: str = "") -> float:
    """Return a float from `least` to `most`, or raise :class:`DomainError` naming the argument and the limits."""
    number = require_positive(value, name, unit)
    if not least <= number <= most:
        text = f"{name} = {shown(value)}: expected {least:g} to {most:g} {unit}"
        raise DomainError(text.rstrip(), key=name)
    return number


def finite(values: np.ndarray, name: str) -> np.ndarray:
    """Return numbers that are all finite, or raise :class:`DomainError` naming the argument."""
    if np.size(values) > _MOST_NUMBERS:
        raise DomainError(f"{name} = {shown(values)}: expected at most {_MOST_NUMBERS} numbers", key=name)
    if not np.isfinite(values).all():
        raise DomainError(f"{name} = {shown(values)}: expected finite numbers", key=name)
    return values


def radians(value: Any, name: str) -> np.ndarray:
    """Return an angle in radians as a float64 array; plain numbers are radians already."""
    return in_unit(value, "rad", name)


def positive_angle(value: Any, name: str) -> float:
    """Return a finite, positive angle in radians; plain numbers are radians already."""
    return require_positive(radians(value, name), name, "radians")


def metres(value: Any, name: str) -> np.ndarray:
    """Return a length in metres as a float64 array; plain numbers are metres already."""
    return in_unit(value, "m", name)


def length(value: Any, name: str) -> float:
    """Return one length in metres; plain numbers are metres already."""
    return _single_number(metres(value, name), name, "length")


def angle(value: Any, name: str) -> float:
    """Return one angle in radians; plain numbers are radians already."""
    return _single_number(radians(value, name), name, "angle")


def one_number(value: Any, name: str) -> float:
    """Return one number without a unit."""
    return _single_number(pure_numbers(value, name), name, "number")


def _single_number(values: np.ndarray, name: str, kind: str) -> float:
    if values.ndim:
        raise DomainError(f"{name} has shape {values.shape}: expected one {kind}")
    if _LARGEST < np.abs(values) < np.inf:
        raise DomainError(f"{name} = {float(values):g}: expected one {kind} below {_LARGEST:g} in SI")
    return float(values)


def broadcast_together(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Broadcast named arrays to one shape."""
    try:
        return np.broadcast_arrays(*arrays.values())
    except ValueError:
        names, shapes = ", ".join(arrays), ", ".join(str(a.shape) for a in arrays.values())
        raise DomainError(f"{names} have shapes {shapes}: expected shapes that fit together") from None


def for_each(values: np.ndarray, count: int, name: str) -> np.ndarray:
    """Return one number, or one for each of so many objects, as [count]."""
    if values.shape not in ((), (count,)):
        raise DomainError(f"{name} has shape {values.shape}: expected one number or [{count}]")
    return np.broadcast_to(values, (count,))


def plane_points(x: Any, y: Any) -> tuple[np.ndarray, ...]:
    """Return points of a plane [m], which may be quantities, as two arrays of one shape."""
    return broadcast_together({"x": metres(x, "x"), "y": metres(y, "y")})


#: Largest number of pupil points, rays or steps in one call.
MOST = 10**8


def require_count(value: Any, name: str, least: int, most: int = MOST) -> int:
    """Return a whole number in a range, or raise :class:`DomainError` naming the argument."""
    number = value.item() if isinstance(value, np.generic) else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or number != number // 1 or number < least:
        raise DomainError(f"{name} = {shown(value)}: expected a whole number of at least {least}", key=name)
    if number > most:
        raise DomainError(f"{name} = {shown(value)}: expected a whole number of at most {most}", key=name)
    return int(number)


def require_seed(value: Any, name: str = "seed") -> int:
    """Return a seed of random numbers, a whole number from zero, or raise :class:`DomainError`."""
    return require_count(value, name, 0, 2**128)


def arcseconds(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] in arc seconds."""
    return np.rad2deg(angle) * 3600.0


def field_label(field: np.ndarray) -> str:
    """Return a field point [rad] as error messages name it, in degrees."""
    x, y = np.rad2deg(field)
    return f"field = ({x:.6g}, {y:.6g}) deg"


def angular(text: str) -> str:
    """Return a text or key with micro- and milliradians in place of micrometres and millimetres."""
    for length, angle in (("µm", "µrad"), ("_um", "_urad"), ("_mm", "_mrad"), ("mm", "mrad")):
        text = text.replace(length, angle)
    return text
