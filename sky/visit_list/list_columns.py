"""Columns of a visit list by quantity, in SI units and radians, and errors of values that cannot be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy import units as u

from ...core.errors import DomainError, ProductError, cut_short
from ...core.units import ARCSEC
from .list_table import ListTable
from .names import QUANTITIES

#: Columns by which databases of OpSim 3 are known, whose angles are in radians.
_OPSIM_3 = {"expmjd", "obshistid"}
#: Of angles in radians with few digits.
_ROUNDING = 0.01


@dataclass
class ListColumns:
    """Columns of a list by quantity, in SI units and radians, with remarks on them."""

    values: dict[str, np.ndarray]
    source: dict[str, str]  #: names of the columns in the file
    kind: str  #: of the file, as :class:`ListTable` has it
    all_names: tuple[str, ...]  #: of the columns of the file
    remarks: list[str] = field(default_factory=list)
    assumption: str = ""  #: on units, for messages of wrong values

    @classmethod
    def of(cls, table: ListTable, where: str | None) -> ListColumns:
        """Return the columns of a table that are known."""
        source = {
            key: name
            for key, quantity in QUANTITIES.items()
            if (name := next((name for name in quantity.names if name in table.columns), None)) is not None
        }
        columns = cls({}, source, table.kind, table.columns)
        if not source:
            columns.require("ra")
        selected = table.select(list(dict.fromkeys(source.values())), where)
        in_radians = table.kind == "sqlite" and set(table.columns) >= _OPSIM_3
        if in_radians and _has_degrees(table, source):
            in_radians = False
            columns.remarks.append("angles are in degrees, although the columns are those of OpSim 3")
        elif in_radians:
            columns.remarks.append("angles are in radians, as in databases of OpSim 3")
            columns.assumption = (
                "angles are taken in radians, as of OpSim 3, which has expMJD and obsHistID; if they are in degrees, "
                "rename expMJD to observationStartMJD"
            )
        for key, name in source.items():
            unit = "rad" if in_radians and QUANTITIES[key].unit == "deg" else QUANTITIES[key].unit
            values = selected[name]
            columns.values[key] = values if key == "band" else _in_si(values, table.units.get(name), unit, name)
        return columns

    def __len__(self) -> int:
        return len(next(iter(self.values.values()), ()))

    def rows(self, mask: np.ndarray) -> ListColumns:
        """Return the rows of a mask."""
        values = {key: column[mask] for key, column in self.values.items()}
        return ListColumns(values, self.source, self.kind, self.all_names, self.remarks, self.assumption)

    def require(self, *keys: str) -> str:
        """Return the first of some quantities that the list has; ProductError names the columns looked for."""
        for key in keys:
            if key in self.values:
                return key
        names = ", ".join(name for key in keys for name in QUANTITIES[key].names)
        raise ProductError(
            f"no column of the {QUANTITIES[keys[0]].text}: expected one of {names}; "
            f"columns are {', '.join(self.all_names) or 'none'}",
            key=QUANTITIES[keys[0]].names[0],
        )

    def numbers(self, key: str, default: float | None = None) -> np.ndarray:
        """Return a quantity as numbers, NaN where empty; `default` in place of all empty ones."""
        if key not in self.values:
            return np.full(len(self), np.nan if default is None else default)
        column = self.values[key]
        return column if default is None else np.where(np.isfinite(column), column, default)

    def complete(self, key: str, valid: Callable[[np.ndarray], np.ndarray], expected: str) -> np.ndarray:
        """Return a quantity that every visit must have; DomainError names the first that has not, and how many."""
        numbers = self.numbers(key)
        with np.errstate(invalid="ignore"):
            self._check(key, numbers, np.isfinite(numbers) & valid(numbers), expected)
        return numbers

    def stated(self, key: str, valid: Callable[[np.ndarray], np.ndarray], expected: str) -> np.ndarray:
        """Return a quantity, NaN where a visit has none; DomainError names the first value that cannot be."""
        numbers = self.numbers(key)
        with np.errstate(invalid="ignore"):
            self._check(key, numbers, np.isnan(numbers) | (np.isfinite(numbers) & valid(numbers)), expected)
        return numbers

    def _check(self, key: str, numbers: np.ndarray, possible: np.ndarray, expected: str) -> None:
        """Raise DomainError of the first visit of a mask that is false, and of how many there are."""
        wrong = np.flatnonzero(~possible)
        if wrong.size:
            name = self.source.get(key, QUANTITIES[key].names[0])
            raise self.visit_error(wrong, f"{name} = {_shown(numbers[wrong[0]], QUANTITIES[key].unit)}", expected, name)

    def visit_error(self, wrong: np.ndarray, value: str, expected: str, name: str) -> DomainError:
        """Return the error of the first of some visits."""
        number = self.values["visit"][wrong[0]] if "visit" in self.values else wrong[0] + 1
        extent = f"{len(wrong)} of {len(self)} visits are so; " if len(wrong) > 1 else ""
        assumption = f"; {self.assumption}" if self.assumption else ""
        return DomainError(
            f"visit {number}: {value}: expected {expected}; {extent}leave them out by a condition (where){assumption}",
            key=name,
        )


def _has_degrees(table: ListTable, source: dict[str, str]) -> bool:
    """Return whether an angle of any row is too large for radians, and possible in degrees."""
    largest = {"ra": (2.0 * np.pi, 360.0), "dec": (0.5 * np.pi, 90.0), "altitude": (0.5 * np.pi, 90.0)}
    return any(
        table.has_row(source[key], radians + _ROUNDING, degrees)
        for key, (radians, degrees) in largest.items()
        if key in source
    )


def _in_si(values: np.ndarray, file_unit: Any, unit: str, name: str) -> np.ndarray:
    """Return a column in SI units, angles in radians; dates stay days."""
    if values.dtype.kind == "U":
        values = _as_numbers(values, name)
    if not unit or unit == "mag":
        return values
    default = u.Unit(unit)
    column_unit = default if file_unit is None else file_unit
    units = {"angle": u.rad, "length": u.m, "speed": u.m / u.s}
    target = next((units[kind] for kind in units if kind in default.physical_type), default)
    try:
        return np.asarray((values * column_unit).to_value(target), dtype=np.float64)
    except (u.UnitsError, ValueError, TypeError, AttributeError):
        shown = str(file_unit) or "pure numbers"
        raise DomainError(f"column {name} in {shown}: expected a unit such as {unit}", key=name) from None


def _as_numbers(texts: np.ndarray, name: str) -> np.ndarray:
    """Return texts as numbers, NaN where empty; DomainError names the first that is none, and its row."""
    numbers = np.full(len(texts), np.nan)
    for row, text in enumerate(texts.tolist()):
        if text.strip():
            try:
                numbers[row] = float(text)
            except ValueError:
                raise DomainError(
                    f"column {name}, row {row + 1}: {cut_short(text)!r}: expected a number", key=name
                ) from None
    return numbers


def _shown(value: float, unit: str) -> str:
    """Return a number of a message in the unit of lists."""
    if np.isnan(value):
        return "nothing"
    factor = {"deg": np.rad2deg(1.0), "arcsec": 1.0 / ARCSEC}.get(unit, 1.0)
    return f"{value * factor:.6g} {unit}".strip()
