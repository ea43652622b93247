"""Base of results: a short representation, a table with units, files, a summary, and HTML for notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .arguments import check_arguments
from .docstrings import Description, described
from .files import plain_values
from .notebook import html_picture

# astropy takes a third of a second to import: only where a table is made.
if TYPE_CHECKING:
    from astropy.table import QTable

    from .products import Card

#: Rows of a table in HTML.
_ROWS = 8
#: Columns that a representation names.
_NAMED = 6


class Result:
    """Base of the results of computations.

    A subclass is a dataclass. It lists the columns of its table in `_table`, by the names of attributes that have the
    length of the table, and images of its FITS files in `_images`. Units and descriptions are those of the docstrings
    of class and properties, or of the class `_row_type` of the rows. Where rows are no elements of the attributes it
    overrides :meth:`_columns`. It may have a method ``plot(ax=None)``, and :meth:`_summary` and :meth:`_label` of its
    own.
    """

    _table: ClassVar[tuple[str, ...]] = ()
    _row_type: ClassVar[type] = object
    _images: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Keep the short representation, which dataclass() would replace by one of all digits."""
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = super(cls, cls).__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._label()}>"

    def _label(self) -> str:
        """Return the content in a few words, for the representation."""
        columns = self._columns()
        rows = len(next(iter(columns.values()), ()))
        ellipsis = ", ..." if len(columns) > _NAMED else ""
        return f"{rows} row{'s' * (rows != 1)} of {', '.join(list(columns)[:_NAMED])}{ellipsis}"

    def _columns(self) -> dict[str, Any]:
        """Return the columns of the table, described by the attribute of each name."""
        return {name: getattr(self, name) for name in self._table}

    def _meta(self) -> dict[str, Any]:
        """Return the values common to all rows: the scalars among the fields."""
        assert is_dataclass(self)
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: v for k, v in values.items() if isinstance(v, (str, int, float, np.number)) and k not in self._table}

    def _summary(self) -> dict[str, Any]:
        """Return the results by name: values common to all rows, and the median of each column of numbers."""
        table = self.to_table()
        columns = {name: np.asarray(table[name]) for name in table.colnames}
        medians = {
            f"median_{name}": np.nanmedian(values, axis=0)
            for name, values in columns.items()
            if values.dtype.kind in "iuf" and np.isfinite(values).any()
        }
        return {**self._meta(), "rows": len(table), **medians}

    def _image_cards(self) -> Sequence[Card]:
        """Return the cards of the headers of images in FITS files, beside unit and description."""
        return ()

    def _described(self, name: str) -> Description:
        description = described(type(self), name)
        return description if description.text else described(self._row_type, name)

    def summary(self) -> dict[str, Any]:
        """Return the results by name as plain numbers, texts and lists for JSON; None where there is no number."""
        plain: dict[str, Any] = plain_values(self._summary(), digits=None)
        return plain

    def to_table(self) -> QTable:
        """Return the results as a table with units and descriptions of its columns."""
        from astropy.table import QTable

        from .products import described_table

        columns = {}
        for name, values in self._columns().items():
            array = np.asarray(values)
            if array.ndim < 2 or array[:1].size:
                columns[name] = array, *self._described(name)
        return QTable(described_table(columns, plain_values(self._meta())))

    @check_arguments
    def write(self, path: str | Path) -> None:
        """Write the table, whole or not at all.

        The file ends in .ecsv, .csv, .fits or .parquet. FITS files hold images too, if there are any. Names of columns
        have the unit in CSV and Parquet, and columns of several numbers become several columns there.

        Raises
        ------
        ConfigError
            If the file has another ending, or pyarrow is missing for Parquet.
        ProductError
            If it cannot be written.
        """
        from .table_files import in_format_of, write_table

        images = {name: (np.asarray(getattr(self, name)), *self._described(name)) for name in self._images}
        write_table(Path(path), in_format_of(Path(path), self.to_table()), images, self._image_cards())

    def _repr_html_(self) -> str:
        """Return the first rows of the table and the picture, as notebooks show them."""
        parts = [f"<p><b>{type(self).__name__}</b>: {escape(self._label())}</p>", html_table(self.to_table())]
        if plot := getattr(self, "plot", None):
            parts.append(html_picture(plot, type(self).__name__))
        return "\n".join(parts)


class Values(Result):
    """Base of results that are a few numbers: a table of one row, a column for each field."""

    def _label(self) -> str:
        first_values = [*self._values().items()][:_NAMED]
        return ", ".join(f"{name} {_cell_text(value)}" for name, value in first_values)

    def _columns(self) -> dict[str, Any]:
        return {name: [value] for name, value in self._values().items()}

    def _meta(self) -> dict[str, Any]:
        return {}

    def _summary(self) -> dict[str, Any]:
        return self._values()

    def _values(self) -> dict[str, Any]:
        assert is_dataclass(self)
        return {f.name: getattr(self, f.name) for f in fields(self)}


def html_table(table: QTable, rows: int = _ROWS) -> str:
    """Return the first rows of a table as HTML; titles of columns hold their descriptions."""
    heads, cells = [], []
    for name in table.colnames:
        unit = getattr(table[name], "unit", None)
        text = f"{name} [{unit}]" if unit else name
        heads.append(f'<th title="{escape(table[name].info.description or "")}">{escape(text)}</th>')
        cells.append([escape(_cell_text(value)) for value in table[name][:rows]])
    lines = [f"<tr>{''.join(f'<td>{c}</td>' for c in row)}</tr>" for row in zip(*cells, strict=True)]
    row_note = f"<p>{len(table) - rows} more rows</p>" if len(table) > rows else ""
    body = f"<table><tr>{''.join(heads)}</tr>{''.join(lines)}</table>"
    return f'<div style="overflow-x:auto">{body}</div>{row_note}'


def _cell_text(value: Any) -> str:
    value = getattr(value, "value", value)
    if np.ndim(value):
        elements = np.ravel(value)
        return ", ".join(map(_cell_text, elements[:4])) + (", ..." if len(elements) > 4 else "")
    return f"{value:.5g}" if isinstance(value, (float, np.floating)) else str(value)
