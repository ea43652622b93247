"""Files that a run leaves: written whole or not at all, the same bytes for the same input, and checked when read.

A file is written under a temporary name in its own folder, flushed to the disk and then renamed, so a run that is
killed or finds the disk full leaves no half product behind.
"""

from __future__ import annotations

import io
import json
import os
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from .errors import ProductError

#: Stands in the comment of CHECKSUM and DATASUM, where astropy writes the time of day: equal runs give equal bytes.
_WHEN = "FITS checksum"


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, flush it to the disk and rename it.

    Raises
    ------
    ProductError
        If it cannot be written: one line with the path and the system's reason. Nothing is left behind then.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        try:
            with open(partial, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            with suppress(OSError):
                partial.unlink()
            raise
    except OSError as error:
        raise ProductError(f"cannot write {path}: {error.strerror or error}") from None


def make_folder(folder: Path) -> None:
    """Make a folder, and those it lies in, where they are not there yet.

    Raises
    ------
    ProductError
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProductError(f"cannot make the folder {folder}: {error.strerror}") from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file with sorted keys; numbers that are not finite become null."""
    write_bytes(path, (json_text(content) + "\n").encode())


def json_text(content: Any) -> str:
    """Return indented JSON with sorted keys; numbers that are not finite become null."""
    return json.dumps(_plain(content), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        # Nine digits say all that there is to say, and hide that sums of other machines differ in the last bits.
        return float(f"{value:.9g}") if np.isfinite(value) else None
    return value


@dataclass(frozen=True)
class Stamp:
    """What every product carries to say where it comes from.

    Attributes
    ----------
    version : str
        Version of pachon.
    config_hash : str
        SHA-256 of the resolved configuration.
    seed : int
        Seed of the run.
    """

    version: str
    config_hash: str
    seed: int

    def cards(self) -> list[tuple[str, Any, str]]:
        """Return the header cards."""
        return [
            ("CREATOR", f"pachon {self.version}", "program and version"),
            ("CONFHASH", self.config_hash, ""),
            ("SEED", self.seed, "seed of all random numbers"),
        ]

    def matches(self, header: fits.Header) -> bool:
        """Return whether a header carries this stamp."""
        return all(header.get(key) == value for key, value, _ in self.cards())


def write_fits(path: Path, hdus: list[Any], stamp: Stamp | None, cards: list[tuple[str, Any, str]]) -> None:
    """Write a FITS product with checksums and the stamp in the primary header.

    Parameters
    ----------
    path : Path
        File to write.
    hdus : list of ImageHDU and BinTableHDU
        Extensions, each with a name.
    stamp : Stamp or None
        Where the product comes from; None where it comes from no run.
    cards : list of (keyword, value, comment)
        More for the primary header.

    Raises
    ------
    ProductError
        If it cannot be written.
    """
    primary = fits.PrimaryHDU()
    parts = ("NPARTS", 1 + len(hdus), "header and extensions of this file")
    for keyword, value, comment in [*(stamp.cards() if stamp else []), parts, *cards]:
        primary.header[keyword] = (value, comment)
    buffer = io.BytesIO()
    everything = fits.HDUList([primary, *hdus])
    for hdu in everything:
        hdu.add_checksum(when=_WHEN)
    everything.writeto(buffer, checksum=False)
    write_bytes(path, buffer.getvalue())


def read_fits(path: Path) -> fits.HDUList:
    """Read a FITS product into memory and check the checksum of every part.

    Raises
    ------
    ProductError
        If there is no such file, or it is no product of this program as it was written.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ProductError(f"cannot read {path}: {error.strerror}") from None
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)
        try:
            hdus = fits.open(io.BytesIO(data), lazy_load_hdus=False)
            for hdu in hdus:
                place = hdu.fileinfo()
                if not _checksum_holds(data[place["hdrLoc"] : place["datLoc"] + place["datSpan"]]):
                    raise ProductError(f"{path}: damaged ({hdu.name} does not match its checksum)")
                hdu.data  # noqa: B018 - reads it now, within the checks
            if len(hdus) != hdus[0].header["NPARTS"]:
                raise ProductError(f"{path}: cut short; expected {hdus[0].header['NPARTS']} parts, found {len(hdus)}")
        except (AstropyWarning, OSError, ValueError, KeyError, TypeError, IndexError) as error:
            raise ProductError(f"{path}: damaged or no FITS product ({' '.join(str(error).split())})") from None
    return hdus


def _checksum_holds(part: bytes) -> bool:
    """Return whether the 32-bit ones'-complement sum of a header and its data is all ones (FITS standard 4.0, J.1)."""
    if not part or len(part) % 4:
        return False
    total = int(np.frombuffer(part, dtype=">u4").sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total == 0xFFFFFFFF


def table_hdu(name: str, columns: dict[str, tuple[np.ndarray, str, str]]) -> fits.BinTableHDU:
    """Return a FITS table.

    Parameters
    ----------
    name : str
        Name of the extension.
    columns : dict of str to (values, unit, description)
        Columns in order; the unit in FITS notation, empty for pure numbers.
    """
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(name=key, array=values, format=_FORMATS[values.dtype.kind], unit=unit or None)
            for key, (values, unit, _) in columns.items()
        ],
        name=name,
    )
    for index, (key, (_, _, description)) in enumerate(columns.items(), start=1):
        table.header.comments[f"TTYPE{index}"] = description
        table.header.set(f"TTYPE{index}", key, description)
    return table


_FORMATS = {"f": "D", "i": "J", "b": "L"}


def image_hdu(name: str, image: np.ndarray, comment: str) -> fits.ImageHDU:
    """Return a FITS image in single precision with a comment on what it holds."""
    hdu = fits.ImageHDU(np.asarray(image, dtype=np.float32), name=name)
    hdu.header["COMMENT"] = comment
    return hdu


def column(table: fits.BinTableHDU, name: str) -> np.ndarray:
    """Return a column in the machine's own byte order."""
    values = np.asarray(table.data[name])
    return values.astype(values.dtype.newbyteorder("="))


def write_ecsv(path: Path, columns: dict[str, tuple[np.ndarray, str, str]], meta: dict[str, Any]) -> None:
    """Write an ECSV table, which people and astropy both read; the columns as in :func:`table_hdu`."""
    text = io.StringIO()
    described_table(columns, meta).write(text, format="ascii.ecsv")
    write_bytes(path, text.getvalue().encode())


def described_table(columns: dict[str, tuple[np.ndarray, str, str]], meta: dict[str, Any]) -> Table:
    """Return an astropy table with units and descriptions; the columns as in :func:`table_hdu`."""
    table = Table(meta=meta)
    for key, (values, unit, description) in columns.items():
        table[key] = values
        table[key].description = description
        if unit:
            table[key].unit = u.Unit(unit)
    return table
