"""Runs with cameras other than the LSST's: rectangular and rotated CCDs, camera files, defaults, bad input."""

import json

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon import PachonError, load_camera
from pachon.commands.cli import main
from pachon.pipeline.config import Configuration, configuration_of, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run import run
from pachon.pipeline.run_folder import finished_ccds, stamp_of
from pachon.pipeline.sensor.displacement import EdgeRolloff
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_ccd, expose_positions
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.reconstruction.ccd_product import read_product
from pachon.studies.sweep.file import load_sweep

SMALL = {
    "telescope": "hsc",
    "wavelengths_nm": [770],
    "stars": {"truth": 14, "observed": 12},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 800, "exposure_s": 2, "time_step_s": 0.5},
    "psf": {"n_pupil": 60, "stamp": 25},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}
#: Two CCDs beside each other, one of them turned by a quarter; and the same as rectangles that are not turned.
TURNED = """\
name: two
source: test
pixel_um: 15
ccds:
  - {name: A, x_mm: -50, y_mm: 20, pixels: [2048, 4176], rotation_deg: 90}
  - {name: B, x_mm: 30, y_mm: 20, pixels: [2048, 2000], rotation_deg: 180}
"""
UPRIGHT = TURNED.replace("[2048, 4176], rotation_deg: 90", "[4176, 2048]").replace(", rotation_deg: 180", "")


def small(folder=None, **changes):
    return Experiment.from_config(configuration_of({**SMALL, **changes}, "test"), folder)


@pytest.fixture
def cameras(tmp_path):
    (tmp_path / "turned.yaml").write_text(TURNED)
    (tmp_path / "upright.yaml").write_text(UPRIGHT)
    return tmp_path


@pytest.mark.long
def test_the_axes_of_a_ccd_change_no_star(cameras):
    """A rectangle is one, however its rows run: stars, shapes and residuals of both descriptions are equal."""
    products = []
    for name in ("turned", "upright"):
        experiment = small(cameras, camera=f"{name}.yaml", focal_plane={"budget": "flat"}, ccds=["A", "B"])
        with experiment.screens(2):
            products.append([model_ccd(experiment, expose_ccd(experiment, c, threads=2)) for c in "AB"])
    for one, other in zip(*products, strict=True):
        for kind in ("holdout", "observed"):
            # Positions round differently in the last bit, which moves rays by as much and no photon.
            for column, error in {"x": 1e-16, "y": 1e-16, "e1": 1e-5, "e2": 1e-5, "model_e1": 1e-5}.items():
                a, b = (getattr(getattr(p, kind), column) for p in (one, other))
                np.testing.assert_allclose(a, b, rtol=0, atol=error)
        assert np.isfinite(one.holdout.e1).all()


@pytest.mark.slow
def test_hsc_runs_by_command_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hsc.yaml").write_text(json.dumps(SMALL))
    assert main(["run", "hsc.yaml", "--out", "out", "--quiet", "--ccds", "hsc103"]) == 0
    camera, experiment = load_camera("hsc"), small(ccds=["hsc103", "hsc050"])
    assert experiment.site.name == "maunakea"
    assert finished_ccds(tmp_path / "out", experiment) == ("hsc103",)
    product = read_product(tmp_path / "out" / "ccd_hsc103.fits", stamp_of(experiment))
    for stars in (product.holdout, product.observed):
        xy = np.stack([stars.x, stars.y], axis=1)
        assert camera.depth(103, *xy.T).min() > 0
        # Field angles are those of chief rays to the stars.
        found = pachon.fields_at(experiment.telescope, xy, 770e-9)
        assert np.allclose(found, np.stack([stars.field_x, stars.field_y], axis=1), rtol=0, atol=1e-9)
    # Of Maunakea's turbulence and a bit of optics.
    assert 0.3 < np.rad2deg(np.median(product.holdout.fwhm)) * 3600 < 0.8
    assert len(Table.read(tmp_path / "out" / "focal_plane.ecsv")) == 104 * 9
    # A run may grow; one that leaves out a finished CCD is another.
    assert main(["run", "hsc.yaml", "--out", "out", "--quiet", "--ccds", "hsc050", "--resume"]) == 2
    assert "another configuration" in capsys.readouterr().err


def test_stars_lie_on_a_ccd_at_any_angle(tmp_path):
    text = TURNED.replace("rotation_deg: 90", "rotation_deg: 33").replace("rotation_deg: 180", "rotation_deg: -100")
    (tmp_path / "tilted.yaml").write_text(text)
    experiment = small(tmp_path, camera="tilted.yaml", stars={"truth": 400, "observed": 400})
    camera = experiment.camera
    for name in "AB":
        i, stars = camera.ccd_index(name), ccd_stars(experiment, name, 3e-6)
        depth = camera.depth(i, *stars.holdout.T)
        # Two pixels from the rim at least, and all over the CCD: of 400 places in u and v some are near each end.
        assert depth.min() > 2 * 15e-6 * (1 - 1e-9)
        assert (np.abs(camera.to_uv(i, stars.holdout)).max(axis=0) > 0.97).all()
        assert camera.depth(i, *stars.observed.T).min() > 22 * 15e-6 * (1 - 1e-9)
        # Pixels of the star field are those of the CCD, two pixels of rim less, counted along one of its axes.
        pixel, own = stars.ccd.to_pixel(stars.observed), camera.to_pixel(i, stars.observed)
        quarter = round(camera.rotation_deg[i] / 90) % 4
        nx = camera.pixels[i, 0]
        expected = own if quarter == 0 else np.stack([own[:, 1], nx - 1 - own[:, 0]], axis=1)
        assert np.allclose(pixel, expected - 2, rtol=0, atol=1e-6)
        (x0, x1, y0, y1), (bx0, bx1, by0, by1) = stars.ccd.extent, camera.bounds([i])
        assert bx0 < x0 < stars.holdout[:, 0].min()
        assert stars.holdout[:, 0].max() < x1 < bx1
        assert by0 < y0 < stars.holdout[:, 1].min()
        assert stars.holdout[:, 1].max() < y1 < by1


def test_edges_roll_off_along_the_ccd():
    half, angle = (0.015, 0.03), 0.7
    plain, turned = EdgeRolloff(1e-6, 1e-3, half), EdgeRolloff(1e-6, 1e-3, half, angle)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.014, 0.014, (2, 50))
    spin = np.exp(1j * angle)
    at, there = (x + 1j * y), (x + 1j * y) * spin
    expected = (plain.at(at.real, at.imag) @ [1, 1j]) * spin
    assert np.allclose(turned.at(there.real, there.imag) @ [1, 1j], expected, rtol=0, atol=1e-18)
    # At the middle of the long edge the displacement is the whole amplitude, outwards along the short side.
    edge = half[0] * spin
    assert np.allclose(turned.at(edge.real, edge.imag) @ [1, 1j], 1e-6 * spin, rtol=1e-9)


def test_rings_are_about_a_place_on_the_ccd(cameras):
    sensor = {"tree_rings_um": 0.3, "tree_ring_center_mm": [30, 10]}
    experiment = small(cameras, camera="turned.yaml", sensor=sensor)
    assert np.allclose(experiment.displacements("A")[0].center, (-0.01, 0.03), atol=1e-17)
    assert np.allclose(experiment.displacements("B")[0].center, (-0.03, -0.01), atol=1e-17)


def test_a_camera_file_counts_by_its_content(cameras):
    plain = small().config_hash
    first = small(cameras, camera="turned.yaml").config_hash
    (cameras / "copy.yaml").write_text(TURNED)
    assert small(cameras, camera="copy.yaml").config_hash == first != plain
    (cameras / "copy.yaml").write_text(TURNED.replace("x_mm: 30", "x_mm: 31"))
    assert small(cameras, camera="copy.yaml").config_hash != first
    # Resolved, the path is absolute; a bundled name stays.
    assert small(cameras, camera="turned.yaml").config.camera == str(cameras / "turned.yaml")
    assert small(camera="decam", ccds=["N4"]).config.camera == "decam"


@pytest.mark.parametrize(
    ("telescope", "loss", "outer"), [("hsc", 0.103, (0.1, 0.1)), ("decam", 0.112, (-0.0169, 0.1917))]
)
def test_a_zero_point_is_that_of_a_star_on_the_axis(telescope, loss, outer):
    """Measured zero points have in them what vanes and rims take from every star; it is not taken twice."""
    experiment = small(telescope=telescope, ccds=None, wavelengths_nm=[640], psf={"engine": "long_exposure"})
    assert experiment.lit_fraction_on_axis == pytest.approx(1.0 - loss, abs=2e-3)  # as `pachon vignetting` traces it
    # By the rims of the pupil in place of 4096 rays.
    axis, off_axis = expose_positions(experiment, np.array([[-0.01, 0.001], outer])).lit_fraction
    assert axis == pytest.approx(1.0, abs=3e-3)
    assert off_axis < axis


def test_sweeps_find_a_camera_beside_them(cameras):
    path = cameras / "sweep.yaml"
    path.write_text(
        "base: {telescope: hsc, camera: turned.yaml}\nparameters: {A.dz_um: {nominal: 0, values: [0, 1]}}\n"
    )
    sweep = load_sweep(path)
    assert sweep.base["camera"] == str(cameras / "turned.yaml")
    before = sweep.digest
    (cameras / "turned.yaml").write_text(UPRIGHT)
    assert load_sweep(path).digest != before


@pytest.mark.parametrize(
    ("telescope", "ccds", "pixel", "scale"),
    # Scales that observatories state ["].
    [("hsc", ("hsc042", "hsc098"), 15.0, 0.168), ("decam", ("S4", "N30"), 15.0, 0.263),
     ("comcam_r", ("R22_S00", "R22_S22"), 10.0, 0.2), ("auxtel", ("RXX_S00", "RXX_S00"), 10.0, 0.0955)],
)  # fmt: skip
def test_defaults_follow_the_camera(telescope, ccds, pixel, scale):
    given = {"atmosphere__screen_size": 1024, "atmosphere__screen_length_m": 280.0, "atmosphere__exposure_s": 1.0}
    if telescope in ("hsc", "decam"):
        given |= {"atmosphere__screen_length_m": 800.0}
    config = Experiment.from_config(with_options(Configuration(), telescope=telescope, **given)).config
    assert (config.ccds[0], config.ccds[-1]) == ccds
    assert config.psf.pixel_um == pixel
    # Stamps of 6.2 arcsec, odd.
    assert abs(config.psf.stamp * scale - 6.2) <= 1.1 * scale
    assert config.psf.stamp % 2 == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"telescope": "paul_baker"}, "telescope = paul_baker, which has none: expected a camera: lsst, .*camera: hsc"),
        ({"camera": "hcs"}, "camera.*unknown camera 'hcs': did you mean hsc"),
        ({"camera": "nothing.yaml"}, "nothing.yaml: no such file"),
        ({"camera": "far.yaml"}, "ccds: B of two reach beyond the field that hsc covers, 1 deg"),
        # Chief rays to B are found, but beyond 1 deg.
        ({"camera": "near.yaml"}, "ccds: B of two reach beyond the field that hsc covers, 1 deg"),
        ({"ccds": ["R22_S11"]}, "unknown CCD of hsc 'R22_S11'"),
        ({"ccds": ["R22"]}, "unknown CCD of hsc 'R22'"),
        ({"atmosphere": {"screen_size": 256, "screen_length_m": 800}}, "at least 391, .* of at most 524"),
        ({"sensor": {"brighter_fatter": "itl"}}, "psf.pixel_um = 15: expected 10"),
        ({"focal_plane": {"heights": "lsstcam"}}, "heights = lsstcam: expected heights of the telescope's camera, hsc"),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path, changes, words):
    (tmp_path / "far.yaml").write_text(TURNED.replace("x_mm: 30", "x_mm: 600"))
    (tmp_path / "near.yaml").write_text(TURNED.replace("x_mm: 30", "x_mm: 330"))
    with pytest.raises(PachonError, match=words) as caught:
        small(tmp_path, **changes)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_focal_plane_model_of_rotated_ccds(tmp_path):
    """On three CCDs at three angles residuals are as predicted, and the file gives the model back."""
    rows = ["{name: A, x_mm: -21, y_mm: 0}", "{name: B, x_mm: 21, y_mm: 12, rotation_deg: 30}",
            "{name: C, x_mm: 0, y_mm: -40, rotation_deg: 90, raft: R}"]  # fmt: skip
    head = ["name: own", "source: test", "pixel_um: 10", "pixels: [4000, 2000]", "ccds:"]
    (tmp_path / "own.yaml").write_text("\n".join([*head, *(f"  - {row}" for row in rows)]))
    changes = {
        "telescope": "comcam_r", "camera": "own.yaml", "wavelengths_nm": [640], "stars": {"truth": 60, "observed": 40},
        "psf": {"n_pupil": 80},
        "reconstruction": {"components": 5, "model": "focal_plane"},
    }  # fmt: skip
    experiment = small(tmp_path, **changes)
    result = run(experiment, tmp_path / "out")
    chi2 = [v for k, v in result.summary["all"].items() if k.startswith("chi2_left_out")]
    assert len(chi2) == 3
    # 120 stars: chi-square of each within 5 standard deviations of sqrt(2/120).
    assert all(abs(v - 1.0) < 5 * np.sqrt(2 / 120) for v in chi2)
    model = pachon.FocalPlanePsf.read(tmp_path / "out" / "focal_plane_psf.fits")
    product = read_product(tmp_path / "out" / "ccd_B.fits", stamp_of(experiment))
    again = model.shapes("B", product.holdout.x, product.holdout.y)
    np.testing.assert_allclose(again.e1, product.holdout.model_e1, rtol=0, atol=1e-6)


@pytest.mark.parametrize("pixel", [15.0, 2.0, 0.3])
def test_photometry_has_the_angle_of_small_pixels(tmp_path, pixel):
    """To three digits: a thousandth of an arcsec is a third of pixels of 3 mas, and the sky goes as the square."""
    ccd = "{name: A, x_mm: 0, y_mm: 0, pixels: [1000, 1000]}"
    (tmp_path / "fine.yaml").write_text(f"name: fine\nsource: test\npixel_um: {pixel}\nccds:\n  - {ccd}\n")
    experiment = small(tmp_path, camera="fine.yaml", psf={"n_pupil": 60, "stamp": 25, "pixel_um": 15})
    # The angle of a millimetre in the middle of the field.
    angle = np.hypot(*pachon.fields_at(experiment.telescope, [[1e-3, 0.0]])[0])
    assert experiment.band.pixel_scale == pytest.approx(angle * pixel * 1e-3, rel=5e-3)
