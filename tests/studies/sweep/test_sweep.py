"""Whole sweeps, through the command line: who computes, what is killed, and what the figures are afterwards."""

import os
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.core.dask_cluster import check_versions
from pachon.core.errors import ConfigError, PachonError
from pachon.core.units import ARCSEC
from pachon.models.io.bundled import DATA
from pachon.models.io.prescription import load_telescope
from pachon.pipeline.config import with_run
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.focal_plane_stage import apply_focal_plane_model
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.studies.metrics.scene import Scene
from pachon.studies.metrics.stars import STARS
from pachon.studies.sweep.file import load_sweep, read_sweep
from pachon.studies.sweep.point import point_experiment
from pachon.studies.sweep.store import SweepPoint, SweepStore
from pachon.studies.sweep.sweep import check_room

#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long

SWEEP = """
name: small
base: {ccds: [R23], wavelengths_nm: [624], stars: {truth: 12}, psf: {engine: long_exposure},
       reconstruction: {components: 5, truth_order: 2}}
parameters:
  focal_plane.raft_um: {nominal: 0, range: [0, 10], marks: {specification: 4.8}}
  M2.dz_um: {nominal: 0, range: [-10, 10]}
  R23_S11.rx_urad: {nominal: 0, values: [0, 100]}
  reconstruction.order: {nominal: 3, values: [3, 2]}
design: {kind: latin_hypercube, points: 14}
metrics: [fwhm, rms_e]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "small.yaml").write_text(SWEEP)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def figures(path):
    """Every point's number and figures, as the bytes that the store holds."""
    with sqlite3.connect(path) as connection:
        rows = connection.execute("SELECT number, metrics, problem FROM results ORDER BY number").fetchall()
    connection.close()
    return rows


def count(path):
    if not os.path.exists(path):
        return 0
    try:
        with sqlite3.connect(path) as connection:
            (number,) = connection.execute("SELECT count(*) FROM results").fetchone()
        connection.close()
        return number
    except sqlite3.Error:
        return 0


def start(*arguments, **options):
    with open("said.txt", "wb") as said:
        return subprocess.Popen([sys.executable, "-m", "pachon.commands.cli", *arguments], stderr=said, **options)


def said_by(process):
    """Wait for a command to end, and return what it said on standard error."""
    process.wait(180)
    with open("said.txt", encoding="utf-8") as said:
        return said.read().strip()


def wait_for(path, number, process, seconds=240.0):
    """Wait until a store holds so many points."""
    end = time.monotonic() + seconds
    while count(path) < number:
        assert process.poll() is None, said_by(process)
        assert time.monotonic() < end
        time.sleep(0.02)


def kill_after(process, path, number):
    """Kill a process as soon as a store holds so many points."""
    while count(path) < number and process.poll() is None:
        time.sleep(0.02)
    process.kill()


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    (folder / "small.yaml").write_text(SWEEP)
    assert main(["sweep", str(folder / "small.yaml"), "--processes", "1", "--threads", "2", "--quiet"]) == 0
    return figures(folder / "small.sweep")


def test_points_differ_where_their_parameters_do(reference):
    assert len(reference) == 14
    assert all(problem is None for _, _, problem in reference)
    assert len({metrics for _, metrics, _ in reference}) == 14


@pytest.mark.slow
def test_a_sweep_that_is_killed_three_times_ends_with_the_same_bytes(folder, reference):
    command = ("sweep", "small.yaml", "--processes", "2")
    driver = start(*command)
    wait_for("small.sweep", 2, driver)
    with SweepStore(folder / "small.sweep") as store:
        workers = {int(r.worker.rpartition(":")[2]) for r in store.results()} - {driver.pid}
    os.kill(workers.pop(), signal.SIGKILL)
    last = said_by(driver).splitlines()[-1]
    assert driver.returncode == 2
    assert re.search("a worker process died.*what was computed is kept, go on with --resume", last)
    assert main(["sweep", "small.yaml"]) == 2, "without --resume a store is not touched"

    driver = start(*command, "--resume")
    wait_for("small.sweep", count("small.sweep") + 1, driver)
    driver.send_signal(signal.SIGINT)
    assert "go on with: pachon sweep small.yaml -o small.sweep --resume" in said_by(driver)
    assert driver.returncode == 130

    driver = start("sweep", "small.yaml", "--processes", "1", "--resume")
    wait_for("small.sweep", count("small.sweep") + 1, driver)
    driver.kill()
    driver.wait()
    assert 4 <= count("small.sweep") < 14
    assert main(["sweep", "small.yaml", "--processes", "1", "--resume", "--quiet"]) == 0
    assert figures("small.sweep") == reference


@pytest.mark.slow
def test_a_dask_cluster_that_loses_a_worker_its_driver_and_its_scheduler(folder, reference, cluster, capsys):
    command = ("sweep", "small.yaml", "--scheduler", cluster["address"])
    driver = start(*command)
    wait_for("small.sweep", 2, driver)
    cluster["workers"][0].kill()
    wait_for("small.sweep", count("small.sweep") + 2, driver)
    driver.kill()
    driver.wait()
    before = count("small.sweep")
    lost = threading.Thread(target=kill_after, args=(cluster["scheduler"], "small.sweep", before + 2))
    lost.start()
    assert main([*command, "--resume"]) == 2
    lost.join()
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "the Dask scheduler is lost; what was computed is kept, go on with --resume" in last
    assert before + 2 <= count("small.sweep") < 14
    for process in (cluster["scheduler"], *cluster["workers"]):
        process.kill()
        process.wait()
    cluster["restart"]()
    assert main([*command, "--resume", "--quiet"]) == 0
    assert figures("small.sweep") == reference


@pytest.mark.slow
def test_a_changed_sweep_is_refused_with_what_differs(folder, capsys):
    (folder / "small.yaml").write_text(SWEEP.replace("points: 14", "points: 1"))
    assert main(["sweep", "small.yaml", "--quiet"]) == 0
    (folder / "small.yaml").write_text(SWEEP.replace("points: 14", "points: 2"))
    assert main(["sweep", "small.yaml", "--resume", "--quiet"]) == 2
    assert "small.sweep: store of another sweep (design.points: 1 -> 2); give another -o" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("M2.dz_um", "M7.dz_um"), "'M7': did you mean M3 or M2 or M1"),
        (("M2.dz_um", "M2.dz"), "changes.M2.dz: expected its unit at the end, such as M2.dz_um"),
        (("focal_plane.raft_um", "focal_plane.raf_um"), "focal_plane.raf_um"),
        (("R23_S11.rx_urad", "R23_S11.rx_um"), "unknown motion of R23_S11 'rx_um': did you mean rx_urad"),
        (("fwhm, rms_e", "fwhm, rms_ee"), "unknown metric 'rms_ee': did you mean rms_e"),
        (("ccds: [R23]", "ccds: [R99]"), "R99"),
        (("values: [3, 2]", "values: [3, -2]"), "reconstruction.order = -2: expected a number from 0"),
        (("name: small", "name: small\nxi_target: -1"), "xi_target = -1: expected a number above 0"),
    ],
)
def test_bad_sweeps_end_with_one_line_before_anything_is_computed(folder, capsys, change, message):
    (folder / "small.yaml").write_text(SWEEP.replace(*change))
    assert main(["sweep", "small.yaml"]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert not (folder / "small.sweep").exists()


@pytest.mark.slow
def test_every_metric_gives_finite_figures(folder):
    metrics = ", ".join(m for m in STARS if m != "reconstruction")
    (folder / "small.yaml").write_text(
        SWEEP.replace("fwhm, rms_e", metrics).replace("points: 14", "points: 1").replace("[R23]", "[R23_S11, R23_S12]")
    )
    assert main(["sweep", "small.yaml", "--quiet"]) == 0
    with SweepStore(folder / "small.sweep") as store:
        (result,) = store.results()
    names = set(result.metrics)
    # No CCD lies in some rings of the field, and few stars have few close pairs; all else is a number.
    empty = {name for name, value in result.metrics.items() if value != value and not name.startswith(("xi_p", "xi_m"))}
    assert empty == {"mean_e_0_to_0.5_deg", "mean_e_1.5_to_1.8_deg"}
    assert {
        "effective_fwhm_arcsec",
        "fwhm_arcsec",
        "rms_g",
        "xi_g_raw_short",
        "rms_e",
        "border_jump_e",
        "xi_raw_short",
        "ee80_arcsec",
        "throughput_min",
        "Z4_nm",
    } <= names


def test_bins_of_the_correlation_have_one_name_in_all_replicas():
    """Stars of another seed have other mean separations: replicas would never meet in one column."""
    base = {"ccds": ["R22_S11"], "psf": {"engine": "long_exposure"}, "stars": {"truth": 15}}
    sweep = read_sweep(
        {"base": base, "parameters": {"M2.dz_um": {"nominal": 0, "values": [0]}}, "metrics": ["xi_bins"]}, "test"
    )
    found = []
    for seed in (1, 2):
        experiment = point_experiment(sweep, SweepPoint(0, {"M2.dz_um": 0}, seed), Path())
        scene = Scene(experiment.telescope, experiment, threads=1)
        found.append(STARS["xi_bins"].compute(scene))
        assert list(found[-1].values())[: scene.bins.n_bins] == pytest.approx(scene.correlation.xi_plus, nan_ok=True)
    # Stars that reach farther have a bin more.
    few, many = sorted(found, key=len)
    assert set(few) <= set(many)
    # Eight bins from 10 arcmin to 3 degrees, and as wide ones below.
    middles = [float(name.split("_")[2]) for name in many if name.startswith("xi_plus")]
    assert middles == pytest.approx(10.0 * 18.0 ** ((np.arange(len(middles)) - 7.5) / 8.0), rel=3e-3)


def test_more_points_than_there_is_room_for_are_refused_before_starting(folder):
    content = {
        "parameters": {f"M1.Z{j}_nm": {"range": [0, 1]} for j in range(4, 16)},
        "design": {"kind": "grid", "points": 20},
    }
    with pytest.raises(ConfigError, match=r"4,096,000,000,000,000 points take about .* of memory, .* are free"):
        check_room(read_sweep(content, "test"), folder / "s.sweep")


def test_a_scheduler_that_does_not_answer_is_one_line(folder, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("pachon.core.dask_cluster.CONNECT_SECONDS", 1.0)
    assert main(["sweep", "small.yaml", "--scheduler", "tcp://127.0.0.1:9"]) == 2
    error = capsys.readouterr().err.strip()
    assert "--scheduler = tcp://127.0.0.1:9: no answer within 1 s" in error
    assert len(error.splitlines()) == 1


def test_an_address_that_is_none_is_one_line(folder, capsys):
    pytest.importorskip("distributed")
    assert main(["sweep", "small.yaml", "--scheduler", "login1:8786"]) == 2
    assert "--scheduler = login1:8786: expected an address such as tcp://host:8786" in capsys.readouterr().err


def test_workers_with_another_version_are_refused():
    class Client:
        def run(self, function, on_error):
            return {"tcp://a": "0.0.1"}

    with pytest.raises(ConfigError, match=r"worker tcp://a: has pachon 0\.0\.1, expected"):
        check_versions(Client())


@pytest.mark.slow
def test_points_that_cannot_be_computed_are_reported_and_the_others_go_on(folder, capsys):
    # A CCD at the rim of the field sees no light when M2 is moved by half a metre.
    text = SWEEP.replace("range: [-10, 10]", "values: [0, 3.0e+6]").replace("points: 14", "points: 6")
    (folder / "small.yaml").write_text(text)
    assert main(["sweep", "small.yaml"]) == 0
    rows = figures("small.sweep")
    failed = [problem for _, _, problem in rows if problem]
    assert 0 < len(failed) < 6
    assert all("\n" not in problem for problem in failed)
    assert main(["sweep", "status", "small.sweep"]) == 0
    assert failed[0][:40] in capsys.readouterr().out.replace("\n", "")


def test_sweep_files_may_name_the_file_of_their_configuration(folder):
    (folder / "base.yaml").write_text("seed: 5\nccds: [R22_S11]\n")
    (folder / "two.yaml").write_text("base: base.yaml\nparameters: {band: {nominal: r, values: [r, i]}}\n")
    assert load_sweep(folder / "two.yaml").base == {"seed": 5, "ccds": ["R22_S11"]}


def test_files_of_a_configuration_in_another_folder_lie_beside_it(folder):
    """As for the run alone; a file of the same name beside the sweep is another one."""
    runs = folder / "runs"
    runs.mkdir()
    for place in (runs / "mine.yaml", runs / "site.yaml", folder / "mine.yaml"):
        place.write_text("content: of no matter here\n")
    (runs / "run.yaml").write_text("telescope: mine.yaml\natmosphere: {site: site.yaml}\nccds: [R22_S11]\n")
    (folder / "two.yaml").write_text("base: runs/run.yaml\nparameters: {band: {nominal: r, values: [r, i]}}\n")
    base = load_sweep(folder / "two.yaml").base
    assert (base["telescope"], base["atmosphere"]["site"]) == (str(runs / "mine.yaml"), str(runs / "site.yaml"))
    # Of nights, visits and images too.
    run = with_run({"run": "runs/run.yaml"}, folder / "night.yaml")["run"]
    assert run == {**base, "ccds": ["R22_S11"]}
    beside = with_run({"run": "run.yaml"}, runs / "night.yaml")["run"]
    assert beside["telescope"] == "mine.yaml"


@pytest.mark.slow
def test_a_wavelength_is_a_parameter(folder):
    text = "base: {ccds: [R22_S11], stars: {truth: 12}, psf: {engine: long_exposure}, reconstruction: {components: 5, "
    text += (
        "truth_order: 2}}\nparameters: {wavelengths_nm: {values: [560, 690]}}\ndesign: {kind: grid}\nmetrics: [fwhm]\n"
    )
    (folder / "small.yaml").write_text(text)
    assert main(["sweep", "small.yaml", "--quiet"]) == 0
    with SweepStore(folder / "small.sweep") as store:
        blue, red = (result.metrics["effective_fwhm_arcsec"] for result in store.results())
    # Seeing falls as the wavelength to the power -1/5; optics and detector are there too, the outer scale takes more.
    assert 0.9 < red / blue < (690 / 560) ** -0.2


@pytest.mark.slow
def test_compensators_are_solved_at_every_point(folder):
    text = SWEEP.replace("metrics:", "compensators: [Camera.dz_um]\nmetrics:").replace(
        "latin_hypercube, points: 14", "grid"
    )
    text = text.replace("M2.dz_um: {nominal: 0, range: [-10, 10]}", "Camera.dz_um: {nominal: 0, values: [0, 10]}")
    text = re.sub(r"  focal_plane.*\n|  R23_S11.*\n|  reconstruction.order.*\n", "", text)
    (folder / "small.yaml").write_text(text)
    assert main(["sweep", "small.yaml", "--quiet"]) == 0
    with SweepStore(folder / "small.sweep") as store:
        still, moved = (result.metrics for result in store.results())
    # The camera goes back by what it was moved; the solver stops at 1e-9 of the mean square radius of the spots.
    assert moved["solved Camera.dz_um"] - still["solved Camera.dz_um"] == pytest.approx(-10.0, abs=0.02)
    assert moved["rms_e"] == pytest.approx(still["rms_e"], rel=1e-3)


_FOUR = ("A_1", "A_2", "B_1", "B_2")


def test_motions_are_those_of_the_points_own_camera(folder):
    """A camera of four CCDs named otherwise than the LSST's: its names are motions, the LSST's are none."""
    rows = [f"  - {{name: {name}, raft: {name[0]}, x_mm: {40 * i}, y_mm: 0}}" for i, name in enumerate(_FOUR)]
    camera = ["name: four", "source: test", "pixel_um: 10", "pixels: [3000, 3000]", "ccds:", *rows]
    (folder / "camera.yaml").write_text("\n".join(camera))
    text = (DATA / "lsst_v3.3_r.yaml").read_text().replace("camera: lsst", "camera: camera.yaml")
    (folder / "four.yaml").write_text(text)
    base = {"telescope": "four.yaml", "ccds": ["A_1"], "wavelengths_nm": [624]}

    def configuration(parameter):
        content = {"base": base, "parameters": {parameter: {"values": [5]}}, "design": {"kind": "grid"}}
        return point_experiment(read_sweep(content, "test"), SweepPoint(0, {parameter: 5}, 1), folder).config

    assert configuration("B_2.dz_um").focal_plane.moved["B_2"].dz_um == 5
    assert configuration("A.rx_urad").focal_plane.moved["A"].rx_urad == 5
    with pytest.raises(PachonError, match="R22_S11"):
        configuration("R22_S11.dz_um")


def test_reconstruction_is_that_of_the_configuration(focal_plane_config, plane_model):
    config = focal_plane_config()
    scene = Scene(load_telescope(config.telescope), Experiment.from_config(config), threads=1)
    found = STARS["reconstruction"].compute(scene)
    assert plane_model.fits == 1
    alone = Scene(scene.telescope, Experiment.from_config(focal_plane_config(reconstruction__model="ccd")), threads=1)
    others = STARS["reconstruction"].compute(alone)
    assert list(found) == list(others)
    assert plane_model.fits == 1
    assert all(found[key] != others[key] for key in ("rms_residual_away", "rms_residual_at_stars"))
    products = [model_ccd(scene.experiment, expose_ccd(scene.experiment, name, threads=1)) for name in config.ccds]
    applied, _ = apply_focal_plane_model(scene.experiment, products)
    away = np.concatenate([p.ellipticity("away") for p in applied], axis=1)
    assert found["rms_residual_away"] == np.sqrt(np.mean(away**2))
    away = np.concatenate([p.ellipticity("away", "g") for p in applied], axis=1)
    assert found["rms_residual_g_away"] == np.sqrt(np.mean(away**2))


def test_each_width_has_one_meaning(focal_plane_config):
    config = focal_plane_config()
    scene = Scene(load_telescope(config.telescope), Experiment.from_config(config), threads=1)
    true = STARS["half_maximum"].compute(scene)["fwhm_arcsec"]
    effective = STARS["fwhm"].compute(scene)["effective_fwhm_arcsec"]
    # Of a run, the median of the widths at half maximum; wings make the noise-equivalent area larger. Here chief rays,
    # there centroids are at centres of pixels: the band-limited images agree to a thousandth.
    products = [model_ccd(scene.experiment, expose_ccd(scene.experiment, name, threads=1)) for name in config.ccds]
    widths = np.concatenate([p.holdout.fwhm for p in products])
    assert true * ARCSEC == pytest.approx(np.median(widths), rel=1e-3)
    assert 1.02 < effective / true < 1.3
    # g and e of the LSST's requirements are those of the holdout positions of the run, but for the place on the pixels,
    # which changes g by some 1e-5.
    adaptive = STARS["adaptive"].compute(scene)
    g = np.concatenate([p.ellipticity("truth", "g") for p in products], axis=1)
    assert adaptive["rms_g"] == pytest.approx(np.sqrt(np.mean(g**2)), abs=2e-5)
    modulus = np.hypot(*g)
    assert adaptive["median_distortion"] == pytest.approx(np.median(2.0 * modulus / (1.0 + modulus**2)), abs=4e-5)
