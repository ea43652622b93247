"""Zemax archives that the tests pack themselves, with a compressor of their own, and damaged ones."""

from pathlib import Path

import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.io.zar import reader

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"
GLASS = "NM LAK9 1 0 1.6 50\nCD 2.56\nLD 0.3 2.0\n"


def compressed(data):
    """Return data by LZW with codes of 9 bits and more: a table of texts, written as a string of bits."""
    table = {bytes([i]): i for i in range(256)}
    bits, text, sent = "", b"", 0
    for value in data:
        longer = text + bytes([value])
        if longer in table:
            text = longer
            continue
        # The reader's table has one entry less, and its codes grow when that is full.
        bits += format(table[text], f"0{max(9, (255 + sent).bit_length())}b")
        table[longer] = len(table)
        text, sent = bytes([value]), sent + 1
    if text:
        bits += format(table[text], f"0{max(9, (255 + sent).bit_length())}b")
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))


def member(name, data, kind=0xEC):
    if kind == 0xEC:
        header = bytearray(0x288)
        header[0x10:0x18] = len(data).to_bytes(8, "little")
        header[0x30 : 0x30 + 2 * len(name)] = name.encode("utf-16-le")
    else:
        header = bytearray(0x14C)
        header[0xC:0x10] = len(data).to_bytes(4, "little")
        header[0x20 : 0x20 + len(name)] = name.encode("latin-1")
    header[0:2] = bytes([kind, 3])
    return bytes(header) + data


def written(tmp_path, *members):
    path = tmp_path / "archive.zar"
    path.write_bytes(b"".join(members))
    return path


def test_the_compressor_and_the_reader_undo_each_other():
    # Texts in which an entry is used in the step that makes it, and more than 512 and 1024 entries.
    for data in (b"", b"a", b"aaaaaaaaaaaa", bytes(range(256)) * 9, b"abcabcabcab" * 400, LENS.read_bytes()):
        assert reader._unpacked(compressed(data), "data") == data


@pytest.mark.parametrize("kind", [0xEC, 0xEA])
@pytest.mark.parametrize("packed", [True, False])
def test_the_lens_of_an_archive_is_that_of_the_file(tmp_path, kind, packed):
    data, ending = (compressed(LENS.read_bytes()), ".LZW") if packed else (LENS.read_bytes(), "")
    path = written(tmp_path, member("notes.ses", b"x" * 77, kind), member(f"Lens 1.ZMX{ending}", data, kind))
    archived, plain = pachon.load_telescope(path), pachon.load_telescope(LENS)
    assert archived.surfaces == plain.surfaces
    assert archived.stop_z == plain.stop_z
    assert archived.name == "archive"


def test_the_glasses_of_an_archive_come_first(tmp_path):
    text = LENS.read_bytes().decode("utf-16" if LENS.read_bytes()[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1")
    first = next(line for line in text.splitlines() if "GLAS" in line)
    lens = text.replace(first, "  GLAS LAK9 0 0 1.5 40 0 0 0", 1).encode()
    path = written(tmp_path, member("SCHOTT.AGF.LZW", compressed(GLASS.encode())), member("a.zmx", lens))
    found = pachon.load_telescope(path).surfaces
    glass = next(s.medium_after for s in found if s.medium_after.name == "LAK9")
    assert float(glass.index(550e-9)) == pytest.approx(1.6, rel=1e-15)
    broken = written(tmp_path, member("SCHOTT.AGF", b"NM A 99\nCD 1 2\n"), member("a.zmx", LENS.read_bytes()))
    with pytest.warns(PrescriptionWarning, match=r"SCHOTT.AGF, line 1: .* expected a dispersion .*is left out"):
        assert pachon.load_telescope(broken).surfaces == pachon.load_telescope(LENS).surfaces


def test_damaged_archives_are_refused(tmp_path, monkeypatch):
    lens = member("a.zmx.lzw", compressed(LENS.read_bytes()))
    for members, expected in (
        ((b"PK\x03\x04" + b"0" * 900,), "byte 0: expected the header of a file in a Zemax archive"),
        ((lens[:-20],), "byte 0: the archive ends before the file that begins here"),
        ((lens[:100],), "byte 0: the archive ends"),
        ((member("a.ses", b"12"),), r"expected one lens file \(.zmx\) in the archive, found none"),
        ((lens, member("b.zmx", LENS.read_bytes())), "found 'a.zmx.lzw', 'b.zmx'"),
        ((member("a.zmx.lzw", b"\xff" * 40),), "a.zmx.lzw: code 511 beyond the table of 256: a damaged file"),
    ):
        path = written(tmp_path, *members)
        with pytest.raises(PrescriptionError, match=expected) as error:
            pachon.load_telescope(path)
        assert "\n" not in str(error.value)
    monkeypatch.setattr(reader, "MAX_UNPACKED", 1000)
    with pytest.raises(PrescriptionError, match="more than 1000 bytes when unpacked"):
        pachon.load_telescope(written(tmp_path, lens))
