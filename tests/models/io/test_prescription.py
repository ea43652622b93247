import os
import re

import numpy as np
import pytest
import yaml

from pachon.core.errors import PrescriptionError, UnknownNameError
from pachon.models.aperture import Annulus, Circle
from pachon.models.io.bundled import BUNDLED, DATA
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.io.yaml.writer import telescope_to_yaml
from pachon.models.media.medium import ConstantIndex, Sellmeier
from pachon.models.rotation import rotation_matrix
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.surface import Interaction

LSST_NAMES = [f"lsst_v3.3_{band}" for band in "ugrizy"]
TEXT = (DATA / "lsst_v3.3_r.yaml").read_text()


def load_text(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return load_telescope(path)


def message(tmp_path, text):
    """Return the one line that loading this text fails with, less the folder."""
    with pytest.raises(PrescriptionError) as caught:
        load_text(tmp_path, text)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(tmp_path / "mine.yaml"))
    return line.removeprefix(str(tmp_path) + "/")


def batoid_file(name):
    return "LSST_g_500.yaml" if "zemax" in name else f"LSST_{name[-1]}.yaml"


@pytest.mark.parametrize("name", [*LSST_NAMES, "lsst_v3.3_g_vacuum_zemax_check"])
def test_bundled_lsst_has_the_figures_of_batoids_file(name):
    batoid = pytest.importorskip("batoid")
    optic, telescope = batoid.Optic.fromYaml(batoid_file(name)), load_telescope(name)
    leaves = [item for key, item in optic.itemDict.items() if not hasattr(item, "items")]
    assert [s.name for s in telescope.surfaces] == [item.name for item in leaves]
    kinds = {"Mirror": Interaction.MIRROR, "RefractiveInterface": Interaction.REFRACT, "Detector": Interaction.DETECTOR}
    for ours, theirs in zip(telescope.surfaces, leaves, strict=True):
        assert ours.interaction == kinds[type(theirs).__name__]
        assert ours.vertex == tuple(theirs.coordSys.origin)
        assert np.array_equal(ours.matrix, theirs.coordSys.rot)
        shape = theirs.surface
        if isinstance(shape, batoid.Plane):
            assert ours.shape == Plane()
        elif isinstance(shape, batoid.Sphere):
            assert ours.shape == Sphere(shape.R)
        elif isinstance(shape, batoid.Asphere):
            assert ours.shape == EvenAsphere(shape.R, shape.conic, tuple(shape.coefs))
        else:
            assert ours.shape == Conic(shape.R, shape.conic)
        clear = theirs.obscuration.original
        if isinstance(clear, batoid.ObscAnnulus):
            assert ours.aperture == Annulus(clear.inner, clear.outer, clear.x, clear.y)
        else:
            assert ours.aperture == Circle(clear.radius, clear.x, clear.y)
        medium = theirs.outMedium
        if isinstance(medium, batoid.SellmeierMedium):
            assert (*ours.medium_after.B, *ours.medium_after.C) == medium.coefs
        else:
            assert ours.medium_after == ConstantIndex(medium.n)
    assert telescope.pupil_diameter == optic.pupilSize
    assert telescope.pupil_obscuration == optic.pupilObscuration
    assert telescope.launch_distance == optic.backDist
    assert telescope.reference_sphere_radius == optic.sphereRadius
    assert telescope.stop_z == optic.stopSurface.coordSys.origin[2]


@pytest.mark.parametrize("name", LSST_NAMES)
def test_bundled_lsst_states_what_it_covers(name):
    telescope = load_telescope(name)
    assert telescope.name == name
    assert telescope.camera == "lsst"
    assert telescope.wavelength_range == (300e-9, 1200e-9)
    assert telescope.field_radius == np.deg2rad(1.75)
    assert telescope.field_limit == np.deg2rad(2.5)
    # Middle of the band to a tenth of a nanometre or, for a band with an odd width, half of one.
    assert telescope.default_wavelength == pytest.approx(np.mean(telescope.band), abs=0.6e-9)
    assert "batoid 0.9.0" in telescope.source
    assert "Zemax" in telescope.source


def test_r_band_is_that_of_the_paper():
    telescope = load_telescope("lsst_v3.3_r")
    assert telescope.band == (545e-9, 703e-9)
    assert telescope.default_wavelength == 624e-9


def test_groups_are_the_camera_and_its_lenses():
    telescope = load_telescope("lsst_v3.3_i")
    assert list(telescope.groups) == ["Camera", "L1", "L2", "Filter", "L3"]
    assert telescope.groups["Camera"] == telescope.surface_names[3:]
    assert telescope.groups["Filter"] == ("Filter_entrance", "Filter_exit")


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_files_round_trip_and_keep_to_a_surface_a_line(name, tmp_path):
    telescope = load_telescope(name)
    save_telescope(telescope, tmp_path / "copy.yaml")
    assert load_telescope(tmp_path / "copy.yaml") == telescope
    lines = (DATA / f"{name}.yaml").read_text().splitlines()
    table = lines[lines.index("surfaces:") + 1 :]
    assert len(table) == len(telescope.surfaces)
    # Plain YAML, whatever reads it, gives numbers and not texts.
    for row in yaml.safe_load((DATA / f"{name}.yaml").read_text())["surfaces"]:
        assert all(isinstance(row[k], float) for k in ("z", "radius", "conic") if k in row)
        assert all(isinstance(v, float) for v in row.get("coefficients", []))


def test_perturbed_telescope_round_trips_with_its_pivots(tmp_path):
    telescope = load_telescope("lsst_v3.3_z").perturbed("Camera", shift=(1e-3, 2e-4, 0), tilt=(1e-3, -1e-4, 0.2))
    telescope = telescope.perturbed("L1_entrance", tilt=(1e-2, 0, 0)).perturbed("L3", shift=(0, 0, 1e-7))
    save_telescope(telescope, tmp_path / "moved.yaml")
    again = load_telescope(tmp_path / "moved.yaml")
    assert again == telescope
    tilt = {"tilt": (2e-3, 1e-3, 0.0)}
    assert again.perturbed("Camera", **tilt) == telescope.perturbed("Camera", **tilt)


def test_odd_wavelengths_and_angles_round_trip(tmp_path):
    # Values that no decimal in um or degrees converts to exactly make the writer use SI.
    fields = {name: getattr(load_telescope("lsst_v3.3_r"), name) for name in load_telescope("paul_baker").__dict__}
    fields = {k: v for k, v in fields.items() if not k.startswith("surface_names")}
    odd = np.nextafter(fields["field_radius"], 0)
    telescope = type(load_telescope("paul_baker"))(
        **(fields | {"field_radius": float(odd), "default_wavelength": 1e-6 / 3, "name": "a: 'b' #c", "version": "1e3"})
    )
    save_telescope(telescope, tmp_path / "odd.yaml")
    assert load_telescope(tmp_path / "odd.yaml") == telescope


def test_every_kind_of_entry_is_read(tmp_path):
    text = """
name: all
source: a test
version: "0"
units: {length: mm, angle: deg, wavelength: nm}
stop: {z: 0}
pupil: {diameter: 100, obscuration: 0.1}
launch_distance: 1e3
reference_sphere_radius: 500
field: {radius: 1, limit: 2}
wavelengths: {range: [400, 700], default: 550}
medium_before: air
media:
  air: {n: 1.0003}
  bk7: {B: [1.03961212, 0.231792344, 1.01046945], C: [0.00600069867, 0.0200179144, 103.560653], range: [300, 2500]}
surfaces:
  - {name: a, type: refract, shape: even_asphere, z: 1, radius: 250, conic: -1, coefficients: [1e-9, 2e-15],
     medium: bk7}
  - {name: b, type: refract, shape: sphere, x: 1, y: -2, z: 0, radius: -250, tilt: [1, 2, 3], medium: air}
  - {name: c, type: mirror, shape: conic, z: -400, radius: 800, conic: -1.0, circle: 60, centre: [1, 2]}
  - {name: d, type: detector, shape: plane, z: 0, rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
"""
    t = load_text(tmp_path, text)
    assert t.pupil_diameter == 0.1
    assert t.launch_distance == 1.0
    assert t.wavelength_range == t.band == (400e-9, 700e-9)
    assert t.medium_before == ConstantIndex(1.0003)
    assert isinstance(t.surface("a").medium_after, Sellmeier)
    assert t.surface("a").medium_after.wavelength_range == (300e-9, 2500e-9)
    # mm^-3 is 1e9 m^-3, mm^-5 is 1e15 m^-5; powers of ten in floating point.
    assert t.surface("a").shape.coefficients == pytest.approx((1.0, 2.0), rel=1e-15)
    assert t.surface("b").vertex == (1e-3, -2e-3, 0.0)
    assert np.array_equal(t.surface("b").matrix, rotation_matrix(np.deg2rad([1.0, 2.0, 3.0])))
    assert t.surface("c").aperture == Circle(0.06, 1e-3, 2e-3)
    # Mirror and detector stay in the medium before them.
    assert t.surface("d").medium_after == t.surface("c").medium_after == t.medium_before
    save_telescope(t, tmp_path / "again.yaml")
    assert load_telescope(tmp_path / "again.yaml") == t


def test_unknown_names_offer_the_nearest():
    with pytest.raises(UnknownNameError, match=r"unknown telescope 'lsst_v3\.3_R2': did you mean lsst_v3\.3_r"):
        load_telescope("lsst_v3.3_R2")
    with pytest.raises(UnknownNameError, match=r"expected one of \d+ names such as lsst_v3\.3_u"):
        load_telescope("hubble")


def test_missing_and_unreadable_files_are_one_line(tmp_path):
    with pytest.raises(PrescriptionError, match=r"^nowhere/mine\.yaml: no such file$"):
        load_telescope("nowhere/mine.yaml")
    with pytest.raises(PrescriptionError, match=r"expected a prescription file that ends in \.yaml"):
        load_telescope(tmp_path / "lens.txt")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(PrescriptionError, match="cannot be read"):
        load_telescope(tmp_path / "folder.yaml")
    (tmp_path / "bytes.yaml").write_bytes(b"name: \xff\xfe")
    with pytest.raises(PrescriptionError, match="not a UTF-8 text file"):
        load_telescope(tmp_path / "bytes.yaml")
    with pytest.raises(PrescriptionError, match=r"cannot write .*folder\.yaml: No such file or directory"):
        save_telescope(load_telescope("paul_baker"), tmp_path / "no" / "folder.yaml")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("conic: -1.215", "konic: -1.215", "mine.yaml: unknown key surfaces[M1].konic = -1.215: did you mean conic?"),
        ("conic: -1.215", "conic: steep", "mine.yaml: surfaces[M1].conic = 'steep': expected a number"),
        (
            "radius: 19.835",
            "radius: 0.0",
            "mine.yaml: surfaces[M1].radius = 0.0: expected a finite radius of curvature",
        ),
        ("radius: 19.835", "radius: .nan", "mine.yaml: surfaces[M1].radius = nan: expected a number"),
        ("radius: 19.835, ", "", "mine.yaml: surfaces[M1].radius is missing"),
        ("name: lsst_v3.3_r\n", "", "mine.yaml: name is missing"),
        ("stop: {z: 0.4393899}\npupil:", "#", "mine.yaml: stop is missing; also pupil"),
        (
            "shape: even_asphere",
            "shape: asphere",
            "surfaces[M1].shape = 'asphere': expected one of plane, sphere, conic, ",
        ),
        (
            "type: mirror",
            "type: mirrr",
            "type = 'mirrr': expected one of mirror, refract, detector, baffle",
        ),
        ("medium: silica", "medium: silca", "surfaces[L1_entrance].medium = 'silca': expected one of vacuum, silica"),
        ("medium: vacuum", "medium: [1]", "surfaces[L1_exit].medium = [1]: expected a text"),
        (", medium: silica", "", "surfaces[L1_entrance].medium is missing"),
        (
            "annulus: [2.558, 4.18]",
            "annulus: [4.18, 2.558]",
            "surfaces[M1].annulus = [4.18, 2.558] m: expected 0 <= inner",
        ),
        ("annulus: [2.558, 4.18]", "annulus: [2.558]", "surfaces[M1].annulus = [2.558]: expected a list of 2 numbers"),
        ("circle: 0.775", "circle: 0.7, annulus: [0.1, 0.2]", "circle = 0.7: expected circle or annulus, not both"),
        ("circle: 0.775", "centre: [0, 0]", "centre = [0, 0]: expected a circle or an annulus beside it"),
        ("circle: 0.775", "tilt: [0, 0, 1], rotation: [[1]]", "tilt = [0, 0, 1]: expected tilt or rotation, not both"),
        ("circle: 0.775", "rotation: [[1]]", "rotation = [[1]]: expected three rows of three numbers"),
        ("launch_distance: 15.0", "launch_distance: -1", "launch_distance = -1: expected a positive number"),
        (
            "launch_distance: 15.0",
            "lunch_distance: 15",
            "unknown key lunch_distance = 15: did you mean launch_distance",
        ),
        ("length: m,", "length: inch,", "units.length = 'inch': expected one of m, mm"),
        ("obscuration: 0.612", "obscuration: 1.5", "pupil_obscuration = 1.5: expected 0 <= value < 1"),
        ("obscuration: 0.612", "obscuration: yes", "pupil.obscuration = True: expected a number"),
        (
            "L1: [L1_entrance, ",
            "L1: [L1_entrence, ",
            "group 'L1': unknown surface 'L1_entrence': did you mean L1_entrance",
        ),
        ("L1: [L1_entrance, L1_exit]", "L1: 3", "groups.L1 = 3: expected a list of names"),
        ("name: M2,", "name: M1,", "surface name 'M1' occurs more than once"),
        ("name: M2,", "name: 2,", "surfaces[2].name = 2: expected a text"),
        (
            "silica: {B: [0.69618302, ",
            "silica: {B: [",
            "media.silica.B = (0.407925877, 0.897464057): expected 3",
        ),
        ("silica: {B", "vacuum: {B", "media.vacuum = "),
        ("default: 0.624", "default: 6.24", "default_wavelength = 6.24e-06: expected within the wavelength range"),
        ("range: [0.3, 1.2]", "range: [1.2, 0.3]", "wavelength_range"),
        ("{radius: 1.75, limit: 2.5}", "{radius: 1.75, limit: 1.5}", "field_radius = 1.75 deg: expected at most the f"),
        ("surfaces:\n", "surfaces: 3\nspare:\n", "unknown key spare"),
        ("camera: lsst", "camera: lsst\ncamera: lsst", "line 20: not valid YAML: key 'camera' occurs twice"),
        ("camera: lsst", "camera: [lsst", "not valid YAML"),
        ("camera: lsst", "camera: !!python/name:os.system", "not valid YAML: could not determine a constructor"),
        ("camera: lsst", "3: lsst", "key 3: expected a name"),
        ("camera: lsst", "camera: ''", "camera = '': expected a text"),
    ],
)
def test_malformed_files_say_file_key_value_and_what_was_expected(tmp_path, old, new, expected):
    assert old in TEXT
    assert expected in message(tmp_path, TEXT.replace(old, new, 1))


@pytest.mark.parametrize("text", ["", "just text", "- a\n- b\n", "surfaces: []"])
def test_files_that_are_no_prescription_are_refused(tmp_path, text):
    message(tmp_path, text)


@pytest.mark.parametrize("key", [line.split(":")[0] for line in TEXT.splitlines() if re.match(r"[a-z_]+:", line)])
def test_a_missing_header_key_is_named_or_optional(tmp_path, key):
    content = yaml.safe_load(TEXT)
    del content[key]
    if key in ("description", "camera", "groups"):
        load_text(tmp_path, yaml.safe_dump(content))
    elif key == "media":
        assert "medium = 'silica': expected one of vacuum" in message(tmp_path, yaml.safe_dump(content))
    else:
        assert message(tmp_path, yaml.safe_dump(content)) == f"mine.yaml: {key} is missing"


def test_a_failed_save_leaves_no_scrap(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(PrescriptionError, match=r"cannot write .*full\.yaml: No space left on device"):
        save_telescope(load_telescope("paul_baker"), tmp_path / "full.yaml")
    assert list(tmp_path.iterdir()) == []


def test_text_of_a_telescope_loads_anywhere():
    content = yaml.safe_load(telescope_to_yaml(load_telescope("paul_baker")))
    assert [row["name"] for row in content["surfaces"]] == ["M1", "M2", "M3", "Detector"]
