"""Tables as ECSV, CSV, FITS and Parquet files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from astropy.table import Table

from .errors import ConfigError
from .files import write_bytes

#: Formats of astropy, or Parquet, by the ending of the file.
FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits", ".parquet": "parquet"}


def write_table(path: Path, table: Table) -> None:
    """Write a table in the format of the file's ending; Parquet takes the columns alone, and needs ``pyarrow``.

    Raises
    ------
    ConfigError
        If the file has another ending, or pyarrow is missing.
    ProductError
        If it cannot be written.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"expected a file that ends in {', '.join(FORMATS)}", file=path)
    write_bytes(path, _encoded(table, FORMATS[path.suffix.lower()], path))


def _encoded(table: Table, kind: str, path: Path) -> bytes:
    if kind.startswith("ascii"):
        text = io.StringIO()
        table.write(text, format=kind)
        return text.getvalue().encode()
    data = io.BytesIO()
    if kind == "fits":
        table.write(data, format="fits")
        return data.getvalue()
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ConfigError("Parquet needs the package pyarrow: pip install 'pachon[parquet]'", file=path) from None
    arrays = {name: pyarrow.array(np.asarray(table[name]).tolist()) for name in table.colnames}
    parquet.write_table(pyarrow.table(arrays), data)
    return data.getvalue()
