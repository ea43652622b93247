"""FITS and ECSV products: stamped with their origin, and checked by checksum when read."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from .ccd_names import NAMES_CARD, refuse_mirrored_names
from .errors import ProductError
from .files import parsing, read_bytes, write_bytes
from .fits_files import unpacked_bytes
from .version import VERSION

#: Comment of CHECKSUM and DATASUM. astropy's default is the time of day, with which no two runs have the same bytes.
_WHEN = "FITS checksum"
#: FITS formats of columns by kind of NumPy type.
_FORMATS = {"f": "D", "i": "J", "b": "L"}
#: Largest whole number of the format J.
_LARGEST_INT = np.iinfo(np.int32).max
# Python escape of a character beyond ASCII.
_ESCAPE = re.compile(r"\\x[89a-f][0-9a-f]|\\u[0-9a-f]{4}|\\U[0-9a-f]{8}")
#: Columns of a table in order, by name: values, unit in FITS notation (empty for pure numbers), description.
Columns = dict[str, tuple[np.ndarray, str, str]]
#: Keyword, value and comment of a line of a FITS header.
Card = tuple[str, object, str]


@dataclass(frozen=True)
class Stamp:
    """Origin of a product: SHA-256 of the resolved configuration, seed of the run, version of pachon."""

    config_hash: str
    seed: int
    version: str = VERSION

    def cards(self) -> list[Card]:
        """Return the header cards."""
        return [
            ("CREATOR", f"pachon {self.version}", "program and version"),
            ("CONFHASH", self.config_hash, ""),
            ("SEED", self.seed, "seed of all random numbers"),
            NAMES_CARD,
        ]

    def meta(self) -> dict[str, str | int]:
        """Return the entries of a table's header or a JSON file."""
        return {"pachon": self.version, "config_hash": self.config_hash, "seed": self.seed}

    def matches(self, header: fits.Header) -> bool:
        """Return whether a header has this stamp."""
        return all(header.get(key) == value for key, value, _ in self.cards())


def card_text(text: str) -> str:
    r"""Return a text as a FITS card or column holds it: ASCII, other characters as Python escapes such as ``\xfc``."""
    return text.encode("ascii", "backslashreplace").decode()


def card_value(value: object) -> object:
    """Return the value of a FITS card, texts by :func:`card_text`."""
    return card_text(value) if isinstance(value, str) else value


def text_of_card(text: str) -> str:
    """Return the text that :func:`card_text` has made ASCII."""
    return _ESCAPE.sub(lambda escape: chr(int(escape[0][2:], 16)), text)


def write_fits(path: Path, hdus: list[Any], stamp: Stamp | None, cards: Sequence[Card]) -> None:
    """Write named extensions as a FITS product with checksums.

    The primary header has the stamp, which is None for a product of no run, and `cards`: (keyword, value, comment).
    Texts are ASCII there, by :func:`card_text`.
    """
    primary = fits.PrimaryHDU()
    parts = ("NPARTS", 1 + len(hdus), "header and extensions of this file")
    for keyword, value, comment in [*(stamp.cards() if stamp else []), parts, *cards]:
        primary.header[keyword] = (card_value(value), comment)
    write_hdus(path, fits.HDUList([primary, *hdus]))


def write_hdus(path: Path, hdus: fits.HDUList) -> None:
    """Write all parts of a FITS product, as :func:`read_fits` returns them, with checksums."""
    buffer = io.BytesIO()
    for hdu in hdus:
        hdu.add_checksum(when=_WHEN)
    hdus.writeto(buffer, checksum=False)
    write_bytes(path, buffer.getvalue())


def read_fits(path: Path, stamp: Stamp | None = None, *, checksums: bool = True) -> fits.HDUList:
    """Read a FITS product into memory and check the checksum of every part, and the stamp where one is given.

    Without `checksums` a part need not have any, nor the file its number of parts: the standard leaves them free, and
    files may come from other programs. Those that are there must hold.

    Raises ProductError if there is no such file, it is no product of this program as it was written, or has another
    stamp.
    """
    data = read_bytes(path, ProductError)
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)
        with parsing(path, "damaged or no FITS product" if checksums else "damaged or not FITS", ProductError):
            data = unpacked_bytes(path, data, ProductError)
            hdus = fits.open(io.BytesIO(data), lazy_load_hdus=False)
            for hdu in hdus:
                if problem := _checksum_problem(hdu, data, required=checksums):
                    raise ProductError(f"damaged ({hdu.name} {problem})", file=path)
                hdu.data  # noqa: B018 - reads it now, within the checks
                # Parts are found by their names.
                hdu.header.get("EXTNAME")
            parts = hdus[0].header["NPARTS"] if checksums else hdus[0].header.get("NPARTS", len(hdus))
            if len(hdus) != parts:
                raise ProductError(f"cut short; expected {parts} parts, found {len(hdus)}", file=path)
    header = hdus[0].header
    if "CONFHASH" in header:
        refuse_mirrored_names([header.get("CCD", "")], header.get(NAMES_CARD[0]), path)
    if stamp is not None and not stamp.matches(header):
        raise ProductError("was made with another version, configuration or seed", file=path)
    return hdus


def is_whole(path: Path, stamp: Stamp) -> bool:
    """Return whether there is an undamaged FITS product with a stamp."""
    try:
        read_fits(path, stamp)
    except ProductError:
        return False
    return True


def _checksum_problem(hdu: Any, data: bytes, *, required: bool) -> str:
    """Return what is wrong with the checksums of a part of a file: empty where they hold, or none is required or there.

    An empty keyword is one whose value is undefined (FITS standard 4.0, 4.4.2.7).
    """
    place = hdu.fileinfo()
    content = slice(place["datLoc"], place["datLoc"] + place["datSpan"])
    if hdu.header.get("CHECKSUM") or required:
        holds = _ones_complement_sum(data[place["hdrLoc"] : content.stop]) == 0xFFFFFFFF
        return "" if holds else "does not match its checksum"
    if datasum := hdu.header.get("DATASUM"):
        return "" if _ones_complement_sum(data[content]) == int(datasum) else "does not match its DATASUM"
    return ""


def _ones_complement_sum(part: bytes) -> int:
    """Return the 32-bit ones'-complement sum; of a header and its data it is all ones (FITS standard 4.0, J.1).

    It is -1 of a part that was cut within a word.
    """
    if len(part) % 4:
        return -1
    total = int(np.frombuffer(part, dtype=">u4").sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def table_hdu(name: str, columns: Columns) -> fits.BinTableHDU:
    """Return a FITS table."""
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(name=key, array=values, format=_format_of(values), unit=unit or None)
            for key, (values, unit, _) in columns.items()
        ],
        name=name,
    )
    for index, (key, (_, _, description)) in enumerate(columns.items(), start=1):
        table.header.set(f"TTYPE{index}", key, description)
    return table


def _format_of(values: np.ndarray) -> str:
    """Return the FITS format of a column; whole numbers of 64 bits only where they need them."""
    kind = values.dtype.kind
    return "K" if kind == "i" and np.abs(values).max(initial=0) > _LARGEST_INT else _FORMATS[kind]


def image_hdu(name: str, image: np.ndarray, comment: str) -> fits.ImageHDU:
    """Return a FITS image in single precision with a comment on its content."""
    hdu = fits.ImageHDU(np.asarray(image, dtype=np.float32), name=name)
    hdu.header["COMMENT"] = comment
    return hdu


def column(table: fits.BinTableHDU, name: str) -> np.ndarray:
    """Return a column in the machine's own byte order."""
    values = np.asarray(table.data[name])
    return values.astype(values.dtype.newbyteorder("="))


def write_ecsv(path: Path, columns: Columns, meta: Mapping[str, object]) -> None:
    """Write an ECSV table, which people and astropy both read."""
    text = io.StringIO()
    described_table(columns, meta).write(text, format="ascii.ecsv")
    write_bytes(path, text.getvalue().encode())


def described_table(columns: Columns, meta: Mapping[str, object]) -> Table:
    """Return an astropy table with units and descriptions."""
    table = Table(meta=meta)
    for key, (values, unit, description) in columns.items():
        table[key] = values
        table[key].description = description
        if unit:
            table[key].unit = u.Unit(unit)
    return table
