"""Measured heights in the configuration of a run, in sweeps, in baselines and among the causes of ellipticity."""

import numpy as np
import pytest
from astropy.table import Table

from pachon.core.errors import ConfigError, PachonError
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.height_budget import HeightBudget
from pachon.models.camera.lsst import lsst_camera
from pachon.pipeline.config import Configuration, load_configuration, to_yaml, with_options
from pachon.pipeline.config_hash import hashed_heights
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.report.height_plots import vendor_heights_plot
from pachon.studies.attribution.causes import checked_causes, without
from pachon.studies.baseline.baseline import _input_stamps
from pachon.studies.sweep.file import load_sweep
from pachon.studies.sweep.point import point_experiment
from pachon.studies.sweep.sweep import numbered_points

SMALL = {"stars__truth": 30, "stars__observed": 25, "ccds": ("R22_S11",)}


def experiment_of(**options):
    return Experiment.from_config(with_options(Configuration(), **SMALL, **options))


def points_file(path, height, names=("R22_S11",)):
    """Write a table of points, all of one height [um], on some CCDs."""
    camera = lsst_camera()
    x, y = np.concatenate(
        [camera.centers[camera.ccd_index(n)] + 0.02 * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]) for n in names]
    ).T
    table = Table({"x": x, "y": y, "z": np.full(x.size, float(height))}, units={"x": "m", "y": "m", "z": "um"})
    table.write(path, overwrite=True)


def test_a_run_takes_the_camera_as_built_and_moves_its_rafts(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("focal_plane: {heights: lsstcam, moved: {R22: {dz_um: 2}}}\n")
    experiment = Experiment.from_config(load_configuration(path), tmp_path)
    built = FocalPlane.as_measured("lsstcam")
    x, y = np.random.default_rng(1).uniform(-0.06, 0.06, (2, 100))
    assert np.allclose(
        experiment.focal_plane.height(x, y), built.height(x, y) + 2e-6, rtol=0, atol=1e-18, equal_nan=True
    )
    # The resolved configuration, with its defaults of an unused budget, gives the same again.
    path.write_text(to_yaml(experiment.config))
    again = Experiment.from_config(load_configuration(path), tmp_path)
    assert again.config == experiment.config
    assert again.config_hash == experiment.config_hash


def test_configurations_without_measured_heights_keep_their_hash():
    experiment = experiment_of()
    section = experiment.config.as_dict()["focal_plane"]
    # Versions before there were measured heights had no such key.
    assert hashed_heights(section) == {key: value for key, value in section.items() if key != "heights"}
    measured = experiment_of(focal_plane__heights="lsstcam")
    assert hashed_heights(measured.config.as_dict()["focal_plane"])["heights"] == "lsstcam"
    assert measured.config_hash != experiment.config_hash


@pytest.mark.filterwarnings("ignore::pachon.errors.HeightWarning")
def test_a_file_lies_beside_the_configuration_and_counts_by_its_content(tmp_path):
    hashes, stamps = [], []
    for folder, height in (("a", 1), ("b", 1), ("c", 2)):
        (tmp_path / folder).mkdir()
        points_file(tmp_path / folder / "mine.ecsv", height)
        path = tmp_path / folder / "run.yaml"
        path.write_text("ccds: [R22_S11]\nfocal_plane: {heights: mine.ecsv}\n")
        experiment = Experiment.from_config(load_configuration(path), path.parent)
        assert experiment.focal_plane.height(0.0, 0.0) == pytest.approx(height * 1e-6, abs=1e-18)
        hashes.append(experiment.config_hash)
        stamps.append(_input_stamps(experiment.telescope, experiment)["configuration_sha256"])
    assert hashes[0] == hashes[1] != hashes[2]
    assert stamps[0] == stamps[1] != stamps[2]


@pytest.mark.filterwarnings("ignore::pachon.errors.HeightWarning")
def test_a_sweep_reads_heights_beside_it_and_counts_them_by_content(tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text(
        "base: {ccds: [R22_S11], focal_plane: {heights: mine.ecsv}}\n"
        "parameters: {R22.dz_um: {values: [0, 3]}}\ndesign: {kind: grid}\nmetrics: [fwhm]\n"
    )
    points_file(tmp_path / "mine.ecsv", 1)
    sweep = load_sweep(path)
    heights = [
        float(point_experiment(sweep, point, tmp_path).focal_plane.height(0.0, 0.0))
        for point in numbered_points(sweep, tmp_path)
    ]
    assert heights == pytest.approx([1e-6, 4e-6], abs=1e-18)
    before = sweep.digest
    assert load_sweep(path).digest == before
    points_file(tmp_path / "mine.ecsv", 2)
    assert load_sweep(path).digest != before


@pytest.mark.filterwarnings("ignore::pachon.errors.HeightWarning")
@pytest.mark.parametrize(
    ("section", "parts"),
    [
        ({"heights": "lsstcm"}, ["focal_plane.heights = lsstcm", "lsstcam, or a file ending in .ecsv, .fits, .fit"]),
        ({"heights": "lsstcam", "raft": False}, ["focal_plane.raft = false", "focal_plane.heights = lsstcam"]),
        ({"heights": "lsstcam", "budget": "flat"}, ['focal_plane.budget = "flat"', "no budget with measured heights"]),
        ({"heights": "lsstcam", "ccd_um": 3.0}, ["focal_plane.ccd_um = 3.0", "no budget"]),
        ({"heights": "missing.fits"}, ["focal_plane.heights", "missing.fits: no such file"]),
        ({"heights": "other.ecsv"}, ["focal_plane.heights", "other.ecsv: no heights of R22_S11, one of ccds"]),
    ],
)
def test_bad_heights_are_refused_in_one_line(tmp_path, section, parts):
    points_file(tmp_path / "other.ecsv", 1, ("R22_S12",))
    options = {f"focal_plane__{key}": value for key, value in section.items()}
    config = with_options(Configuration(), **SMALL, **options)
    with pytest.raises(PachonError) as caught:
        Experiment.from_config(config, tmp_path)
    assert "\n" not in str(caught.value)
    assert all(part in str(caught.value).replace(f"{tmp_path}/", "") for part in parts), str(caught.value)


def test_measured_heights_are_a_cause_but_have_no_terms():
    config = experiment_of(focal_plane__heights="lsstcam").config
    causes = checked_causes(config)
    assert "heights" in causes
    assert not {"global", "raft", "ccd", "tilt", "potato_chip"} & set(causes)
    flat = Experiment.from_config(without(config, "heights")).focal_plane
    assert flat.height(0.0, 0.0) == 0.0
    with pytest.raises(ConfigError, match=r"raft cannot be switched off: focal_plane\.heights = lsstcam"):
        checked_causes(config, ["raft"])


@pytest.mark.long
def test_distributions_of_heights_hold_every_ccd(monkeypatch):
    """However much their surfaces differ: beyond 59 um none was counted."""
    monkeypatch.setattr("pachon.pipeline.report.height_plots._SAMPLES", 10)
    plane = FocalPlane.from_budget("lsst", seed=1, budget=HeightBudget(0.0, 0.0, 0.0, 5e-3, 0.0))
    drawn = vendor_heights_plot(plane, "heights").axes[2]
    counts = []
    for patch in drawn.patches:
        x, y = patch.get_xy().T
        # Steps: each bin is as wide as it is high in CCDs, over its width.
        counts.append(round(float(np.sum(0.5 * (y[1:] + y[:-1]) * np.diff(x))) / (max(x) / 59)))
        assert max(x) >= drawn.get_xlim()[1] / 1.06
    assert counts == [72, 117]
