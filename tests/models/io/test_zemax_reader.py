"""Zemax lens files: what the parts of a file become, the real ones of other projects, and what is refused."""

import math
import random
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pachon.core.errors import PachonError, PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Annulus, Circle, Complement, Ellipse, Rectangle, Union
from pachon.models.first_order import first_order
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.shapes.freeform import Biconic, OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.qbfs import QbfsAsphere
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import IDENTITY, Interaction

#: Where a glass takes the place of the mirror, the light goes back within it.
pytestmark = pytest.mark.filterwarnings("ignore:.*of thickness -500 mm")

DATA = Path(__file__).parents[2] / "data" / "zmx"
FILES = sorted(DATA.glob("*.zmx"))

MIRROR = """VERS 190513 30 123457 L123457
MODE SEQ
NAME one mirror
UNIT MM X W X CM MR CPMM
ENPD 100
ENVD 20 1 0
GCAT SCHOTT
FTYP 0 0 2 1 0 0 0
XFLN 0 0.3 0
YFLN 0 0.4 0
WAVM 1 0.55 1
WAVM 2 0.7 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
SURF 1
  COMM front
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 400
SURF 2
  STOP
  TYPE STANDARD
  CURV -0.001 0 0 0 0 ""
  DISZ -500
  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0
  DIAM 50 0 0 0 1 ""
SURF 3
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
BLNK
TOL TOFF   0   0
MNUM 1 1
"""


def written(tmp_path, text, encoding="utf-8", name="lens.zmx"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


def with_surface(tmp_path, lines):
    """The mirror's lines with others in place of TYPE and CURV."""
    text = MIRROR.replace('  TYPE STANDARD\n  CURV -0.001 0 0 0 0 ""\n', "".join(f"  {line}\n" for line in lines))
    text = text.replace('  DIAM 50 0 0 0 1 ""\n', "")
    return load_telescope(written(tmp_path, text)).surfaces[1]


def test_a_mirror_and_the_axes(tmp_path):
    telescope = load_telescope(written(tmp_path, MIRROR))
    front, mirror, image = telescope.surfaces
    assert (front.name, mirror.name, image.name) == ("front", "S2", "Image")
    kinds = [s.interaction for s in telescope.surfaces]
    assert kinds == [Interaction.PASS, Interaction.MIRROR, Interaction.DETECTOR]
    # Light comes from +z: the front plane is above the mirror, which is the origin, and so is the focus; the centre of
    # curvature lies where the light comes from.
    assert [s.vertex for s in telescope.surfaces] == [(0, 0, 0.4), (0, 0, 0), (0, 0, 0.5)]
    assert mirror.shape == Sphere(1.0)
    assert all(s.rotation == IDENTITY for s in telescope.surfaces)
    assert (telescope.stop_z, telescope.pupil_diameter) == (0.0, 0.1)
    assert telescope.field_radius == pytest.approx(np.deg2rad(0.5), rel=1e-15)
    assert telescope.default_wavelength == 550e-9
    assert telescope.object_distance == np.inf
    assert (telescope.name, telescope.description) == ("lens", "one mirror")
    figures = first_order(telescope)
    assert figures.focal_length == pytest.approx(0.5, rel=1e-15)
    assert figures.focus_z == pytest.approx(0.5, rel=1e-15)


@pytest.mark.parametrize("unit", ["MM 0.001", "CM 0.01", "IN 0.0254", "METER 1"])
def test_lens_units(tmp_path, unit):
    name, metres = unit.split()
    telescope = load_telescope(written(tmp_path, MIRROR.replace("UNIT MM", f"UNIT {name}")))
    assert telescope.surfaces[1].shape.radius == pytest.approx(1000 * float(metres), rel=1e-15)
    assert telescope.pupil_diameter == pytest.approx(100 * float(metres), rel=1e-15)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "iso-8859-1"])
def test_encodings(tmp_path, encoding):
    text = MIRROR.replace("NAME one mirror", "NAME Größe Ø").replace("\n", "\r\n")
    assert load_telescope(written(tmp_path, text, encoding)).description == "Größe Ø"


# Points of a surface's own frame [mm], and the sag there restated from Zemax's manual.
X, Y = np.array([3.0, -7.0, 0.5]), np.array([4.0, 1.0, -9.0])
R2 = X**2 + Y**2


def conic_sag(c, k, r2):
    return c * r2 / (1 + np.sqrt(1 - (1 + k) * c**2 * r2))


def turned(g, radius):
    """A point g of the curve in y on its circle about an axis: radius - sqrt((radius - g)^2 - x^2)."""
    return g + X**2 / (radius - g + np.sqrt((radius - g) ** 2 - X**2))


SHAPES = {
    "standard": (["TYPE STANDARD", "CURV -0.01", "CONI -1.5"], conic_sag(-0.01, -1.5, R2), Conic),
    "flat": (["TYPE STANDARD", "CURV 0.0"], 0 * X, Plane),
    "even asphere": (
        ["TYPE EVENASPH", "CURV 0.01", "CONI 0.5", "PARM 1 0", "PARM 2 1e-6", "PARM 3 -2e-9", "PARM 8 1e-18"],
        conic_sag(0.01, 0.5, R2) + 1e-6 * R2**2 - 2e-9 * R2**3 + 1e-18 * R2**8,
        EvenAsphere,
    ),
    "even asphere with r^2": (
        ["TYPE EVENASPH", "CURV 0.01", "PARM 1 1e-3", "PARM 2 1e-6"],
        conic_sag(0.01, 0, R2) + 1e-3 * R2 + 1e-6 * R2**2,
        Sum,
    ),
    "Schmidt plate": (
        ["TYPE EVENASPH", "CURV 0.0", "PARM 2 1e-6", "PARM 4 2e-9"],
        1e-6 * R2**2 + 2e-9 * R2**4,
        None,
    ),
    "odd asphere": (
        ["TYPE ODDASPHE", "CURV 0.01", "PARM 1 1e-3", "PARM 3 2e-6"],
        conic_sag(0.01, 0, R2) + 1e-3 * np.sqrt(R2) + 2e-6 * R2**1.5,
        OddAsphere,
    ),
    "biconic": (
        ["TYPE BICONICX", "CURV 0.01", "CONI -0.3", "PARM 1 200", "PARM 2 0.7"],
        (X**2 / 200 + 0.01 * Y**2) / (1 + np.sqrt(1 - 1.7 * X**2 / 200**2 - 0.7 * 0.01**2 * Y**2)),
        Biconic,
    ),
    "toroid": (
        ["TYPE TOROIDAL", "CURV 0.01", "CONI -0.3", "PARM 1 200", "XDAT 1 0"],
        # The circle about an axis at 200 along z that the profile's point of this y runs on.
        200 - np.sqrt((200 - conic_sag(0.01, -0.3, Y**2)) ** 2 - X**2),
        Toroid,
    ),
    "toroid with powers": (
        ["TYPE TOROIDAL", "CURV 0.01", "PARM 1 200", "PARM 2 1e-3", "PARM 4 2e-7", "XDAT 1 0"],
        turned(conic_sag(0.01, 0, Y**2) + 1e-3 * Y**2 + 2e-7 * Y**6, 200),
        Toroid,
    ),
    "cylinder": (["TYPE TOROIDAL", "CURV 0.01", "PARM 1 0"], conic_sag(0.01, 0, Y**2), Toroid),
    "Zernike sag": (
        # Z2 = 2 x, Z3 = 2 y, Z4 = sqrt 3 (2 r^2 - 1), Z7 = sqrt 8 (3 r^2 - 2) y, Z10 = sqrt 8 (x^3 - 3 x y^2).
        [
            "TYPE SZERNSAG",
            "CURV 0.01",
            "PARM 2 1e-6",
            "XDAT 1 10 0 0 1 0 0",
            "XDAT 2 20",
            "XDAT 4 0.01",
            "XDAT 5 0.02",
            "XDAT 6 0.03",
            "XDAT 9 0.04",
            "XDAT 12 0.05",
        ],
        conic_sag(0.01, 0, R2)
        + 1e-6 * R2**2
        + 0.01 * 2 * X / 20
        + 0.02 * 2 * Y / 20
        + 0.03 * np.sqrt(3) * (2 * R2 / 400 - 1)
        + 0.04 * np.sqrt(8) * (3 * R2 / 400 - 2) * Y / 20
        + 0.05 * np.sqrt(8) * (X**3 - 3 * X * Y**2) / 20**3,
        Sum,
    ),
    "Fringe Zernike sag": (
        # Z2 = x, Z4 = 2 r^2 - 1, Z5 = x^2 - y^2, Z8 = (3 r^2 - 2) y, Z9 = 6 r^4 - 6 r^2 + 1.
        [
            "TYPE FZERNSAG",
            "CURV 0.01",
            "CONI 0.2",
            "PARM 2 1e-6",
            "XDAT 1 9 0 0 1 0 0",
            "XDAT 2 20",
            "XDAT 4 0.01",
            "XDAT 6 0.02",
            "XDAT 7 0.03",
            "XDAT 10 0.04",
            "XDAT 11 0.05",
        ],
        conic_sag(0.01, 0.2, R2)
        + 1e-6 * R2**2
        + 0.01 * X / 20
        + 0.02 * (2 * R2 / 400 - 1)
        + 0.03 * (X**2 - Y**2) / 400
        + 0.04 * (3 * R2 / 400 - 2) * Y / 20
        + 0.05 * (6 * R2**2 / 400**2 - 6 * R2 / 400 + 1),
        Sum,
    ),
    "Qbfs": (
        ["TYPE QED_TYPE", "CURV 0.01", "XDAT 1 0", "XDAT 2 2", "XDAT 3 12", "XDAT 4 0.02", "XDAT 5 -0.01"],
        conic_sag(0.01, 0, R2)
        + R2 / 144 * (1 - R2 / 144) / np.sqrt(1 - 1e-4 * R2) * (0.02 - 0.01 * (13 - 16 * R2 / 144) / np.sqrt(19)),
        QbfsAsphere,
    ),
    "extended asphere": (
        ["TYPE XASPHERE", "CURV 0.01", "CONI 0.5", "XDAT 1 3", "XDAT 2 10", "XDAT 4 0.01", "XDAT 5 0.02"],
        conic_sag(0.01, 0.5, R2) + 0.01 * (R2 / 100) ** 2 + 0.02 * (R2 / 100) ** 3,
        EvenAsphere,
    ),
    "tilted plane": (["TYPE TILTSURF", "PARM 1 0.1", "PARM 2 -0.2"], 0.1 * X - 0.2 * Y, None),
    "extended polynomial": (
        [
            "TYPE XPOLYNOM",
            "CURV 0.01",
            "XDAT 1 9",
            "XDAT 2 10",
            "XDAT 4 0.1",
            "XDAT 6 0.2",
            "XDAT 10 0.3",
            "XDAT 11 0.4",
        ],
        # Terms 2 y, 4 xy, 8 x y^2, 9 y^3.
        conic_sag(0.01, 0, R2) + 0.1 * Y / 10 + 0.2 * X * Y / 100 + 0.3 * X * Y**2 / 1000 + 0.4 * Y**3 / 1000,
        Sum,
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_have_the_sag_of_the_manual(tmp_path, name):
    lines, sag, kind = SHAPES[name]
    surface = with_surface(tmp_path, lines)
    assert kind is None or isinstance(surface.shape, kind)
    # Half a turn about y: a point (x, y, z) is (-x, y, -z) here. Rounding of sags of some mm: 1e-17 m.
    assert surface.shape.sag(-X * 1e-3, Y * 1e-3) == pytest.approx(-sag * 1e-3, rel=1e-13, abs=1e-18)


def test_a_grid_has_its_nodes_where_zemax_has_them(tmp_path):
    # 5 x 4 nodes: x runs first, from -x; rows from the top, at steps of 2 and 3 mm.
    values = np.arange(20.0) ** 1.5 * 1e-3
    lines = ["TYPE GRID_SAG", "CURV 0.0", "GDAT 5 4 2 3"] + [
        f"GARR {i} {v:.17g} 0 0 0" for i, v in enumerate(values, 1)
    ]
    shape = with_surface(tmp_path, lines).shape
    assert isinstance(shape, GridSag)
    for row in range(4):
        for column in range(5):
            x, y = 2e-3 * (column - 2), 3e-3 * (1.5 - row)
            # Inside the grid by 1e-12 of it: a rim counts to neither side.
            found = float(shape.sag(-x * (1 - 1e-12), y * (1 - 1e-12)))
            assert found == pytest.approx(-values[5 * row + column] * 1e-3, abs=1e-15)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["CLAP 0 30 0"], Circle(0.03, 0.0, 0.0)),
        (["CLAP 10 30 0", "OBDC 2 5"], Annulus(0.01, 0.03, -0.002, 0.005)),
        (["OBSC 0 12 0"], Complement(Circle(0.012))),
        (["ELAP 3 4 0", "OBDC 1 0"], Ellipse(0.003, 0.004, -0.001, 0.0)),
        (["ELOB 3 4 0"], Complement(Ellipse(0.003, 0.004))),
        (["SQAP 3 4 0", "OBDC 1 0"], Rectangle(0.006, 0.008, -0.001, 0.0)),
        (["SQOB 3 4 0"], Complement(Rectangle(0.006, 0.008))),
        # A floating aperture clips where its semi-diameter is fixed, and not where it is automatic.
        (["DIAM 50 1 0 0 1", "FLAP 0 50 0"], Circle(0.05)),
        (["DIAM 50 0 0 0 1", "FLAP 0 50 0"], None),
        (["DIAM 50 1 0 0 1"], None),
    ],
)
def test_apertures(tmp_path, lines, expected):
    found = with_surface(tmp_path, ["TYPE STANDARD", "CURV -0.001", *lines]).aperture
    if expected is None:
        assert found is None
        return
    x, y = np.meshgrid(np.linspace(-0.06, 0.06, 81) + 1e-5, np.linspace(-0.06, 0.06, 81) + 1e-5)
    assert type(found) is type(expected)
    assert np.array_equal(found.contains(x, y), expected.contains(x, y))


def test_a_spider_has_its_arms_at_equal_angles_from_x(tmp_path):
    spider = with_surface(tmp_path, ["TYPE STANDARD", "CURV -0.001", "SPID 2 3 0"]).aperture
    assert isinstance(spider, Complement)
    assert isinstance(spider.part, Union)
    # Arms of Zemax at 0, 120 and 240 degrees from +X are at 180, 60 and 300 from +x.
    angles = np.deg2rad([180, 60, 300, 0, 120, 240])
    assert spider.contains(0.02 * np.cos(angles), 0.02 * np.sin(angles)).tolist() == [False] * 3 + [True] * 3


def test_glasses_come_from_given_catalogues_one_beside_the_file_and_the_bundled_one(tmp_path):
    lens = MIRROR.replace("GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0", "GLAS {} 0 0 1.5 40 0 0 0 0 0 0")
    path = written(tmp_path, lens.format("n-bk7"))
    assert load_telescope(path).surfaces[1].medium_after == GlassCatalogue.bundled()["N-BK7"]
    path.with_suffix(".agf").write_text("NM N-BK7 1 0 1.5 60\nCD 2.25\nLD 0.4 1.0\n", encoding="utf-8")
    assert float(load_telescope(path).surfaces[1].medium_after.index(5.5e-7)) == 1.5
    other = tmp_path / "other.agf"
    other.write_text("NM N-BK7 1 0 1.5 60\nCD 2.56\nLD 0.4 1.0\n", encoding="utf-8")
    for given in (other, GlassCatalogue.read(other)):
        found = load_telescope(path, glass_catalogues=[given]).surfaces[1].medium_after
        assert float(found.index(5.5e-7)) == 1.6


def test_a_model_glass_has_the_figures_of_the_file(tmp_path):
    text = MIRROR.replace("GLAS MIRROR 0 0 1.5 40", "GLAS ___BLANK 1 0 1.62 36.0")
    medium = load_telescope(written(tmp_path, text)).surfaces[1].medium_after
    assert float(medium.index(0.5875618e-6)) == pytest.approx(1.62, abs=1e-14)


def test_a_glass_of_no_catalogue_is_an_error_or_a_model_glass_with_a_warning(tmp_path):
    path = written(tmp_path, MIRROR.replace("GLAS MIRROR 0 0 1.5 40", "GLAS N-NONE 0 0 1.62 36.0"))
    with pytest.raises(PrescriptionError, match=r"surface 2: GLAS N-NONE .*the glass is in no catalogue"):
        load_telescope(path)
    with pytest.warns(PrescriptionWarning, match="N-NONE"):
        medium = load_telescope(path, lenient=True).surfaces[1].medium_after
    assert float(medium.index(0.5875618e-6)) == pytest.approx(1.62, abs=1e-14)


def test_the_stop_inside_makes_a_paraxial_entrance_pupil(tmp_path):
    # A thin lens of focal length f with the stop at d behind it: the pupil is at d f / (f - d) behind the lens,
    # magnified by f / (f - d).
    text = MIRROR.replace("  STOP\n", "").replace("GLAS MIRROR 0 0 1.5 40", "GLAS G 1 0 1.5 0")
    text = text.replace('  CURV -0.001 0 0 0 0 ""\n  DISZ -500', "  CURV 0.01\n  DISZ 0")
    text = text.replace(
        "SURF 3\n  TYPE STANDARD\n", "SURF 3\n  TYPE STANDARD\n  CURV -0.01\n  DISZ 20\nSURF 4\n  STOP\n"
    )
    text = text.replace("ENPD 100", "FLOA").replace(
        "  DISZ 0\nBLNK", "  DISZ 80\n  DIAM 8 1\nSURF 5\n  TYPE STANDARD\nBLNK"
    )
    telescope = load_telescope(written(tmp_path, text))
    f, d = 100.0, 20.0
    assert telescope.stop_z == pytest.approx(-d * f / (f - d) * 1e-3, rel=1e-14)
    assert telescope.pupil_diameter == pytest.approx(16e-3 * f / (f - d), rel=1e-14)
    telescope = load_telescope(written(tmp_path, text.replace("FLOA", "FNUM 4 0")))
    assert telescope.pupil_diameter == pytest.approx(25e-3, rel=1e-14)


def test_a_stop_in_the_focal_plane_has_no_entrance_pupil(tmp_path):
    # The focus of the mirror is 500 mm in front of it.
    text = MIRROR.replace("  STOP\n", "").replace("SURF 3\n", "SURF 3\n  STOP\n")
    with pytest.raises(PrescriptionError, match=r"entrance pupil at infinity \(telecentric\)"):
        load_telescope(written(tmp_path, text))


@pytest.mark.parametrize(
    ("kind", "distance", "expected"),
    [
        # Angles of 0.3 and 0.4 degrees; heights of 0.3 and 0.4 mm at 500 mm focal length, and in an object that stands
        # 2000 mm in front of the pupil: 1600 mm from the first surface, which is 400 mm from the mirror.
        (0, "INFINITY", np.deg2rad(0.5)),
        (2, "INFINITY", np.arctan(0.5 / 500)),
        (3, "INFINITY", np.arctan(0.5 / 500)),
        (1, "1600", np.arctan(0.5 / 2000)),
    ],
)
def test_fields_are_angles_or_heights(tmp_path, kind, distance, expected):
    # Ten times the heights, to be above the least field.
    text = MIRROR.replace("FTYP 0", f"FTYP {kind}").replace("DISZ INFINITY", f"DISZ {distance}")
    text = text if kind == 0 else text.replace("FLN 0 0.", "FLN 0 ")
    telescope = load_telescope(written(tmp_path, text))
    scale = 1.0 if kind == 0 else np.tan(telescope.field_radius) / np.tan(expected)
    assert scale == pytest.approx(1.0 if kind == 0 else 10.0, rel=1e-14)
    assert kind != 0 or telescope.field_radius == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("MODE SEQ", "MODE NSC", "MODE NSC: expected SEQ"),
        ("UNIT MM", "UNIT FURLONG", r"line \d+: UNIT FURLONG: expected one of MM"),
        ("ENPD 100", "ENPD -1", "line 5: ENPD -1: expected an entrance pupil of finite size"),
        ("ENPD 100\n", "", "expected the aperture: a line ENPD, FNUM or FLOA"),
        ("ENPD 100", "ENPX 100", "line 5: ENPX 100: this keyword is not understood"),
        ("ENPD 100", "ENPD ten", "line 5: ENPD ten: expected a number in place of 'ten'"),
        ("WAVM 1 0.55 1\n", "", "WAVM 1 is missing"),
        ("WAVM 1 0.55 1", "WAVM 1 -0.55 1", r"line \d+: WAVM 1 -0.55 1: expected positive wavelengths"),
        ("PWAV 1", "PWAV 9", r"line \d+: PWAV 9: expected 1 to 1"),
        ("XFLN 0 0.3 0", "XFLN 0 120 0", r"line \d+: XFLN: expected fields within 89 degrees"),
        ("FTYP 0", "FTYP 7", r"line \d+: FTYP 7: expected 0 to 3"),
        ("  STOP\n", "", "no surface is the stop"),
        ("SURF 2", "SURF 7", "SURF 7: expected surface 2 here"),
        ("  DISZ -500", "  DISZ INFINITY", "surface 2: DISZ INFINITY: expected a finite thickness"),
        ("  DISZ -500", "  DISZ -5_00", "surface 2: DISZ -5_00: expected a number"),
        (
            "TYPE STANDARD\n  CURV -0.001",
            "TYPE FRESNELS\n  CURV -0.001",
            "surface 2: TYPE FRESNELS: expected one of STANDARD",
        ),
        (
            "TYPE STANDARD\n  CURV -0.001",
            "TYPE STANDARD\n  PARM 1 3\n  CURV -0.001",
            "surface 2: PARM 1 3: not understood",
        ),
        (
            "TYPE STANDARD\n  CURV -0.001",
            "TYPE STANDARD\n  XDAT 1 3\n  CURV -0.001",
            "surface 2: XDAT 1 3: not understood",
        ),
        (
            "  DIAM 50",
            "  USAP 3 4\n  DIAM 50",
            "surface 2: USAP 3 4: user-defined apertures are read where USAP or USOB names",
        ),
        ("  DIAM 50", "  NEWK 3 4\n  DIAM 50", "surface 2: NEWK 3 4: this keyword is not understood"),
        ("ENVD 20 1 0", "ENVD 20 1 0\nNEWH 3", "line 7: NEWH 3: this keyword is not understood"),
        ("ENVD 20 1 0", "ENVD 5 0.7 1", "ENVD 5 0.7 1: indices are not adjusted"),
        ("  DIAM 50", "  SCBD 1 1 0 0 0 5 0 0\n  DIAM 50", "surface 2: SCBD .*only a tilt before the surface"),
        ("  DIAM 50", "  CLAP 30 20\n  DIAM 50", "surface 2: CLAP 30 20: expected a smallest and a largest radius"),
        ("TYPE STANDARD\n  CURV -0.001", "TYPE COORDBRK\n  PARM 9 1", "surface 2: PARM 9 1"),
        (
            "TYPE STANDARD\n  CURV -0.001",
            "TYPE GRID_SAG\n  GDAT 2 2 1 1",
            "GDAT 2 2 1 1 .*expected at least 4 x 4 nodes",
        ),
        ("TYPE STANDARD\n  CURV -0.001", "TYPE GRID_SAG\n  GDAT 4 4 1 1", "16 lines GARR; that of node 1 is missing"),
        ("TYPE STANDARD\n  CURV -0.001", "TYPE SZERNSAG\n  XDAT 1 4", "a positive normalisation radius"),
        ("GLAS MIRROR 0 0 1.5 40", "GLAS SF11 0 0 1.5 40", None),
        ("WAVM 1 0.55 1", "WAVM 1 55 1", None),
    ],
)
def test_what_is_not_understood_is_one_line_with_file_surface_and_keyword(tmp_path, old, new, expected):
    assert old in MIRROR
    path = written(tmp_path, MIRROR.replace(old, new, 1))
    if expected is None:
        assert load_telescope(path)
        return
    with pytest.raises(PrescriptionError, match=expected) as error:
        load_telescope(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_lenient_warns_of_each_thing_left_out(tmp_path):
    text = MIRROR.replace("  DIAM 50", "  NEWK 3 4\n  USAP 1 2\n  DIAM 50").replace("GCAT", "NEWH 1\nGCAT")
    with pytest.warns(PrescriptionWarning) as caught:
        telescope = load_telescope(written(tmp_path, text), lenient=True)
    assert sorted(str(w.message).split(": ")[1].split()[0] for w in caught) == ["NEWH", "NEWK", "USAP"]
    assert telescope.surfaces[1].aperture is None


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_real_files_load_without_leniency_or_warning(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        telescope = load_telescope(path)
    assert telescope.surfaces[-1].interaction == Interaction.DETECTOR


@pytest.mark.parametrize(
    ("name", "focal_length", "tolerance"),
    [
        # "f=1.49mm", "f=15 mm": as many digits as the catalogues print; lens1: ENPD is a third of 25 mm, at f/3.
        ("354710-C", 1.49e-3, 1e-6),
        ("lens_thorlabs_iso_8859_1", 15e-3, 5e-4),
        ("lens1", 25e-3, 2e-7),
        # Two mirrors: 1/f = 1/f1 + 1/f2 - d/(f1 f2), from the curvatures of the file [1/mm].
        (
            "HoO-V2C18Ex03",
            1e-3 / (2 * 2.187226596675415774e-2 - 2 * 5.2083333e-2 * (1 - 16 * 2 * 2.187226596675415774e-2)),
            1e-7,
        ),
    ],
)
def test_focal_lengths_of_real_files(name, focal_length, tolerance):
    figures = first_order(load_telescope(DATA / f"{name}.zmx"))
    assert figures.focal_length == pytest.approx(focal_length, rel=tolerance)


def test_a_file_by_f_number_has_the_pupil_that_makes_it():
    assert first_order(load_telescope(DATA / "HoO-V2C18Ex03.zmx")).f_number == pytest.approx(4.0, rel=1e-14)


def test_catalogue_lenses_have_their_focus_where_the_file_has_the_image():
    # The files were focused for the wavelength on the axis, the second by best focus: a micrometre in 1.5 and 15 mm.
    for name in ("354710-C", "lens_thorlabs_iso_8859_1"):
        telescope = load_telescope(DATA / f"{name}.zmx")
        assert first_order(telescope).focus_z == pytest.approx(telescope.surfaces[-1].vertex[2], abs=1e-6)


def test_a_file_without_indentation_ends_its_surfaces_all_the_same(tmp_path):
    text = "\n".join(line.strip() for line in MIRROR.splitlines())
    assert load_telescope(written(tmp_path, text)) == load_telescope(written(tmp_path, MIRROR))


def test_a_cylinder_without_curvature_is_a_plane(tmp_path):
    assert with_surface(tmp_path, ["TYPE TOROIDAL", "CURV 0.0", "PARM 1 0", "XDAT 1 0", "XDAT 2 100"]).shape == Plane()


def test_an_object_at_a_finite_distance_is_kept():
    telescope = load_telescope(DATA / "US05831776-1.zmx")
    # DISZ of the object, from the first lens, whose vertex is the origin.
    assert telescope.object_distance == pytest.approx(0.1108588354359, rel=1e-14)


def test_a_finite_object_is_written_as_ours_too(tmp_path):
    telescope = load_telescope(DATA / "US05831776-1.zmx")
    save_telescope(telescope, tmp_path / "lens.yaml")
    assert load_telescope(tmp_path / "lens.yaml") == telescope
    with pytest.raises(PrescriptionError, match="object_distance = "):
        replace(telescope, object_distance=telescope.stop_z)


WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "INFINITY",
    "abc",
    "-0",
    "1e400",
    "9999999999",
    "COORDBRK",
    "MIRROR",
    "TOROIDAL",
)
WORDS += ("SZERNSAG", "GRID_SAG", "XPOLYNOM", "BICONICX", "ODDASPHE", "é")
LINES = ("GLAS MIRROR", "CLAP 1 2", "SQAP 1 1", "XDAT 1 5", "XDAT 2 3", "GDAT 5 5 1 1", "GARR 1 0", "STOP", "SPID 1 3")
LINES += ("PARM 1 3", "SCBD 1 0 0 1 1 1 1 1", "CONI 5", "DISZ INFINITY", "FLAP 0 1", "TYPE BICONICX", "SURF 3")


def mutated(text, rng):
    lines = text.split("\n")
    for _ in range(rng.randint(1, 4)):
        i, kind = rng.randrange(len(lines)), rng.randrange(6)
        if kind <= 1:
            words = lines[i].split(" ")
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[i] = " ".join(words)
        elif kind == 2:
            del lines[i]
        elif kind == 3:
            lines.insert(i, lines[rng.randrange(len(lines))])
        elif kind == 4:
            lines[i] = lines[i][: rng.randrange(len(lines[i]) + 1)]
        else:
            lines.insert(i, "  " + rng.choice(LINES))
    return "\n".join(lines)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_mutilated_files_end_in_one_line_and_nothing_else(tmp_path, path):
    rng = random.Random(path.stem)
    raw = path.read_bytes()
    text = raw.decode("utf-16" if raw.startswith(b"\xff\xfe") else "iso-8859-1")
    refused = []
    for _ in range(40):
        broken = written(tmp_path, mutated(text, rng), rng.choice(["utf-8", "utf-16"]))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", PrescriptionWarning)
                load_telescope(broken, lenient=rng.random() < 0.5)
        except PachonError as error:
            refused.append(str(error))
    assert 0 < len(refused) < 40
    assert [text for text in refused if not text.startswith(str(broken)) or "\n" in text] == []


def test_a_picked_up_model_glass(tmp_path):
    text = MIRROR.replace(
        "  DISZ 400", "  GLAS ___BLANK 2 1 1.489 57.4 0 0 0 0 0 0\n  STUD 1\n  OEMA 2 0 0\n  DISZ 400"
    )
    text = text.replace("GLAS MIRROR 0 0 1.5 40", "GLAS BK7 0 0 1.5 40").replace("MODE SEQ", "MODE SEQ\nDBDT 1 2")
    glass = load_telescope(written(tmp_path, text)).surfaces[0].medium_after
    d, f, c = (float(glass.index(w)) for w in (0.5875618e-6, 0.4861327e-6, 0.6562725e-6))
    assert (d, (d - 1) / (f - c)) == pytest.approx((1.489, 57.4), rel=1e-10)


@pytest.mark.parametrize("figures", ["0 0 1.5 40 0", "0 0 1.50E+00 4.00E+01 0", "0 0 0 0 0", ""])
def test_placeholders_behind_an_unknown_glass_are_no_indices(tmp_path, figures):
    """Zemax writes 1.5 and 40 behind every name: taken for indices they made another lens."""
    path = written(tmp_path, MIRROR.replace("GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0", f"GLAS NONESUCH {figures}"))
    for lenient in (False, True):
        with pytest.raises(PrescriptionError, match=r"surface 2: GLAS NONESUCH.*: the glass is in no catalogue"):
            load_telescope(path, lenient=lenient)


def test_a_telecentric_object_space_has_its_pupil_by_the_numerical_aperture(tmp_path):
    finite = MIRROR.replace("DISZ INFINITY", "DISZ 1600").replace("FTYP 0 0", "FTYP 1 1")
    telescope = load_telescope(written(tmp_path, re.sub("ENPD .*", "OBNA 0.02", finite)))
    assert telescope.design_data.telecentric
    # The beam of one point at the first surface, which is 1600 mm from the object.
    assert telescope.object_distance - telescope.stop_z == pytest.approx(1.6, rel=1e-14)
    assert telescope.stop_z == telescope.surfaces[0].vertex[2]
    assert telescope.pupil_diameter == pytest.approx(3.2 * math.tan(math.asin(0.02)), rel=1e-14)
    # The second word makes the number an angle from the axis, as of a cone of 3 deg; in glass its sine counts more.
    cone = re.sub("ENPD .*", "OBNA 3 1", finite)
    pupil = 3.2 * math.tan(math.radians(3.0))
    assert load_telescope(written(tmp_path, cone)).pupil_diameter == pytest.approx(pupil, rel=1e-14)
    immersed = cone.replace("DISZ 1600", "DISZ 1600\n  GLAS N-BK7")
    assert load_telescope(written(tmp_path, immersed)).pupil_diameter == pytest.approx(pupil, rel=1e-13)
    with pytest.raises(PrescriptionError, match="OBNA 90 1: expected an angle between the axis and the cone"):
        load_telescope(written(tmp_path, cone.replace("OBNA 3 1", "OBNA 90 1")))
    # Of an object at infinity it means nothing.
    assert not load_telescope(written(tmp_path, MIRROR.replace("FTYP 0 0", "FTYP 0 1"))).design_data.telecentric
    with pytest.raises(PrescriptionError, match="telecentric: expected object or image heights as fields"):
        load_telescope(written(tmp_path, finite.replace("FTYP 1 1", "FTYP 0 1")))


def test_the_f_number_of_a_cylinder_is_that_of_its_curved_section(tmp_path):
    """One mirror of 1 m radius along y, flat along x, at f/5: f = 500 mm, D = 100 mm."""
    cylinder = "  TYPE BICONICX\n  PARM 1 0\n  PARM 2 0\n  CURV -0.001"
    text = MIRROR.replace("  TYPE STANDARD\n  CURV -0.001", cylinder).replace("ENPD 100", "FNUM 5 0")
    assert load_telescope(written(tmp_path, text)).pupil_diameter == pytest.approx(0.1, rel=1e-14)


@pytest.mark.parametrize("count", ["FTYP 0 0 3 3", "FTYP 0"])
def test_lists_of_fields_and_wavelengths_of_old_files(tmp_path, count):
    """``XFLD``, ``YFLD``, ``WAVL`` of the first files, and ``WAVN``, filled up to its longest; ``TOLE`` is no datum."""
    lines = {
        "FTYP 0 0 2 1 0 0 0\nXFLN 0 0.3 0\nYFLN 0 0.4 0\n": f"{count}\nXFLD 0 0.3 0\nYFLD 0 0.4 0.5\nTOLE 1 2\n",
        "WAVM 1 0.55 1\nWAVM 2 0.7 1\nPWAV 1\n": "WAVL 0.5 0.6 0.7\nWWGT 1 1 1\nWAVN 0.51 0.61 0.71 0 0 0\n"
        "WWGN 1 2 1 1 1 1\nPWAV 2\n",
    }
    text = MIRROR
    for old, new in lines.items():
        assert old in text
        text = text.replace(old, new)
    data = load_telescope(written(tmp_path, text)).design_data
    assert data.wavelengths == pytest.approx((0.51e-6, 0.61e-6, 0.71e-6))
    assert data.wavelength_weights == (1.0, 2.0, 1.0)
    assert np.rad2deg(data.fields) == pytest.approx(np.array([[0, 0], [-0.3, 0.4], [0, 0.5]]), abs=1e-12)
