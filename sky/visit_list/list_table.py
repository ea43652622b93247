"""Files of visit lists as tables of a database, from which rows are selected by an SQL expression.

A database of SQLite is opened for reading only. Other files become a table in memory. So one language selects from all,
and nothing of an expression is evaluated by Python.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ...core.errors import ConfigError, ProductError, cut_short
from ...core.table_files import ENDINGS, read_columns
from .names import HEADER_WORDS

#: Tables of databases that hold visits, the first that is there: of rubin_scheduler, OpSim 4, OpSim 3, ConsDB.
_TABLES = ("observations", "summaryallprops", "summary", "visit1", "visits")
_SQLITE = b"SQLite format 3\x00"
#: Rows that are fetched at once.
_ROWS = 10_000
#: Of SQLite's whole numbers, of 64 bits.
_LARGEST_INTEGER = 2**63 - 1
#: Bytes and lines before which the header of an instance catalogue must end: its objects may be gigabytes.
_HEADER_BYTES = 1 << 16
_HEADER_LINES = 1000
# What an expression may do: read the columns of the table, and call functions.
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)
# Texts, names and comments of SQL; the group is the content of a name in double quotes.
_TOKENS = re.compile(r"""'(?:[^']|'')*'|`(?:[^`]|``)*`|\[[^]]*\]|--[^\n]*|/\*.*?\*/|"((?:[^"]|"")*)\"""", re.DOTALL)


@dataclass(frozen=True)
class ListTable:
    """Table of visits in a database, with the names of its columns in small letters."""

    connection: sqlite3.Connection
    name: str
    columns: tuple[str, ...]
    units: Mapping[str, Any]  #: of columns that have one
    kind: str  #: sqlite, catalogue (header of an instance catalogue) or table

    def select(self, columns: Sequence[str], where: str | None) -> dict[str, np.ndarray]:
        """Return columns of the rows for which an SQL expression holds: numbers, NaN where empty, or texts.

        ConfigError if the expression is no condition on the columns.
        """
        names = ", ".join(f'"{column}"' for column in columns)
        # The expression stands on lines of its own, so that a comment in it ends there.
        query = f'SELECT {names} FROM "{self.name}"' + ("" if where is None else f" WHERE (\n{_quoted_names(where)}\n)")
        selects = 0

        def authorize(action: int, table: str | None, _column: Any, _database: Any, _trigger: Any) -> int:
            nonlocal selects
            selects += action == sqlite3.SQLITE_SELECT
            readable = action != sqlite3.SQLITE_READ or str(table).lower() == self.name.lower()
            allowed = action in _ALLOWED and readable and selects <= 1
            return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY

        chunks: list[list[np.ndarray]] = []
        if where is not None:
            self.connection.set_authorizer(authorize)
        try:
            with closing(self.connection.execute(query)) as cursor:
                while rows := cursor.fetchmany(_ROWS):
                    chunks.append([_column_array(values) for values in zip(*rows, strict=True)])
        except (sqlite3.Error, sqlite3.Warning, ValueError) as error:
            if where is None:
                raise ProductError(f"cannot be read ({error})") from None
            expected = f"a condition on its columns, in SQL with texts in single quotes: {', '.join(self.columns)}"
            raise ConfigError(f"where = {cut_short(where)}: {error}; expected {expected}", key="where") from None
        finally:
            self.connection.set_authorizer(None)
        if not chunks:
            return {column: np.zeros(0) for column in columns}
        return {name: _joined([chunk[i] for chunk in chunks]) for i, name in enumerate(columns)}

    def has_row(self, column: str, above: float, limit: float) -> bool:
        """Return whether the size of a number of a column is in an interval; ProductError if it is unreadable."""
        query = (
            f"SELECT EXISTS (SELECT 1 FROM \"{self.name}\" WHERE typeof(\"{column}\") IN ('integer', 'real') "
            f'AND abs("{column}") > ? AND abs("{column}") <= ?)'
        )
        try:
            return bool(self.connection.execute(query, (above, limit)).fetchone()[0])
        except sqlite3.Error as error:
            raise ProductError(f"cannot be read ({error})") from None


@contextmanager
def open_list(path: Path) -> Iterator[ListTable]:
    """Open a file of visits, whatever its format, until the end of the ``with`` block.

    ProductError if it is none, or cannot be read.
    """
    try:
        with path.open("rb") as stream:
            is_database = stream.read(len(_SQLITE)) == _SQLITE
    except OSError as error:
        raise ProductError(f"cannot be read ({error.strerror or error})", file=path) from None
    if is_database:
        with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)) as connection:
            yield _database_table(connection, path)
        return
    is_table = path.suffix.lower() in ENDINGS
    columns = read_columns(path) if is_table else read_header(path)
    units = {name: getattr(column, "unit", None) for name, column in columns.items()}
    with closing(sqlite3.connect(":memory:")) as connection:
        names = _fill(connection, columns)
        yield ListTable(connection, "visits", names, units, "table" if is_table else "catalogue")


def read_header(path: Path) -> dict[str, np.ndarray]:
    """Read the header of an instance catalogue: a word and a number a line, before the objects.

    ProductError if the file is none.
    """
    endings = ", ".join(ENDINGS)
    problem = f"no list of visits: expected a database of SQLite, a table ({endings}), or an instance catalogue"
    header: dict[str, np.ndarray] = {}
    with path.open("rb") as file:
        lines = file.read(_HEADER_BYTES).decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines[:_HEADER_LINES], start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in ("object", "includeobj"):
            break
        if len(words) != 2 or (not header and words[0].lower() not in HEADER_WORDS):
            raise ProductError(problem, file=path, place=f"line {number}")
        try:
            header[words[0].lower()] = np.array([float(words[1])])
        except ValueError:
            header[words[0].lower()] = np.array([words[1]])
    if not header:
        raise ProductError(problem, file=path)
    return header


def _quoted_names(where: str) -> str:
    """Return an expression with its names in double quotes in backticks.

    In double quotes SQLite takes a name that no column has for a text, as in ``"airmas" > 1``, which always holds.
    """

    def in_backticks(token: re.Match[str]) -> str:
        name = token[1]
        return token[0] if name is None else "`" + name.replace('""', '"').replace("`", "``") + "`"

    return _TOKENS.sub(in_backticks, where)


def _database_table(connection: sqlite3.Connection, path: Path) -> ListTable:
    """Return the table of visits of a database."""
    try:
        rows = connection.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')").fetchall()
        tables = {name.lower(): name for (name,) in rows if not name.startswith("sqlite_")}
        name = next((tables[key] for key in _TABLES if key in tables), None)
        if name is None and len(tables) == 1:
            (name,) = tables.values()
        if name is None:
            known, there = ", ".join(_TABLES), ", ".join(tables.values()) or "none"
            raise ProductError(
                f"no table of visits: expected {known}, or a single table; tables are {there}", file=path
            )
        columns = tuple(row[1].lower() for row in connection.execute(f'PRAGMA table_info("{name}")'))
    except (sqlite3.Error, UnicodeError) as error:
        raise ProductError(f"cannot be read ({error})", file=path) from None
    return ListTable(connection, name, columns, {}, "sqlite")


def _fill(connection: sqlite3.Connection, columns: Mapping[str, Any]) -> tuple[str, ...]:
    """Make a table of columns in memory, and return their names.

    Columns with more than one number a row are left out, and of names that differ in capitals only, which SQL does not
    tell apart, those that are not in small letters.
    """
    scalars = {
        name.replace('"', "'").replace("\0", " "): values
        for name, values in columns.items()
        if np.ndim(values) == 1 and name == name.lower()
    }
    if scalars:
        names = ", ".join(f'"{name}"' for name in scalars)
        marks = ", ".join("?" * len(scalars))
        connection.execute(f"CREATE TABLE visits ({names})")
        rows = zip(*(_plain_list(values) for values in scalars.values()), strict=True)
        connection.executemany(f"INSERT INTO visits VALUES ({marks})", rows)
    return tuple(scalars)


def _plain_list(values: Any) -> list[Any]:
    """Return a column as numbers and texts of Python, None where it is empty; times are MJD in TAI."""
    from astropy.time import Time

    return [_stored(item) for item in np.ma.asarray(values.tai.mjd if isinstance(values, Time) else values).tolist()]


def _stored(item: Any) -> Any:
    """Return a value as SQLite stores it: a number, a text, or None; others, such as dates and lists, as texts."""
    if isinstance(item, Decimal) or (isinstance(item, int) and abs(item) > _LARGEST_INTEGER):
        return float(item)
    if isinstance(item, float):
        return None if np.isnan(item) else item
    if isinstance(item, bytes):
        return item.decode("utf-8", "replace")
    return item if item is None or isinstance(item, (int, str)) else str(item)


def _column_array(values: Sequence[Any]) -> np.ndarray:
    """Return the values of a column as numbers, NaN where empty, or as texts, empty where empty."""
    # NumPy's whole numbers are stored as their bytes by some writers.
    values = [int.from_bytes(value, "little", signed=True) if isinstance(value, bytes) else value for value in values]
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else str(value) for value in values])
    if all(isinstance(value, int) for value in values):
        return np.array(values, dtype=np.int64)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return parts of a column as one array: texts where a part is."""
    if any(part.dtype.kind == "U" for part in parts):
        parts = [part if part.dtype.kind == "U" else np.where(np.isnan(part), "", part.astype(str)) for part in parts]
    return np.concatenate(parts)
