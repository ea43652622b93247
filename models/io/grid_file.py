"""Grids of sag in FITS files: measured deformations and bending modes.

The first image of two dimensions is taken, its rows along y. The nodes follow from its header, as for any map:
``x = CRVAL1 + (i - CRPIX1) CDELT1`` for column i = 1, 2, ... in CUNIT1, the same with 2 for the rows, and BUNIT, the
unit of the sag. Units are metres where a card is missing.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, error_context
from ...core.files import parsing, require_file, write_bytes
from ...core.fits_files import open_fits
from ..shapes.grid import GridSag
from .hdf5_map import SIGNATURE

if TYPE_CHECKING:
    from astropy.io import fits

#: First bytes of other formats in which maps of mirrors come.
_FOREIGN = {SIGNATURE: "HDF5", b"MATLAB 5.0 MAT-file": "MATLAB"}


@check_arguments
def read_grid(path: str | os.PathLike[str]) -> GridSag:
    """Return the sag that a FITS image holds.

    Parameters
    ----------
    path : str or path
        File to read.

    Raises
    ------
    PrescriptionError
        If the file cannot be read, has no image of two dimensions, a unit that is no length, or is no valid grid.
    """
    header, data = fits_image(Path(path), 2)
    with error_context(file=path), parsing(Path(path), "cannot be read as FITS", PrescriptionError):
        x, y = _axis(header, 1, data.shape[1]), _axis(header, 2, data.shape[0])
        return GridSag(x, y, data * length_unit(header, "BUNIT"))


def fits_image(path: Path, dimensions: int) -> tuple[fits.Header, np.ndarray]:
    """Return header and float64 data of the first image of a number of dimensions in a FITS file; PrescriptionError."""
    require_file(path, PrescriptionError)
    with parsing(path, "cannot be read as FITS", PrescriptionError), open(path, "rb") as file:
        start = file.read(max(map(len, _FOREIGN)))
        for signature, kind in _FOREIGN.items():
            if start.startswith(signature):
                text = f"{kind} file, whose maps have no nodes and no unit: expected a FITS image"
                alternative = "pachon.read_hdf5_map" if kind == "HDF5" else "a pachon.GridSag of its map"
                raise PrescriptionError(f"{text}, or {alternative}", file=path)
    with (
        parsing(path, "cannot be read as FITS", PrescriptionError),
        open_fits(path, PrescriptionError, memmap=False) as hdus,
    ):
        images = [(hdu.header, hdu.data) for hdu in hdus if hdu.is_image and np.ndim(hdu.data) == dimensions]
    if not images:
        number = {2: "two", 4: "four"}[dimensions]
        raise PrescriptionError(f"expected a FITS image of {number} dimensions", file=path)
    header, data = images[0]
    with parsing(path, "cannot be read as FITS", PrescriptionError):
        return header, np.asarray(data, dtype=np.float64)


def write_grid(grid: GridSag, path: str | os.PathLike[str]) -> None:
    """Write a grid of sag as a FITS image that :func:`read_grid` reads; the file is replaced as a whole.

    Raises
    ------
    PrescriptionError
        If the file cannot be written.
    """
    from astropy.io import fits

    header = fits.Header()
    for number, (first, step) in enumerate(zip((grid.x[0], grid.y[0]), grid.step, strict=True), start=1):
        header[f"CRPIX{number}"] = 1.0
        header[f"CRVAL{number}"] = float(first)
        header[f"CDELT{number}"] = step
        header[f"CUNIT{number}"] = "m"
    header["BUNIT"] = ("m", "sag")
    buffer = io.BytesIO()
    fits.PrimaryHDU(np.asarray(grid.values), header).writeto(buffer, checksum=True)
    write_bytes(Path(path), buffer.getvalue(), PrescriptionError)


def _axis(header: Any, number: int, size: int) -> np.ndarray:
    keys = [f"CRPIX{number}", f"CRVAL{number}", f"CDELT{number}"]
    for key in keys:
        if key not in header:
            raise PrescriptionError(f"{key} is missing: expected the header to say where the nodes are")
        if isinstance(header[key], bool) or not isinstance(header[key], (int, float)) or not np.isfinite(header[key]):
            raise PrescriptionError(f"{key} = {header[key]!r}: expected a number")
    cross = 3 - number
    unturned = {f"PC{number}_{number}": 1, f"PC{number}_{cross}": 0, f"CD{number}_{cross}": 0, f"CROTA{number}": 0}
    for key, expected in unturned.items():
        if header.get(key, expected) != expected:
            raise PrescriptionError(f"{key} = {header[key]!r}: expected {expected}, nodes along x and y")
    reference, value, step = (float(header[key]) for key in keys)
    return (value + (np.arange(1, size + 1) - reference) * step) * length_unit(header, f"CUNIT{number}")


def length_unit(header: Any, key: str, default: str = "m") -> float:
    """Return the length in metres of the unit that a card names; PrescriptionError where it is none."""
    from astropy import units as u  # few prescriptions have a grid

    text = header.get(key, default)
    try:
        return float(u.Unit(text).to(u.m))
    except (ValueError, TypeError, u.UnitConversionError):
        raise PrescriptionError(f"{key} = {text!r}: expected a unit of length") from None
