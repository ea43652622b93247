"""FITS files opened within bounds, compressed ones too."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from .errors import PachonError
from .files import require_file
from .memory import readable, require_bytes

if TYPE_CHECKING:
    from astropy.io import fits

#: Bytes to which any file may unpack: 4096 x 4096 pixels of float64.
_UNPACKED = 128 * 2**20
#: Times its own size to which a larger file may unpack: images with noise shrink to a half or a quarter.
_RATIO = 10
#: Bytes to which one image of a tile-compressed file (fpack) may unpack.
_TILED = 2**30
# What astropy says of a card.
_UNPARSABLE = re.compile(r"Unparsable card \((\S+)\)")
#: Bytes that are unpacked at once.
_PIECE = 2**20


@contextmanager
def open_fits(
    path: Path, error: type[PachonError], *, content: bytes | None = None, **options: Any
) -> Iterator[fits.HDUList]:
    """Open a FITS file that may be compressed by gzip, bzip2, xz, zip or fpack, or its content.

    What a small file unpacks to is limited to 128 MiB, or ten times its size where that is more, and an image of fpack
    to 1 GiB and to the memory that is free: a few bytes can stand for as many gigabytes. Other options are those of
    ``astropy.io.fits.open``.

    Raises `error` where it unpacks to more, or a card that is asked for meanwhile cannot be read; whatever else astropy
    raises for a damaged file passes, its warning of one cut short among them.
    """
    from astropy.io import fits  # few prescriptions have a grid, and it takes long to import

    if content is None:
        require_file(path, error)
    with open(path, "rb") if content is None else io.BytesIO(content) as packed:
        stream = _unpacked(path, packed, error)
        with (
            _short_files_refused(),
            readable_cards(path, error),
            fits.open(packed if stream is None else stream, **options) as hdus,
        ):
            for hdu in hdus:
                if isinstance(hdu, fits.CompImageHDU):
                    _require_room(path, hdu, error)
            yield hdus


@contextmanager
def readable_cards(path: Path, error: type[PachonError]) -> Iterator[None]:
    """Raise `error` for a card of a header that astropy cannot read, which it does when it is asked for."""
    from astropy.io import fits

    try:
        yield
    except fits.VerifyError as cause:
        card = _UNPARSABLE.search(str(cause))
        name = "a card" if card is None else card[1]
        raise error(f"{name} of the header cannot be read: expected KEY = value as FITS has it", file=path) from None


@contextmanager
def _short_files_refused() -> Iterator[None]:
    """Raise astropy's warning of a file cut short, which it opens all the same."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        yield


def unpacked_bytes(path: Path, data: bytes, error: type[PachonError]) -> bytes:
    """Return the content of a file, unpacked within the limits of :func:`open_fits` where it is compressed."""
    stream = _unpacked(path, io.BytesIO(data), error)
    return data if stream is None else stream.getvalue()


def _unpacked(path: Path, packed: IO[bytes], error: type[PachonError]) -> io.BytesIO | None:
    """Return the unpacked content of a compressed stream; None of one that is not compressed."""
    start = packed.read(6)
    size = packed.seek(0, io.SEEK_END)
    packed.seek(0)
    openers: dict[bytes, Callable[[Any], Any]] = {
        b"\x1f\x8b": gzip.open,
        b"BZh": bz2.open,
        b"\xfd7zXZ\0": lzma.open,
        b"PK\x03\x04": _first_member,
    }
    opener = next((opener for signature, opener in openers.items() if start.startswith(signature)), None)
    if opener is None:
        return None
    size_limit = max(_UNPACKED, _RATIO * size)
    content = io.BytesIO()
    with opener(packed) as stream:
        while piece := stream.read(_PIECE):
            if content.tell() + len(piece) > size_limit:
                text = (
                    f"compressed file of {readable(size)} that unpacks to more than {readable(size_limit)}: unpack it"
                )
                raise error(text, file=path)
            content.write(piece)
    content.seek(0)
    if any(bytes(content.getbuffer()[:6]).startswith(signature) for signature in openers):
        raise error("compressed twice: unpack it", file=path)
    return content


def _first_member(packed: IO[bytes]) -> IO[bytes]:
    archive = zipfile.ZipFile(packed)
    return archive.open(archive.namelist()[0])


def _require_room(path: Path, hdu: fits.CompImageHDU, error: type[PachonError]) -> None:
    needed = abs(int(hdu.header.get("BITPIX", 8))) // 8
    for length in hdu.shape:
        needed *= length
    if needed > _TILED:
        text = f"compressed image {hdu.name} of {readable(needed)}: expected at most {readable(_TILED)}"
        raise error(text, file=path)
    require_bytes(2 * needed, f"{path}: compressed image {hdu.name}")
