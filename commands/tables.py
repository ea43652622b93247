"""Tables and JSON on standard output: numbers as text, columns by key of a summary, a console of enough width."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..core.number_text import CellText, NumberText
from ..core.terminal import print_line, terminal_json, terminal_text


class Column(NamedTuple):
    """A column of numbers or names."""

    heading: str | Callable[[dict[str, Any]], str]  #: with the unit in brackets; or function of the summary
    values: str | Callable[[Any], Any]  #: key of the result's summary, or function from the result to a value per row
    form: str = ""  #: format of the numbers; of pairs that of each
    scale: float = 1.0  #: factor from the value to the unit of the heading
    subject: str = ""  #: what its numbers are, in a verdict; empty of columns that give none

    def title(self, summary: dict[str, Any]) -> str:
        """Return the heading."""
        from ..core.units import angular

        heading = self.heading(summary) if callable(self.heading) else self.heading
        return heading if self.key(summary) == self.values else angular(heading)

    def texts(self, result: Any, summary: dict[str, Any]) -> list[str]:
        """Return the cells of the column."""
        return number_texts(self.numbers(result, summary), self.form)

    def numbers(self, result: Any, summary: dict[str, Any]) -> Any:
        """Return the values of the column in the unit of the heading."""
        key = self.key(summary)
        values = key(result) if callable(key) else summary[key]
        return values if self.scale == 1.0 else self.scale * values

    def verdict(self, result: Any, summary: dict[str, Any]) -> str:
        """Return the range of the numbers in one sentence."""
        unit = re.search(r"\[([^][]+)\]", self.title(summary))
        numbers = self.numbers(result, summary)
        values = range_text(numbers, self.form, unit[1] if unit else "")
        missing = _rows_without_numbers(numbers)
        if 0 < missing < len(numbers):
            return f"{self.subject} is {values} at {len(numbers) - missing} of {len(numbers)} fields; others have none."
        over = f" over {len(numbers)} fields" if len(numbers) > 1 else ""
        return f"{self.subject} is {values}{over}."

    def key(self, summary: dict[str, Any]) -> Any:
        """Return the values: their function or key, that of angles where the image is at infinity; None if absent."""
        from ..core.units import angular

        if callable(self.values):
            return self.values
        return next((key for key in (self.values, angular(self.values)) if key in summary), None)


#: Field angles, or heights of an object at a finite distance: the first column of most tables.
FIELD = Column(
    lambda summary: "object [mm]" if "object_mm" in summary else "field [deg]",
    lambda result: list(result.field_items().values())[-1],
    ".4g",
)


def field_headings(result: Any) -> list[str]:
    """Return the field points of a result as headings of columns."""
    (name, values) = list(result.field_items().items())[-1]
    return [f"{text}°" if name == "field_deg" else f"{text} mm" for text in number_texts(values, ".4g")]


def _rows_without_numbers(values: Any) -> int:
    """Return the number of rows that have no finite number."""
    import numpy as np

    finite = np.isfinite(np.asarray(values, dtype=np.float64))
    return int((~finite.reshape(len(finite), -1).any(axis=1)).sum()) if finite.ndim else 0


def range_text(values: Any, form: str, unit: str = "") -> str:
    """Return the range of the finite numbers among some; a word where there are none."""
    import numpy as np

    numbers = np.asarray(values, dtype=np.float64)
    finite = numbers[np.isfinite(numbers)]
    if not finite.size:
        return "unknown"
    low, high = number_texts((finite.min(), finite.max()), form)
    return f"{low if low == high else f'{low} to {high}'}{f' {unit}' if unit else ''}"


#: Signs in headings, and their spelling in ASCII.
_ASCII = {"µ": "u", "ξ": "xi", "²": "2", "³": "3", "°": " deg", "±": "+-", "Δ": "d", "λ": "lambda", "θ": "theta"}


#: Cells without a number in columns of numbers.
_NO_NUMBER = ("", "-")
#: Text of a number; names such as 0_12 and 007 are none.
_NUMBER = re.compile(r"[+-]?(?:(?!0\d)\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?inf|nan", re.IGNORECASE)
_WHOLE = re.compile(r"[+-]?\d+")


@dataclass(frozen=True)
class Rows:
    """A table as text."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""  #: meaning of the columns, printed below
    left: int = 1  #: number of columns that are aligned on the left, as names are; the others hold numbers
    verdict: str = ""  #: result in one sentence, printed above

    def show(self) -> None:
        """Print the verdict, and the table."""
        if self.verdict:
            print_line(self.verdict)
        # Columns are never cut: a narrower terminal wraps the lines itself.
        columns = zip(self.headings, *self.rows, strict=True)
        console = wide_console(sum(max(cell_len(terminal_text(text)) for text in column) + 2 for column in columns))
        table = plain_table()
        for i, name in enumerate(self.headings):
            table.add_column(name, justify="left" if i < self.left else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*row)
        console.print(table)
        if self.caption:
            console.print(self.caption, style="dim", width=100)

    def write(self, path: Path) -> None:
        """Write the table: .ecsv, .csv, .fits or .parquet; numbers as numbers, with units and errors of their own."""
        from astropy.table import Table as AstropyTable

        from ..core.table_files import in_format_of, name_and_unit, write_table

        table = AstropyTable()
        for heading, *cells in zip(self.headings, *self.rows, strict=True):
            name, unit = name_and_unit(heading or "name")
            for key, values in _plain_columns(cells).items():
                is_text = any(isinstance(value, str) for value in values)
                if path.suffix.lower() == ".fits":
                    name, values = _ascii(name), [_ascii(str(value)) for value in values] if is_text else values
                column = _unused(name + key if not key or key.startswith("_") else key, table.colnames)
                table[column] = values
                if unit and not is_text:
                    table[column].unit = unit
        write_table(path, in_format_of(path, table))


def write_rows(rows: Rows, path: Path | None) -> None:
    """Write a table where it has a path."""
    if path is not None:
        rows.write(path)


def _plain_columns(cells: list[str]) -> dict[str, Sequence[float] | Sequence[str]]:
    """Return columns of cells by the keys of their values: cells of several values are as many."""
    values: list[dict[str, float | str]] = [cell.values if isinstance(cell, CellText) else {"": cell} for cell in cells]
    keys = dict.fromkeys(key for row in values for key in row if key or row[key] not in _NO_NUMBER) or {"": None}
    return {key: _plain_column([row.get(key, "") for row in values]) for key in keys}


def _plain_column(values: list[float | str]) -> Sequence[float] | Sequence[str]:
    """Return the values of a column as numbers, NaN for dashes and empty ones, or as text where they are none."""
    if not all(_NUMBER.fullmatch(value) for value in values if isinstance(value, str) and value not in _NO_NUMBER):
        return [str(value) for value in values]
    if all(_WHOLE.fullmatch(str(value)) for value in values):
        return [int(value) for value in values]
    return [math.nan if value in _NO_NUMBER else float(value) for value in values]


def _unused(name: str, names: Sequence[str]) -> str:
    """Return a name, with a number behind it where it stands among some already."""
    numbers = (f"{name}_{k}" for k in range(2, len(names) + 3))
    return next(candidate for candidate in (name, *numbers) if candidate not in names)


def _ascii(text: str) -> str:
    """Return a text as FITS holds it: Greek letters and signs in ASCII."""
    for sign, word in _ASCII.items():
        text = text.replace(sign, word)
    return text.encode("ascii", "replace").decode()


def numbers_of(summary: dict[str, Any]) -> dict[str, Any]:
    """Return a summary with lists of numbers as arrays, and NaN where there is no number."""
    return {key: _numbers(value) for key, value in summary.items()}


def _numbers(value: Any) -> Any:
    if value is None:
        return math.nan
    if not isinstance(value, list):
        return value
    import numpy as np

    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return value


def print_json(content: Any) -> None:
    """Print metrics as JSON."""
    from ..core.files import json_text

    print(terminal_json(json_text(content)))


def number_texts(values: Iterable[Any], form: str) -> list[str]:
    """Return numbers in a format, pairs with a comma, zeros without a minus sign, NaN as a dash; text as it is."""
    return [
        v if isinstance(v, str) else ", ".join(number_texts(v, form)) if hasattr(v, "__len__") else NumberText(v, form)
        for v in values
    ]


class PlainConsole(Console):
    """Console that shows texts as they are: no markup, no names of emoji, control characters as escapes."""

    def __init__(self, least_width: int) -> None:
        super().__init__(markup=False, emoji=False)
        self.width = max(self.width, least_width)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text to be printed; cells of tables come here as well."""
        return super().render_str(terminal_text(text), **options)


def wide_console(least_width: int = 0) -> Console:
    """Return a console of 132 columns or more: a narrower terminal wraps the lines of a table itself."""
    return PlainConsole(max(132, least_width))


def plain_table(**options: Any) -> Table:
    """Return an empty table without lines."""
    return Table(box=None, header_style="bold", padding=(0, 2, 0, 0), **options)
