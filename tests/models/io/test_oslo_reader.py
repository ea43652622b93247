"""OSLO lens files against closed forms and the same lenses in other formats, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle
from pachon.models.first_order import first_order
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.rotation import rotation_matrix
from pachon.models.shapes.freeform import OddAsphere, Toroid
from pachon.models.shapes.polynomial import XYPolynomial
from pachon.models.shapes.shape import Conic, EvenAsphere, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction

DATA = Path(__file__).parents[2] / "data"

# The doublet of the OSLO User's Guide, "Assignment commands", as it stands there.
GUIDE = """// OSLO 5.00 31567     0     0
LEN NEW "He-ne f/2 doublet focusing lens" 60 5
EBR  15.0
ANG  0.0000572957795
DES  "OSLO"
UNI  1.0
SNO1 "This is the completed Lens entry Doublet lens example; from the // User Guide."
SNO2 "Note that variables and operands have not yet been introduced."
AIR
TH   1.0e+20
AP  9.9999999977e+13
NXT
GLA LASF35
RD   100.0
TH   5.0
NXT
AIR
TH   1.0
NXT
PK  GLA  -2
RD   50.0
TH   5.0
NXT
AIR
PU   -0.25
PY   0.0
NXT
AIR
CALLBACK  1
GPRT On
WV 0.6328
WW 1.0
END  5
"""


def lens(tmp_path, *surfaces, system="EBR 5.0\nANG 2.0\nUNI 1.0", distance="1e20", image="", after="", name="lens.len"):
    """Write a lens of surfaces, each a text of commands, and return its path."""
    blocks = [f"AIR\nTH {distance}", *surfaces, f"AIR\n{image}\nWV 0.58756 0.48613 0.65627"]
    text = f'LEN NEW "test" 100 {len(blocks) - 1}\n{system}\n' + "\nNXT\n".join(blocks)
    path = tmp_path / name
    path.write_text(f"{text}\nEND {len(blocks) - 1}\n{after}")
    return path


def test_the_doublet_of_the_users_guide(tmp_path):
    path = tmp_path / "lasrdb1.len"
    path.write_text(GUIDE)
    doublet = pachon.load_telescope(path)
    assert doublet.description == "He-ne f/2 doublet focusing lens"
    assert doublet.source == "OSLO file lasrdb1.len"
    assert doublet.default_wavelength == pytest.approx(632.8e-9, rel=1e-15)
    assert [s.medium_after.name for s in doublet.surfaces] == ["LASF35", "", "LASF35", "", ""]
    # The solve for the slope: 15 / 0.25 mm, the focal length of the title; that for the height puts the image there.
    summary = first_order(doublet, doublet.default_wavelength)
    assert summary.focal_length == pytest.approx(0.060, rel=1e-13)
    assert summary.f_number == pytest.approx(2.0, rel=1e-13)
    assert summary.focus_z == pytest.approx(doublet.surfaces[-1].vertex[2], rel=1e-13)


def test_system_data(tmp_path):
    surfaces = ("GLA N-BK7\nRD 60\nTH 5\nAP CHK 9", "AIR\nCV -0.0125; TH 20\nAP 8", "AST\nTH 65")
    telescope = pachon.load_telescope(lens(tmp_path, *surfaces, image="TH 0.1"))
    first, second, stop, image = telescope.surfaces
    assert telescope.surface_names == ("S1", "S2", "S3", "Image")
    assert first.aperture == Circle(9 * 1e-3)
    assert second.aperture is None
    assert (first.shape, second.shape) == (Sphere(-0.06), Sphere(0.08))
    assert first.medium_after == GlassCatalogue.bundled()["N-BK7"]
    # Thicknesses 5, 20, 65 and the defocus of the image.
    assert image.vertex[2] == pytest.approx(-90.1e-3, abs=1e-15)
    assert stop.vertex[2] == pytest.approx(-25e-3, abs=1e-15)
    assert telescope.pupil_diameter == pytest.approx(0.01, rel=1e-15)
    assert telescope.field_radius == pytest.approx(np.deg2rad(2.0), rel=1e-15)
    assert telescope.default_wavelength == pytest.approx(587.56e-9, rel=1e-15)
    # The entrance pupil is the image of the stop by the lens: a thick lens by its matrix, lens unit mm.
    n = float(first.medium_after.index(587.56e-9))
    refract = np.array([[1.0, 0.0], [-(n - 1) / 60, 1.0]])
    leave = np.array([[1.0, 0.0], [-(n - 1) / 80, 1.0]])
    matrix = np.array([[1.0, 20.0], [0, 1]]) @ leave @ np.array([[1.0, 5.0 / n], [0, 1]]) @ refract
    assert telescope.stop_z == pytest.approx(-1e-3 * matrix[0, 1] / matrix[0, 0], rel=1e-12)


@pytest.mark.parametrize(
    ("system", "distance", "diameter"),
    [
        # A thin lens, focal length 100 mm, of n = 1.5; object at 300 mm, or far.
        ("NAO 0.06", "300", 2 * 300 * np.tan(np.arcsin(0.06))),
        ("EBR 12", "300", 24.0),
        # The image is at 150 mm: a cone of 1 / (2 F).
        ("FNO 5", "300", 150 / 5),
        ("NAP 0.1", "300", 150 * 0.2),
        ("FNO 5", "1e20", 100 / 5),
    ],
)
def test_apertures(tmp_path, system, distance, diameter):
    path = lens(tmp_path, "GLA 1.5\nRD 100\nTH 0", "AIR\nRD -100\nTH 100", system=f"{system}\nOBH 1", distance=distance)
    telescope = pachon.load_telescope(path)
    assert telescope.pupil_diameter == pytest.approx(diameter * 1e-3, rel=1e-12)
    if distance == "300":
        assert telescope.object_distance == pytest.approx(0.3, rel=1e-15)
        assert telescope.field_radius == pytest.approx(max(np.arctan(1 / 300), np.deg2rad(0.1)), rel=1e-12)


def test_a_beam_of_a_finite_object_is_named_as_it_is_written(tmp_path):
    """The warning said that the diameter of the entrance pupil, which has no place, was written."""
    path = lens(tmp_path, "GLA 1.5\nRD 100\nTH 0", "AIR\nRD -100\nTH 100", system="EBR 12\nOBH 1", distance="300")
    telescope = pachon.load_telescope(path)
    stated = {"aperture": "entrance_pupil", "aperture_value": telescope.pupil_diameter}
    message = "aperture = entrance pupil: an OSLO file has no place for it; written as the numerical aperture of the"
    with pytest.warns(PrescriptionWarning, match=message):
        pachon.save_telescope(telescope.with_design(**stated), tmp_path / "again.len", lenient=True)
    read = pachon.load_telescope(tmp_path / "again.len")
    assert read.design_data.aperture == "object_na"
    assert read.pupil_diameter == pytest.approx(24e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("commands", "shape"),
    [
        ("RD 100\nCC -1", Conic(-0.1, -1.0)),
        ("RD 100\nAD 1e-7\nAG 1e-14", EvenAsphere(-0.1, 0.0, (-1e2, 0.0, 0.0, -1e13))),
        ("RD 100\nASP ASR 2\nAS2 1e-7", EvenAsphere(-0.1, 0.0, (-1e2,))),
        ("RD 100\nASP ARA 3\nAS3 1e-6", OddAsphere(-0.1, 0.0, (0.0, 0.0, -1.0))),
        # AS1 x + AS5 y^2 + AS7 x^2 y; x changes its sign with the axes.
        ("RD 100\nASP ASX 7\nAS1 1e-3\nAS5 1e-5; AS7 2e-7",
         Sum((Sphere(-0.1), XYPolynomial(((1, 0, 1e-3), (0, 2, -1e-2), (2, 1, -0.2)))))),
        ("RD 100\nCVX 0.02", Toroid(-0.05, -0.1)),
    ],
)  # fmt: skip
def test_shapes(tmp_path, commands, shape):
    found = pachon.load_telescope(lens(tmp_path, f"GLA N-BK7\n{commands}\nTH 5", "AIR\nTH 50")).surfaces[0].shape
    x, y = np.meshgrid([-0.01, 0.0, 0.013], [-0.008, 0.002])
    assert np.allclose(found.sag(x, y), shape.sag(x, y), rtol=1e-12, atol=1e-18)


def test_pick_ups_take_the_whole_shape(tmp_path):
    surfaces = ("GLA N-BK7\nRD 100\nCC -0.5\nAD 1e-7\nTH 5\nAP 7", "AIR\nPK CVM 1\nPK TH -1 2.5\nPK AP 1", "TH 40")
    first, second, third, _ = pachon.load_telescope(lens(tmp_path, *surfaces)).surfaces
    assert first.shape.conic == -0.5
    assert second.shape.curvature == -first.shape.curvature
    assert second.shape.coefficients == tuple(-a for a in first.shape.coefficients)
    assert second.shape.conic == first.shape.conic
    assert third.vertex[2] == pytest.approx(-5e-3 - 7.5e-3, abs=1e-17)


def test_tilts_and_decentres(tmp_path):
    surfaces = (
        "TH 10",
        "DCX 0.1\nDCY 0.2; DCZ 0.3\nTLA 3\nTLB -2\nTLC 15\nTH 5\nRCO",
        "DT -1\nDCY 0.5\nTLA 4\nTLB 6\nTH 2",
        "GC 1\nTLA 1\nTOZ 8\nTH 3",
    )
    found = pachon.load_telescope(lens(tmp_path, *surfaces)).surfaces
    half = np.diag([-1.0, 1.0, -1.0])

    def places(number):
        return half @ found[number].vertex * 1e3, half @ found[number].matrix @ half

    # Stated once more: left-handed about x and y; with RCO the next surface starts from the untilted frame.
    position, axes = places(1)
    assert position == pytest.approx([0.1, 0.2, 10.3], abs=1e-12)
    assert np.allclose(axes, rotation_matrix(np.radians([-3.0, 2.0, 15.0])), atol=1e-14)
    position, axes = places(2)
    about_x, about_y = rotation_matrix(np.radians([-4.0, 0, 0])), rotation_matrix(np.radians([0, -6.0, 0]))
    assert np.allclose(axes, about_y @ about_x, atol=1e-14)
    assert position == pytest.approx([0, 0, 15.0] + axes @ [0, 0.5, 0], abs=1e-12)
    # In the frame of surface 1, about a point 8 mm behind its vertex.
    position, axes = places(3)
    turn = rotation_matrix(np.radians([-1.0, 0, 0]))
    assert position == pytest.approx(np.array([0, 0, 8.0]) - turn @ [0, 0, 8.0], abs=1e-12)
    # The image goes on along the new axis.
    assert places(4)[0] == pytest.approx(position + 3.0 * turn[:, 2], abs=1e-12)


def test_a_bent_mirror(tmp_path):
    found = pachon.load_telescope(lens(tmp_path, "TH 20", "RFL\nTLA 45\nBEN\nTH -30")).surfaces
    assert found[1].interaction == Interaction.MIRROR
    # TLA 45 leaves the light along -y of the file, TH -30 goes along it; the image is across it.
    image = np.diag([-1.0, 1.0, -1.0]) @ found[2].vertex * 1e3
    rays = pachon.launch_rays(pachon.load_telescope(tmp_path / "lens.len"), (0, 0), 587.56e-9, ([0.0], [0.0]))
    traced = pachon.trace(pachon.load_telescope(tmp_path / "lens.len"), rays)
    assert np.allclose(traced.position[0], found[2].vertex, atol=1e-15)
    assert np.abs(image - [0, 0, 20]).max() == pytest.approx(30, abs=1e-12)
    assert abs(traced.direction[0] @ found[2].matrix[:, 2]) == pytest.approx(1, abs=1e-14)


def test_glasses(tmp_path):
    surfaces = (
        "GLA 1.6\nTH 1",
        "WV 0.58756 0.48613 0.65627\nGLA MOD M1 1.62 1.63 1.61\nTH 1",
        "GLA MOD 1.7 30\nTH 1",
        "GLA 1.5 1.51 1.49\nTH 1",
        "AIR\nTH 50",
    )
    media = [s.medium_after for s in pachon.load_telescope(lens(tmp_path, *surfaces)).surfaces]
    d, f, c = 587.56e-9, 486.13e-9, 656.27e-9
    assert media[0].index(d) == media[0].index(f) == 1.6
    for medium, indices in ((media[1], (1.62, 1.63, 1.61)), (media[3], (1.5, 1.51, 1.49))):
        assert [float(medium.index(w)) for w in (d, f, c)] == pytest.approx(indices, rel=1e-14)
    nd, nf, nc = (float(media[2].index(w)) for w in (587.5618e-9, 486.1327e-9, 656.2725e-9))
    assert (nd, (nd - 1) / (nf - nc)) == pytest.approx((1.7, 30), rel=1e-10)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("RD   100.0", "RD   round", "line 14, surface 1: RD round: expected a number in place of 'round'"),
        ("RD   100.0", "GIZMO 3", "line 14, surface 1: GIZMO 3: this command is not understood"),
        ("RD   100.0", "PFL 50", "surface 1: PFL 50: perfect lenses are not read"),
        ("GLA LASF35", "GLA NOGLASS", "line 13, surface 1: GLA NOGLASS: the glass is in no catalogue"),
        ("EBR  15.0", "EBR  -15.0", "line 3: EBR -15.0: expected an entrance pupil of finite size"),
        ("WV 0.6328", "WV 0.6328 -0.5", "WV 0.6328 -0.5: expected positive wavelengths"),
        ("ANG  0.0000572957795", "ANG 89.5", "line 4: ANG: expected fields within 89 degrees"),
        ("RD   100.0", "RD   100.0\nAP CHK -4", "line 15, surface 1: AP CHK -4: expected a smallest and a larg"),
        ("AP  9.9999999977e+13", "CV 0.1", "line 11, surface 0: CV 0.1: curved objects are not read"),
        ("UNI  1.0", "UNI  2.0", "UNI 2.0: expected one of 1, 10, 25.4, 1000"),
        ("PK  GLA  -2", "PK GLA 4", "line 2., surface 3: PK GLA 4: expected an earlier surface than 3"),
        ("EBR  15.0", "", "expected the aperture: one of EBR, NAO, FNO, NAP"),
        ("EBR  15.0", "FNO 2.0", "surface 4: PU -0.25: expected an axial ray of known height"),
        ("LEN NEW", "LENS", "expected LEN NEW first"),
        ("RD   50.0", "ASP SPL 3", "surface 3: ASP SPL: expected ADO"),
        ("RD   50.0", "GC 9", "surface 3: GC 9: expected one of the surfaces 1 to 2"),

        ("WV 0.6328", "WV9 0.6328", "expected one number, and those of the wavelengths before it"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(tmp_path, old, new, expected):
    assert old in GUIDE
    path = tmp_path / "lens.len"
    path.write_text(GUIDE.replace(old, new, 1))
    with pytest.raises(PrescriptionError, match=expected) as error:
        pachon.load_telescope(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_lenient_warns_of_what_is_left_out(tmp_path):
    path = lens(tmp_path, "GLA N-BK7\nRD 60\nTH 5\nGIZMO 1", "AIR\nTH 100", after="CFG NEW\nTH 1 2 5.0\nEND\n")
    with pytest.warns(PrescriptionWarning) as caught:
        pachon.load_telescope(path, lenient=True)
    first, second = (str(w.message).split(": ", 1)[1] for w in caught)
    assert first.startswith("GIZMO 1: this command is not understood")
    assert second.startswith("CFG: one configuration is read")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x01\x00\x00\x00LEN\x00\x10CODE V\x00\x00", "a binary file, as of CODE V.*as a sequence .WRL."),
        (b'RDM;LEN "a lens"\nEPD 10\n', "a sequence of CODE V.*end in .seq"),
    ],
)
def test_a_file_of_another_program_is_named(tmp_path, content, words):
    path = tmp_path / "lens.len"
    path.write_bytes(content)
    with pytest.raises(PrescriptionError, match=words) as caught:
        pachon.load_telescope(path)
    assert "\n" not in str(caught.value)


def test_sessions_of_other_programs_say_what_to_save(tmp_path):
    path = tmp_path / "lens.zos"
    path.write_bytes(b"PK")
    with pytest.raises(
        PrescriptionError, match=r"lens.zos: a session of Zemax OpticStudio: save the lens there as .zmx"
    ):
        pachon.load_telescope(path)
