"""Images, merits and files of afocal telescopes: closed forms, rays by hand, and differences."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from scipy.special import j0, j1

import pachon
from pachon.commands.cli import main
from pachon.core.errors import DomainError, PrescriptionError, PrescriptionWarning
from pachon.design.images.mtf import tangential_angle
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.optimize.merit import Beams, SpotMerit, WavefrontMerit
from pachon.models.design_data import DesignData
from pachon.models.first_order import first_order
from pachon.models.io.prescription import save_telescope
from pachon.models.media.medium import ConstantIndex
from pachon.models.parameters.parameters import parse_parameters
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.models.thin_lens import ThinLens
from pachon.pipeline.config import configuration_of
from pachon.pipeline.experiment import Experiment
from pachon.studies.metrics.telescope import TELESCOPE_METRICS, TelescopeScene

LIGHT = 500e-9
#: Focal lengths of two confocal paraboloids, and width of the beam, in units of their size.
LONG, SHORT, WIDTH = 1.0, 0.2, 0.05
EXIT = WIDTH * SHORT / LONG


def expander(size=1.0, moved=0.0):
    """A beam expander of 5, all of its lengths times a size [m]; the second mirror moved up the axis [m]."""
    place = (0.0, 0.0, size * (LONG - SHORT) + moved)
    return Telescope(
        name="expander",
        surfaces=(
            Surface("M1", Interaction.MIRROR, Conic(2 * size * LONG, -1.0), (0.0, 0.0, 0.0), VACUUM),
            Surface("M2", Interaction.MIRROR, Conic(2 * size * SHORT, -1.0), place, VACUUM),
            Surface("exit", Interaction.DETECTOR, Plane(), (0.0, 0.0, -0.1 * size), VACUUM),
        ),
        stop_z=0.0, pupil_diameter=size * WIDTH, pupil_obscuration=0.0, launch_distance=2.0 * size,
        reference_sphere_radius=1.0, field_radius=2e-3, field_limit=1e-2, wavelength_range=(4e-7, 7e-7),
        default_wavelength=LIGHT, design_data=DesignData(afocal=True),
    )  # fmt: skip


@pytest.mark.parametrize("size", [1.0, 200.0])
def test_wavefronts_refer_to_plane_waves_and_pupils_have_any_size(size):
    """Beams of 10 mm and 2 m: paths to a plane across the chief ray, and the Airy disc of the exit pupil."""
    telescope, field = expander(size, moved=2e-6 * size), (1e-3, 1e-3)
    x, y = 0.5 * WIDTH * size * np.array([[0.0, 0.9, -0.3, 0.1], [0.0, 0.1, 0.7, -0.95]])
    end = pachon.trace(telescope, pachon.launch_rays(telescope, field, LIGHT, (x, y)), threads=1)
    along, place = end.direction[0], end.position - np.array(telescope.surfaces[-1].vertex)
    path = end.path_length - (place @ along) / (end.direction @ along)
    found = pachon.wavefront_opd(telescope, field, LIGHT, (x, y), threads=1)
    assert np.abs(found.value).max() > 1e-9 * size
    # Rounding of paths of some metres, or some hundred.
    assert found.value == pytest.approx(path[0] - path, abs=1e-15 * max(size, 4.0))
    assert found.radius == np.inf
    many = pachon.wavefront_opds(telescope, [field], LIGHT, (x, y), threads=1)
    assert many.value[0] == pytest.approx(found.value, abs=1e-15 * max(size, 4.0))
    fans = pachon.design.opd_fans(telescope, [field], n_points=5, threads=1)
    assert np.isfinite(fans.value).all()
    diagram = pachon.spots(telescope, [[0.0, 0.0]], threads=1)
    # To the next order: the aperture over the focal length, squared.
    assert diagram.airy_radius[0] == pytest.approx(1.22 * LIGHT / (EXIT * size), rel=2e-4)


def test_the_mean_of_all_rays_as_reference_removes_tilt_and_piston():
    telescope, field = expander(moved=2e-6), (0.0, 1e-3)
    found = pachon.wavefront_opd(telescope, field, LIGHT, grid=16, reference="mean", threads=1)
    assert np.nanmean(found.value) == pytest.approx(0.0, abs=1e-15)
    plane = np.stack([found.x[found.lit], found.y[found.lit]])
    # The mean direction is that of the mean slope of the wavefront: its tilts vanish to the slope of coma.
    assert np.abs(plane @ found.value[found.lit]).max() < 1e-2 * np.abs(plane * found.value[found.lit]).sum()


@pytest.mark.parametrize("make", [pachon.fft_psf, pachon.huygens_psf])
def test_a_perfect_expander_has_the_airy_pattern_in_angles(make):
    pattern = make(expander(), [[0.0, 0.0]], LIGHT, pixels=65, threads=1)
    angle = np.hypot(*np.meshgrid(pattern.axis, pattern.axis))
    reach = np.maximum(np.pi * EXIT * angle / LIGHT, 1e-9)
    airy = (2.0 * j1(reach) / reach) ** 2
    # Lattices of 128 and 160 points across the pupil.
    assert pattern.image[0] / pattern.image[0].max() == pytest.approx(airy, abs=2e-3)
    assert pattern.strehl[0] == pytest.approx(1.0, abs=1e-4)
    assert str(pattern.to_table()["fwhm"].unit) == "rad"
    assert pattern.summary()["airy_radius_urad"] == pytest.approx([1.22e6 * LIGHT / EXIT], rel=1e-3)


def test_encircled_energy_is_that_of_the_airy_disc_and_of_the_rays():
    radius = LIGHT / EXIT * np.array([0.6, 1.0, 1.5])
    found = pachon.encircled_energy(expander(), [[0.0, 0.0]], LIGHT, radii=radius, threads=1)
    reach = np.pi * EXIT * radius / LIGHT
    # Rayleigh's formula; pixels of a fifth of wavelength over aperture.
    assert found.fraction[0] == pytest.approx(1.0 - j0(reach) ** 2 - j1(reach) ** 2, abs=3e-3)
    assert str(found.to_table()["radius"].unit) == "rad"
    # Slopes of defocus grow with the height: uniform light within their largest, h d / f^2.
    moved = 2e-6
    rays = pachon.encircled_energy(expander(moved=moved), [[0.0, 0.0]], LIGHT, kind="geometric", threads=1)
    largest = 0.5 * EXIT * moved / SHORT**2
    assert rays.radius_holding(0.5)[0] == pytest.approx(np.sqrt(0.5) * largest, rel=5e-3)
    assert "ee80_radius_urad" in rays.summary()


def test_distortion_is_the_angular_magnification():
    found = pachon.distortion(expander(), threads=1)
    assert found.axis_focal_length == pytest.approx(LONG / SHORT, rel=1e-9)
    # Tangents along y by chief rays traced one by one.
    ends = [pachon.Request.of(expander(), (0.0, a)).bundles(LIGHT, np.zeros((1, 2))).chief_landing() for a in (0, 2e-3)]
    ratio = abs(float((ends[1] - ends[0])[0, 1])) / np.tan(2e-3)
    edge = np.argmax(found.fields[:, 1])
    assert found.percent_of_axis_scale[edge] == pytest.approx(100.0 * (ratio * SHORT / LONG - 1.0), abs=1e-7)
    summary = found.summary()
    assert summary["axis_angular_magnification"] == found.axis_focal_length
    assert {"largest_shift_urad", "position_mrad"} < set(summary)
    assert "focal_length_m" not in summary
    assert str(found.to_table()["shift"].unit) == "rad"
    found.plot()


def lenses(first=0.2, second=0.05):
    """A Keplerian telescope of two thin plano-convex lenses, n = 1.5; the stop is the first."""
    glass = ConstantIndex(1.5)
    z = -(first + second)

    def lens(name, focal, at):
        return (
            Surface(f"{name} front", Interaction.REFRACT, Conic(-0.5 * focal, 0.0), (0.0, 0.0, at), glass),
            Surface(f"{name} back", Interaction.REFRACT, Plane(), (0.0, 0.0, at), VACUUM),
        )

    return replace(
        expander(),
        name="kepler",
        surfaces=(
            *lens("objective", first, 0.0),
            *lens("eyepiece", second, z),
            Surface("exit", Interaction.DETECTOR, Plane(), (0.0, 0.0, z - 0.1), VACUUM),
        ),
        pupil_diameter=0.01,
    )


def test_a_keplerian_telescope_to_first_order():
    first, second = 0.2, 0.05
    found = first_order(lenses(first, second))
    assert found.angular_magnification == pytest.approx(-first / second, rel=1e-12)
    assert found.exit_pupil_diameter == pytest.approx(0.01 * second / first, rel=1e-12)
    # The eyepiece makes an image of the objective behind itself.
    assert found.exit_pupil_z == pytest.approx(-(first + second) - second * (1.0 + second / first), rel=1e-12)


def test_a_tilted_plate_leaves_directions_and_waves_as_they_are(afocal):
    plate = afocal(fold=False).with_design(afocal=True)
    for angle in (0.0, 0.3):
        tilted = plate
        for name in ("front", "back"):
            tilted = tilted.perturbed(name, tilt=(angle, 0.0, 0.0), about=(0.0, 0.0, 0.0))
        diagram = pachon.spots(tilted, [[0.0, 0.0], [0.0, 1e-3]], threads=1)
        # Sines and their inverse in glass.
        assert diagram.rms_radius == pytest.approx(0.0, abs=1e-15)
        assert diagram.reference_point[1] - diagram.reference_point[0] == pytest.approx([0.0, np.tan(1e-3)], abs=1e-14)
        opd = pachon.wavefront_opd(tilted, (0.0, 1e-3), LIGHT, grid=8, threads=1)
        assert np.nanmax(np.abs(opd.value)) < 1e-14


@pytest.mark.parametrize("merit", [SpotMerit, WavefrontMerit])
@pytest.mark.parametrize("aiming", ["off", "real"])
def test_derivatives_of_merits_are_those_of_differences(merit, aiming):
    telescope = expander(moved=1e-4).with_design(aiming=aiming, stop="M1")
    names = ["M2.dz", "M2.dx", "M2.rx", "M2.conic", "M1.curvature"]
    chosen = parse_parameters(names, telescope)
    judge = merit(telescope, Beams.of(telescope, [[0.0, 0.0], [1e-3, 2e-3]], threads=1))
    value, slopes = judge.derivatives(ParameterColumns.at(telescope, chosen))
    assert judge.residuals(telescope) == pytest.approx(value, abs=1e-15)
    for i, name in enumerate(names):
        step = (1e-4 if name == "M2.conic" else 1e-6) * np.eye(len(names))[i]
        ends = [judge.derivatives(ParameterColumns.at(telescope, chosen, s * step))[0] for s in (1.0, -1.0)]
        change = (ends[0] - ends[1]) / (2.0 * step[i])
        # Rounding of residuals over the step, and its square.
        assert slopes[:, i] == pytest.approx(change, abs=1e-5 * np.abs(change).max() + 1e-10), name


def test_sensitivities_are_those_of_differences():
    telescope, fields, step = expander(moved=1e-4), [[0.0, 0.0], [1e-3, 2e-3]], 1e-6
    found = pachon.sensitivity(telescope, ["M2.dz"], fields, n_zernike=11, threads=1)
    plain, *ends = (
        pachon.wavefront_zernikes(telescope.perturbed("M2", shift=(0, 0, h)), fields, jmax=11, threads=1).coefficients
        for h in (0.0, step, -step)
    )
    assert found.zernikes == pytest.approx(plain, abs=1e-14)
    assert found.matrix[..., 0] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-9)


@pytest.mark.parametrize("merit", [pytest.param("spots", marks=pytest.mark.slow), "wavefront"])
def test_an_expander_out_of_adjustment_is_optimised(merit, tmp_path):
    found = pachon.optimize(expander(moved=1e-4), ["M2.dz"], merit, [[0.0, 0.0]], threads=1)
    assert found.telescope.surface("M2").vertex[2] == pytest.approx(LONG - SHORT, abs=1e-10)
    assert found.merits[1] < 1e-6 * found.merits[0]
    unit = "rad" if merit == "spots" else "m"
    assert f"rms_end_{unit}" in found.summary()
    assert repr(found).endswith(f" {unit}>")
    found.plot().savefig(tmp_path / "optimum.png")


def test_operands_hold_angles():
    telescope = expander(moved=1e-4)
    with pytest.raises(DomainError, match=r"expected one with a focus.*AMAG"):
        pachon.design.FocalLength(value=4.9).measure(expander())
    magnification = pachon.design.ImageScale(value=4.9)
    assert magnification.measure(expander()) == pytest.approx(LONG / SHORT, rel=1e-6)
    found = pachon.optimize(
        telescope, ["M2.dz", "M2.curvature"], "spots", [[0.0, 0.0]], targets=[magnification], threads=1
    )
    assert magnification.measure(found.telescope) == pytest.approx(4.9, rel=1e-6)


def test_configurations_of_afocal_telescopes_are_optimised_together():
    """Two expanders that share the error of the place of their second mirror."""
    pair = [expander(moved=1e-4), replace(expander(moved=1e-4), name="narrow", pupil_diameter=0.5 * WIDTH)]
    found = pachon.optimize(pair, ["M2.dz"], "wavefront", [[0.0, 0.0]], threads=1)
    assert [t.surface("M2").vertex[2] for t in found.telescopes] == pytest.approx([LONG - SHORT] * 2, abs=1e-10)
    target = pachon.design.Target(lambda t: first_order(t).angular_magnification, value=4.9, weight=1.0)
    found = pachon.optimize(pair[0], ["M2.curvature"], "spots", [[0.0, 0.0]], targets=[target], threads=1)
    assert found.operands[0].end != found.operands[0].start


def test_colours_side_by_side_in_microradians():
    matrix = pachon.design.spot_matrix(
        expander(moved=1e-5), [[0.0, 0.0]], [4e-7, 6e-7], against="wavelength", threads=1
    )
    spots = pachon.spots(expander(moved=1e-5), [[0.0, 0.0]], 4e-7, sampling="rings", n_pupil=10, threads=1)
    assert matrix.rms_radius == pytest.approx(np.full((1, 2), spots.rms_radius[0]), rel=1e-9)
    assert str(matrix.to_table()["rms_radius"].unit) == "urad"
    matrix.plot()
    color = pachon.design.lateral_color(lenses(), threads=1)
    assert color.shift == pytest.approx(0.0, abs=1e-15)
    assert "spread_urad" in color.summary()
    color.plot()


ZEMAX = """MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 25
FTYP 0 0 2 1 0 0 {afocal}
XFLN 0 0
YFLN 0 1
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 0.01
  DISZ 4
  GLAS N-BK7
SURF 2
  TYPE STANDARD
  DISZ 50
SURF 3
  TYPE STANDARD
"""


def test_files_keep_that_the_image_space_is_afocal(tmp_path):
    path = tmp_path / "lens.zmx"
    for afocal in (0, 1):
        path.write_text(ZEMAX.format(afocal=afocal))
        telescope = pachon.load_telescope(path)
        assert telescope.design_data.afocal == bool(afocal)
        for name in ("again.zmx", "again.yaml"):
            pachon.save_telescope(telescope, tmp_path / f"{afocal}{name}")
            assert pachon.load_telescope(tmp_path / f"{afocal}{name}").design_data.afocal == bool(afocal)
    # Files of optiland have no place for it.
    with pytest.raises(PrescriptionError, match="afocal: a file of optiland has no place for it"):
        pachon.save_telescope(telescope, tmp_path / "lens.json")
    with pytest.warns(PrescriptionWarning, match="afocal"):
        pachon.save_telescope(telescope, tmp_path / "lens.json", lenient=True)


def test_runs_and_metrics_of_sweeps(tmp_path):
    pachon.save_telescope(expander(), tmp_path / "expander.yaml")
    config = configuration_of({"telescope": "expander.yaml", "camera": "comcam"}, "test")
    with pytest.raises(DomainError, match="expander is afocal, its light parallel: a camera needs an image"):
        Experiment.from_config(config, tmp_path)
    scene = TelescopeScene(expander(moved=1e-5), np.zeros((1, 2)), threads=1)
    # Slopes of defocus, uniform light within the largest.
    rms = 0.5 * EXIT * 1e-5 / SHORT**2 / np.sqrt(2.0)
    assert TELESCOPE_METRICS["spots"].compute(scene)["spot_rms_um"] == pytest.approx(1e6 * rms, rel=2e-3)


@pytest.mark.parametrize(("line", "afocal"), [("", False), ("AFO YES", True), ("AFO", True), ("AFO NO", False)])
def test_a_code_v_file_says_that_it_is_afocal(tmp_path, line, afocal):
    path = tmp_path / "lens.seq"
    path.write_text(
        f"RDM\nDIM M\nEPD 20\nWL 550\n{line}\nYAN 0 1\nSO 0 1e11\nS 100 4 NBK7_SCHOTT\nS 0 50\nSI 0 0\nGO\n"
    )
    assert pachon.load_telescope(path).design_data.afocal == afocal


def test_the_tangential_direction_of_transfer_is_that_of_the_field():
    """Behind ideal lenses light is parallel: differences of the directions of marginal rays are rounding alone."""
    air = ConstantIndex(1.0)
    first, second = (
        Surface(name, Interaction.THIN_LENS, Plane(), (0.0, 0.0, z), air, thin_lens=ThinLens(focal_length))
        for name, z, focal_length in (("objective", 0.0, 0.5), ("eyepiece", -0.6, 0.1))
    )
    surfaces = (first, second, Surface("exit", Interaction.DETECTOR, Plane(), (0.0, 0.0, -0.7), air))
    telescope, angle = replace(expander(), surfaces=surfaces), np.deg2rad([0.0, 30.0, 60.0, 135.0])
    fields = 2e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = tangential_angle(telescope, pachon.design.principal_rays(telescope, fields))
    assert np.sin(found - angle) == pytest.approx(np.zeros(4), abs=1e-5)


def test_files_of_images_say_that_pixels_are_angles(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_telescope(expander(), "expander.yaml")
    assert (
        main(["psf", "expander.yaml", "--field-deg", "0", "--pixels", "16", "--pupil-points", "32", "-o", "p.fits"])
        == 0
    )
    assert fits.getheader("p.fits").comments["PIXEL"] == "[urad] distance of pixel centres"
