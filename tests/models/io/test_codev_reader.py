"""CODE V lens files against the same lenses as Zemax files, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Annulus, Circle, Complement, Ellipse, Rectangle
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
    telescope = load_telescope(written(tmp_path, TRIPLET))
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
    oval = load_telescope(written(tmp_path, text.replace("REX 3; REY 4", "ELX 3; ELY 4"))).surfaces[1].aperture
    assert oval == Ellipse(0.003, 0.004, -0.001, 0.0)


def test_surfaces_may_be_named_by_number(tmp_path):
    text = MIRRORS.format(mode="BEN").replace("GO", "")
    changed = text + "THI S1 -170\nCUY S2 1e-3\nGLA S2 BK7\nGO\n"
    telescope = load_telescope(written(tmp_path, changed))
    assert telescope.surfaces[1].shape.curvature == pytest.approx(-1.0, rel=1e-14)
    assert telescope.surfaces[1].interaction == Interaction.REFRACT


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("DIM   M", "DIM   K", "line 5: DIM K: expected one of M, MM, C, CM, I, IN"),
        ("EPD   8", "EPX   8", "line 4: EPX .*this command is not understood"),
        ("  STO", "  DIF DOE", "surface 5: DIF DOE: diffractive surfaces are not read"),
        ("  STO", "  STO\n  ADE x", "surface 5: ADE x: expected a number in place of 'x'"),
        ("  STO", "  STO\n  THI S77 3", "THI S77 3: expected a surface from 0"),
        ("RDM;LEN", "LEN", "curvature 12.4398: a sphere smaller than the entrance pupil of 8.33333; expected RDM"),
        ("  STO", "  CUF 0.1", "surface 5: CUF 0.1: Fresnel surfaces are not read"),
        ("  STO", "  CIR ODD 3", "surface 5: CIR ODD 3: expected CIR with one of CLR, OBS, HOL, EDG"),
        ("  STO", "  CIR 1; CIR L'B' 2", "surface 5: CIR L'B' 2: one aperture and one obscuration"),
        ("GO", "PIK RDY S3 Z1 THI S2 Z1\nGO", "PIK RDY S3 Z1 THI S2 Z1: only pick-ups of the same value"),
        ("SI    0.0 0.0", "THI S7 0; PIM\nSI 0 0", "PIM: expected the thickness of the solve in the file"),
        ("WL    656", "PRV\nPWL 700 600\n'E48' 1.5\nEND\nWL    656", "'E48' 1.5: expected 2 indices"),
        ("WL    656", "PRV\nPWL 700\n'E48' 1.5\nEND\nWL    656", "glass E48: wavelengths = .*at least two"),
        ("N-LAK9_SCHOTT", "N-LAX9_SCHOTT", "line 21, surface 6: S 25.* N-LAX9_SCHOTT: the glass is in no catalogue"),
        ("REF   2", "REF   5", "line 7: REF 5: expected 1 to 3"),
        ("EPD   8.3", "! EPD", "lens.seq: expected the aperture: EPD, FNO or NAO$"),
        ("EPD   8.3", "EPD  -8.3", "line 4: EPD -8.3.*: expected an entrance pupil of finite size"),
        ("WL    656", "! WL", "lens.seq: expected the wavelengths: WL$"),
        ("587.5", "-587.5", "line 6: WL 656.* -587.*: expected positive wavelengths"),
        ("12.000000", "92.000000", "line 10: YAN: expected fields within 89 degrees"),
        (
            "  STO",
            "  STO; CIR 4\n  REX 3; REY 3",
            "line 21, surface 5: REX 3: expected one aperture .*, not CIR",
        ),
        ("  STO", "  STO; REX 4", "line 20, surface 5: REX 4: expected two positive half widths"),
        ("  STO", "  STO; CIR 4; CIR OBS 5", "line 20, surface 5: CIR OBS 5: expected a radius below that of CIR 4"),
        ("  SLB 'flint'", "  K -1; A 1e300", "line 17, surface 3: A 1e300: coefficients"),
        ("SO    0.0 0.1e14", "SO 0.0 0.1e14\n  ADE 3", "surface 0: ADE 3: expected a flat object on the axis"),
        ("648338", "0.0:33", "line 16, surface 3: S -12.* 0.0:33: "),
        ("SO    0.0 0.1e14", "SO    0.0 nan", "surface 0: SO 0.0 nan: expected a number"),
    ],
)
def test_what_is_not_understood_is_one_line(tmp_path, old, new, expected):
    text = TRIPLET
    assert old in text
    path = written(tmp_path, text.replace(old, new, 1))
    with pytest.raises(PrescriptionError, match=expected) as error:
        load_telescope(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("first", "second", "stop"), [("1", "2", "S2"), ("2", "1", "S1")])
def test_the_last_command_of_the_stop_counts(tmp_path, first, second, stop):
    """It was the last surface with one."""
    text = TRIPLET.replace("  STO\n", "") + f"\nSTO S{first}\nSTO S{second}\n"
    assert load_telescope(written(tmp_path, text)).design_data.stop == stop


def test_lenient_warns(tmp_path):
    text = TRIPLET.replace("  STO", "  STO; XYZ 3")
    with pytest.warns(PrescriptionWarning, match="surface 5: XYZ 3: this command is not understood"):
        load_telescope(written(tmp_path, text), lenient=True)


def test_a_file_without_surfaces_is_refused(tmp_path):
    with pytest.raises(PrescriptionError, match="0 surfaces: expected SO"):
        load_telescope(written(tmp_path, "RDM\nEPD 3\n"))


def test_without_rdm_curvatures_are_read(tmp_path):
    """CODE V's default; with RDM after the surfaces they are radii."""
    lens = "LEN\nEPD 1\nWL 550\nYAN 0\nSO 0 1e13\nS 0.1 1 NBK7_SCHOTT\nSTO\nS -0.05 15\nSI 0 0\n"
    for text, curvatures in ((lens, (100.0, -50.0)), (lens + "RDM\n", (1e4, -2e4)), (lens + "RDM N\n", (100.0, -50.0))):
        telescope = load_telescope(written(tmp_path, text))
        # Turned by half a turn about y.
        assert [-s.shape.curvature for s in telescope.surfaces[:2]] == pytest.approx(curvatures, rel=1e-14)


LANDSCAPE = """tit 'Landscape lens'
so 0. 1.0e+10
s 0. 1.664
s -0.2 0.22 nbk7_schott ! radius 5
  cir edg 0.5
s -0.387040626 10.150245
  cir 0.7; cir obs L'A' 0.1
si 0 0
epd 1.0; dim mm
wl 587.5618
yim 0 3
"""


def test_system_data_may_follow_the_surfaces(tmp_path):
    telescope = load_telescope(written(tmp_path, LANDSCAPE))
    # The lens maker's equation of a thick lens, with Schott's nd of N-BK7; curvatures [1/mm].
    n, c1, c2, d = 1.5168, -0.2, -0.387040626, 0.22
    power = (n - 1) * (c1 - c2 + (n - 1) * d * c1 * c2 / n)
    assert first_order(telescope).focal_length == pytest.approx(1e-3 / power, rel=1e-5)
    assert telescope.pupil_diameter == pytest.approx(1e-3, rel=1e-15)
    # No stop is named: the first surface is. An edge stops nothing.
    assert telescope.stop_z == pytest.approx(telescope.surfaces[0].vertex[2], abs=1e-15)
    assert [s.aperture for s in telescope.surfaces] == [None, None, Annulus(1e-4, 7e-4), None]
    # Without SI the image stands behind the last surface.
    without = load_telescope(written(tmp_path, LANDSCAPE.replace("si 0 0\n", "")))
    assert without.surfaces[-1] == telescope.surfaces[-1]


def test_f_numbers_are_those_of_the_cone_to_the_image(tmp_path):
    """One to one: the object 2f in front of a thin lens of f = 100 mm, at f/5 in the image: D = 200 mm / 5."""
    lens = "RDM\nFNO 5\nWL 587.5618\nYOB 0\nSO 0 200\nS 100 1e-6 500000.500000\nSTO\nS -100 200\nSI 0 0\n"
    telescope = load_telescope(written(tmp_path, lens))
    # The lens is 1 nm thick.
    assert telescope.pupil_diameter == pytest.approx(40e-3, rel=1e-7)


def test_reversed_decentres_undo_others(tmp_path):
    """To one side and back, in two legs of 2 sqrt(2) mm at 45 degrees: 2 mm across, 2 mm along."""
    text = (
        "EPD 1\nWL 550\nYAN 0\nSO 0 1e11\nS 0 3\nS 0 2.8284271247461903\nYDE 2; ADE 45\nS 0 3\nREV; ADE 45\n"
        "S 0 2.8284271247461903\nADE -45\nS 0 0\nREV; ADE -45; YDE 2\nS 0 3\nSI 0 0\n"
    )
    telescope = load_telescope(written(tmp_path, text))
    y = [1e3 * s.vertex[1] for s in telescope.surfaces]
    z = [1e3 * (telescope.surfaces[0].vertex[2] - s.vertex[2]) for s in telescope.surfaces]
    # ADE is left-handed about x: it turns +z towards +y.
    assert y == pytest.approx([0, 2, 4, 4, 2, 0, 0], abs=1e-14)
    assert z == pytest.approx([0, 3, 5, 8, 10, 10, 13], abs=1e-13)
    # A reversed surface itself stands in the frame before it.
    tilts = [np.rad2deg(np.arcsin(s.matrix[1, 2])) for s in telescope.surfaces]
    assert np.abs(tilts) == pytest.approx([0, 45, 45, 45, 45, 0, 0], abs=1e-12)
    assert tilts[1] == pytest.approx(tilts[2], rel=1e-14)
    assert tilts[3] == pytest.approx(-tilts[2], rel=1e-14)


def test_pick_ups_take_the_value_of_the_other_surface(tmp_path):
    text = TRIPLET.replace("GO", "PIK RDY S7 Z1 RDY S1 Z1 -1.0\nPIK THI S4 Z1 THI S2 Z1 2.0 0.5\nGO")
    telescope = load_telescope(written(tmp_path, text))
    one, seven = telescope.surface("S1").shape.curvature, telescope.surface("S7").shape.curvature
    assert seven == pytest.approx(-one, rel=1e-15)
    z = [telescope.surface(name).vertex[2] for name in ("S4", "S5")]
    assert z[0] - z[1] == pytest.approx((2 * 2.6377501487731934 + 0.5) * 1e-3, rel=1e-13)


def test_private_glasses(tmp_path):
    catalogue = "PRV\n PWL 700.0 600.0&\n 500.0 450.0\n 'E48' 1.52 1.525&\n 1.533 1.54\nEND\nWL "
    text = TRIPLET.replace("WL ", catalogue).replace("NSK16_SCHOTT", "'E48'")
    glass = load_telescope(written(tmp_path, text)).surface("S1").medium_after
    assert [float(glass.index(w * 1e-9)) for w in (450, 500, 600, 700)] == pytest.approx(
        [1.54, 1.533, 1.525, 1.52], rel=1e-15
    )


def test_private_glasses_may_have_underscores(tmp_path):
    """What follows an underscore is a maker only where the file has no glass of the whole name."""
    text = TRIPLET.replace("WL ", "PRV\n PWL 700.0 450.0\n 'E_48' 1.52 1.54\nEND\nWL ")
    glass = load_telescope(written(tmp_path, text.replace("NSK16_SCHOTT", "'E_48'"))).surface("S1").medium_after
    assert float(glass.index(700e-9)) == 1.52


def test_aspheres_up_to_the_twentieth_power(tmp_path):
    """Letters go on from G, r^16, to H and J: CODE V has no I."""
    powers = "ABCDEFGHJ"
    lines = "".join(f"\n {letter} {(-1) ** i}e-{9 + 2 * i}" for i, letter in enumerate(powers))
    text = TRIPLET.replace("NSK16_SCHOTT", f"NSK16_SCHOTT\n ASP{lines}", 1).replace("648338", "NF2_SCHOTT")
    lens = load_telescope(written(tmp_path, text))
    # In millimetres, along the light.
    expected = sum((-1) ** i * 10.0 ** -(9 + 2 * i) * 3.0 ** (4 + 2 * i) for i in range(9))
    sphere = load_telescope(written(tmp_path, TRIPLET)).surface("S1").shape.sag(0.003, 0.0)
    assert -1e3 * (lens.surface("S1").shape.sag(0.003, 0.0) - sphere) == pytest.approx(expected, rel=1e-9)
    pachon.save_telescope(lens, tmp_path / "again.seq")
    again = load_telescope(tmp_path / "again.seq").surface("S1").shape
    assert again.coefficients == pytest.approx(lens.surface("S1").shape.coefficients, rel=1e-14)


def test_an_object_at_infinity_may_be_written_so(tmp_path):
    telescope = load_telescope(written(tmp_path, TRIPLET.replace("SO    0.0 0.1e14", "SO 0.0 inf")))
    assert telescope == load_telescope(written(tmp_path, TRIPLET))


TELESCOPE_METRICS = """EPD 5.0
WL 587.6
YAN 0.0 3.0
SO 0.0 1e10
S  50.0 5.0  1.5168:64.17
S  -80.0 45.0
SI 0.0 0.0
"""


@pytest.mark.parametrize("aperture", ["EPD 5.0", "FNO 4.0"])
def test_radii_without_rdm_are_read_when_lenient(tmp_path, aperture):
    (tmp_path / "bare.seq").write_text(TELESCOPE_METRICS.replace("EPD 5.0", aperture))
    with pytest.raises(PrescriptionError, match=r"curvature 50: a sphere smaller than .*; expected RDM"):
        load_telescope(tmp_path / "bare.seq")
    with pytest.warns(PrescriptionWarning, match=r"expected RDM .*; the surfaces have radii"):
        found = load_telescope(tmp_path / "bare.seq", lenient=True)
    (tmp_path / "stated.seq").write_text("RDM\n" + TELESCOPE_METRICS.replace("EPD 5.0", aperture))
    stated = load_telescope(tmp_path / "stated.seq")
    assert [s.shape for s in found.surfaces] == [s.shape for s in stated.surfaces]
    # The glass is given by its index and Abbe number.
    d, f, c = (
        float(np.squeeze(stated.surfaces[0].medium_after.index(w))) for w in (587.5618e-9, 486.1327e-9, 656.2725e-9)
    )
    assert d == pytest.approx(1.5168, abs=1e-9)
    assert (d - 1.0) / (f - c) == pytest.approx(64.17, rel=1e-6)


def test_solves_whose_solution_stands_in_the_file_are_passed_over(tmp_path):
    """CODE V writes the solved curvature at the beginning of the surface, and the solve behind it."""
    text = "RDM;LEN\nEPD 20\nDIM M\nWL 500\nSO 0 1e13\nS 50 5 1.5:60\n  STO\nS {} 96.5\n  CUY UMY -0.1\n  PIM\nSI 0 0\n"
    text += "  UID '9D3F'; DOR 1\nGO\n"
    (tmp_path / "lens.seq").write_text(text.format(1175.7))
    lens = load_telescope(tmp_path / "lens.seq")
    assert lens.surfaces[1].shape.parameters["radius"] == pytest.approx(-1.1757)
    (tmp_path / "lens.seq").write_text(text.format(0))
    with pytest.raises(
        PrescriptionError, match=r"CUY UMY -0\.1: expected the curvature of the solve in the file; it is 0"
    ):
        load_telescope(tmp_path / "lens.seq")
    (tmp_path / "lens.seq").write_text(text.format(1175.7).replace("DIM M", "DIM M\nZOO 3"))
    with pytest.raises(PrescriptionError, match="ZOO 3: zoom positions are not read"):
        load_telescope(tmp_path / "lens.seq")
