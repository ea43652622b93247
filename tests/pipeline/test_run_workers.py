"""A run by processes, by a cluster and in parts: the same bytes as one process leaves."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml
from drivers import kill_a_worker, start, wait_for

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.core.files import marked_folder
from pachon.core.long_work import Execution, Job, JobComputation
from pachon.core.workers import Workers, serial_worker
from pachon.pipeline import memory, run_folder
from pachon.pipeline import run as run_module
from pachon.pipeline.ccd_worker import compute_ccd
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.memory import check_memory
from pachon.pipeline.run import run
from pachon.pipeline.screen_cache import with_cached_screens


@pytest.fixture(autouse=True)
def no_report(monkeypatch, finished_run):
    """Take the report of the finished run for every other: drawing it takes longest, and others test it."""
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    monkeypatch.setattr(run_module, "build_report", lambda *_: (finished_run / "report.html").read_text())


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "timings.json"}


def test_workers_write_the_bytes_of_one_process(finished_run, tmp_path, tiny):
    result = run(tiny(), tmp_path / "run", execution=Execution(workers=serial_worker))
    assert contents(tmp_path / "run") == contents(finished_run)
    assert result.computed == ("R22_S11", "R24_S12")


@pytest.mark.slow
def test_a_worker_that_does_not_see_the_folder_sends_its_product(finished_run, tmp_path, tiny):
    experiment = Experiment.from_config(tiny())
    computation = JobComputation(partial(compute_ccd, experiment), tmp_path, ".another_mark")
    result = computation(Job(0, "CCD R24_S12", "R24_S12"), 1)
    assert result.files == (("ccd_R24_S12.fits", (finished_run / "ccd_R24_S12.fits").read_bytes()),)
    assert not any(tmp_path.iterdir())

    def far(compute):
        return Workers("far", 0, lambda jobs: (replace(compute, mark="none")(job, 1) for job in jobs))

    run(tiny(), tmp_path / "run", execution=Execution(workers=far))
    assert contents(tmp_path / "run") == contents(finished_run)


def test_parts_share_a_folder_and_the_last_writes_the_report(finished_run, tmp_path, tiny):
    first = run(tiny(), tmp_path / "run", part=(2, 2))
    assert (first.computed, first.missing, first.report) == (("R24_S12",), ("R22_S11",), None)
    assert not (tmp_path / "run" / "summary.json").exists()
    again = run(tiny(), tmp_path / "run", part=(2, 2))
    assert (again.computed, again.kept) == ((), ("R24_S12",))
    # A batch system may have more jobs than there are CCDs.
    idle = run(tiny(), tmp_path / "run", part=(3, 3))
    assert (idle.computed, idle.missing, idle.report) == ((), ("R22_S11",), None)
    last = run(tiny(), tmp_path / "run", part=(1, 2))
    assert last.report is not None
    assert contents(tmp_path / "run") == contents(finished_run)


@pytest.mark.long
def test_parts_with_a_ccd_each_that_cannot_be_modelled_end_with_a_report(tmp_path, tiny, monkeypatch):
    real, reason = run_folder.model_ccds, "3 of 12 stars left"
    bad = {"R22_S11", "R22_S12"}

    def fails(experiment, exposures):
        products = iter(real(experiment, [e for e in exposures if e.name not in bad]))
        return [DomainError(reason) if e.name in bad else next(products) for e in exposures]

    monkeypatch.setattr(run_folder, "model_ccds", fails)
    config = tiny(ccds=("R22_S11", "R22_S12", "R24_S12"))
    first = run(config, tmp_path / "run", part=(1, 2))
    assert (first.not_modelled, first.missing, first.report) == ({"R22_S11": reason}, ("R22_S12",), None)
    last = run(config, tmp_path / "run", part=(2, 2))
    assert last.not_modelled == last.summary["not_modelled"] == {"R22_S11": reason, "R22_S12": reason}
    assert last.report is not None
    run(config, tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    assert {name: text for name, text in contents(tmp_path / "run").items() if name in whole} == whole
    # It is tried again by the part that it belongs to, and the other one learns of it.
    bad.remove("R22_S11")
    again = run(config, tmp_path / "run", part=(1, 2))
    assert (again.computed, again.not_modelled) == (("R22_S11",), {"R22_S12": reason})
    assert [path.name for path in (tmp_path / "run").glob("not_modelled*")] == ["not_modelled_R22_S12.json"]


@pytest.mark.parametrize("part", [(0, 2), (3, 2), (1, 0)])
def test_a_part_that_is_none_is_refused(tmp_path, tiny, part):
    with pytest.raises(DomainError, match=f"part = {part[0]}/{part[1]}: expected i/n"):
        run(tiny(), tmp_path / "run", part=part)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["3", "a/b", "1/2/3", "1.5/2"])
def test_a_part_is_two_numbers(tmp_path, capsys, text):
    assert main(["run", "--out", str(tmp_path / "run"), "--part", text]) == 2
    assert capsys.readouterr().err.strip() == f"pachon: error: --part = {text}: expected I/N, such as 3/8"


def test_a_ccd_that_cannot_be_modelled_is_left_out_or_ends_the_run(tmp_path, tiny, monkeypatch):
    real = run_folder.model_ccds

    def fails(experiment, exposures):
        (exposure,) = exposures
        return [DomainError("3 of 12 stars left")] if exposure.name == "R22_S11" else real(experiment, exposures)

    monkeypatch.setattr(run_folder, "model_ccds", fails)
    result = run(tiny(), tmp_path / "one", execution=Execution(workers=serial_worker))
    assert (result.not_modelled, result.computed) == ({"R22_S11": "3 of 12 stars left"}, ("R24_S12",))
    with pytest.raises(ProductError, match=r"^CCD R22_S11: 3 of 12 stars left$"):
        run(tiny(), tmp_path / "two", execution=Execution(workers=serial_worker), strict=True)


def test_a_product_that_cannot_be_written_ends_the_run_in_one_line(tmp_path, tiny, monkeypatch):
    def full(*_):
        raise ProductError("cannot write ccd.fits: No space left on device")

    monkeypatch.setattr(run_folder, "write_product", full)
    with pytest.raises(ProductError, match=r"^CCD R22_S11: cannot write ccd\.fits: No space left on device$"):
        run(tiny(), tmp_path / "run", execution=Execution(workers=serial_worker))


def test_processes_that_do_not_fit_into_memory_are_refused(tiny, monkeypatch):
    experiment = Experiment.from_config(tiny())
    monkeypatch.setattr(memory, "available_bytes", lambda: int(2.5 * memory.needed_bytes(experiment, 1)))
    check_memory(experiment, 1, copies=2)
    check_memory(experiment, 1, copies=0)
    with pytest.raises(ConfigError, match=r"^3 processes need about .* of memory, .* are free; 2 would do$"):
        check_memory(experiment, 1, copies=3)


def test_screens_are_kept_where_they_are_the_same_and_freed_where_not(tiny):
    def kept(**changed):
        return with_cached_screens(Experiment.from_config(tiny(**changed))).atmosphere

    # A seed of its own: screens of an atmosphere of another test may be in use until it is collected.
    one, same = kept(seed=11), kept(seed=11, ccds=("R24_S12",), atmosphere__exposure_s=1.0)
    screens = one.screens("slopes")
    assert same.screens("slopes") is screens
    other = kept(seed=2)
    assert not np.array_equal(other.screens("slopes"), screens)
    # In use until released, then freed and made again.
    assert same.screens("slopes") is screens
    one.release()
    same.release()
    assert same.screens("slopes") is not screens


def test_the_mark_of_a_folder_goes_with_its_process(tmp_path):
    with marked_folder(tmp_path) as mark, marked_folder(tmp_path) as other:
        assert (tmp_path / mark).is_file()
        assert mark != other
    assert not any(tmp_path.iterdir())


def start_run(folder, *options):
    """Start a run, and wait for its first product."""
    driver = start(folder, "run", "small.yaml", "--out", "run", *options)
    wait_for(lambda: any((folder / "run").glob("ccd_*.fits")), driver)
    return driver


@pytest.fixture
def reference(settings_file, tmp_path):
    """Six CCDs by one process."""
    content = yaml.safe_load(settings_file.read_text())
    content |= {"ccds": ["R22_S11", "R22_S12", "R23_S10", "R23_S11", "R23_S12", "R24_S12"]}
    content["stars"]["truth"] = 400
    settings_file.write_text(yaml.safe_dump(content))
    assert main(["run", str(settings_file), "--out", str(tmp_path / "one"), "--quiet"]) == 0
    return contents(tmp_path / "one")


@pytest.mark.slow
def test_processes_of_which_one_is_killed_and_the_run_resumed(reference, tmp_path):
    driver = start_run(tmp_path, "--processes", "2")
    kill_a_worker(driver)
    said = driver.communicate()[1]
    assert driver.returncode == 2
    assert "a worker process died" in said.strip().splitlines()[-1]
    assert main(["run", str(tmp_path / "small.yaml"), "--out", str(tmp_path / "run"), "--resume", "--quiet"]) == 0
    made, wanted = contents(tmp_path / "run"), reference
    assert {k: v for k, v in made.items() if k != "report.html"} == {
        k: v for k, v in wanted.items() if k != "report.html"
    }


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_leaves_the_same_bytes(reference, tmp_path, cluster):
    driver = start_run(tmp_path, "--scheduler", cluster["address"])
    cluster["workers"][0].kill()
    said = driver.communicate()[1]
    assert driver.returncode == 0, said
    made = contents(tmp_path / "run")
    assert {k: v for k, v in made.items() if k.startswith("ccd_")} == {
        k: v for k, v in reference.items() if k.startswith("ccd_")
    }
    assert made["summary.json"] == reference["summary.json"]
    shutil.rmtree(tmp_path / "run")
