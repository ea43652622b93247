"""Catalogue lines that cannot be read are left out by name, the rest is used; line ends within texts are none."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionNote
from pachon.core.files import text_lines
from pachon.models.io.glass_catalogue import GlassCatalogue

GOOD = "NM GOOD 1 0 1.5 60\nCD 2.25\nLD 0.3 2.0\n"
LENS = """MODE SEQ
ENPD 5
UNIT MM
FTYP 0 0 1 1
YFLN 0
WAVM 1 0.55 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.01
  GLAS {glass}
  DISZ 3
SURF 2
  DISZ 50
SURF 3
"""
#: Form feed, NEL, line and paragraph separators, and the information separators: no ends of lines.
WITHIN_LINES = ("\x0b", "\x0c", "\x1c", "\x1e", "\x85", "\u2028", "\u2029")


@pytest.fixture(autouse=True)
def no_configuration(monkeypatch, tmp_path):
    monkeypatch.delenv("PACHON_GLASS_PATH", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def written(tmp_path, text, name="mine.agf"):
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ("lines", "expected", "names"),
    [
        ("NM BAD 14 0 1.5 60\nCD 2.25\n", "line 4: NM BAD 14 .*: expected a dispersion formula", {"GOOD"}),
        ("NM BAD 1 0 1.5 60\nLD 0.3 2\n", "line 4: glass BAD has no line CD", {"GOOD"}),
        ("NM BAD 1 0 1.5 60\nCD two\n", "line 5: CD two: expected a number", {"GOOD"}),
        ("NM\nCD 2.25\n", "line 4: NM: expected a name", {"GOOD"}),
        (
            "NM USED 1 0 1.5 60\nCD 2.25\nXX 3\n",
            "line 6: XX 3: expected CD, TD, LD or .* in glass USED",
            {"GOOD", "USED"},
        ),
        ("NM USED 1 0 1.5 60\nCD 2.25\nXX 3\n4 5\n", "line 6: XX 3", {"GOOD", "USED"}),
        ("NM USED 1 0 1.5 60\nCD 2.25\nTD 0 0 0 0 0 0 -300\n", "line 6: TD .*absolute zero", {"GOOD", "USED"}),
    ],
)
def test_a_line_that_cannot_be_read_is_left_out(tmp_path, lines, expected, names):
    path = written(tmp_path, GOOD + lines)
    with pytest.warns(PrescriptionNote, match=rf"mine.agf, {expected}.*; left out") as caught:
        catalogue = GlassCatalogue.read(path)
    assert set(catalogue) == names
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)


@pytest.mark.parametrize("break_at", [1, 3, 5])
def test_numbers_may_go_on_in_the_next_lines(tmp_path, break_at):
    sellmeier = "1.03961212E+00 6.00069867E-03 2.31792344E-01 2.00179144E-02 1.01046945E+00 1.03560653E+02"
    numbers = sellmeier.split()
    coefficients = " ".join(numbers[:break_at]), " ".join(numbers[break_at:])
    for second in (coefficients[1], f"CD {coefficients[1]}"):
        text = f"NM MYBK7 2 0 1.5168 64.17\nCD {coefficients[0]}\n  {second}\nIT 0.4 0.99\n 0.5 0.99\nLD 0.3\n 2.5\n"
        glass = GlassCatalogue.read(written(tmp_path, text))["MYBK7"]
        assert glass == GlassCatalogue.bundled()["N-BK7"]


@pytest.mark.parametrize("character", WITHIN_LINES)
def test_no_character_but_line_ends_divides_lines(tmp_path, character):
    assert text_lines(f"a{character}b\r\nc\rd\n\ne") == [f"a{character}b", "c", "d", "", "e"]
    text = f"CC Gr{character}NM BAD two\n" + GOOD.replace("\nLD", f"\nGC a{character}XX b\nLD")
    catalogue = GlassCatalogue.read(written(tmp_path, text))
    assert set(catalogue) == {"GOOD"}
    lens = LENS.format(glass="N-BK7 0 0 1.5 40").replace("SURF 1\n", f"SURF 1\n  COMM a{character}SURF b\n", 1)
    # A name has no control characters; the comment is no line of its own, whatever becomes of it.
    try:
        telescope = pachon.load_telescope(written(tmp_path, lens, "lens.zmx"))
    except pachon.errors.PrescriptionError as error:
        pytest.fail(str(error))
    assert len(telescope.surfaces) == 3
    codev = f"RDM;LEN ! a{character}XXX b\nEPD 5\nWL 550\nSO 0 1e13\nS 100 3 NBK7\n  STO\nS 0 50\nSI 0 0\nGO\n"
    assert len(pachon.load_telescope(written(tmp_path, codev, "lens.seq")).surfaces) == 3
    oslo = (
        f'LEN NEW "a" 1 1 // b{character}XXX c\nEBR 5\nAIR\nTH 1e20\nNXT\nGLA BK7\nRD 100\nTH 3\nAST\nNXT\nAIR\nTH 50\n'
        "NXT\nAIR\nEND\n"
    )
    assert len(pachon.load_telescope(written(tmp_path, oslo, "lens.len")).surfaces) == 3


@pytest.mark.parametrize("ending", ["yaml", "zmx", "seq", "len", "json", "roa"])
@pytest.mark.parametrize("character", ["\x9b", "\x7f", *WITHIN_LINES, "\ufeff", "\ud800"])
def test_a_description_that_is_written_is_read_again(tmp_path, ending, character):
    telescope = pachon.load_telescope(written(tmp_path, LENS.format(glass="N-BK7 0 0 1.5 40"), "lens.zmx"))
    path = tmp_path / f"again.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionNote)
        pachon.save_telescope(replace(telescope, description=f"a {character} b"), path)
        description = pachon.load_telescope(path).description
    # Lens files hold the description as words; what is no character of a text is a question mark.
    assert description.split()[0] == "a"
    assert description.split()[-1] == "b"
    if ending == "yaml" and character != "\ud800":
        assert description == f"a {character} b"


def test_one_bad_catalogue_does_not_block_the_others(tmp_path, monkeypatch):
    folder = tmp_path / "glasses"
    folder.mkdir()
    (folder / "a.agf").write_text("no catalogue at all")
    (folder / "b.agf").write_bytes(b"\x00\x01")
    (folder / "c.agf").write_text(GOOD)
    monkeypatch.setenv("PACHON_GLASS_PATH", f"{tmp_path / 'nowhere'}:{folder}")
    path = written(tmp_path, LENS.format(glass="GOOD"), "lens.zmx")
    with pytest.warns(PrescriptionNote) as caught:
        telescope = pachon.load_telescope(path)
    assert telescope.surfaces[0].medium_after.index(550e-9) == pytest.approx(1.5)
    texts = [str(w.message) for w in caught]
    for part in ("nowhere: expected an AGF file", "a.agf: expected a glass catalogue", "b.agf: not a text file"):
        assert any(part in text for text in texts), part
    with pytest.warns(PrescriptionNote), pytest.raises(pachon.errors.PrescriptionError, match="in no catalogue"):
        pachon.load_telescope(written(tmp_path, LENS.format(glass="NOGLASS"), "none.zmx"))
    # A lens of bundled glasses does not ask for them.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pachon.load_telescope(written(tmp_path, LENS.format(glass="N-BK7"), "lens.zmx"))


@pytest.mark.parametrize(
    ("glass", "index"),
    [
        # Helium against air at one atmosphere, as OpticStudio writes it, and what stands for vacuum.
        ("___BLANK 1 0 0.99977 0 0 0 0 0 0 0", 0.99977),
        ("___BLANK 1 0 1.0 0", 1.0),
        ("___BLANK 1 0 0.99977 35 0", 0.99977),
        ("___BLANK 1 0 1.00028 89 0", 1.00028),
    ],
)
def test_an_index_of_at_most_one(tmp_path, glass, index):
    medium = pachon.load_telescope(written(tmp_path, LENS.format(glass=glass), "lens.zmx")).surfaces[0].medium_after
    d, f, c = (float(v) for v in medium.index(np.array([0.5875618e-6, 0.4861327e-6, 0.6562725e-6])))
    assert d == pytest.approx(index, abs=1e-15)
    abbe = float(glass.split()[4])
    assert (f - c) == pytest.approx((index - 1) / abbe if abbe else 0.0, rel=1e-9)
    # No absorption bands: the index goes evenly from the ultraviolet to the infrared.
    if abbe:
        change = np.diff(medium.index(np.linspace(0.2e-6, 10e-6, 50)))
        assert np.all(change < 0) or np.all(change > 0)


def test_a_wavelength_that_a_glass_does_not_cover_names_it(tmp_path):
    lens = LENS.format(glass="B270").replace("WAVM 1 0.55 1", "WAVM 1 1.55 1")
    assert pachon.load_telescope(written(tmp_path, lens, "lens.zmx")).wavelength_range[1] == pytest.approx(2.5e-6)
    with pytest.raises(pachon.errors.DomainError, match=r"2600 nm: expected 334 to 2500 nm for glass B270"):
        GlassCatalogue.bundled()["B270"].index(2.6e-6)
