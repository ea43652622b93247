"""Stamps of donuts from FITS files: a cube with a table, one extension each, or a CCD's image and positions.

Field angles stand in columns ``field_x`` and ``field_y`` [deg] of the first table of the file or of a file of
positions, one row a stamp, or in keywords ``FIELD_X`` and ``FIELD_Y`` of each image. ``defocus_um`` (keyword
``DEFOC_UM``) is the shift of the detector along z; pixels ``x`` and ``y``, from 0, are the donuts' places on an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from ..core.errors import ProductError
from ..core.files import parsing, require_file
from .inputs import SMALLEST_STAMP


@dataclass(frozen=True)
class DonutStamps:
    """Stamps with their places in the field.

    Attributes
    ----------
    images : list of ndarray
        Stamps as the file has them.
    fields : ndarray, shape [n, 2], or None
        Field angles [rad]; None where the file has none.
    defocus : ndarray, shape [n]
        Shifts of the detector [m]; 0 where the file has none.
    """

    images: list[np.ndarray]
    fields: np.ndarray | None
    defocus: np.ndarray

    def __len__(self) -> int:
        return len(self.images)


def read_stamps(path: Path, positions: Path | None = None, size: int = 180) -> DonutStamps:
    """Read the stamps of a FITS file.

    Parameters
    ----------
    path : Path
        The file.
    positions : Path, optional
        Table (ECSV, CSV or FITS) of donuts: of their places on one image, or of the stamps of a cube.
    size : int
        Side of the stamps cut out of an image [pixels].

    Raises
    ------
    ProductError
        If a file cannot be read, has no images, or a table lacks a column or has another number of rows.
    """
    require_file(path, ProductError)
    with parsing(path, "cannot be read as FITS", ProductError), fits.open(path, memmap=False) as units:
        images = [
            (_described(unit.header), np.asarray(unit.data, dtype=np.float64))
            for unit in units
            if unit.is_image and unit.data is not None
        ]
        tables = [Table.read(unit) for unit in units if isinstance(unit, fits.BinTableHDU)]
    table = _table(positions) if positions is not None else tables[0] if tables else None
    stacks = [data for _, data in images]
    if not stacks or any(d.ndim not in (2, 3) or min(d.shape[-2:]) < SMALLEST_STAMP for d in stacks):
        raise ProductError("expected images: a cube [n, ny, nx], stamps, or one image of a CCD", file=path)
    if len(stacks) == 1 and stacks[0].ndim == 2 and table is not None and {"x", "y"} <= _names(table):
        cut = [_cut(stacks[0], *place, size) for place in zip(_column(table, "x"), _column(table, "y"), strict=True)]
        return DonutStamps(cut, *_places(table, len(cut), positions or path))
    stamps = [stamp for data in stacks for stamp in (data if data.ndim == 3 else data[None])]
    if table is not None:
        return DonutStamps(stamps, *_places(table, len(stamps), positions or path))
    headers = [header for header, data in images for _ in range(len(data) if data.ndim == 3 else 1)]
    have_fields = all("FIELD_X" in h and "FIELD_Y" in h for h in headers)
    fields = np.deg2rad([[h["FIELD_X"], h["FIELD_Y"]] for h in headers]) if have_fields else None
    return DonutStamps(stamps, fields, np.array([1e-6 * h.get("DEFOC_UM", 0.0) for h in headers]))


def _described(header: fits.Header) -> dict[str, float]:
    """Return the place and the defocus of a stamp, as far as its header has them."""
    return {key: float(header[key]) for key in ("FIELD_X", "FIELD_Y", "DEFOC_UM") if key in header}


def _table(path: Path) -> Table:
    require_file(path, ProductError)
    with parsing(path, "cannot be read as a table", ProductError):
        return Table.read(path)


def _names(table: Table) -> set[str]:
    return {name.lower() for name in table.colnames}


def _column(table: Table, name: str) -> np.ndarray:
    """Return a column of numbers by its name in any case; ProductError where it holds something else."""
    values = np.asarray(table[next(n for n in table.colnames if n.lower() == name)])
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise ProductError(f"column {name} of shape {values.shape} and type {values.dtype}: expected a number a row")
    return values.astype(np.float64)


def _places(table: Table, count: int, file: Path) -> tuple[np.ndarray | None, np.ndarray]:
    """Return field angles [rad], None without columns, and shifts of the detector [m]."""
    names = _names(table)
    if len(table) != count:
        raise ProductError(f"table of {len(table)} rows for {count} stamps: expected one row a stamp", file=file)
    fields = None
    if {"field_x", "field_y"} <= names:
        fields = np.deg2rad(np.stack([_column(table, "field_x"), _column(table, "field_y")], axis=-1))
    defocus = 1e-6 * _column(table, "defocus_um") if "defocus_um" in names else np.zeros(count)
    return fields, defocus


def _cut(image: np.ndarray, x: float, y: float, size: int) -> np.ndarray:
    """Return a stamp about a place; pixels beside the image are NaN."""
    stamp = np.full((size, size), np.nan)
    first = np.array([round(y), round(x)]) - size // 2
    low, high = np.maximum(first, 0), np.minimum(first + size, image.shape)
    if (high > low).all():
        inside = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
        stamp[inside] = image[low[0] : high[0], low[1] : high[1]]
    return stamp
