"""Files of ray-optics against its own rays, and ours as it reads them: written as .roa and as .seq."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.first_order import first_order
from pachon.models.media.medium import ConstantIndex, Sellmeier
from pachon.models.rotation import rotation_matrix
from pachon.models.surface import Interaction
from pachon.models.telescope import VACUUM

rayoptics = pytest.importorskip("rayoptics")

# Each ray is traced by Python there.
pytestmark = pytest.mark.slow
ROOT = Path(rayoptics.__file__).parent
FILES = [
    *(
        f"models/{name}.roa"
        for name in ("Cassegrain", "Dall_Kirkham", "Ritchey_Chretien", "Sasian Triplet", "TwoMirror")
    ),
    *("models/double2frelay.roa", "models/f2 focuser.roa", "models/singlet_f5.roa", "models/telephoto.roa"),
    *("optical/tests/cell_phone_camera.roa", "optical/tests/Nikon Nikkor Z 14-30mm f-4 S.roa"),
    *("optical/tests/US007277232_Example04P.roa", "optical/tests/US007277232_Example04P_hikari_glasses.roa"),
    *("gui/tests/cell_phone_camera_old.roa", "zemax/models/PhotoPrime/US05331467-1_asm.roa"),
]
UNITS = {"mm": 1e3, "cm": 1e2, "m": 1.0}
LENSES = sorted((Path(__file__).parents[1] / "data" / "lenses").glob("*.zmx"))
#: Planes in front of the first surface that carry the entrance pupil, and CODE V's shapes.
OFF_AXIS, ODD = ("decentred", "fold"), "odd_asphere"


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Its importer of CODE V writes a log into the folder it is called from."""
    monkeypatch.chdir(tmp_path)


def compare_rays(telescope, model, origin):
    """Compare rays through a model of ray-optics with ours; `origin` is the height of its first surface [m]."""
    from rayoptics.raytr import trace

    sequence, unit = model["seq_model"], UNITS[model.system_spec.dimensions.lower()]
    # The object a millimetre in front of the first surface: rays of any direction from any point of its plane.
    sequence.gaps[0].thi = 1.0
    sequence.update_model()
    wavelength = telescope.default_wavelength
    # It looks for wavelengths of its own by their exact numbers.
    nm = min(model["optical_spec"].spectral_region.wavelengths, key=lambda w: abs(w - wavelength * 1e9))
    assert nm == pytest.approx(wavelength * 1e9, rel=1e-12)
    rng = np.random.default_rng(4)
    radius, angle = 0.5 * telescope.pupil_diameter * np.sqrt(rng.uniform(size=8)), rng.uniform(0, 2 * np.pi, 8)
    points = (radius * np.cos(angle), radius * np.sin(angle))
    for fraction in (0.0, 0.5):
        field = (0.2 * fraction * telescope.field_radius, fraction * telescope.field_radius)
        rays = pachon.launch_rays(telescope, field, wavelength, points, projection="zemax")
        traced = pachon.trace(telescope, rays)
        for place, along, ours in zip(
            np.array(rays.position), np.array(rays.direction), np.array(traced.position), strict=True
        ):
            x, y, z = (place - [0.0, 0.0, origin]) * [-unit, unit, -unit]
            direction = along * [-1.0, 1.0, -1.0]
            start = np.array([x, y, z]) - direction * (z + 1.0) / direction[2]
            start[2] = 0.0
            ray = trace.trace(sequence, start, direction, nm)[0]
            axes, vertex = sequence.gbl_tfrms[-1]
            found = axes @ ray[-1][0] + vertex
            # 1 nm is what was asked for, 6e-14 m what is found.
            assert np.allclose((ours - [0.0, 0.0, origin]) * [-unit, unit, -unit], found, rtol=0, atol=1e-12 * unit)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", [".roa", ".seq"])
@pytest.mark.parametrize("source", [*LENSES, "lsst_v3.3_r", "paul_baker"], ids=lambda s: Path(s).stem)
def test_ours_written_for_other_programs(tmp_path, source, ending):
    """The same rays, first-order data, stop, fields, wavelengths; ray-optics imports files of CODE V too."""
    from rayoptics.gui.appcmds import open_model

    telescope, path = pachon.load_telescope(source), tmp_path / f"ours{ending}"
    name = Path(source).stem
    if (name, ending) in ((ODD, ".seq"), ("lsst_v3", ".seq")):
        pytest.skip("no counterpart in CODE V, or chief rays that its importer loses from an object 1e13 mm away")
    pachon.save_telescope(telescope, path, lenient=True)
    telescope = telescope.with_design(aiming="off")
    model, data = open_model(str(path)), telescope.design_data
    plane = data.stop is None
    if np.isinf(telescope.object_distance):
        # Farther away its paraxial rays lose digits; that is where it has an object at infinity.
        model["seq_model"].gaps[0].thi = 1e10
        model.update_model()
    first = model["analysis_results"]["parax_data"].fod
    unit = UNITS[model.system_spec.dimensions]
    diameter = telescope.pupil_diameter
    if ending == ".seq" and data.aperture == "object_na":
        # It takes the numerical aperture for the slope.
        diameter = 2 * 0.150 * data.aperture_value
    assert 2 * first.enp_radius / unit == pytest.approx(diameter, rel=1e-6)
    origin = telescope.stop_z if plane else telescope.surfaces[0].vertex[2]
    assert origin - first.enp_dist / unit == pytest.approx(telescope.stop_z, abs=1e-6 * telescope.pupil_diameter)
    try:
        expected = first_order(telescope).focal_length
    except DomainError:
        assert name in OFF_AXIS
    else:
        # Powers of r and r^2 have no part in its focal length.
        expected = abs(first.efl) / unit if name == ODD else expected
        assert abs(first.efl) / unit == pytest.approx(abs(expected), rel=1e-6)
    labels = [surface.label for surface in model["seq_model"].ifcs[1:]]
    # From a file of CODE V it does not take the label of the image.
    known = len(labels) if ending == ".roa" else -1
    assert labels[:known] == (["pachon entrance pupil"] * plane + list(telescope.surface_names))[:known]
    stop = data.stop if data.stop is not None and not plane else "pachon entrance pupil"
    assert model["seq_model"].ifcs[model["seq_model"].stop_surface].label == stop
    optics = model["optical_spec"]
    if data.fields:
        size = np.radians(1.0) if data.field_type == "angle" else 1.0 / unit
        found = [(-field.x * size, field.y * size) for field in optics["fov"].fields]
        assert np.allclose(found, data.fields, rtol=1e-14, atol=0)
        assert np.allclose(optics["wvls"].wavelengths, np.array(data.wavelengths) * 1e9, rtol=1e-14)
        assert tuple(optics["wvls"].spectral_wts) == data.wavelength_weights
    compare_rays(telescope, model, origin)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", [".roa", ".seq"])
def test_glasses_of_no_catalogue_as_it_reads_them(tmp_path, ending):
    from rayoptics.gui.appcmds import open_model

    glass = Sellmeier((0.7, 0.4, 0.9), (0.005, 0.0135, 98.0), (0.3e-6, 2e-6), name="melt 7")
    singlet = pachon.load_telescope(LENSES[0].parent / "singlet.zmx")
    surfaces = (replace(singlet.surfaces[0], medium_after=glass), *singlet.surfaces[1:])
    pachon.save_telescope(replace(singlet, surfaces=surfaces), tmp_path / f"a{ending}", lenient=True)
    medium = open_model(str(tmp_path / f"a{ending}"))["seq_model"].gaps[1].medium
    for wave in singlet.design_data.wavelengths:
        assert medium.rindex(wave * 1e9) == pytest.approx(float(glass.index(wave)), rel=1e-14)
    # Between the entries of a table by a cubic spline.
    assert medium.rindex(555.5) == pytest.approx(float(glass.index(555.5e-9)), rel=1e-14 if ending == ".roa" else 1e-8)


@pytest.mark.filterwarnings("ignore")
def test_rays_that_it_launches_from_our_fields(tmp_path):
    """Chief rays through the middle of the stop, as ours are with paraxial aiming."""
    from rayoptics.gui.appcmds import open_model
    from rayoptics.raytr import trace

    triplet = pachon.load_telescope(LENSES[0].parent / "triplet.zmx")
    assert triplet.design_data.aiming == "paraxial"
    pachon.save_telescope(triplet, tmp_path / "ours.roa")
    model = open_model(str(tmp_path / "ours.roa"))
    for field, point in zip(model["optical_spec"]["fov"].fields, triplet.design_data.fields, strict=True):
        theirs = trace.trace_base(model, [0.0, 0.0], field, model["optical_spec"]["wvls"].central_wvl)[0][-1][0]
        rays = pachon.launch_rays(triplet, point, triplet.default_wavelength, ([0.0], [0.0]), projection="zemax")
        ours = np.array(pachon.trace(triplet, rays).position)[0]
        # Its search for the chief ray ends a nanometre from the middle of the stop.
        assert np.allclose(ours[:2] * [-1e3, 1e3], theirs[:2], rtol=0, atol=2e-6)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_rays_of_a_file(name):
    from rayoptics.gui.appcmds import open_model
    from rayoptics.raytr import trace

    if not (ROOT / name).is_file():
        pytest.skip(f"this ray-optics has no {name}")
    telescope, model = pachon.load_telescope(ROOT / name), open_model(str(ROOT / name))
    sequence, unit = model["seq_model"], UNITS[model.system_spec.dimensions.lower()]
    # The object a millimetre in front of the first surface: rays of any direction from any point of its plane.
    sequence.gaps[0].thi = 1.0
    sequence.update_model()
    wavelength = telescope.default_wavelength
    # It looks for wavelengths of its own by their exact numbers.
    nm = min(model["optical_spec"].spectral_region.wavelengths, key=lambda w: abs(w - wavelength * 1e9))
    assert nm == pytest.approx(wavelength * 1e9, rel=1e-12)
    rng = np.random.default_rng(4)
    radius, angle = 0.5 * telescope.pupil_diameter * np.sqrt(rng.uniform(size=8)), rng.uniform(0, 2 * np.pi, 8)
    points = (radius * np.cos(angle), radius * np.sin(angle))
    image, first = telescope.surfaces[-1], telescope.surfaces[0].vertex[2]
    for fraction in (0.0, 0.5):
        field = (0.2 * fraction * telescope.field_radius, fraction * telescope.field_radius)
        rays = pachon.launch_rays(telescope, field, wavelength, points, projection="zemax")
        traced = pachon.trace(telescope, rays)
        local = (np.array(traced.position) - image.vertex) @ image.matrix * [-unit, unit, -unit]
        for place, along, ours in zip(np.array(rays.position), np.array(rays.direction), local, strict=True):
            x, y, z = (place - [0.0, 0.0, first]) * [-unit, unit, -unit]
            direction = along * [-1.0, 1.0, -1.0]
            start = np.array([x, y, z]) - direction * (z + 1.0) / direction[2]
            start[2] = 0.0
            ray = trace.trace(sequence, start, direction, nm)[0]
            # 1 nm is what was asked for, 4e-14 m what is found.
            assert np.allclose(ours, ray[-1][0], rtol=0, atol=1e-12 * unit)


GRATINGS = [
    (Interaction.MIRROR, (12.0, -7.0, 20.0), pachon.models.Grating(2, 300.0, 0.4), 0.0),
    (Interaction.MIRROR, (0.0, 6.0, 0.0), pachon.models.Grating(-40, 31.6), 0.0),
    (Interaction.REFRACT, (5.0, 3.0, 0.0), pachon.models.Grating(-1, 600.0, -0.7), 0.0),
    (Interaction.REFRACT, (5.0, 3.0, 0.0), pachon.models.Grating(3, 100.0, 1.3), 1.6),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("interaction", "tilt", "grating", "index"), GRATINGS)
def test_plane_gratings(tmp_path, interaction, tilt, grating, index):
    """Its orders have the opposite sign in transmission."""
    from rayoptics.gui.appcmds import open_model

    after = ConstantIndex(index) if index else VACUUM
    turn = tuple(map(tuple, rotation_matrix(np.radians(tilt)).tolist()))
    place = (0.0, 0.0, 0.2 if interaction == Interaction.MIRROR else -0.2)
    surfaces = (
        pachon.Surface("ruled", interaction, pachon.Plane(), (0.0, 0.0, 0.0), after, rotation=turn, grating=grating),
        pachon.Surface("Detector", Interaction.DETECTOR, pachon.Plane(), place, after),
    )
    telescope = pachon.Telescope(
        "spectrograph", surfaces, stop_z=0.0, pupil_diameter=0.03, pupil_obscuration=0.0, launch_distance=2.0,
        reference_sphere_radius=1.0, field_radius=0.01, field_limit=0.2, wavelength_range=(4e-7, 8e-7),
        default_wavelength=550e-9, band=(5e-7, 6e-7),
    )  # fmt: skip
    path = tmp_path / "ours.roa"
    pachon.save_telescope(telescope, path)
    compare_rays(telescope, open_model(str(path)), 0.0)
    back = pachon.load_telescope(path)
    assert back.surfaces[0].grating.order == grating.order
