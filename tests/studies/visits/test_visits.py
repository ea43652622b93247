import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, PachonError
from pachon.core.long_work import Execution
from pachon.core.progress import Reporter
from pachon.core.units import ARCSEC
from pachon.measure.adaptive_moments import adaptive_moments
from pachon.measure.shapes import measure_shapes
from pachon.models.camera.lsst import lsst_camera
from pachon.pipeline.config import Configuration, digest, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_positions
from pachon.studies.visits.config import VisitsConfig, VisitsSection, load_visits_configuration
from pachon.studies.visits.plan import Visit
from pachon.studies.visits.psf_visit import StackFrame, visit_experiment, visit_psfs, visit_telescope
from pachon.studies.visits.sky_points import draw_points
from pachon.studies.visits.stack import PsfStack
from pachon.studies.visits.visits import SUMS_NAME, _left_out_line, cell_of, stack_path, stack_visits

# The pictures are those of test_null_test.py.
pytestmark = [pytest.mark.long, pytest.mark.usefixtures("empty_pictures")]


def content(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def stacked(visits_config, tmp_path_factory, undrawn):
    folder = tmp_path_factory.mktemp("visits")
    with undrawn():
        return stack_visits(visits_config(), folder, execution=Execution(threads=1)), folder


def test_psfs_are_those_of_the_detector_turned_with_the_sky(visits_config):
    config = visits_config()
    experiment = config.experiment()
    frame, visit = StackFrame.of(experiment, 31), Visit(1, 1, roll=0.9)
    points = draw_points(1, 0.003, cell_of(experiment, frame), 20, 8)
    seen = visit_psfs(visit_experiment(experiment, visit), visit, points, frame)
    xy = visit.on_detector(experiment.telescope, points.sky[seen.index], 620e-9)
    stamps = expose_positions(visit_experiment(experiment, visit), xy).image
    weight = experiment.weight_fwhm
    there, here = (measure_shapes(images, 0.2 * ARCSEC, weight) for images in (stamps, seen.true))
    # A telescope that is rolled from north to east sees the sky turned the other way; x and y of the stack are those
    # of the detector without a roll, turned as the sky is.
    angle = np.arctan2(
        *(visit.jacobians(experiment.telescope, np.zeros((1, 2)), 620e-9)[0] @ np.linalg.inv(frame.matrix))[::-1, 0]
    )
    expected = (there.e1 + 1j * there.e2) * np.exp(-2j * angle)
    assert abs(angle) == pytest.approx(0.9, abs=1e-6)
    # Bicubic resampling of a PSF of 3.5 pixels changes e by up to 1e-3.
    np.testing.assert_allclose(here.e1 + 1j * here.e2, expected, atol=1e-3)
    assert np.abs(expected).max() > 5e-3
    np.testing.assert_allclose(seen.true.sum(axis=(1, 2)), 1.0, rtol=1e-5)


def test_models_follow_the_psf(stacked):
    result, _ = stacked
    for stack in result.stacks.values():
        # CCD heights make the PSF vary; its mean is known to the noise of 20 stars of S/N 30 and more.
        left = np.hypot(stack.residual_e1, stack.residual_e2)
        assert np.nanmedian(left) < 5e-3
        assert abs(np.nanmean(stack.residual_e1)) < 2e-3
    assert set(result.stacks) == {1, 2}
    assert result.stacks[2].count.max() == 2


def test_each_visit_has_the_figures_of_its_psfs(stacked, visits_config):
    result, folder = stacked
    visits = Table.read(folder / "visits.ecsv")
    assert len(visits) == len(result.figures) == 2
    # The stack of one visit is that visit.
    with fits.open(folder / "stack_0001.fits") as hdus:
        star = hdus["POINTS"].data["STAR"]
        scale = StackFrame.of(visits_config().experiment(), 31).pixel_scale
        true, model = (measure_shapes(hdus[name].data, scale, 0.7 * ARCSEC) for name in ("TRUE", "MODEL"))
    residual = np.hypot(true.e1 - model.e1, true.e2 - model.e2)
    assert visits["rms_e"][0] == pytest.approx(np.sqrt(np.mean(true.e1**2 + true.e2**2)), rel=1e-5)
    for rows, name in ((star, "stars"), (~star, "places")):
        assert visits[f"rms_residual_e_{name}"][0] == pytest.approx(np.sqrt(np.mean(residual[rows] ** 2)), rel=1e-3)
    assert visits["median_size"].unit == "arcsec"
    assert visits["median_size"][0] == pytest.approx(np.median(true.size) / ARCSEC, rel=1e-5)


def test_a_stack_has_adaptive_moments_of_its_images(stacked):
    result, folder = stacked
    stack = PsfStack.read(stack_path(folder, 2))
    true, model = (adaptive_moments(images, 0.2 * ARCSEC) for images in (stack.true, stack.model))
    with fits.open(stack_path(folder, 2)) as hdus:
        points = hdus["POINTS"].data
        np.testing.assert_allclose(points["G1"], true.g1, atol=1e-12)
        np.testing.assert_allclose(points["MODEL_G2"], model.g2, atol=1e-12)
        np.testing.assert_allclose(points["RELATIVE_SIZE_RESIDUAL"], (true.T - model.T) / true.T, atol=1e-12)
    metrics = result.summary["stacks"]["2"]
    residual = (true.g1 - model.g1 + 1j * (true.g2 - model.g2))[~stack.star]
    assert metrics["rms_residual_g_places"] == pytest.approx(np.sqrt(np.mean(np.abs(residual) ** 2)), rel=1e-6)
    assert {"xi_plus_psf_g_short", "xi_plus_residual_places_g_short_error"} <= set(metrics)
    assert (folder / "correlation_g.png").exists()
    # North and east: unit vectors along which eta and xi grow, and the other does not.
    (north, east), places = stack.sky_directions, np.stack([stack.x, stack.y], axis=1)
    for direction, grows, stays in ((north, stack.eta, stack.xi), (east, stack.xi, stack.eta)):
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        assert np.corrcoef(places @ direction, grows)[0, 1] > 0.9999
        slope = np.linalg.lstsq(np.stack([grows, stays], axis=1), places @ direction, rcond=None)[0]
        assert slope == pytest.approx([1.0, 0.0], abs=0.01)


def test_the_stack_is_the_mean_of_its_visits(stacked, visits_config):
    result, _ = stacked
    config = visits_config()
    experiment = config.experiment()
    frame = StackFrame.of(experiment, 31)
    one, two = result.stacks[1], result.stacks[2]
    # Points that both visits saw: the mean without the first is the second.
    whole = two.count == 2
    place = {xy: i for i, xy in enumerate(zip(one.xi, one.eta, strict=True))}
    rows = [place[xy] for xy in zip(two.xi[whole], two.eta[whole], strict=True)]
    second = 2.0 * two.true[whole] - one.true[rows]
    np.testing.assert_allclose(second.sum(axis=(1, 2)), 1.0, atol=1e-5)
    # Turbulence is its mean in all visits, and the residual aberration small.
    shapes = measure_shapes(second, 1.0 / np.sqrt(abs(np.linalg.det(frame.matrix))), experiment.weight_fwhm)
    assert np.median(shapes.size) == pytest.approx(np.median(one.size), rel=0.02)


def test_an_interrupted_stack_goes_on_to_the_same_bytes(stacked, visits_config, tmp_path):
    _, folder = stacked

    def stop_at(count):
        lines = []

        def check():
            lines.append(None)
            if len(lines) > count:
                raise KeyboardInterrupt

        return Reporter(quiet=True, check=check)

    with pytest.raises(KeyboardInterrupt):
        stack_visits(visits_config(), tmp_path, execution=Execution(reporter=stop_at(3), threads=1))
    assert (tmp_path / SUMS_NAME).exists() is False or len(content(tmp_path)) < len(content(folder))
    stack_visits(visits_config(), tmp_path, execution=Execution(resume=True, threads=2))
    assert content(tmp_path) == content(folder)


@pytest.mark.slow
def test_workers_that_end_visits_in_another_order_leave_the_same_bytes(stacked, visits_config, backwards, tmp_path):
    _, folder = stacked
    stack_visits(visits_config(), tmp_path, execution=Execution(workers=backwards))
    assert content(tmp_path) == content(folder)


@pytest.mark.slow
def test_more_visits_join_a_finished_stack(stacked, visits_config, tmp_path):
    _, folder = stacked
    stack_visits(visits_config(count=1), tmp_path, execution=Execution(threads=1))
    stack_visits(visits_config(count=2), tmp_path, execution=Execution(resume=True, threads=1))
    assert content(tmp_path) == content(folder)


def test_other_visits_are_refused(stacked, visits_config):
    _, folder = stacked
    before = content(folder)
    with pytest.raises(PachonError, match="holds visits already; go on with --resume"):
        stack_visits(visits_config(), folder)
    with pytest.raises(PachonError, match=r"visits\.places: 8 -> 9"):
        stack_visits(visits_config(places=9), folder, execution=Execution(resume=True))
    with pytest.raises(PachonError, match="holds 2 visits: expected at most 1"):
        stack_visits(visits_config(count=1), folder, execution=Execution(resume=True))
    (folder / "stack_0002.fits").rename(folder / "elsewhere.fits")
    with pytest.raises(PachonError, match="kept no stack of 2 visits"):
        stack_visits(visits_config(), folder, execution=Execution(resume=True))
    (folder / "elsewhere.fits").rename(folder / "stack_0002.fits")
    assert content(folder) == before


def test_files_come_back_as_they_were(stacked):
    result, folder = stacked
    again = PsfStack.read(stack_path(folder, 2))
    for name in ("xi", "x", "e1", "model_size", "true"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result.stacks[2], name))
    assert load_visits_configuration(folder / "config.yaml").visits.count == 2
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["stacks"]["2"]["rms_e"] == pytest.approx(
        float(np.sqrt(np.nanmean(again.e1**2 + again.e2**2))), rel=1e-8
    )


def test_a_full_disk_is_noticed_before_the_first_visit(visits_config, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000})())
    with pytest.raises(PachonError, match=r"the stacks need .* of disk, 1000 B are free|the stacks need"):
        stack_visits(visits_config(), tmp_path / "full")


def test_visits_that_see_too_little_end_in_one_line(visits_config, tmp_path):
    with pytest.raises(PachonError, match="visit 0: CCD R22_S11: 2 of 2 stars left"):
        stack_visits(visits_config(stars=2), tmp_path / "few")
    config = visits_config(snapshots=(), count=3)
    away = config.model_copy(update={"run": config.run.model_copy(update={"ccds": ("R01_S11",)})})
    with pytest.raises(PachonError, match="were seen by half of 3 visits: expected more of them, or CCDs around"):
        stack_visits(
            away.model_copy(update={"visits": config.visits.model_copy(update={"count": 3})}), tmp_path / "away"
        )


def test_ccds_that_a_visit_leaves_out_are_one_line():
    assert _left_out_line({"R01_S01": "8 of 8 stars left"}) == (
        "CCD R01_S01 is left out, it cannot be modelled: 8 of 8 stars left"
    )
    assert _left_out_line({"R01_S01": "8 of 8 stars left", "R03_S01": "no star"}) == (
        "2 CCDs are left out, they cannot be modelled; CCD R01_S01: 8 of 8 stars left"
    )


def test_the_run_may_be_a_file_and_its_ccds_one_name(tmp_path):
    (tmp_path / "run.yaml").write_text("{seed: 3, ccds: R22}")
    (tmp_path / "of_file.yaml").write_text("run: run.yaml")
    (tmp_path / "inline.yaml").write_text("run: {seed: 3, ccds: R22}")
    of_file, inline = (load_visits_configuration(tmp_path / f"{name}.yaml") for name in ("of_file", "inline"))
    assert of_file == inline
    assert (of_file.run.seed, of_file.run.ccds) == (3, ("R22",))


def test_bad_files_end_in_one_line(tmp_path, capsys):
    for text, expected in (
        ("visits: {count: 0}", "visits.count"),
        ("visits: {dither_deg: 9}", "visits.dither_deg"),
        ("run: {psf: {engine: slow}}", "run.psf.engine"),
        ("visit: {count: 3}", "visit"),
    ):
        path = tmp_path / "bad.yaml"
        path.write_text(text)
        assert main(["visits", str(path), "-o", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert expected in error
        assert "bad.yaml" in error


def test_a_visit_with_a_rotator_angle_is_the_run_with_it(visits_config):
    config = visits_config()
    rotated = config.model_copy(update={"run": config.run.model_copy(update={"rotator_deg": 35.0})})
    one, other = config.experiment(), rotated.experiment()
    visit = Visit(1, 3, roll=0.4, rotator_deg=35.0)
    frame = StackFrame.of(one, 31)
    points = draw_points(1, 0.003, cell_of(one, frame), 20, 8)
    own = visit_experiment(one, visit)
    assert own.config == visit_experiment(other, Visit(1, 3, roll=0.4)).config
    assert own.telescope == Experiment.from_config(with_options(other.config, atmosphere__epoch=3)).telescope
    found = visit_psfs(own, visit, points, frame)
    expected = visit_psfs(visit_experiment(other, Visit(1, 3)), Visit(1, 3, roll=0.4), points, frame)
    assert found.index.tobytes() == expected.index.tobytes()
    assert found.true.tobytes() == expected.true.tobytes()
    assert found.model.tobytes() == expected.model.tobytes()
    # The camera's heights are at other places of the sky than without a rotator.
    plain = visit_psfs(visit_experiment(one, Visit(1, 3)), Visit(1, 3, roll=0.4), points, frame)
    both = np.intersect1d(plain.index, found.index)
    assert 10 < len(both) < len(found.index)
    images = [seen.true[np.isin(seen.index, both)] for seen in (plain, found)]
    assert np.abs(images[0] - images[1]).max() > 1e-3
    # Tiles and images take the telescope of the visit.
    assert np.allclose(visit_telescope(one, visit).surfaces[-1].matrix, own.telescope.surfaces[-1].matrix, atol=1e-15)
    assert visit_telescope(other, Visit(0, 0)) is other.telescope


def test_keys_of_angles_leave_older_stacks_usable(visits_config):
    config = visits_config()
    experiment = config.experiment()
    before = {"dither_deg": 0.0, "stars": 20, "places": 8, "first_epoch": 0}
    expected = digest({"run": experiment.config_hash, "ccds": experiment.config.ccds, "visits": before})
    assert config.digest(experiment) == expected
    assert visits_config(rotator_deg="random").digest(experiment) != expected


def test_angles_of_the_command_line(capsys, tmp_path):
    assert main(["visits", "-n", "3", "--rotator", "0,45", "-o", str(tmp_path / "a")]) == 2
    assert "visits.rotator_deg: 2 angles for 3 visits, expected one for each" in capsys.readouterr().err
    assert main(["visits", "--roll", "north", "-o", str(tmp_path / "b")]) == 2
    assert "--roll = north: expected random, or angles in degrees with commas between" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_screens_too_short_for_a_rotated_camera_are_refused_before_any_visit(tmp_path):
    # The diagonal of the focal plane along x: 3.5 degrees at 20 km, and more than the side of 3.1 degrees needs.
    run = Configuration(ccds=tuple(lsst_camera().ccd_names))
    config = VisitsConfig(run=run, visits=VisitsSection(count=3, rotator_deg=(0.0, 90.0, 45.0)))
    expected = r"^visit 2, rotator 45 deg: atmosphere\.exposure_s = 15: .* at least 1[34]\d\d "
    with pytest.raises(ConfigError, match=expected):
        stack_visits(config, tmp_path / "visits")
    assert not list(tmp_path.iterdir())
