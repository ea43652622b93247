"""Gratings in prescription files and lens files: read, written, refused."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.media.medium import ConstantIndex
from pachon.models.rotation import rotation_matrix
from pachon.models.telescope import VACUUM

WAVELENGTH = 550e-9


def axes(*degrees):
    return tuple(map(tuple, rotation_matrix(np.radians(degrees)).tolist()))


def spectrograph(curved=True):
    """A transmission grating on glass, two tilted gratings on mirrors, and a detector along the light."""
    glass = ConstantIndex(1.5)
    shape = pachon.Conic(-0.9, -0.5) if curved else pachon.Plane()
    surfaces = [
        pachon.Surface("front", pachon.Interaction.REFRACT, pachon.Plane(), (0.0, 0.0, 0.3), glass),
        pachon.Surface("back", pachon.Interaction.REFRACT, pachon.Plane(), (0.0, 0.0, 0.295), VACUUM,
                       grating=pachon.models.Grating(-1, 90.0, 0.25)),
        pachon.Surface("air", pachon.Interaction.REFRACT, pachon.Plane(), (0.0, 0.0, 0.25), VACUUM,
                       pachon.models.Circle(0.05), axes(2.0, -3.0, 0.0), grating=pachon.models.Grating(1, 60.0)),
        pachon.Surface("ruled", pachon.Interaction.MIRROR, shape, (0.001, -0.002, 0.0), VACUUM,
                       pachon.models.Circle(0.06), axes(12.0, -6.0, 5.0),
                       grating=pachon.models.Grating(2, 123.4, -0.35)),
        pachon.Surface("second", pachon.Interaction.MIRROR, pachon.Plane(), (0.09, -0.13, 0.25), VACUUM,
                       rotation=axes(8.0, -4.0, 0.0), grating=pachon.models.Grating(-3, 77.0, 2.9)),
        pachon.Surface("Detector", pachon.Interaction.DETECTOR, pachon.Plane(), (0.2, -0.2, -0.1), VACUUM),
    ]  # fmt: skip
    return pachon.Telescope(
        "spectrograph", tuple(surfaces), stop_z=0.31, pupil_diameter=0.02, pupil_obscuration=0.0, launch_distance=2.0,
        reference_sphere_radius=1.0, field_radius=0.01, field_limit=0.2, wavelength_range=(4e-7, 8e-7),
        default_wavelength=WAVELENGTH, band=(5e-7, 6e-7),
    )  # fmt: skip


def landing(telescope, wavelength=WAVELENGTH):
    x, y = np.meshgrid(np.linspace(-0.009, 0.009, 5), np.linspace(-0.009, 0.009, 5))
    rays = pachon.launch_rays(telescope, (0.003, -0.002), wavelength, (x.ravel(), y.ravel()))
    end = pachon.trace(telescope, rays)
    assert (end.status == pachon.RayStatus.OK).all()
    return telescope.surfaces[-1].to_local(end.position), end.path_length


#: Curved gratings are those of all formats but ray-optics'.
FORMATS = [("yaml", True), ("zmx", True), ("seq", True), ("json", True), ("roa", False)]


@pytest.mark.parametrize(("ending", "curved"), FORMATS)
def test_written_and_read_again(ending, curved, tmp_path):
    telescope = spectrograph(curved)
    path = tmp_path / f"lens.{ending}"
    with warnings.catch_warnings():
        # What the formats do not state of pupils is told elsewhere.
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        back = pachon.load_telescope(path)
    if ending == "yaml":
        assert back.surfaces == telescope.surfaces
    assert [s.grating is None for s in back.surfaces] == [s.grating is None for s in telescope.surfaces]
    for wavelength in (520e-9, WAVELENGTH):
        (ours, our_paths), (theirs, their_paths) = landing(telescope, wavelength), landing(back, wavelength)
        # Rounding of angles in degrees over a metre.
        assert np.abs(ours - theirs).max() < 1e-14
        assert np.abs(np.diff(our_paths) - np.diff(their_paths)).max() < 1e-14


def zemax_file(folder, *surface, angle=(0.0, 0.0)):
    """A plate of N-BK7 with a grating on its back, in millimetres and micrometres."""
    lines = [
        "VERS 190513 30 123457 L123457", "MODE SEQ", "UNIT MM X W X CM MR CPMM", "ENPD 15",
        "FTYP 0 0 1 1 0 0 0", f"XFLN {angle[0]}", f"YFLN {angle[1]}", "WAVM 1 0.587 1", "PWAV 1",
        "SURF 0", "  TYPE STANDARD", "  CURV 0.0", "  DISZ INFINITY",
        "SURF 1", "  TYPE STANDARD", "  CURV 0.0", "  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0", "  DISZ 5",
        "SURF 2", "  STOP", *surface, "  DISZ 30", "SURF 3", "  TYPE STANDARD", "  CURV 0.0", "  DISZ 0",
    ]  # fmt: skip
    path = folder / "plate.zmx"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("angle", "expected"),
    [((0.0, 0.0), (0.0, -0.1174, 0.9930847094)), ((2.0, 8.0), (0.0345602649, 0.0216899611, 0.9991672201))],
)
def test_the_order_of_zemax(tmp_path, angle, expected):
    """Direction cosines along x, y, z of the file, from optiland's tests of this plate (checked with Zemax there)."""
    path = zemax_file(tmp_path, "  TYPE DGRATING", "  CURV 0.0", "  PARM 1 0.2", "  PARM 2 -1", angle=angle)
    telescope = pachon.load_telescope(path)
    assert telescope.surfaces[1].grating == pachon.models.Grating(-1, 200.0)
    field = telescope.design_data.fields[0]
    end = pachon.trace(telescope, pachon.launch_rays(telescope, field, 587e-9, ([0.0], [0.0]), projection="zemax"))
    x, y, z = end.direction[0]
    assert np.allclose((-x, y, -z), expected, atol=1e-10)


def test_codev_gratings(tmp_path):
    """GRS is the spacing in units of the lens, GRX GRY the vector across the grooves, along y where not stated."""
    head = "RDM;LEN\nDIM M\nEPD 10\nWL 550\nYAN 0\nSO 0 1e13\nS 0 100\n STO\n"
    for grooves, lines in (
        ("GRT; GRO -1; GRS 0.005", 200.0),
        ("DIF GRT; GRO 2; GRS 0.0025; GRX -0.6; GRY 0.8", 400.0),
    ):
        path = tmp_path / "lens.seq"
        path.write_text(f"{head}S 0 -100 REFL\n {grooves}\nSI 0 0\nGO\n")
        telescope = pachon.load_telescope(path)
        grating = telescope.surfaces[1].grating
        rays = pachon.launch_rays(telescope, (0.0, 0.0), 550e-9, ([0.0], [0.0]))
        x, y, z = pachon.trace(telescope, rays).direction[0]
        step = 550e-9 * 1e3 * lines * grating.order
        across = (0.0, 1.0) if "GRX" not in grooves else (-0.6, 0.8)
        assert np.allclose((-x, y), step * np.array(across), atol=1e-15)
        assert z > 0
        assert grating.lines_per_mm == pytest.approx(lines)


def test_optiland_phase_gratings_and_orders(tmp_path):
    """A linear phase profile has its period in millimetres, a grating in micrometres."""
    telescope = spectrograph(False)
    path = tmp_path / "lens.json"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        content = json.loads(path.read_text())
        surfaces = content["surface_group"]["surfaces"]
        ruled = next(s for s in surfaces if s["comment"] == "ruled")
        assert ruled["geometry"]["type"] == "PlaneGrating"
        assert ruled["geometry"]["period"] == pytest.approx(1e3 / 123.4)
        order, period, angle = (ruled["geometry"].pop(key) for key in ("order", "period", "angle"))
        ruled["geometry"]["type"] = "Plane"
        profile = {"phase_type": "linear_grating", "period": 1e-3 * period, "angle": angle + 0.5 * np.pi}
        model = {"type": "PhaseInteractionModel", "phase_profile": profile | {"order": order, "efficiency": 1.0}}
        ruled["interaction_model"] |= model
        path.write_text(json.dumps(content))
        back = pachon.load_telescope(path)
    assert np.abs(landing(telescope)[0] - landing(back)[0]).max() < 1e-14


REFUSED = [
    (("  TYPE GRINSUR1", "  CURV 0.0"), "TYPE GRINSUR1: gradient-index media are not read"),
    (("  TYPE HOLOGRM1", "  CURV 0.0"), "TYPE HOLOGRM1: holograms are not read"),
    (("  TYPE BIREFRIN", "  CURV 0.0"), "TYPE BIREFRIN: birefringent media are not read"),
    (("  TYPE DGRATING", "  CURV 0.0", "  PARM 1 0.2", "  PARM 2 1.5"), "PARM 2 1.5: expected a whole number"),
    (("  TYPE DGRATING", "  CURV 0.0", "  PARM 1 0.2", "  PARM 2 1", "  PARM 3 4"), "PARM 3 4: not understood"),
]


@pytest.mark.parametrize(("surface", "message"), REFUSED)
def test_refused_by_name(tmp_path, surface, message):
    with pytest.raises(PrescriptionError, match=message):
        pachon.load_telescope(zemax_file(tmp_path, *surface))


CODEV_REFUSED = [
    ("GRT; GRO 1.5; GRS 0.005", "GRO 1.5: expected a whole number"),
    ("GRT; GRO 1", "GRT: expected a positive spacing GRS"),
    ("GRT; GRO 1; GRS 0.005; GRZ 1", "GRZ 1: expected a vector GRX GRY across the grooves, GRZ 0"),
    ("GRO 1; GRS 0.005", "GRO 1: expected a grating"),
    ("DIF HOE", "DIF HOE: diffractive surfaces are not read"),
]


@pytest.mark.parametrize(("grooves", "message"), CODEV_REFUSED)
def test_codev_refused(tmp_path, grooves, message):
    path = tmp_path / "lens.seq"
    head = "RDM;LEN\nDIM M\nEPD 10\nWL 550\nYAN 0\nSO 0 1e13\nS 0 100\n STO\n"
    path.write_text(f"{head}S 0 -100 REFL\n {grooves}\nSI 0 0\n")
    with pytest.raises(PrescriptionError, match=message):
        pachon.load_telescope(path)


def test_yaml_refused(tmp_path):
    path = tmp_path / "lens.yaml"
    pachon.save_telescope(spectrograph(), path)
    text = path.read_text()
    for old, new, message in (
        ("order: 2", "order: 2.5", "order"),
        ("lines_per_mm: 123.4", "lines_per_mm: -1", "lines_per_mm"),
        ("lines_per_mm: 123.4", "lines: 3", "lines"),
        ("{order: 2, lines_per_mm: 123.4", "{lines_per_mm: 123.4", "order"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(PrescriptionError, match=message) as caught:
            pachon.load_telescope(path)
        assert "\n" not in str(caught.value)


def test_formats_without_gratings_say_so(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        telescope = spectrograph()
        with pytest.raises(PrescriptionError, match="surface back: grating: a batoid file has none"):
            pachon.save_telescope(telescope, tmp_path / "batoid.yaml", format="batoid")
        with pytest.raises(PrescriptionError, match=r"surface back: grating: .* is written without them"):
            pachon.save_telescope(telescope, tmp_path / "lens.len")
        with pytest.raises(PrescriptionError, match="surface ruled: grating on Conic: a ray-optics file has"):
            pachon.save_telescope(telescope, tmp_path / "lens.roa")
        ruled = telescope.surface("ruled")
        square = replace(ruled, aperture=pachon.models.Rectangle(0.1, 0.1))
        odd = replace(telescope, surfaces=tuple(square if s is ruled else s for s in telescope.surfaces))
        with pytest.raises(PrescriptionError, match="surface ruled: grating: a Zemax file has grooves along x"):
            pachon.save_telescope(odd, tmp_path / "lens.zmx")
