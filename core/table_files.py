"""Tables as ECSV, CSV, FITS and Parquet files, written and read."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Column, MaskedColumn, Table
from astropy.table.meta import get_header_from_yaml
from astropy.utils.exceptions import AstropyUserWarning, AstropyWarning

from .errors import ConfigError, DomainError, PachonError, ProductError, error_context, shown
from .files import parsing, read_bytes, text_lines, write_bytes
from .products import Card, Columns, card_text, card_value
from .units import metres, pure_numbers, radians

#: Formats of astropy, or Parquet, by the ending of the file.
FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits", ".parquet": "parquet"}
#: Endings of files that are read.
ENDINGS = (*FORMATS, ".fit")
# Of columns in CSV files; the first where a file has one column.
_DELIMITERS = ",;\t"
# First line of a catalogue of SExtractor: number, name and meaning of its first column.
_SEXTRACTOR = re.compile(r"#\s+1\s+[A-Z]")
# Headings such as "rms [nm]".
_HEADING = re.compile(r"(.*?)\s*\[([^][]+)\](.*)")
#: Values, unit in FITS notation and description.
Described = tuple[np.ndarray, str, str]


def read_columns(path: Path) -> dict[str, Column | np.ndarray]:
    """Return the columns of a file, of FITS its first table, by their names in small letters.

    Names with units, of CSV and Parquet, stand for their columns beside the names alone, whose columns have the units.
    Of names that differ in capitals only, as ``R`` and ``r`` of magnitudes, all but that in small letters stay as they
    are. Columns of times by the FITS standard are those of astropy.

    Raises
    ------
    ProductError
        If the file has another ending, cannot be read or is damaged, pyarrow is missing, or several columns have one
        name but for capitals, and none is in small letters.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ProductError(f"ending {path.suffix!r}: expected one of {', '.join(ENDINGS)}", file=path)
    kind = FORMATS.get(ending, "fits")
    data = read_bytes(path, ProductError)
    with warnings.catch_warnings(), error_context(file=path):
        warnings.simplefilter("ignore", AstropyWarning)
        with parsing(path, f"damaged or no {kind.removeprefix('ascii.').upper()} table", ProductError):
            if kind == "parquet":
                content = parquet_module(path, ProductError).read_table(io.BytesIO(data))
                columns = _parquet_columns(content)
                return columns | {
                    name: _with_unit(columns[heading], unit)
                    for name, (heading, unit) in _names_in_headings(columns).items()
                }
            table = _fits_table(data) if kind == "fits" else text_table(data, kind)
        return {key: table[name] for key, name in names_in_small_letters(table.colnames).items()}


def _fits_table(data: bytes) -> Table:
    """Return the first table of a FITS file, with its times unless they are in a scale beyond the standard."""
    try:
        return Table.read(io.BytesIO(data), format="fits", astropy_native=True)
    except (ValueError, AssertionError):  # astropy asserts that it knows the scale
        return Table.read(io.BytesIO(data), format="fits")


def names_in_small_letters(names: Iterable[str]) -> dict[str, str]:
    """Return the names of columns by these names in small letters.

    Where a name in small letters is that of a column, others that differ from it in capitals only stand under their
    own.

    Raises
    ------
    ProductError
        If names differ in capitals only, and none is in small letters.
    """
    all_names = dict.fromkeys(map(str, names))
    by_key: dict[str, str] = {}
    for name in all_names:
        key = name if name.lower() in all_names else name.lower()
        if key in by_key:
            raise ProductError(f"columns {by_key[key]} and {name}: expected names that differ in more than capitals")
        by_key[key] = name
    return by_key


def column_in_unit(columns: Mapping[str, Any] | Table, name: str, unit: u.UnitBase | None) -> np.ndarray:
    """Return a column in rad or m, or as it is without `unit`, that of a column that has none; NaN where masked.

    Raises
    ------
    ProductError
        If a row has more than one number, or the unit does not convert.
    PachonError
        If the column has no numbers.
    """
    column = columns[name]
    if column.ndim != 1:
        raise ProductError(f"column {name!r}: expected one number in every row")
    if column.dtype.kind in "US" and len(column):  # such as right ascensions in hours, minutes and seconds
        text, unit_text = shown(str(column[0])), "" if unit is None else f" in {unit}"
        raise DomainError(f"column {name} = {text}, ...: expected real numbers{unit_text}")
    numbers = pure_numbers(column.data if isinstance(column, Column) else column, f"column {name}")
    if unit is None:
        return numbers
    column_unit = getattr(column, "unit", None)
    if isinstance(column_unit, u.UnrecognizedUnit):  # "DEG", "degrees"
        column_unit = u.Unit(str(column_unit).lower().removesuffix("s"), parse_strict="silent")
    if isinstance(column_unit, u.UnrecognizedUnit):
        raise ProductError(f"column {name!r} in {column_unit}: expected a unit that converts to {unit}")
    quantity = u.Quantity(numbers, column_unit or unit)
    return metres(quantity, f"column {name}") if unit == u.m else radians(quantity, f"column {name}")


def _parquet_columns(content: Any) -> dict[str, Column | np.ndarray]:
    """Return the columns of a table of Parquet by their names in small letters, with units and masks that it states."""
    units, columns = _parquet_units(content.schema), {}
    # astropy writes the mask of a column as another column.
    masks = {f"{name}.mask" for name in content.column_names}.intersection(content.column_names)
    for key, name in names_in_small_letters(content.column_names).items():
        values = content[name].to_numpy()
        if f"{name}.mask" in masks:
            values = MaskedColumn(values, mask=content[f"{name}.mask"].to_numpy())
        if name in units:
            values = _with_unit(values, u.Unit(units[name], parse_strict="silent"))
        if name not in masks:
            columns[key] = values
    return columns


def _with_unit(values: np.ndarray, unit: u.UnitBase) -> Column:
    """Return values as a column with a unit, masked where they are."""
    return (MaskedColumn if isinstance(values, MaskedColumn) else Column)(values, unit=unit)


def _parquet_units(schema: Any) -> dict[str, str]:
    """Return the units of columns of Parquet that state one: fields of this package, or the header of astropy."""
    units = {field.name: field.metadata[b"unit"].decode() for field in schema if b"unit" in (field.metadata or {})}
    header = (schema.metadata or {}).get(b"table_meta_yaml")
    if header is not None:
        described_columns = get_header_from_yaml(header.decode().splitlines())["datatype"]
        units |= {column["name"]: column["unit"] for column in described_columns if "unit" in column}
    return {name: unit for name, unit in units.items() if unit}


def text_table(data: bytes, kind: str = "ascii.csv") -> Table:
    """Return the table of a file of CSV or ECSV; numbers that a CSV file leaves out are masked.

    CSV files are also those of spreadsheets, with a byte order mark, comments, semicolons or tabs for commas. A column
    ``x [mm]`` of theirs has a copy ``x`` with the unit, unless there is one. Catalogues of SExtractor (ASCII_HEAD) have
    a line for each column before the rows.
    """
    lines = text_lines(data.decode("utf-8-sig"))
    if lines and _SEXTRACTOR.match(lines[0]):
        return Table.read(lines, format="ascii.sextractor")
    if kind == "ascii.ecsv" or (lines and lines[0].startswith("# %ECSV")):
        return Table.read(lines, format="ascii.ecsv")
    head = next((line for line in lines if line.strip() and not line.startswith("#")), None)
    if head is None:
        return Table()
    table = Table.read(lines, format=kind, delimiter=max(_DELIMITERS, key=head.count), comment=r"\s*#")
    for name, (heading, unit) in _names_in_headings(table.colnames).items():
        table[name] = table[heading]
        table[name].unit = unit
    return table


def name_and_unit(heading: str) -> tuple[str, u.UnitBase | None]:
    """Return the name and the unit of a heading such as ``rms [nm]``; no unit where astropy has none of that name."""
    match = _HEADING.fullmatch(heading)
    if match is None:
        return heading, None
    try:
        unit = u.Unit("arcsec" if match[2] == '"' else match[2])
    except (ValueError, TypeError):
        return heading, None
    return f"{match[1]}{match[3]}".strip() or "value", unit


def _names_in_headings(headings: Collection[str]) -> dict[str, tuple[str, u.UnitBase]]:
    """Return headings that have units, and these, by the names before them that no other column has."""
    names = [heading.partition("[")[0].strip() for heading in headings]
    named = {heading: name_and_unit(heading) for heading in headings}
    return {
        name: (heading, unit)
        for heading, (name, unit) in named.items()
        # Pure numbers in brackets count columns: "flux [1]", "flux [2]".
        if unit is not None and unit.physical_type != "dimensionless" and names.count(name) == 1
    }


def parquet_module(path: Path, error: type[PachonError]) -> Any:
    """Return pyarrow's module for Parquet, or raise an error that names the file."""
    try:
        from pyarrow import parquet
    except ImportError:
        raise error("Parquet needs the package pyarrow: pip install 'pachon[parquet]'", file=path) from None
    return parquet


def write_table(
    path: Path, table: Table, images: Mapping[str, Described] = MappingProxyType({}), cards: Sequence[Card] = ()
) -> None:
    """Write a table in the format of the file's ending; Parquet takes the columns alone, and needs ``pyarrow``.

    Images, arrays with unit and description by name, become extensions of FITS files, with the cards; others leave them
    out. Texts of FITS files are ASCII, with Python escapes of other characters.

    Raises
    ------
    ConfigError
        If the file has another ending, or pyarrow is missing.
    ProductError
        If it cannot be written.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"expected a file that ends in {', '.join(FORMATS)}", file=path)
    write_bytes(path, _encoded(table, FORMATS[path.suffix.lower()], path, images, cards))


def _encoded(table: Table, kind: str, path: Path, images: Mapping[str, Described], cards: Sequence[Card]) -> bytes:
    if kind.startswith("ascii"):
        text = io.StringIO()
        table.write(text, format=kind)
        return text.getvalue().encode()
    data = io.BytesIO()
    if kind == "fits":
        with warnings.catch_warnings():
            # Long keywords become HIERARCH cards; units that FITS lacks, such as electron, are kept for astropy.
            warnings.simplefilter("ignore", AstropyUserWarning)
            _with_ascii_texts(table).write(data, format="fits")
        if not images:
            return data.getvalue()
        hdus = fits.open(io.BytesIO(data.getvalue()))
        for name, (values, unit, meaning) in images.items():
            hdu = fits.ImageHDU(values.astype(np.uint8) if values.dtype.kind == "b" else values, name=name)
            if unit:
                hdu.header["BUNIT"] = unit
            hdu.header["COMMENT"] = card_text(meaning)
            for key, value, comment in cards:
                hdu.header[key] = (card_value(value), comment)
            hdus.append(hdu)
        file_data = io.BytesIO()
        hdus.writeto(file_data)
        return file_data.getvalue()
    columns: Columns = {name: (np.asarray(table[name]), "", "") for name in table.colnames}
    return parquet_bytes(path, columns, error=ConfigError)


def _with_ascii_texts(table: Table) -> Table:
    """Return a table with the texts that FITS takes: names, cells and metadata by :func:`~.products.card_text`."""
    ascii_table = table.copy(copy_data=False)
    for key, value in table.meta.items():
        ascii_table.meta[key] = card_value(value)
    for name in table.colnames:
        column = ascii_table[name]
        column.info.description = card_text(column.info.description or "") or None
        cells = np.asarray(column).ravel().tolist() if column.dtype.kind == "U" else []
        if not all(map(str.isascii, cells)):
            texts = np.array(list(map(card_text, cells))).reshape(column.shape)
            ascii_table[name] = column.__class__(texts, description=column.info.description)
        if not name.isascii():
            ascii_table.rename_column(name, card_text(name).replace("\\", "_"))
    return ascii_table


def parquet_bytes(
    path: Path, columns: Columns, meta: Mapping[str, Any] = MappingProxyType({}), *, error: type[PachonError]
) -> bytes:
    """Return columns as the content of a Parquet file, with unit and description of those that have them.

    Without pyarrow an error of the class given names the file.
    """
    parquet = parquet_module(path, error)
    import pyarrow

    arrays, fields = [], []
    for name, (values, unit, description) in columns.items():
        # pyarrow takes text and rows of several numbers as lists, and the bytes of numbers in the machine's order.
        plain = values.ndim == 1 and values.dtype.kind in "biuf"
        array = pyarrow.array(values.astype(values.dtype.newbyteorder("=")) if plain else values.tolist())
        about = {"unit": unit, "description": description} if unit or description else None
        arrays.append(array)
        fields.append(pyarrow.field(name, array.type, metadata=about))
    schema = pyarrow.schema(fields, metadata={key: str(value) for key, value in meta.items()} or None)
    data = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=schema), data)
    return data.getvalue()


def in_format_of(path: Path, table: Table) -> Table:
    """Return a table as the format of a file holds it: in CSV and Parquet units stand in the names of columns."""
    return flat_table(table) if path.suffix.lower() in (".csv", ".parquet") else table


def flat_table(table: Table) -> Table:
    """Return a table as CSV and Parquet hold it: one number or text a cell, units in the names of columns."""
    flat = Table()
    for name in table.colnames:
        column = table[name]
        unit = f" [{text}]" if (text := str(getattr(column, "unit", None) or "")) else ""
        values = np.asarray(column)
        if values.ndim == 1:
            flat[name + unit] = values
            continue
        values = values.reshape(len(values), -1)
        for k in range(values.shape[1]):
            flat[f"{name}_{k}{unit}"] = values[:, k]
    return flat
