"""Read the lens file of a Zemax archive (.zar), with the glass catalogues packed beside it.

An archive is a row of files, each behind a header of fixed length, little-endian: in archives whose headers begin with
the byte EC the length of the packed file stands at 0x10 (8 bytes), its name in UTF-16 at 0x30, its content at 0x288; in
older ones, EA, the length at 0xC (4 bytes), the name at 0x20, the content at 0x14C. Names that end in .LZW are of
compressed files: codes of 9 bits and more, the highest bit first, a new entry of the table with each. The layout is not
published; this is that of the description by T. Vettenburg (zmxtools).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ....core.errors import PrescriptionError, shown
from ....core.files import read_bytes
from ...media.medium import Medium
from ..glass_catalogue import GlassCatalogue
from ..lens.description import LensDescription
from ..lens.glasses import Glasses
from ..lens.source import Findings
from ..lens.text import decoded
from ..zemax.file import parse_zemax_file
from ..zemax.reader import described

#: Ending of the names of compressed files.
_PACKED = ".lzw"
#: Longest archive [byte].
MAX_BYTES = 100_000_000
#: Longest file of an archive when unpacked [byte].
MAX_UNPACKED = 50_000_000


@dataclass(frozen=True)
class _Layout:
    """Places in a header: of the length of the file and its bytes, of the name and its encoding, of the content."""

    length: int
    length_bytes: int
    name: int
    encoding: str
    content: int


LAYOUTS = {0xEC: _Layout(0x10, 8, 0x30, "utf-16-le", 0x288), 0xEA: _Layout(0xC, 4, 0x20, "iso-8859-1", 0x14C)}


def read_zemax_archive(
    path: Path, findings: Findings, catalogues: Glasses, configuration: int | None = None
) -> LensDescription:
    """Return the description of the lens file of an archive; glasses of its catalogues come first.

    PrescriptionError if it is no archive, is damaged, or does not hold one lens file.
    """
    lenses: dict[str, str] = {}
    glasses: dict[str, Medium] = {}
    for name, content in _members(read_bytes(path, PrescriptionError, max_bytes=MAX_BYTES), path):
        ending = name.lower().removesuffix(_PACKED)[-4:]
        if ending not in (".zmx", ".agf"):
            continue
        text = decoded(_unpacked(content, name) if name.lower().endswith(_PACKED) else content, name)
        if ending == ".zmx":
            lenses[name] = text
            continue
        try:
            catalogue = GlassCatalogue.parse(text, name)
        except PrescriptionError as error:
            findings.note(error, "this catalogue is left out")
        else:
            glasses |= {glass: catalogue[glass] for glass in catalogue}
    if len(lenses) != 1:
        lens_names = ", ".join(map(shown, lenses)) or "none"
        raise PrescriptionError(f"expected one lens file (.zmx) in the archive, found {lens_names}", file=path)
    (lens,) = lenses.values()
    file = replace(parse_zemax_file(lens, path), glasses=glasses)
    return described(file, findings, catalogues, configuration)


def _members(data: bytes, path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents, still packed, of the files of an archive."""
    place = 0
    while place < len(data):
        layout = LAYOUTS.get(data[place])
        if layout is None:
            raise PrescriptionError(f"byte {place}: expected the header of a file in a Zemax archive (.zar)", file=path)
        start = place + layout.content
        header = data[place:start]
        length = int.from_bytes(header[layout.length : layout.length + layout.length_bytes], "little")
        if start + length > len(data):
            raise PrescriptionError(f"byte {place}: the archive ends before the file that begins here", file=path)
        name = header[layout.name :].decode(layout.encoding, errors="replace").split("\0")[0]
        yield name, data[start : start + length]
        place = start + length


def _unpacked(packed: bytes, source: str) -> bytes:
    """Return the bytes of a compressed file; PrescriptionError if it is damaged or too long."""
    table = [bytes([value]) for value in range(256)]
    unpacked = bytearray()
    previous = b""
    buffer = bits = 0
    width = 9
    for byte in packed:
        buffer, bits = (buffer << 8) | byte, bits + 8
        if bits < width:
            continue
        bits -= width
        code = buffer >> bits
        buffer &= (1 << bits) - 1
        if code < len(table):
            entry = table[code]
        elif code == len(table) and previous:
            # The entry that this very code completes.
            entry = previous + previous[:1]
        else:
            raise PrescriptionError(f"code {code} beyond the table of {len(table)}: a damaged file", file=source)
        if previous:
            table.append(previous + entry[:1])
        unpacked += entry
        previous = entry
        if len(table) >= 1 << width:
            width += 1
        if len(unpacked) > MAX_UNPACKED:
            raise PrescriptionError(f"more than {MAX_UNPACKED} bytes when unpacked", file=source)
    return bytes(unpacked)
