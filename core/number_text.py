"""Texts of numbers: with nouns, and in tables, with the numbers in full behind them."""

from __future__ import annotations

import math
from collections.abc import Mapping


def counted(count: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: 1 CCD, 2 CCDs."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


class CellText(str):
    """Text of a cell: terminals and reports show it, tables that are written hold `values`.

    `values` are numbers in full, or words. Their keys are names of columns; the empty one, and those that begin with an
    underscore, are put behind the heading.
    """

    __slots__ = ("values",)
    values: dict[str, float | str]

    def __new__(cls, text: str, values: Mapping[str, float | str]) -> CellText:
        """Return the text of a cell with its values."""
        cell = super().__new__(cls, text)
        cell.values = dict(values)
        return cell


class NumberText(CellText):
    """Text of one number."""

    __slots__ = ()

    def __new__(cls, value: float, form: str) -> NumberText:
        """Return the text of a number in a format: zeros without a minus sign, NaN as a dash."""
        text = "-" if math.isnan(value) else format(value, form)
        if text != "-" and math.isfinite(value) and float(text) == 0.0:
            text = format(0.0, form)
        cell = str.__new__(cls, text)
        cell.values = {"": float(value)}
        return cell

    @property
    def value(self) -> float:
        """The number in full."""
        return float(self.values[""])


def number_with_error(value: float, error: float, form: str, error_form: str | None = None) -> CellText:
    """Return the text of a number and its error, which are two columns of a table that is written."""
    text = f"{NumberText(value, form)} ± {NumberText(error, error_form or form)}"
    return CellText(text, {"": float(value), "_error": float(error)})


def number_with_unit(value: float, form: str, unit: str) -> CellText:
    """Return the text of a number with a unit that differs from row to row: two columns of a table that is written."""
    text = NumberText(value, form)
    return CellText(f"{text} {unit}" if unit else text, {"": float(value), "_unit": unit})
