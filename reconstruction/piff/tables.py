"""Tables of a Piff file: one row of settings, or columns, found by their names; pickled columns are never decoded."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from ...core.errors import ProductError, shown
from ...core.files import parsing, read_bytes
from ...core.fits_files import open_fits

#: First bytes of the pickles of protocol 2 and later, as versions of Piff before its FITS files had them.
_PICKLE = b"\x80"


@dataclass(frozen=True, eq=False)
class PiffTables:
    """Tables of a Piff file below a name."""

    path: Path
    tables: dict[str, fits.FITS_rec]  #: by name in small letters
    name: str = "psf"

    @classmethod
    def read(cls, path: Path) -> PiffTables:
        """Read the tables of a file; ProductError if it is no FITS file of Piff."""
        data = read_bytes(path, ProductError)
        if data.startswith(_PICKLE):
            raise ProductError("a pickle, which is never read; expected a FITS file of Piff", file=path)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with (
                parsing(path, "damaged or no FITS file of Piff", ProductError),
                open_fits(path, ProductError, content=data, lazy_load_hdus=False) as hdus,
            ):
                binary_tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
                tables = {hdu.name.lower(): hdu.data for hdu in binary_tables}
        return cls(path, tables)

    def below(self, name: str) -> PiffTables:
        """Return the tables below a longer name."""
        return PiffTables(self.path, self.tables, f"{self.name}_{name}")

    def table(self, name: str = "") -> fits.FITS_rec:
        """Return a table, or raise ProductError."""
        full = self._full(name)
        if full not in self.tables:
            raise ProductError(f"no table {full}: expected a file that Piff 1.4 or later wrote", file=self.path)
        return self.tables[full]

    def _full(self, name: str) -> str:
        return (f"{self.name}_{name}" if name else self.name).lower()

    def settings(self, name: str = "") -> dict[str, Any]:
        """Return the settings in the row of a table."""
        table = self.table(name)
        if len(table) == 0:
            raise ProductError(f"table {self._full(name)} is empty", file=self.path)
        return {column: _plain(table[column][0]) for column in table.names}

    def whole(self, name: str, key: str, value: Any, least: int, most: int) -> int:
        """Return a setting that is a whole number in a range, or raise ProductError."""
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most or value % 1:
            raise self.error(f"{name} {key} = {shown(value)}: expected a whole number from {least} to {most}")
        return int(value)

    def positive(self, name: str, key: str, value: Any) -> float:
        """Return a setting that is a positive number, or raise ProductError."""
        if not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
            raise self.error(f"{name} {key} = {shown(value)}: expected a positive number")
        return float(value)

    def column(self, name: str, column: str) -> np.ndarray:
        """Return a column of numbers of a table in the machine's own byte order."""
        table = self.table(name)
        if column not in table.names:
            raise ProductError(f"no column {column} in table {self._full(name)}", file=self.path)
        return np.asarray(table[column]).astype(np.float64)

    def error(self, text: str) -> ProductError:
        """Return the error of what is not understood."""
        return ProductError(text, file=self.path)


def _plain(value: Any) -> Any:
    """Return a value of a row as Python has it: text, number, or list of them."""
    if isinstance(value, np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, bytes):
        return value.decode("ascii", "replace")
    return value.item() if isinstance(value, np.generic) else value
