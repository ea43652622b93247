"""A whole run, small: what it leaves, that the same input gives the same bytes, and that a stopped one goes on."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, PachonError, ProductError
from pachon.core.files import _owning_process
from pachon.core.long_work import Execution
from pachon.core.progress import Reporter
from pachon.measure.correlation import shear_correlation
from pachon.pipeline import run as run_module
from pachon.pipeline import run_folder
from pachon.pipeline.config import load_configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run import run
from pachon.pipeline.simulate import ccd_exposure, ccd_loop
from pachon.pipeline.simulate.ccd_model import model_ccd, model_ccds
from pachon.pipeline.simulate.photometry import electrons
from pachon.pipeline.summary import correlations, run_metrics, separation_bins
from pachon.reconstruction.ccd_product import read_product

CCDS = ("R22_S11", "R24_S12")
CHANGES_EVERY_TIME = "timings.json"


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != CHANGES_EVERY_TIME}


def ended_process():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def copied(finished_run, tmp_path):
    folder = tmp_path / "copied"
    shutil.copytree(finished_run, folder)
    return folder


@pytest.fixture
def no_report(monkeypatch, finished_run):
    """Take the report of the finished run for every other: drawing it takes longest, and others test it."""
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    monkeypatch.setattr(run_module, "build_report", lambda *_: (finished_run / "report.html").read_text())


def test_a_run_leaves_its_files_and_no_other(finished_run):
    assert sorted(p.name for p in finished_run.iterdir()) == [
        "ccd_R22_S11.fits",
        "ccd_R24_S12.fits",
        "config.yaml",
        "focal_plane.ecsv",
        "focal_plane.glb",
        "report.html",
        "summary.json",
        "timings.json",
    ]


@pytest.mark.long
@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_running_its_configuration_again_gives_the_same_bytes_on_two_threads(finished_run, tmp_path, drawn, request):
    """With the report too in the slow form, pictures of which a second process draws."""
    if not drawn:
        request.getfixturevalue("no_report")
    config = Experiment.from_config(load_configuration(finished_run / "config.yaml"), finished_run).config
    run(config, tmp_path / "again", execution=Execution(threads=2))
    assert contents(tmp_path / "again") == contents(finished_run)


def test_a_ccd_does_not_depend_on_the_others(finished_run, tmp_path, tiny, no_report):
    run(tiny(ccds=("R24_S12",)), tmp_path / "alone")
    name = "ccd_R24_S12.fits"
    assert (tmp_path / "alone" / name).read_bytes() == (finished_run / name).read_bytes()


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(finished_run, copied, monkeypatch, tiny, no_report):
    # As a kill leaves it: one CCD done, a part of the next, nothing after that.
    for name in ("ccd_R24_S12.fits", "summary.json", "report.html"):
        (copied / name).unlink()
    (copied / f".ccd_R24_S12.fits.{_owning_process(ended_process())}.partial").write_bytes(b"SIMPLE")
    done = []
    real = ccd_loop.expose_ccds
    monkeypatch.setattr(ccd_loop, "expose_ccds", lambda e, stars, **k: done.extend(stars) or real(e, stars, **k))
    result = run(tiny(), copied, execution=Execution(resume=True))
    assert done == ["R24_S12"]
    assert result.kept == ("R22_S11",)
    assert contents(copied) == contents(finished_run)


@pytest.mark.slow
def test_ccds_computed_apart_make_the_run_that_one_machine_makes(finished_run, tmp_path, tiny, no_report):
    """As a cluster does it: each machine some CCDs in a folder of its own, brought together and resumed."""
    together = tmp_path / "together"
    together.mkdir()
    for name in ("R22_S11", "R24_S12"):
        run(tiny(ccds=(name,)), tmp_path / name)
        shutil.copy(tmp_path / name / f"ccd_{name}.fits", together)
        shutil.copy(tmp_path / name / "config.yaml", together)
    result = run(tiny(), together, execution=Execution(resume=True))
    assert result.computed == ()
    assert contents(together) == contents(finished_run)


def test_a_damaged_product_is_computed_again(finished_run, copied, tiny, no_report):
    path = copied / "ccd_R22_S11.fits"
    data = bytearray(path.read_bytes())
    data[-4000] ^= 1
    path.write_bytes(data)
    assert run(tiny(), copied, execution=Execution(resume=True)).computed == ("R22_S11",)
    assert contents(copied) == contents(finished_run)


def test_an_interrupted_run_keeps_the_ccds_that_were_finished(finished_run, tmp_path, monkeypatch, tiny, no_report):
    real = ccd_loop.expose_ccds

    def interrupted(experiment, stars, **options):
        if "R24_S12" in stars:
            raise KeyboardInterrupt
        return real(experiment, stars, **options)

    monkeypatch.setattr(ccd_loop, "_STARS_TOGETHER", 1)
    monkeypatch.setattr(ccd_loop, "expose_ccds", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tiny(), tmp_path / "out")
    finished = {"ccd_R22_S11.fits", "config.yaml", "focal_plane.ecsv", "focal_plane.glb"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == finished
    monkeypatch.setattr(ccd_loop, "expose_ccds", real)
    assert run(tiny(), tmp_path / "out", execution=Execution(resume=True)).kept == ("R22_S11",)
    assert contents(tmp_path / "out") == contents(finished_run)


@pytest.mark.parametrize("resume", [False, True])
def test_another_configuration_is_refused_and_nothing_is_lost(copied, resume, tiny, no_report):
    before = contents(copied)
    with pytest.raises(ProductError, match=r"another configuration \(seed: 1 -> 2; stars.truth: 14 -> 15\)"):
        run(tiny(seed=2, stars__truth=15), copied, execution=Execution(resume=resume))
    assert contents(copied) == before


def test_a_run_may_grow_when_resumed_and_not_otherwise(finished_run, tmp_path, tiny, no_report):
    folder = tmp_path / "grows"
    run(tiny(ccds=("R22_S11",)), folder)
    with pytest.raises(ProductError, match="ccds: "):
        run(tiny(), folder)
    assert run(tiny(), folder, execution=Execution(resume=True)).kept == ("R22_S11",)
    assert contents(folder) == contents(finished_run)
    with pytest.raises(ProductError, match="ccds: "):
        run(tiny(ccds=("R22_S11",)), folder, execution=Execution(resume=True))


def test_products_without_a_configuration_are_not_written_over(copied, tiny, no_report):
    (copied / "config.yaml").unlink()
    with pytest.raises(ProductError, match=r"holds ccd_R22_S11.fits but no config.yaml"):
        run(tiny(), copied)


def test_a_folder_that_is_a_file_is_one_line(tmp_path, tiny, no_report):
    (tmp_path / "out").write_text("")
    with pytest.raises(ProductError, match="cannot make the folder"):
        run(tiny(), tmp_path / "out")


def test_an_error_inside_a_ccd_names_it(tmp_path, monkeypatch, tiny, no_report):
    def fails(*args, **options):
        raise ConfigError("something is off")

    monkeypatch.setattr(ccd_exposure, "make_psfs", fails)
    with pytest.raises(PachonError, match=r"^CCD R22_S11: something is off$"):
        run(tiny(), tmp_path / "out")


@pytest.fixture
def failing_ccd(monkeypatch):
    """Let the first CCD be one that cannot be modelled."""
    real = run_folder.model_ccds

    def fails(experiment, exposures):
        error = DomainError("3 of 12 stars left (9 neighbour): expected at least 5")
        products = real(experiment, exposures)
        return [error if e.name == "R22_S11" else p for e, p in zip(exposures, products, strict=True)]

    monkeypatch.setattr(run_folder, "model_ccds", fails)
    return "3 of 12 stars left (9 neighbour): expected at least 5"


def test_a_ccd_that_cannot_be_modelled_is_left_out(finished_run, tmp_path, tiny, failing_ccd, monkeypatch, capsys):
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    out = tmp_path / "out"
    result = run(tiny(), out, execution=Execution(reporter=Reporter()))
    assert result.not_modelled == {"R22_S11": failing_ccd}
    assert result.computed == ("R24_S12",)
    assert f"CCD R22_S11 is left out, it cannot be modelled: {failing_ccd}\n" in capsys.readouterr().err
    name = "ccd_R24_S12.fits"
    assert (out / name).read_bytes() == (finished_run / name).read_bytes()
    assert not (out / "ccd_R22_S11.fits").exists()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["not_modelled"] == {"R22_S11": failing_ccd}
    assert list(summary["ccd"]) == ["R24_S12"]
    assert summary["all"]["ccds"] == 1
    # That of the one CCD alone, as a run of it says.
    alone = json.loads((finished_run / "summary.json").read_text())["ccd"]["R24_S12"]
    assert summary["all"]["rms_residual_away"] == pytest.approx(alone["rms_residual_away"], rel=1e-8)
    assert f"<li>CCD R22_S11: {failing_ccd}</li>" in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_ccd_that_could_not_be_modelled_is_tried_again(
    finished_run, tmp_path, tiny, no_report, failing_ccd, monkeypatch
):
    run(tiny(), tmp_path / "out", execution=Execution(threads=1))
    monkeypatch.setattr(run_folder, "model_ccds", model_ccds)
    result = run(tiny(), tmp_path / "out", execution=Execution(resume=True))
    assert (result.kept, result.computed, result.not_modelled) == (("R24_S12",), ("R22_S11",), {})
    assert contents(tmp_path / "out") == contents(finished_run)


def test_strict_ends_at_a_ccd_that_cannot_be_modelled_and_keeps_the_others(
    finished_run, settings_file, tmp_path, failing_ccd, capsys
):
    out = tmp_path / "out"
    command = ["run", str(settings_file), "--out", str(out), "--quiet", "--strict", "--threads", "2"]
    assert main(command) == 2
    assert capsys.readouterr().err == f"pachon: error: CCD R22_S11: {failing_ccd}\n"
    # The other CCD was on its way.
    finished = {"ccd_R24_S12.fits", "config.yaml", "focal_plane.ecsv", "focal_plane.glb"}
    assert {p.name for p in out.iterdir()} == finished
    assert (out / "ccd_R24_S12.fits").read_bytes() == (finished_run / "ccd_R24_S12.fits").read_bytes()


def test_who_wants_no_progress_hears_of_a_ccd_left_out(settings_file, tmp_path, failing_ccd, no_report, capsys):
    assert main(["run", str(settings_file), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr().err == f"pachon: CCD R22_S11 is left out, it cannot be modelled: {failing_ccd}\n"


@pytest.mark.long
def test_a_run_of_which_no_ccd_can_be_modelled_is_one_line(tmp_path, tiny, failing_ccd):
    with pytest.raises(DomainError, match=r"^none of 1 CCD can be modelled; CCD R22_S11: 3 of 12 stars left"):
        run(tiny(ccds=("R22_S11",)), tmp_path / "out")


def test_errors_of_mean_correlations_are_their_jackknife(finished_run, monkeypatch):
    """Where two CCDs are enough, what is left without one of them are the pairs within the other."""
    summary = json.loads((finished_run / "summary.json").read_text())
    products = [read_product(finished_run / f"ccd_{name}.fits") for name in CCDS]
    bins = separation_bins(products)
    monkeypatch.setattr("pachon.measure.correlation.FEWEST_PATCHES", 2)
    metrics = run_metrics(products, correlations(products))["all"]
    for kind, stars in (("residual", [p.observed for p in products]), ("away", [p.holdout for p in products])):
        short = np.array(summary["correlation"][kind]["r_arcmin"]) < 10.0
        left = []
        for s in stars:
            c = shear_correlation(s.field_x, s.field_y, s.e1 - s.model_e1, s.e2 - s.model_e2, bins=bins)
            chosen = short & (c.n_pairs > 0)
            left.append(np.average(c.xi_plus[chosen], weights=c.n_pairs[chosen]))
        expected = np.sqrt(0.5 * np.sum((np.array(left) - np.mean(left)) ** 2))
        # Sums in another order.
        assert metrics[f"error_xi_plus_{kind}_short"] == pytest.approx(expected, rel=1e-7)
        # Such an error is itself good to 70 %: a run says none.
        assert summary["all"][f"error_xi_plus_{kind}_short"] is None


def test_the_summary_holds_what_the_products_say(finished_run, tiny):
    summary = json.loads((finished_run / "summary.json").read_text())
    assert summary["seed"] == 1
    assert list(summary["ccd"]) == list(CCDS)
    experiment = Experiment.from_config(tiny())
    assert summary["config_hash"] == experiment.config_hash
    residuals = []
    for name in CCDS:
        product = read_product(finished_run / f"ccd_{name}.fits", run_folder.stamp_of(experiment))
        truth = product.holdout
        residuals.append(np.concatenate([truth.e1 - truth.model_e1, truth.e2 - truth.model_e2]))
        figures = summary["ccd"][name]
        # JSON keeps nine digits.
        assert figures["rms_residual_away"] == pytest.approx(np.sqrt(np.mean(residuals[-1] ** 2)), rel=1e-8)
        assert figures["mean_e_truth"] == pytest.approx(np.hypot(truth.e1, truth.e2).mean(), rel=1e-8)
    everything = np.concatenate(residuals)
    assert summary["all"]["rms_residual_away"] == pytest.approx(np.sqrt(np.mean(everything**2)), rel=1e-8)
    assert set(summary["correlation"]) == {"truth", "observed", "residual", "away"}


def test_stars_of_a_product_lie_on_their_ccd_and_stamps_are_centred(finished_run, tiny):
    product = read_product(finished_run / "ccd_R24_S12.fits")
    camera = Experiment.from_config(tiny()).camera
    for stars in (product.holdout, product.observed):
        assert np.all(camera.ccd_at(stars.x, stars.y) == camera.ccd_index("R24_S12"))
        # 10.31 m of focal length: a detector position is the tangent of the field angle to a per cent (distortion).
        np.testing.assert_allclose(np.tan(stars.field_x) * 10.31, stars.x, rtol=0.01)
    assert product.holdout_images.shape == (14, 31, 31)
    assert product.observed_images.shape == (12, 31, 31)
    np.testing.assert_allclose(product.holdout_images.sum(axis=(1, 2)), 1.0, rtol=1e-5)
    peaks = product.holdout_images.reshape(14, -1).argmax(axis=1)
    assert np.all(np.abs(np.stack(np.unravel_index(peaks, (31, 31))) - 15) <= 1)
    # The faintest star is still at the limit, S/N 30.
    assert product.observed.snr.min() >= 30.0 * (1 - 1e-9)
    assert product.observed.used.all()
    # At 1.66 deg the camera and the mirrors' rims take some 5 to 10 % of the light.
    exposure = Experiment.from_config(tiny()).config.atmosphere.exposure_s
    light = product.observed.electrons / electrons(product.observed.magnitude, "r", exposure)
    assert np.all((light > 0.86) & (light < 0.98))


def computed(config):
    """The product of the one CCD of a configuration."""
    experiment = Experiment.from_config(config)
    return model_ccd(experiment, ccd_exposure.expose_ccd(experiment, config.ccds[0]))


@pytest.mark.long
def test_visits_have_the_same_stars_and_other_noise(tiny):
    """Without an atmosphere nothing but the noise tells two visits apart."""
    options = {"ccds": ("R22_S11",), "atmosphere__enabled": False, "psf__stamp": 31, "psf__n_pupil": 200}
    first, again, second = (computed(tiny(atmosphere__epoch=epoch, **options)) for epoch in (0, 0, 1))
    np.testing.assert_array_equal(first.observed_images, again.observed_images)
    np.testing.assert_array_equal(first.holdout_images, second.holdout_images)
    for key in ("x", "y", "magnitude", "electrons"):
        np.testing.assert_array_equal(getattr(first.observed, key), getattr(second.observed, key))
    assert not np.any(np.all(first.observed_images == second.observed_images, axis=(1, 2)))


@pytest.mark.long
def test_residual_aberration_and_jitter_reach_the_stars(tiny):
    options = {"ccds": ("R22_S11",), "atmosphere__enabled": False, "psf__stamp": 31, "psf__n_pupil": 200}
    plain, bent, shaken = (
        computed(tiny(**options, **more)).holdout
        for more in ({}, {"active_optics__residual_um": 0.4}, {"psf__jitter_arcsec": 0.1})
    )
    # Near the axis the telescope is round; 0.4 um make several per cent, jitter only width.
    assert np.abs(bent.e1 - plain.e1).max() > 0.02
    assert np.all(shaken.fwhm > 1.3 * plain.fwhm)
    assert np.all(np.hypot(shaken.e1, shaken.e2) < np.hypot(plain.e1, plain.e2) + 0.01)


@pytest.mark.long
def test_silicon_reaches_the_stars(tiny):
    options = {"ccds": ("R22_S11",), "band": "y", "wavelengths_nm": (970.0,), "psf__engine": "long_exposure"}
    options |= {"telescope": None, "psf__n_pupil": 80, "focal_plane__budget": "flat"}
    plain, deep, refocused = (
        computed(tiny(**options, **more)).holdout
        for more in (
            {"psf__diffusion_pixels": 0.0},
            {"psf__diffusion_pixels": 0.0, "detector__silicon": True},
            {"psf__diffusion_pixels": 0.0, "detector__silicon": True, "changes": {"Detector.dz_um": -12.3}},
        )
    )
    # On the axis the design is in focus at the surface, and light that goes on in silicon is not.
    assert np.all(deep.size > 1.015 * plain.size)
    assert np.all(refocused.size < 0.99 * deep.size)
    assert np.all(refocused.size > plain.size)


def test_without_an_atmosphere_the_optics_alone_make_the_psf(tmp_path, tiny, no_report):
    config = tiny(ccds=("R22_S11",), atmosphere__enabled=False, stars__truth=8, stars__observed=8)
    config = Experiment.from_config(with_options(config, reconstruction__components=2)).config
    run(config, tmp_path / "optics")
    product = read_product(tmp_path / "optics" / "ccd_R22_S11.fits")
    # These PSFs are narrower than a pixel, of which adaptive moments, GalSim's too, make nothing.
    assert (product.holdout.adaptive_flags != 0).all()
    summary = json.loads((tmp_path / "optics" / "summary.json").read_text())
    assert summary["all"]["xi_plus_g_truth_short"] is None
    assert summary["all"]["xi_plus_truth_short"] is not None
    # A tenth of an arcsecond of aberrations and no half arcsecond of seeing.
    assert np.median(product.holdout.fwhm) < np.deg2rad(0.2 / 3600)
