"""Glass catalogues in AGF format: indices of the makers, encodings, and what is refused."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, UnknownNameError
from pachon.models.io.glass_catalogue import FURTHER_MAKERS, MAKERS, OBSOLETE, SUBSTANCES, GlassCatalogue
from pachon.models.media.air import Air
from pachon.models.media.medium import Sellmeier

LINE_D, LINE_F, LINE_C = 0.5875618e-6, 0.4861327e-6, 0.6562725e-6
BK7 = """CC a catalogue of one glass, Größe
NM N-BK7 2 517642.251 1.5168 64.17 0 1
GC a comment
ED 7.1 8.3 2.51 -0.0009 0
CD 1.03961212E+00 6.00069867E-03 2.31792344E-01 2.00179144E-02 1.01046945E+00 1.03560653E+02 0 0 0 0
TD 1.86E-06 1.31E-08 -1.37E-11 4.34E-07 6.27E-10 1.7E-01 2.0E+01
OD 1.0 1.0 0.0 1.0 2.3 2.3
LD 3.0E-01 2.5E+00
IT 3.0E-01 5.0E-02 2.5E+01
"""


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "mine.agf"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize("name", list(GlassCatalogue.bundled()))
def test_bundled_glasses_have_the_index_and_abbe_number_that_their_makers_state(name):
    entry = GlassCatalogue.bundled().entry(name)
    d, f, c = (float(entry.medium.index(w)) for w in (LINE_D, LINE_F, LINE_C))
    # Makers state nd to five or six decimals (half a unit of the fifth is 5e-6), Vd to two.
    assert d == pytest.approx(entry.nd, abs=5e-6)
    assert (d - 1) / (f - c) == pytest.approx(entry.vd, abs=5.5e-3)


def test_b270_has_the_dispersion_of_its_data_sheet():
    # Schott B 270, August 1993, um and indices of four decimals: half a unit of the last.
    sheet = {0.43583: 1.5341, 0.47999: 1.5297, 0.48613: 1.5292, 0.54607: 1.5251, 0.58756: 1.5230, 0.58929: 1.5229,
             0.64385: 1.5207, 0.65627: 1.5203}  # fmt: skip
    glass = GlassCatalogue.bundled()["B270"]
    # Catalogue and data sheet of the maker differ by 1e-4 at all lines: the dispersion is the same within the decimals.
    waves, indices = np.array(list(sheet)) * 1e-6, np.array(list(sheet.values()))
    differences = glass.index(waves) - indices
    assert np.ptp(differences) <= 5e-5
    assert differences.mean() == pytest.approx(9e-5, abs=1e-5)
    assert float(glass.index(1.5e-6)) < float(glass.index(1.0e-6)) < indices.min()


# Half a unit of the last decimal of nd and Vd, and rounding of the coefficients. Sumita's figures are those of melts
# and not of its formulas: off by up to 4e-5 in nd and 0.33 % in Vd.
@pytest.mark.parametrize("maker", [*MAKERS, OBSOLETE, *FURTHER_MAKERS])
def test_the_glasses_of_makers_have_the_index_and_abbe_number_that_these_state(maker):
    catalogue = GlassCatalogue.of_maker(maker)
    assert len(catalogue) > {"corning": 90, "lzos": 45, "heraeus": 4}.get(maker, 150)
    near_nd, near_vd = (4e-5, 3.5e-3) if maker == "sumita" else (6e-6, 3.5e-4)
    for name in catalogue:
        entry = catalogue.entry(name)
        d, f, c = (float(v) for v in entry.medium.index(np.array([LINE_D, LINE_F, LINE_C])))
        assert d == pytest.approx(entry.nd, abs=near_nd), name
        assert (d - 1) / (f - c) == pytest.approx(entry.vd, rel=near_vd), name


def test_common_glasses_are_those_of_their_makers():
    # One database, read at two times: the same formulas.
    common = GlassCatalogue.bundled()
    shared = [(name, maker) for maker in MAKERS for name in GlassCatalogue.of_maker(maker) if name in common]
    waves = np.array([LINE_D, LINE_F, LINE_C])
    owners = {n: [m for name, m in shared if name == n] for n, _ in shared}
    assert len(owners) > 35
    for name, makers in owners.items():
        # Some names of Schott's are Hikari's, Hoya's and CDGM's too.
        glasses = [GlassCatalogue.of_maker(maker)[name] for maker in makers]
        assert any(np.allclose(g.index(waves), common[name].index(waves), rtol=0, atol=1e-9) for g in glasses), name


@pytest.mark.parametrize(
    ("name", "micrometres", "index", "near"),
    [
        # Calcium fluoride: nd of Schott's LITHOTEC-CAF2; the others are figures of data sheets and handbooks, with the
        # digits that these state: sapphire, ordinary ray; zinc selenide at 10.6 um; silicon at 4 um; germanium at
        # 10 um; fused silica at 1.0 um; water at the D line and 20 deg C.
        ("CAF2_MALITSON", 0.58756, 1.43385, 1e-5),
        ("CAF2_DAIMON-20", 0.58756, 1.43385, 3e-5),
        ("AL2O3_MALITSON-O", 0.58756, 1.768, 5e-4),
        ("ZNSE_CONNOLLY", 10.6, 2.4028, 5e-4),
        ("SI_SALZBERG", 4.0, 3.4255, 1e-3),
        ("GE_ICENOGLE", 10.0, 4.003, 1.5e-3),
        ("SIO2_MALITSON", 1.0, 1.450417, 1e-6),
        ("H2O_DAIMON-20.0C", 0.58926, 1.33335, 5e-5),
    ],
)
def test_substances(name, micrometres, index, near):
    catalogue = GlassCatalogue.of_maker(SUBSTANCES)
    assert float(catalogue[name].index(micrometres * 1e-6)) == pytest.approx(index, abs=near)


def test_an_unknown_maker_is_refused():
    with pytest.raises(UnknownNameError, match="unknown glass maker 'schot': did you mean schott"):
        GlassCatalogue.of_maker("schot")


@pytest.mark.parametrize(
    ("name", "nanometres", "index"),
    [
        # Schott data sheets: N-BK7 at h, e and t; SF11 at e; Malitson's fused silica at 1.0 um.
        ("N-BK7", 404.6561, 1.53024),
        ("N-BK7", 546.0740, 1.51872),
        ("N-BK7", 1013.98, 1.50731),
        ("SF11", 546.0740, 1.79190),
        ("F_SILICA", 1000.0, 1.450417),
    ],
)
def test_indices_at_other_lines(name, nanometres, index):
    assert float(GlassCatalogue.bundled()[name].index(nanometres * 1e-9)) == pytest.approx(index, abs=6e-6)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_catalogues_are_read_in_any_encoding(tmp_path, encoding):
    catalogue = GlassCatalogue.read(written(tmp_path, BK7, encoding))
    assert list(catalogue) == ["N-BK7"]
    glass = catalogue["n-bk7"]
    assert glass == GlassCatalogue.bundled()["N-BK7"]
    assert isinstance(glass, Sellmeier)
    assert glass.wavelength_range == (0.3e-6, 2.5e-6)
    assert "N-BK7" in catalogue
    assert "F2" not in catalogue
    assert len(catalogue) == 1


def test_every_formula_number_is_known(tmp_path):
    text = "".join(f"NM GLASS{n} {n} 0 1.5 60\nCD 2.25 0.01 0.01\nLD 0.4 1.0\n" for n in range(1, 14))
    catalogue = GlassCatalogue.read(written(tmp_path, text))
    assert len(catalogue) == 13
    for name in catalogue:
        assert np.isfinite(catalogue[name].index(0.6e-6)), name


def test_sellmeier_numbers_have_three_four_and_five_terms(tmp_path):
    figures = [0.6, 0.004, 0.4, 0.013, 0.8, 97.0, 0.01, 120.0, 0.02, 150.0]
    for number, terms in ((2, 3), (6, 4), (11, 5)):
        listed = " ".join(map(str, figures[: 2 * terms]))
        glass = GlassCatalogue.read(written(tmp_path, f"NM A {number} 0 1.5 60\nCD {listed}\nLD 0.3 2\n"))["A"]
        expected = 1 + sum(
            b * 0.36 / (0.36 - c) for b, c in zip(figures[: 2 * terms : 2], figures[1 : 2 * terms : 2], strict=True)
        )
        assert float(glass.index(0.6e-6)) ** 2 == pytest.approx(expected, rel=1e-14)


def test_in_vacuum_is_the_index_against_vacuum():
    # The d line is 587.5618 nm in air; air of 20 deg C and one atmosphere has 1.000272 there (Schott, TIE-29).
    catalogue = GlassCatalogue.bundled()
    found = catalogue.in_vacuum("N-BK7").index(1.000272 * LINE_D)
    assert float(found) == pytest.approx(1.5168 * 1.000272, abs=1e-6)
    assert catalogue.in_vacuum("S-LAH64").air == Air(temperature=298.15)


def test_an_unknown_glass_is_refused_with_its_neighbours(tmp_path):
    with pytest.raises(UnknownNameError, match=r"unknown glass of the bundled catalogue 'N-BK8': did you mean .*N-BK7"):
        GlassCatalogue.bundled()["N-BK8"]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("NM N-BK7 2", "NM N-BK7 14", "line 2: NM N-BK7 14 .* expected a dispersion formula from 1 to 13"),
        ("NM N-BK7 2", "NM N-BK7 two", "a number in place of 'two'"),
        ("NM N-BK7 2 517642.251 1.5168 64.17 0 1", "NM", "expected a name and the number"),
        ("1.03961212E+00", "1.0396_1212", "a number in place of '1.0396_1212'"),
        ("1.03961212E+00", "nan", "a number in place of 'nan'"),
        ("0 0 0 0", "1 0 0 0", "line 5: CD .*6 coefficients for this formula"),
        ("CD", "CC", "glass N-BK7 has no line CD"),
        ("LD 3.0E-01 2.5E+00", "LD 2.5 0.3", "line 2: glass N-BK7: wavelength_range"),
        ("NM", "CC", "expected a glass catalogue"),
    ],
)
def test_a_line_that_is_not_understood_is_named(tmp_path, old, new, expected):
    assert old in BK7
    with pytest.raises(PrescriptionError, match=expected) as error:
        GlassCatalogue.read(written(tmp_path, BK7.replace(old, new, 1)))
    assert str(error.value).startswith(str(tmp_path / "mine.agf"))
    assert "\n" not in str(error.value)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(PrescriptionError, match=r"none\.agf: no such file"):
        GlassCatalogue.read(tmp_path / "none.agf")


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "b.agf"
    path.write_bytes(b"\x00\x01\x02NM")
    with pytest.raises(PrescriptionError, match="not a text file"):
        GlassCatalogue.read(path)


@pytest.mark.parametrize(("name", "ends"), [("CAF2", (0.23, 9.7)), ("E-LAFH3", (0.4, 0.7))])
def test_a_lens_may_have_the_wavelengths_at_the_ends_of_a_glass(tmp_path, name, ends):
    """0.23 / 1e6 is another float than 0.23e-6: the wavelength itself was refused as beyond its glass."""
    lines = ["MODE SEQ", "UNIT MM", "ENPD 5", "FTYP 0 0 1 2", "XFLN 0", "YFLN 0"]
    lines += [f"WAVM {i} {wave} 1" for i, wave in enumerate(ends, start=1)]
    lines += ["SURF 0", "  DISZ INFINITY", "SURF 1", "  STOP", "  CURV 0.02", f"  GLAS {name}", "  DISZ 3"]
    lines += ["SURF 2", "  DISZ 90", "SURF 3", "  DISZ 0"]
    lens = written(tmp_path, "\n".join(lines)).rename(tmp_path / "lens.zmx")
    telescope = pachon.load_telescope(lens)
    assert telescope.wavelength_range == tuple(float(f"{wave}e-6") for wave in ends)
    for ending in ("zmx", "yaml", "json"):
        pachon.save_telescope(telescope, tmp_path / f"again.{ending}")
        again = pachon.load_telescope(tmp_path / f"again.{ending}")
        assert again.wavelength_range == telescope.wavelength_range
