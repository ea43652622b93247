"""Lens files of optiland and ray-optics against rays that these packages traced, stored beside them."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle, Complement, Rectangle
from pachon.models.first_order import first_order
from pachon.models.rotation import rotation_matrix

DATA = Path(__file__).parents[2] / "data" / "lensfiles"
STORED = json.loads((DATA / "rays.json").read_text())
FILES = [name for name, entry in STORED.items() if isinstance(entry, dict)]


def local_image_points(telescope, rows, wavelength):
    """Return x, y, z [m] on the image, in its axes of the file, of rays by the columns of rays.json."""
    # The frame of the file is turned by half a turn about y.
    first = telescope.surfaces[0].vertex[2]
    direction = rows[:, 2:5] * [-1.0, 1.0, -1.0]
    position = np.column_stack([-rows[:, 0], rows[:, 1], np.full(len(rows), 0.0)]) * 1e-3 + [0.0, 0.0, first]
    # Rays start before the first surface, sag included.
    position = position - 0.5 * telescope.pupil_diameter * direction
    rays = pachon.Rays(position, direction, np.zeros(len(rows)), wavelength)
    traced = pachon.trace(telescope, rays)
    image = telescope.surfaces[-1]
    return (np.array(traced.position) - image.vertex) @ image.matrix * [-1.0, 1.0, -1.0]


@pytest.mark.parametrize("name", FILES)
def test_rays_are_those_of_the_package_that_owns_the_format(name):
    telescope = pachon.load_telescope(DATA / name)
    rows = np.array(STORED[name]["rays"])
    found = local_image_points(telescope, rows, STORED[name]["wavelength_um"] * 1e-6)
    # optiland's iteration ends at 1e-13 m of sag; the paths of the Hubble telescope are of 10 m.
    assert np.allclose(found, rows[:, 5:] * 1e-3, rtol=0, atol=1e-12)


def test_system_data_of_optiland():
    triplet = pachon.load_telescope(DATA / "cooke_triplet.json")
    assert triplet.surface_names == ("S1", "S2", "S3", "S4", "S5", "S6", "Image")
    assert triplet.pupil_diameter == 0.01
    assert triplet.field_radius == pytest.approx(np.deg2rad(20.0), rel=1e-15)
    assert triplet.default_wavelength == pytest.approx(550e-9, rel=1e-15)
    # optiland 0.6.3: paraxial.f2() and EPL() of this sample [mm].
    assert first_order(triplet).focal_length == pytest.approx(49.999783071431914e-3, rel=1e-13)
    assert triplet.stop_z == pytest.approx(-11.512158673746795e-3, rel=1e-13)
    hubble = pachon.load_telescope(DATA / "hubble.json")
    mirror = hubble.surfaces[1]
    assert (mirror.shape.radius, mirror.shape.conic) == (pytest.approx(11.04002286, rel=1e-15), -1.001152)
    assert isinstance(mirror.aperture, Complement)
    # The published focal ratio of the Hubble telescope is 24; primary of 2.4 m.
    assert first_order(hubble).f_number == pytest.approx(24.0, rel=2e-3)
    free = pachon.load_telescope(DATA / "freeforms.json")
    # x changes its sign with the axes.
    assert free.surfaces[0].aperture == Circle(0.012, -1e-4, 2e-4)
    window = free.surfaces[5].aperture
    assert isinstance(window, Rectangle)
    sizes = (window.width, window.height, window.x, window.y)
    assert sizes == pytest.approx((29e-3, 29e-3, 0.5e-3, 1.5e-3), rel=1e-14)


def test_system_data_of_rayoptics():
    tilts = pachon.load_telescope(DATA / "tilts.roa")
    assert tilts.pupil_diameter == pytest.approx(8e-3, rel=1e-15)
    assert tilts.description == "tilts"
    # Alpha 1, beta -2 and gamma 20 degrees, the first two left-handed.
    decentred = tilts.surfaces[1]
    turn = rotation_matrix(np.radians([-1.0, 2.0, 20.0]))
    half = np.diag([-1.0, 1.0, -1.0])
    assert np.allclose(decentred.matrix, half @ turn @ half, rtol=0, atol=1e-15)
    phone = pachon.load_telescope(DATA / "cell_phone_camera.roa")
    # The f-number of the image space that the file states, and its field by image height.
    assert first_order(phone).f_number == pytest.approx(3.5, rel=1e-9)
    chief = pachon.launch_rays(phone, (0.0, 1e-6), phone.default_wavelength, ([0.0], [0.0]))
    height = abs(pachon.trace(phone, chief).position[0, 1]) * np.tan(phone.field_radius) / 1e-6
    # The image height of 3.5 mm is paraxial; terms in r^3 of the aspheres leave a part that falls with the field.
    assert height == pytest.approx(3.5e-3, rel=2e-6)


@pytest.mark.parametrize(("name", "suffix"), [("cooke_triplet.json", ".json"), ("sasian_triplet.roa", ".roa")])
def test_a_key_that_is_not_understood_is_named(tmp_path, name, suffix):
    content = json.loads((DATA / name).read_text())
    root = content if suffix == ".json" else content["optical_model"]["attributes"]
    surface = (root["surface_group"]["surfaces"] if suffix == ".json" else root["seq_model"]["attributes"]["ifcs"])[2]
    (surface if suffix == ".json" else surface["attributes"])["gizmo"] = 3
    path = tmp_path / f"lens{suffix}"
    path.write_text(json.dumps(content))
    with pytest.raises(PrescriptionError, match=r"lens.*, surface 2: 'gizmo' = 3: this key is not understood"):
        pachon.load_telescope(path)
    with pytest.warns(PrescriptionWarning, match="gizmo"):
        lenient = pachon.load_telescope(path, lenient=True)
    assert lenient.surfaces == pachon.load_telescope(DATA / name).surfaces


def changed(path, target, *keys, value):
    """Write a file of JSON with another value at a place."""
    content = json.loads(path.read_text())
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    target.write_text(json.dumps(content))
    return target


SURFACES = ("surface_group", "surfaces")
IFCS = ("optical_model", "attributes", "seq_model", "attributes", "ifcs")
OPTICS = ("optical_model", "attributes", "optical_spec", "attributes")


@pytest.mark.parametrize(
    ("name", "keys", "value", "expected"),
    [
        ("cooke_triplet.json", ("aperture", "type"), "iris", "aperture: type = 'iris': expected one of EPD, imageFNO"),
        ("cooke_triplet.json", ("aperture", "value"), "wide", "aperture: value = 'wide': expected a number"),
        ("cooke_triplet.json", ("surface_group",), None, "expected the JSON file of an optiland Optic"),
        ("cooke_triplet.json", (*SURFACES, 1, "geometry", "type"), "Nurbs", "surface 1: geometry Nurbs: expected one"),
        ("cooke_triplet.json", (*SURFACES, 1, "geometry", "radius"), True, "surface 1: radius = True: expected a numb"),
        ("cooke_triplet.json", (*SURFACES, 1, "material_post", "filename"), "x/schott/GLAS1.yml",
         "surface 1: material GLAS1 of schott: not among the bundled glasses"),
        ("cooke_triplet.json", (*SURFACES, 1, "interaction_model", "type"), "ThinLensInteractionModel",
         "surface 1: interaction_model ThinLensInteractionModel: expected RefractiveReflectiveModel"),
        ("freeforms.json", (*SURFACES, 9, "geometry", "radius_x"), "flat", "surface 9: radius_x = .flat.: expected"),
        ("freeforms.json", (*SURFACES, 2, "geometry", "norm_radius"), 0.0,
         "surface 2: norm_radius = 0.0: expected a positive number"),
        ("freeforms.json", (*SURFACES, 2, "is_stop"), 3, "surface 2: is_stop = 3: expected true or false"),
        ("cooke_triplet.json", ("aperture", "value"), -3.0,
         "aperture: value = -3.0: expected an entrance pupil of finite size"),
        ("cooke_triplet.json", ("wavelengths", "wavelengths", 1, "value"), -0.5,
         "wavelength 1: value = -0.5: expected positive wavelengths"),
        ("cooke_triplet.json", ("fields", "fields", 2, "y"), 90.0, "field 2: y: expected fields within 89 degrees"),
        ("cooke_triplet.json", ("fields", "fields", 2, "vy"), 1.5, "field 2: vy = 1.5: .*expected compressions below"),
        ("cooke_triplet.json", (*SURFACES, 1, "material_post"), {"type": "Material", "name": "GLAS1"},
         "surface 1: name = 'GLAS1': the glass is in no catalogue"),
        ("cooke_triplet.json", (*SURFACES, 1, "geometry", "coefficients"), [1.0],
         "surface 1: 'coefficients' = \\[1.0\\]: this key is not understood"),
        ("freeforms.json", (*SURFACES, 2, "geometry", "zernike_type"), "mine", "zernike_type = 'mine': expected"),
        ("sasian_triplet.roa", (*IFCS, 2, "attributes", "interact_mode"), "diffract", "surface 2: Surface, interact"),
        ("sasian_triplet.roa", (*IFCS, 2, "attributes", "phase_element"),
         {"__instance_type__": ["rayoptics.oprops.doe", "HolographicElement"], "attributes": {}},
         "surface 2: phase_element HolographicElement: expected DiffractionGrating"),
        ("sasian_triplet.roa", (*IFCS, 2, "attributes", "profile_id"), "0", "surface 2: profile_id = '0': expected"),
        ("sasian_triplet.roa", (*OPTICS, "pupil", "attributes", "_key"), ["aperture", "image", "epd"],
         "pupil image epd: expected one of object epd"),
        ("sasian_triplet.roa", (*OPTICS, "pupil", "attributes", "value"), 0.0,
         "value = 0.0: expected an entrance pupil of finite size"),
        ("sasian_triplet.roa", (*OPTICS, "spectral_region", "attributes", "reference_wvl"), 7,
         "reference_wvl = 7: expected 0 to 2"),
        ("sasian_triplet.roa", (*OPTICS, "spectral_region", "attributes", "wavelengths"), [-500.0, 500.0],
         "wavelengths = .-500.0, 500.0.: expected positive wavelengths"),
        ("sasian_triplet.roa", (*OPTICS, "field_of_view", "attributes", "fields", 1, "attributes", "y"), 95.0,
         "x, y: expected fields within 89 degrees"),
        ("sasian_triplet.roa", (*IFCS, 2, "attributes", "clear_apertures"),
         [{"__instance_type__": ["surface", "Circular"], "attributes": {"radius": -3.0}}],
         "surface 2: clear_apertures: Circular: expected a smallest and a largest radius"),
        ("sasian_triplet.roa", ("optical_model",), None, "expected the file of a ray-optics OpticalModel"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(tmp_path, name, keys, value, expected):
    path = changed(DATA / name, tmp_path / name, *keys, value=value)
    with pytest.raises(PrescriptionError, match=expected) as error:
        pachon.load_telescope(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("radii", [(30.0, -45.0), (math.inf, 25.0), (25.0, math.inf)])
def test_a_biconic_of_optiland_is_the_sum_of_two_conics(tmp_path, radii):
    """z = cx x^2 / (1 + sqrt(1 - (1 + kx) cx^2 x^2)) + the same in y: geometries/biconic.py of optiland 0.6.3."""
    content = json.loads((DATA / "freeforms.json").read_text())
    geometry = content["surface_group"]["surfaces"][9]["geometry"]
    geometry |= {"radius_x": radii[0], "radius_y": radii[1], "conic_x": -0.6, "conic_y": 0.4}
    path = tmp_path / "biconic.json"
    path.write_text(json.dumps(content))
    telescope = pachon.load_telescope(path)
    shape = telescope.surfaces[8].shape
    x, y = np.meshgrid(np.linspace(-8e-3, 8e-3, 9), np.linspace(-7e-3, 7e-3, 8))
    cx, cy = (1e3 / r for r in radii)
    one = cx * x**2 / (1.0 + np.sqrt(1.0 - 0.4 * cx**2 * x**2))
    two = cy * y**2 / (1.0 + np.sqrt(1.0 - 1.4 * cy**2 * y**2))
    # The axes of the telescope are rotated by half a turn about y: x and z change their signs.
    assert np.allclose(shape.sag(-x, y), -(one + two), rtol=0, atol=1e-18)
    # Rays meet that surface, in its own axes, to rounding.
    points = (np.array([0.0, 2e-3, -1e-3]), np.array([1e-3, -1e-3, 2e-3]))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), telescope.default_wavelength, points)
    reached = pachon.trace(telescope, rays, surfaces="all")[8]
    local = telescope.surfaces[8].to_local(np.array(reached.position))
    assert np.allclose(local[:, 2], shape.sag(local[:, 0], local[:, 1]), rtol=0, atol=1e-16)
    # And the same once more after writing.
    pachon.save_telescope(telescope, tmp_path / "again.json")
    again = pachon.load_telescope(tmp_path / "again.json").surfaces[8].shape
    assert np.allclose(again.sag(-x, y), -(one + two), rtol=0, atol=1e-17)


def test_files_that_are_no_json(tmp_path):
    path = tmp_path / "lens.json"
    for content, expected in (
        ("[1, 2]", "expected a JSON object"),
        ("{", "not a JSON file"),
        ("[" * 100000, "not a JSON"),
    ):
        path.write_text(content)
        with pytest.raises(PrescriptionError, match=expected):
            pachon.load_telescope(path)


@pytest.mark.parametrize("ending", ["json", "roa"])
def test_whole_numbers_that_no_float_holds_are_named(tmp_path, ending):
    path = tmp_path / f"lens.{ending}"
    pachon.save_telescope(pachon.new_telescope("doublet"), path)
    key = {"json": "rx", "roa": "cv"}[ending]
    path.write_text(re.sub(f'"{key}": [-.\\de]+', f'"{key}": 1{"0" * 400}', path.read_text()))
    with pytest.raises(PrescriptionError, match=f"{key} = .*: expected a finite number"):
        pachon.load_telescope(path)


@pytest.mark.parametrize("name", ["lsst_v3.3_r", "paul_baker", "freeforms.json"])
def test_written_for_optiland_and_read_again(tmp_path, name):
    telescope = pachon.load_telescope(DATA / name if name.endswith(".json") else name)
    path = tmp_path / "written.json"
    pachon.save_telescope(telescope, path)
    again = pachon.load_telescope(path)
    angle = 0.5 * telescope.pupil_diameter * np.array([0.2, 0.5, 0.8, 0.95])
    points = (angle * np.cos([0.0, 1.0, 2.0, 3.0]), angle * np.sin([0.0, 1.0, 2.0, 3.0]))
    field = (0.3 * telescope.field_radius, -0.5 * telescope.field_radius)
    found = [
        pachon.trace(t, pachon.launch_rays(t, field, telescope.default_wavelength, points)) for t in (telescope, again)
    ]
    shift = np.subtract(telescope.surfaces[0].vertex, again.surfaces[0].vertex)
    # Rounding of millimetres and of places along the axis, of 20 m.
    assert np.allclose(found[0].position, found[1].position + shift, rtol=0, atol=1e-14)
    assert np.array_equal(found[0].status, found[1].status)
    assert again.default_wavelength == telescope.default_wavelength
    assert again.pupil_diameter == pytest.approx(telescope.pupil_diameter, rel=1e-15)
    assert [s.name for s in again.surfaces] == [s.name for s in telescope.surfaces]


def test_an_ellipse_written_for_optiland_and_read_again(tmp_path):
    telescope = replace(pachon.load_telescope("paul_baker"), pupil_obscuration=0.0)
    ellipse = pachon.models.Ellipse(2.0, 1.5, 0.25, -0.125)
    surfaces = tuple(replace(s, aperture=ellipse) if i == 0 else s for i, s in enumerate(telescope.surfaces))
    pachon.save_telescope(replace(telescope, surfaces=surfaces), tmp_path / "written.json")
    assert pachon.load_telescope(tmp_path / "written.json").surfaces[0].aperture == ellipse
    optiland = pytest.importorskip("optiland.fileio")
    optic = optiland.load_optiland_file(str(tmp_path / "written.json"))
    peer = next(s.aperture for s in optic.surfaces if s.aperture is not None)
    x, y = np.random.default_rng(1).uniform(-2.5, 2.5, (2, 1000))
    # Its x axis is the other way round, its lengths are millimetres.
    assert np.array_equal(ellipse.contains(x, y), np.asarray(peer.contains(-1e3 * x, 1e3 * y)))


@pytest.mark.parametrize("name", ["lens.json", "lens.zmx"])
def test_apertures_that_a_format_has_not_are_refused_or_left_out(tmp_path, name):
    decam = pachon.load_telescope("decam")
    with pytest.raises(
        PrescriptionError, match=r"surface FILTER_OBSTRUCTION: aperture obscuring Union: a .* has discs"
    ):
        pachon.save_telescope(decam, tmp_path / name)
    assert not list(tmp_path.iterdir())
    with pytest.warns(PrescriptionWarning) as warned:
        pachon.save_telescope(decam, tmp_path / name, lenient=True)
    left_out = {str(w.message).split(":")[0].removeprefix("surface ") for w in warned if "left out" in str(w.message)}
    assert {"FILTER_OBSTRUCTION", "SPIDER"} <= left_out
    again = pachon.load_telescope(tmp_path / name)
    for surface in again.surfaces:
        assert (surface.aperture is None) == (surface.name in left_out or decam.surface(surface.name).aperture is None)


def test_air_is_fitted_for_optiland(tmp_path):
    telescope = pachon.load_telescope("auxtel")
    with pytest.warns(
        pachon.errors.PrescriptionWarning, match="medium air: .*; a formula is fitted, within .e-1[0-9] of"
    ):
        pachon.save_telescope(telescope, tmp_path / "lens.json")
    again = pachon.load_telescope(tmp_path / "lens.json")
    w = telescope.default_wavelength
    assert float(again.medium_before.index(w)) == pytest.approx(float(telescope.medium_before.index(w)), abs=1e-12)


@pytest.mark.parametrize("about_y", [0.5 * np.pi, -0.5 * np.pi, 0.5 * np.pi - 1e-9, 0.5 * np.pi + 1e-14, 0.7])
def test_a_surface_turned_by_a_right_angle_is_written_for_optiland(tmp_path, about_y):
    """About y by a right angle, rotations about x and z are one: angles from single elements are rounding there."""
    telescope = pachon.load_telescope("paul_baker").perturbed("Detector", tilt=(0.2, about_y, -0.3))
    pachon.save_telescope(telescope, tmp_path / "lens.json")
    again = pachon.load_telescope(tmp_path / "lens.json")
    assert np.allclose(again.surfaces[-1].matrix, telescope.surfaces[-1].matrix, rtol=0, atol=2e-15)


def test_lenient_vignetting_without_a_counterpart_in_optiland_is_left_out(tmp_path):
    telescope = pachon.models.triplet(diameter=0.01, f_number=5.0)
    telescope = telescope.with_design(fields=((0.0, 0.1),), vignetting=((0.0, 0.1, 0.0, 0.2, 0.0),))
    with pytest.raises(PrescriptionError, match="compressions alone"):
        pachon.save_telescope(telescope, tmp_path / "lens.json")
    with pytest.warns(pachon.errors.PrescriptionWarning, match="the factors of all fields are left out"):
        pachon.save_telescope(telescope, tmp_path / "lens.json", lenient=True)
    assert not any(map(any, pachon.load_telescope(tmp_path / "lens.json").design_data.vignetting))


@pytest.mark.parametrize(
    ("kind", "terms"),
    [
        # r^2 sin 2t, 2 r^2 - 1, r^2 cos 2t, r cos t and (3 r^3 - 2 r) sin t, numbered and normalised as each has it.
        ("standard", {3: "astigmatism", 4: "defocus", 2: "tilt", 7: "coma"}),
        ("noll", {5: "astigmatism", 4: "defocus", 2: "tilt", 7: "coma"}),
        ("fringe", {6: "astigmatism", 4: "defocus", 2: "tilt", 8: "coma"}),
    ],
)
def test_orders_of_zernike_terms(tmp_path, kind, terms):
    first = 0 if kind == "standard" else 1
    values = {place: 1e-3 * (i + 1) for i, place in enumerate(terms)}
    content = json.loads((DATA / "freeforms.json").read_text())
    geometry = content["surface_group"]["surfaces"][2]["geometry"]
    coefficients = [values.get(first + i, 0.0) for i in range(9)]
    geometry |= {"zernike_type": kind, "radius": float("inf"), "conic": 0.0, "coefficients": coefficients}
    path = tmp_path / "zernikes.json"
    path.write_text(json.dumps(content))
    shape = pachon.load_telescope(path).surfaces[1].shape
    x, y = np.array([3.0, -5.0, 8.0]), np.array([4.0, 1.0, -7.0])
    r, t = np.hypot(x, y) / 15.0, np.arctan2(y, x)
    norms = {"astigmatism": 6**0.5, "defocus": 3**0.5, "tilt": 2.0, "coma": 8**0.5}
    forms = {
        "astigmatism": r**2 * np.sin(2 * t),
        "defocus": 2 * r**2 - 1,
        "tilt": r * np.cos(t),
        "coma": (3 * r**3 - 2 * r) * np.sin(t),
    }
    expected = sum(
        values[place] * forms[name] * (1 if kind == "fringe" else norms[name]) for place, name in terms.items()
    )
    # In the axes of the telescope x and z change their signs.
    assert np.allclose(shape.sag(-x * 1e-3, y * 1e-3), -expected * 1e-3, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("material", "square"),
    [
        ({"kind": "formula", "formula": "formula 1", "coefficients": [0, 1.2, 0.1], "wavelength_range_um": [0.3, 2]},
         lambda w: 1 + 1.2 * w**2 / (w**2 - 0.01)),
        ({"kind": "formula", "formula": "formula 2", "coefficients": [0, 1.2, 0.01, 0.3, 90.0]},
         lambda w: 1 + 1.2 * w**2 / (w**2 - 0.01) + 0.3 * w**2 / (w**2 - 90.0)),
        ({"kind": "formula", "formula": "formula 3", "coefficients": [2.3, -0.01, 2, 0.02, -2, 1e-4, -12]},
         lambda w: 2.3 - 0.01 * w**2 + 0.02 / w**2 + 1e-4 / w**12),
        ({"kind": "tabulated", "wavelengths_um": [0.4, 0.6, 0.7], "indices": [1.6, 1.5, 1.48]},
         lambda w: (1.6 - 0.5 * (w - 0.4)) ** 2),
    ],
)  # fmt: skip
def test_materials_of_formulas_and_tables(tmp_path, material, square):
    stated = {"type": "DataMaterial", "name": "mine", "definition": {"dispersion": material}}
    path = changed(DATA / "cooke_triplet.json", tmp_path / "a.json", *SURFACES, 1, "material_post", value=stated)
    medium = pachon.load_telescope(path).surfaces[0].medium_after
    waves = np.array([0.48, 0.55, 0.59])
    assert np.allclose(medium.index(waves * 1e-6), np.sqrt(square(waves)), rtol=1e-14)
    assert medium.name == "mine"
    # And the same once more after writing.
    pachon.save_telescope(pachon.load_telescope(path), tmp_path / "b.json")
    assert pachon.load_telescope(tmp_path / "b.json").surfaces[0].medium_after == medium


def test_an_abbe_material_is_a_model_glass_with_a_warning(tmp_path):
    stated = {"type": "AbbeMaterial", "index": 1.62, "abbe": 60.3}
    path = changed(DATA / "cooke_triplet.json", tmp_path / "a.json", *SURFACES, 1, "material_post", value=stated)
    with pytest.warns(PrescriptionWarning, match="AbbeMaterial 1.62, 60.3: optiland's dispersion of it is not read"):
        medium = pachon.load_telescope(path).surfaces[0].medium_after
    assert float(medium.index(587.5618e-9)) == pytest.approx(1.62, rel=1e-12)


def test_a_floating_stop_is_read_with_a_warning(tmp_path):
    keys = (*IFCS[:-1], "stop_surface")
    path = changed(DATA / "sasian_triplet.roa", tmp_path / "a.roa", *keys, value=None)
    with pytest.warns(PrescriptionWarning, match="stop_surface is null.*; the first surface is the stop"):
        assert pachon.load_telescope(path).stop_z == pytest.approx(0.0, abs=1e-15)


def test_files_of_optiland_before_version_0_5(tmp_path):
    """Fields had their kind themselves, surfaces whether they reflect; there was no interaction model."""
    content = json.loads((DATA / "cooke_triplet.json").read_text())
    del content["fields"]["field_definition"]
    for point in content["fields"]["fields"]:
        point["field_type"] = "angle"
    content["fields"] |= {"field_type": "angle", "object_space_telecentric": False}
    for surface in content["surface_group"]["surfaces"]:
        interaction = surface.pop("interaction_model", {})
        surface |= {key: interaction.get(key) for key in ("is_reflective", "coating", "bsdf")}
        surface["material_pre"] = {"type": "IdealMaterial", "index": 1.0, "absorp": 0.0}
    (tmp_path / "cooke_triplet.json").write_text(json.dumps(content))
    early = pachon.load_telescope(tmp_path / "cooke_triplet.json")
    assert early == pachon.load_telescope(DATA / "cooke_triplet.json")
    content["fields"]["field_type"] = "theodolite"
    (tmp_path / "cooke_triplet.json").write_text(json.dumps(content))
    with pytest.raises(PrescriptionError, match="field_type = 'theodolite': expected one of angle, object_height"):
        pachon.load_telescope(tmp_path / "cooke_triplet.json")
