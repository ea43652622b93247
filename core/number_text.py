"""Texts of numbers in tables, with the numbers in full behind them."""

from __future__ import annotations

import math


class NumberText(str):
    """Text of a number: terminals and reports show it rounded, tables that are written hold `value`."""

    __slots__ = ("value",)
    value: float

    def __new__(cls, value: float, form: str) -> NumberText:
        """Return the text of a number in a format: zeros without a minus sign, NaN as a dash."""
        text = "-" if math.isnan(value) else format(value, form)
        if text != "-" and float(text) == 0.0:
            text = format(0.0, form)
        number = super().__new__(cls, text)
        number.value = float(value)
        return number
