"""Design data in files: read from Zemax, CODE V and YAML, and written back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError
from pachon.models.design_data import DesignData, vignetted
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.parameters.parameters import apply

DATA = Path(__file__).parents[2] / "data" / "zmx"
FILES = sorted(DATA.glob("*.zmx"))

LENS = """MODE SEQ
UNIT CM X W X CM MR CPMM
{aperture}
ENVD 15 0.5 0
RAIM 0 2 1 1 0 0 0 0 0 1
FTYP {kind} 0 2 3 0 0 0
XFLN 0 3 7 7
YFLN 0 4 7 7
FWGN 1 2 9 9
VDXN 0 0.1
VDYN 0 0.2
VCXN 0 0.3
VCYN 0 0.4
VANN 0 30
WAVM 1 0.4861 1
WAVM 2 0.5876 2
WAVM 3 0.6563 0.5
PWAV 2
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ {distance}
SURF 1
  COMM front
  TYPE STANDARD
  CURV 0.1
  DISZ 1
  GLAS N-BK7
  DIAM 3 1
SURF 2
  COMM back
  TYPE STANDARD
  CURV -0.1
  DISZ 2
SURF 3
  COMM iris
  STOP
  TYPE STANDARD
  CURV 0
  DISZ 7
  DIAM 1 1
SURF 4
  TYPE STANDARD
  CURV 0
  DISZ 0
"""


def lens(tmp_path, kind=0, aperture="ENPD 2", distance="INFINITY"):
    path = tmp_path / "lens.zmx"
    path.write_text(LENS.format(kind=kind, aperture=aperture, distance=distance))
    return load_telescope(path)


def test_a_zemax_file_keeps_what_its_designer_stated(tmp_path):
    telescope = lens(tmp_path)
    data = telescope.design_data
    assert (data.length_unit, data.aperture, data.aperture_value) == ("cm", "entrance_pupil", 0.02)
    assert (data.stop, data.aiming, data.field_type) == ("iris", "real", "angle")
    # Half a turn about y: x changes its sign, and so do decentres along x and angles.
    assert np.rad2deg(data.fields) == pytest.approx(np.array([[0, 0], [-3, 4]]), abs=1e-12)
    assert data.field_weights == (1.0, 2.0)
    assert data.vignetting[1] == pytest.approx((-0.1, 0.2, 0.3, 0.4, -np.pi / 6), rel=1e-14)
    assert data.wavelengths == (0.4861e-6, 0.5876e-6, 0.6563e-6)
    assert data.wavelength_weights == (1.0, 2.0, 0.5)
    assert telescope.default_wavelength == 0.5876e-6
    assert (data.temperature, data.pressure) == (288.15, 50662.5)
    assert [s.semi_diameter for s in telescope.surfaces] == [0.03, None, 0.01, None]
    assert all(s.aperture is None for s in telescope.surfaces)


def test_an_automatic_semi_diameter_is_that_of_the_light(tmp_path):
    """DIAM with 0 behind it: what Zemax computed of the lens in the file is not that of a lens that changes."""
    path = tmp_path / "lens.zmx"
    path.write_text(LENS.format(kind=0, aperture="FLOA", distance="INFINITY").replace("DIAM 3 1", "DIAM 3 0"))
    telescope = load_telescope(path)
    assert [s.semi_diameter for s in telescope.surfaces] == [None, None, 0.01, None]
    path.write_text(path.read_text().replace("DIAM 1 1", "DIAM 1 0"))
    floating = load_telescope(path)
    # The size of the stop, which floats the pupil, is stated all the same.
    assert floating.pupil_diameter == telescope.pupil_diameter
    assert floating.surface("iris").semi_diameter is None


@pytest.mark.parametrize(
    ("line", "aperture", "value"),
    [
        ("ENPD 2", "entrance_pupil", 0.02),
        ("FNUM 4 0", "f_number", 4.0),
        ("FNUM 4 1", "working_f_number", 4.0),
        ("OBNA 0.05", "object_na", 0.05),
        ("FLOA", "stop", 0.01),
    ],
)
@pytest.mark.parametrize("kind", ["object_height", "paraxial_image_height", "real_image_height"])
@pytest.mark.parametrize("ending", ["zmx", "yaml"])
def test_what_is_stated_is_written_back(tmp_path, line, aperture, value, kind, ending):
    number = ("angle", "object_height", "paraxial_image_height", "real_image_height").index(kind)
    telescope = lens(tmp_path, number, line, "50")
    assert telescope.design_data.aperture == aperture
    assert telescope.design_data.aperture_value == pytest.approx(value, rel=1e-15)
    assert telescope.design_data.fields[1] == pytest.approx((-0.03, 0.04), rel=1e-15)
    save_telescope(telescope, tmp_path / f"again.{ending}")
    again = load_telescope(tmp_path / f"again.{ending}")
    if ending == "yaml":
        assert again == telescope
    # A file in centimetres divides and multiplies by its unit.
    assert again.pupil_diameter == pytest.approx(telescope.pupil_diameter, rel=1e-15)
    assert again.design_data.fields[1] == pytest.approx(telescope.design_data.fields[1], rel=1e-15)
    same = ("length_unit", "aperture", "stop", "aiming", "field_type", "field_weights", "wavelengths", "temperature")
    assert all(getattr(again.design_data, key) == getattr(telescope.design_data, key) for key in same)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_real_files_keep_their_design_data(tmp_path, path):
    telescope = load_telescope(path)
    save_telescope(telescope, tmp_path / "again.yaml")
    assert load_telescope(tmp_path / "again.yaml") == telescope
    save_telescope(telescope, tmp_path / "again.zmx")
    expected = telescope.design_data
    found = load_telescope(tmp_path / "again.zmx").design_data
    # Zemax's own temperature and pressure where a file states none.
    for key in (key for key in DesignData.__dataclass_fields__ if key not in ("temperature", "pressure")):
        assert getattr(found, key) == getattr(expected, key), key


def test_a_pupil_of_another_origin_is_written_as_a_plane(tmp_path):
    """A stop that does not make the telescope's entrance pupil is not written: the pupil is what counts."""
    from dataclasses import replace

    telescope = lens(tmp_path)
    other = replace(telescope, stop_z=telescope.stop_z + 0.01).with_design(aiming="off")
    with pytest.warns(
        pachon.errors.PrescriptionWarning, match="do not make the pupil; a plane in front carries the stop$"
    ):
        save_telescope(other, tmp_path / "again.zmx")
    again = load_telescope(tmp_path / "again.zmx")
    assert again.stop_z == pytest.approx(other.stop_z, abs=1e-16)
    assert (again.design_data.stop, again.design_data.aiming) == (None, "off")
    assert again.design_data.fields == other.design_data.fields


def rays_of(telescope, field):
    """Landing points of a few rays that the telescope's own design data launch; NaN where none arrives."""
    rim = np.array([[0.0, 0.0], [0.9, 0.0], [0.0, 0.9], [-0.5, 0.4]]) * 0.5 * telescope.pupil_diameter
    rays = pachon.launch_rays(telescope, field, telescope.default_wavelength, rim.T)
    return pachon.trace(telescope, rays).position[:, :2]


@pytest.mark.parametrize("ending", ["zmx", "json"])
@pytest.mark.parametrize("aperture", ["ENPD 2", "FNUM 3 0", "FLOA"])
def test_a_changed_lens_whose_rays_are_aimed_keeps_stop_and_aiming(tmp_path, aperture, ending):
    """A change moves the image of the stop and makes the focal ratio untrue; the rays of the file are the same."""
    telescope = pachon.models.apply_changes(
        lens(tmp_path, aperture=aperture).with_design(vignetting=(), aiming="real"),
        {"front.radius_mm": 20.0, "front.n": 0.03, "front.abbe": -4.0},
    )
    with pytest.warns(pachon.errors.PrescriptionWarning, match="a formula is fitted, within"):
        save_telescope(telescope, tmp_path / f"again.{ending}")
    again = load_telescope(tmp_path / f"again.{ending}")
    assert (again.design_data.stop, again.design_data.aiming) == ("iris", "real")
    for field in telescope.design_data.fields:
        assert np.allclose(rays_of(again, field), rays_of(telescope, field), rtol=0, atol=1e-13)


@pytest.mark.parametrize("ending", ["zmx", "seq", "json"])
def test_an_aimed_stop_off_the_axis_is_kept(tmp_path, ending):
    """The middle of the stop fixes the chief rays, not the paraxial pupil, which tilted surfaces have not."""
    aiming = "paraxial" if ending == "seq" else "real"
    telescope = lens(tmp_path).with_design(vignetting=(), aiming=aiming)
    tilted = telescope.perturbed("front", shift=(1e-4, 2e-4, 0.0), tilt=(1e-3, 2e-3, 0.0))
    tilted = tilted.perturbed("iris", shift=(3e-4, -2e-4, 0.0))
    save_telescope(tilted, tmp_path / f"again.{ending}")
    again = load_telescope(tmp_path / f"again.{ending}")
    assert (again.design_data.stop, again.design_data.aiming) == ("iris", aiming)
    for field in telescope.design_data.fields:
        assert np.allclose(rays_of(again, field), rays_of(tilted, field), rtol=0, atol=1e-13)
        assert not np.allclose(rays_of(again, field), rays_of(telescope, field), rtol=0, atol=1e-5)


@pytest.mark.parametrize("ending", ["zmx", "json"])
@pytest.mark.parametrize("aperture", ["ENPD 2", "OBNA 0.009"])
def test_an_aimed_stop_of_a_near_object_is_kept(tmp_path, aperture, ending):
    """The pupil moves with a change; the beam keeps its angle, and the fields their points of the object."""
    telescope = lens(tmp_path, kind=1, distance="100", aperture=aperture).with_design(vignetting=(), aiming="real")
    changed = apply(telescope, {"front.radius": 0.02, "front.thickness": 2e-3})
    changed = changed.perturbed("front", shift=(1e-4, 0.0, 0.0))
    save_telescope(changed, tmp_path / f"again.{ending}")
    again = load_telescope(tmp_path / f"again.{ending}")
    assert (again.design_data.stop, again.design_data.aiming) == ("iris", "real")
    assert not np.isclose(again.stop_z, changed.stop_z, rtol=0, atol=1e-4)
    for field, here in zip(pachon.Request.of(changed).fields, pachon.Request.of(again).fields, strict=True):
        assert np.allclose(rays_of(again, here), rays_of(changed, field), rtol=0, atol=1e-13)


def test_an_aimed_stop_that_cannot_be_written_is_a_warning(tmp_path):
    """Field angles of a near object are those at the pupil, which must not move then."""
    telescope = lens(tmp_path, kind=0, distance="100").perturbed("front", shift=(0.0, 0.0, 1e-3))
    with pytest.warns(pachon.errors.PrescriptionWarning, match="stop = iris, aiming = real: .* rays are not aimed"):
        save_telescope(telescope.with_design(aiming="real"), tmp_path / "again.zmx")


def test_codev_files_keep_fields_and_wavelengths(tmp_path):
    path = tmp_path / "lens.seq"
    path.write_text(
        "RDM\nDIM M\nEPD 10\nWL 656.3 587.6 486.1\nWTW 1 2 3\nREF 2\nXAN 0 0\nYAN 0 7\n"
        "WTF 1 4\nVUY 0 0.3\nVLY 0 0.1\n"
        "SO 0 1e20\nS 50 5 NBK7_SCHOTT\nS -50 20\nS 0 30\nSTO\nSI 0 0\n"
    )
    data = load_telescope(path).design_data
    assert (data.length_unit, data.aperture, data.aperture_value, data.stop) == ("mm", "entrance_pupil", 0.01, "S3")
    assert np.rad2deg(data.fields) == pytest.approx(np.array([[0, 0], [0, 7]]), abs=1e-12)
    assert data.wavelengths == pytest.approx((656.3e-9, 587.6e-9, 486.1e-9), rel=1e-15)
    assert (data.wavelength_weights, data.field_weights) == ((1.0, 2.0, 3.0), (1.0, 4.0))
    # The rim of the second field: from -1 + 0.1 to 1 - 0.3.
    rim = vignetted(np.array([[0.0, 1.0], [0.0, -1.0]]), np.array(data.vignetting))
    assert rim[1, :, 1] == pytest.approx([0.7, -0.9], abs=1e-15)


def test_rays_of_codev_files_are_aimed_at_the_stop(tmp_path):
    """A stop that is decentred and returns: chief rays pass its middle, and not that of its paraxial image."""
    path = tmp_path / "lens.seq"
    path.write_text(
        "RDM\nDIM M\nEPD 10\nWL 587.6\nREF 1\nXAN 0\nYAN 3\n"
        "SO 0 1e20\nS 50 5 NBK7_SCHOTT\nS -50 20\nS 0 30\nSTO\nDAR\nYDE 2\nSI 0 0\n"
    )
    lens = load_telescope(path)
    rays = pachon.Request.of(lens).launch(lens.default_wavelength, np.zeros((1, 2)))
    assert lens.design_data.stop == "S3"
    met = pachon.trace(lens, rays, "all")[2].position
    assert lens.surface("S3").to_local(met)[0] == pytest.approx(np.zeros(3), abs=1e-14)
    assert met[0, 1] == pytest.approx(2e-3, abs=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("environment: {", "environment: [1]  # {", r"design.environment = \[1\]: expected a mapping"),
        ("{entrance_pupil: 0.02}", "{entrance_pupil: 0.02, f_number: 4}", "design.aperture = .*: expected one of"),
        ("angle: [", "angel: [", "unknown key design.fields.angel"),
        ("aiming: real", "aiming: yes", "design.aiming = True: expected one of off, paraxial, real"),
        ("stop: iris", "stop: irish", "stop = 'irish': expected the name of a surface, such as 'front'"),
        ("length: cm", "length: ell", "design.length = 'ell': expected one of m, cm, mm, in"),
        ("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0.0, 0.0]", "design.fields.vignetting = .*: expected a list of rows of five"),
        ("semi_diameter: 0.03", "semi_diameter: -1", "semi_diameter = -1.0: expected a positive number"),
    ],
)
def test_wrong_design_sections_are_refused(tmp_path, old, new, expected):
    save_telescope(lens(tmp_path), tmp_path / "lens.yaml")
    text = (tmp_path / "lens.yaml").read_text()
    assert old in text
    (tmp_path / "wrong.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(PrescriptionError, match=expected):
        load_telescope(tmp_path / "wrong.yaml")


def test_yaml_is_in_the_units_of_its_file(tmp_path):
    """Millimetres and degrees become metres and radians, in the section design too."""
    save_telescope(pachon.load_telescope("paul_baker"), tmp_path / "t.yaml")
    text = (tmp_path / "t.yaml").read_text()
    section = (
        "design:\n  aperture: {entrance_pupil: 8.4}\n  stop: M1\n"
        "  fields: {angle: [[0, 0], [0.1, 0.2]], vignetting: [[0, 0, 0, 0, 0], [0, 0, 0, 0, 90]]}\n"
        "  wavelengths: {values: [0.5, 0.6]}\n  environment: {temperature_k: 280}\n"
    )
    (tmp_path / "t.yaml").write_text(text.replace("surfaces:", section + "surfaces:"))
    data = load_telescope(tmp_path / "t.yaml").design_data
    assert data.fields[1] == pytest.approx(np.deg2rad((0.1, 0.2)), rel=1e-15)
    assert data.vignetting[1][4] == pytest.approx(np.pi / 2, rel=1e-15)
    assert (data.aperture_value, data.wavelengths, data.temperature) == (8.4, (5e-7, 6e-7), 280.0)


def test_a_telescope_built_by_hand_can_be_read_again(tmp_path):
    """Neither source nor version is needed to build one; a file has both."""
    bare = replace(pachon.load_telescope("paul_baker"), source="", version="")
    pachon.save_telescope(bare, tmp_path / "bare.yaml")
    again = pachon.load_telescope(tmp_path / "bare.yaml")
    assert again.surfaces == bare.surfaces
    assert again.source == again.version == "not stated"


def test_a_name_that_could_not_be_read_again_is_not_written(tmp_path):
    with pytest.raises(PrescriptionError, match=r"x\.foo: expected a name that ends in \.yaml, \.yml, \.zmx, \.seq, "):
        save_telescope(load_telescope("paul_baker"), tmp_path / "x.foo")
    assert not (tmp_path / "x.foo").exists()
