"""CODE V lens files against the same lenses as Zemax files, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle, Complement, Rectangle
from pachon.models.first_order import first_order
from pachon.models.io.prescription import load_telescope
from pachon.models.shapes.shape import EvenAsphere
from pachon.models.surface import Interaction

DATA = Path(__file__).parents[2] / "data" / "zmx"

# The triplet of tests/data/zmx/lens1.zmx, with the glasses of its catalogue.
TRIPLET = """! a triplet
RDM;LEN
TITLE 'Cooke; f/3'
EPD   8.333333969116211
DIM   M
WL    656.27250000000004 587.56180000000002 486.13269999999997
REF   2
WTW   1 1 1
XAN   0.0 0.0 0.0
YAN   0.0 8.485281610363037 12.000000333930423
SO    0.0 0.1e14
S     12.4397883 5.514017105102539 NSK16_SCHOTT
  CCY 0; THC 0
S     &
      -181.257475 2.6377501487731934 ! carried on
S     -12.3624027 1.017357349395752 648338
  SLB 'flint'
S     10.1818956 0.7544687986373901
S     0.0 1.6761058568954468
  STO
S     25.4625317 1.6096280813217163 N-LAK9_SCHOTT
S     -11.1616001 18.660079956054688
SI    0.0 0.0
GO
"""


def written(tmp_path, text, name="lens.seq"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_triplet(tmp_path):
    telescope = load_telescope(written(tmp_path, TRIPLET.replace("NSK16", "N-SK16")))
    zemax = load_telescope(DATA / "lens1.zmx")
    assert telescope.description == "Cooke; f/3"
    assert telescope.default_wavelength == pytest.approx(587.5618e-9, rel=1e-12)
    assert telescope.surface_names == ("S1", "S2", "flint", "S4", "S5", "S6", "S7", "Image")
    for one, other in zip(telescope.surfaces, zemax.surfaces, strict=True):
        assert one.interaction == other.interaction
        assert one.vertex == pytest.approx(other.vertex, abs=1e-12)
        # Radii are given to nine figures here.
        assert one.shape.curvature == pytest.approx(other.shape.curvature, rel=1e-8)
    assert telescope.field_radius == pytest.approx(zemax.field_radius, rel=1e-14)
    assert telescope.stop_z == pytest.approx(zemax.stop_z, rel=1e-3)
    # Catalogue glasses differ from the file's model glasses by 3e-4 in the index.
    assert first_order(telescope).focal_length == pytest.approx(0.025, rel=2e-3)
    # 648338 is a glass of nd 1.648 and V 33.8.
    flint = telescope.surface("flint").medium_after
    d, f, c = (float(flint.index(w)) for w in (0.5875618e-6, 0.4861327e-6, 0.6562725e-6))
    assert (d, (d - 1) / (f - c)) == pytest.approx((1.648, 33.8), rel=1e-10)


MIRRORS = """RDM N
EPD 20
DIM M
WL 550
YAN 0
SO 0 1E20
S -9.852216748768472150E-04 -160.36 REFL
  ASP
  K -4.278; A 1e-10
  STO
  ADE 3.5; {mode}
S 9.5e-04 206.8 REFL
  ADE 3.32; YDE 2.0; DAR
SI 0 -0.25
  YDE 24.0
"""


def same_in_zemax(bend):
    """The same in a Zemax file, with coordinate breaks written out."""
    back = "PARM 3 -3.5\n" if bend else ""
    surfaces = [
        "TYPE STANDARD\n  DISZ INFINITY",
        "TYPE COORDBRK\n  PARM 3 -3.5\n  DISZ 0",
        "STOP\n  TYPE EVENASPH\n  CURV -9.852216748768472150E-04\n  CONI -4.278\n  PARM 2 1e-10\n  GLAS MIRROR",
        f"TYPE COORDBRK\n  {back}  DISZ -160.36",
        "TYPE COORDBRK\n  PARM 2 2.0\n  PARM 3 -3.32\n  DISZ 0",
        "TYPE STANDARD\n  CURV 9.5e-04\n  GLAS MIRROR\n  DISZ 0",
        "TYPE COORDBRK\n  PARM 2 -2.0\n  PARM 3 3.32\n  PARM 6 1\n  DISZ 206.55",
        "TYPE COORDBRK\n  PARM 2 24.0\n  DISZ 0",
        "TYPE STANDARD\n  DISZ 0",
    ]
    header = "MODE SEQ\nUNIT MM\nENPD 20\nFTYP 0 0 1 1\nXFLN 0\nYFLN 0\nWAVM 1 0.55 1\nPWAV 1\n"
    return header + "".join(f"SURF {i}\n  {text}\n" for i, text in enumerate(surfaces))


@pytest.mark.parametrize("bend", [True, False], ids=["bend", "basic decentre"])
def test_tilted_mirrors_are_where_zemax_has_them(tmp_path, bend):
    telescope = load_telescope(written(tmp_path, MIRRORS.format(mode="BEN" if bend else "")))
    zemax = load_telescope(written(tmp_path, same_in_zemax(bend), "lens.zmx"))
    assert len(telescope.surfaces) == len(zemax.surfaces) == 3
    for one, other in zip(telescope.surfaces, zemax.surfaces, strict=True):
        assert one.interaction == other.interaction
        assert one.vertex == pytest.approx(other.vertex, abs=1e-15)
        assert one.matrix == pytest.approx(other.matrix, abs=1e-15)
    assert isinstance(telescope.surfaces[0].shape, EvenAsphere)
    assert telescope.surfaces[0].shape == zemax.surfaces[0].shape
    # Turned to the left about x: the normal of the first mirror, which looks up, leans towards +y.
    assert telescope.surfaces[0].matrix[1, 2] == pytest.approx(-np.sin(np.deg2rad(3.5)), rel=1e-14)


def test_apertures(tmp_path):
    text = MIRRORS.format(mode="BEN").replace("  STO\n", "  STO\n  CIR 9\n")
    text = text.replace("  ADE 3.32", "  REX 3; REY 4; ADX 1\n  ADE 3.32")
    text = text.replace("  YDE 24.0", "  YDE 24.0\n  CIR OBS 2")
    one, two, image = (s.aperture for s in load_telescope(written(tmp_path, text)).surfaces)
    assert isinstance(one, Circle)
    assert one.radius == pytest.approx(0.009, rel=1e-15)
    assert two == Rectangle(0.006, 0.008, -0.001, 0.0)
    assert image == Complement(Circle(0.002))


def test_surfaces_may_be_named_by_number(tmp_path):
    text = MIRRORS.format(mode="BEN").replace("GO", "")
    changed = text + "THI S1 -170\nCUY S2 1e-3\nGLA S2 BK7\nGO\n"
    telescope = load_telescope(written(tmp_path, changed))
    assert telescope.surfaces[1].shape.curvature == pytest.approx(-1.0, rel=1e-14)
    assert telescope.surfaces[1].interaction == Interaction.REFRACT


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("DIM   M", "DIM   K", "line 5: DIM K: expected one of M, C, I"),
        ("EPD   8", "EPX   8", "line 4: EPX .*this command is not understood"),
        ("  STO", "  DIF GRT", "surface 5: DIF GRT: this command is not understood"),
        ("  STO", "  STO\n  ADE x", "surface 5: ADE x: expected a number in place of 'x'"),
        ("  STO", "  STO\n  THI S77 3", "THI S77 3: expected a surface from 0"),
        ("  STO", "", "no surface is the stop"),
        ("N-LAK9_SCHOTT", "N-LAX9_SCHOTT", "GLAS N-LAX9: the glass is in no catalogue"),
        ("REF   2", "REF   5", "PWAV 5: expected 1 to 3"),
        ("SO    0.0 0.1e14", "SO    0.0 nan", "surface 0: SO 0.0 nan: expected a number"),
    ],
)
def test_what_is_not_understood_is_one_line(tmp_path, old, new, expected):
    text = TRIPLET.replace("NSK16", "N-SK16")
    assert old in text
    path = written(tmp_path, text.replace(old, new, 1))
    with pytest.raises(PrescriptionError, match=expected) as error:
        load_telescope(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_lenient_warns(tmp_path):
    text = TRIPLET.replace("NSK16", "N-SK16").replace("  STO", "  STO; XYZ 3")
    with pytest.warns(PrescriptionWarning, match="surface 5: XYZ 3: this command is not understood"):
        load_telescope(written(tmp_path, text), lenient=True)


def test_a_file_without_surfaces_is_refused(tmp_path):
    with pytest.raises(PrescriptionError, match="0 surfaces: expected SO"):
        load_telescope(written(tmp_path, "RDM\nEPD 3\n"))
