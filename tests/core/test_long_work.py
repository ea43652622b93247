"""Long work with a toy computation: order, kills, other configurations, damaged products, workers that fail."""

import os
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.core.long_work import Execution, JobComputation, claim_folder, differences
from pachon.core.products import Stamp, image_hdu, write_fits
from pachon.core.progress import Reporter
from pachon.core.workers import Workers, process_workers

STAMP = Stamp("ab" * 32, 1)
NAMES = ("a", "b", "c", "d", "e")


def square(content, threads):
    if content < 0:
        raise DomainError("expected at least 0", key="content")
    return content**2


def shuffled(compute):
    """Workers that end jobs in pairs, the later one first."""

    def results(jobs):
        jobs = list(jobs)
        for i in range(0, len(jobs), 2):
            for job in reversed(jobs[i : i + 2]):
                yield compute(job, 1)

    return Workers("shuffled", 3, results)


def far(compute):
    """Workers that do not see the folder."""
    computation = JobComputation(compute.compute, compute.folder, "no mark")
    return Workers("far", 0, lambda jobs: (computation(job, 1) for job in list(jobs)[::-1]))


WORKERS = {"alone": None, "shuffled": shuffled, "far": far}


def squares(contents, workers=None, **options):
    labels = [f"job {content}" for content in contents]
    with Execution(workers).results(square, labels, contents, **options) as results:
        return list(results)


def draw(names, killed_at, name, threads, folder):
    """Write a picture and then the product of a job, of values that only its name determines."""
    if killed_at == name:
        raise Killed
    (folder / f"{name}.txt").write_text(name)
    if killed_at == f"{name}.txt":
        raise Killed
    image = np.full((4, 4), float(names.index(name)))
    write_fits(folder / f"{name}.fits", [image_hdu("IMAGE", image, "toy")], STAMP, [])
    return len(name)


class Killed(BaseException):
    """Stand-in for the end of a process."""


def toy(folder, execution=None, *, size=4, killed_at=None):
    """The steps of long work: claim a folder, know what is finished, hand out the rest, collect it in order."""
    execution = execution or Execution()
    claim_folder(
        folder / "config.txt",
        str(size).encode(),
        products="*.fits",
        noun="toys",
        now={"size": size},
        read=lambda path: {"size": int(path.read_text())},
        wanted=execution.resume,
    )
    paths = {name: folder / f"{name}.fits" for name in NAMES}
    finished = execution.finished(paths, STAMP)
    missing = [name for name in NAMES if name not in finished]
    with execution.results(
        partial(draw, NAMES, killed_at),
        missing,
        missing,
        folder=folder,
        product=lambda number: paths[missing[number]],
    ) as results:
        collected = dict(zip(missing, results, strict=True))
    assert list(collected) == missing
    return missing


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "toys"
    assert toy(folder) == list(NAMES)
    return contents(folder)


@pytest.mark.parametrize("title", [None, "squares"])
@pytest.mark.parametrize("workers", [None, shuffled])
def test_results_keep_the_order_of_the_jobs(workers, title):
    assert squares([3, 1, 4, 1.5, 9], workers, title=title) == [9, 1, 16, 2.25, 81]
    assert squares([], workers, title=title) == []


def test_progress_counts_the_items_of_jobs(capsys):
    with Execution(reporter=Reporter()).results(square, ["a", "b"], [1, 2], title="t", sizes=[9, 1]) as results:
        assert list(results) == [1, 4]
    first, second, _ = capsys.readouterr().err.splitlines()
    assert first.startswith("a (9 of 10, ")
    assert second == "b (10 of 10)"


def test_a_result_is_there_before_the_jobs_after_it_are_computed():
    taken = []

    def contents():
        for content in (1, 2, 3):
            taken.append(content)
            yield content

    with Execution().results(square, ["a", "b", "c"], contents()) as results:
        assert next(results) == 1
        assert taken == [1]


def test_results_are_stored_as_they_arrive():
    stored = []
    assert squares([1, 2, 3, 4], shuffled, save=stored.append) == [1, 4, 9, 16]
    assert stored == [4, 1, 16, 9]


@pytest.mark.parametrize("workers", [None, shuffled])
def test_an_error_names_the_job_and_keeps_its_class(workers):
    with pytest.raises(DomainError, match=r"^job -2: expected at least 0$") as caught:
        squares([1, -2, 3], workers)
    assert caught.value.key == "content"


def test_memory_is_checked_before_the_first_job():
    def check(processes):
        raise DomainError(f"{processes} processes are too many")

    with pytest.raises(DomainError, match=r"^3 processes are too many"):
        squares([-1], shuffled, check=check)


@pytest.mark.parametrize("workers", WORKERS.values(), ids=WORKERS)
def test_workers_leave_the_same_bytes(workers, whole, tmp_path):
    toy(tmp_path / "out", Execution(workers))
    assert contents(tmp_path / "out") == whole


@pytest.mark.parametrize("workers", WORKERS.values(), ids=WORKERS)
@pytest.mark.parametrize("point", [*NAMES, *(f"{name}.txt" for name in NAMES)])
def test_a_killed_computation_goes_on_to_the_same_bytes(workers, point, whole, tmp_path):
    with pytest.raises(Killed):
        toy(tmp_path, Execution(workers), killed_at=point)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fits")}
    missing = toy(tmp_path, Execution(workers, resume=True))
    assert missing == [name for name in NAMES if f"{name}.fits" not in before]
    assert contents(tmp_path) == whole
    assert all((tmp_path / name).stat().st_mtime_ns == time for name, time in before.items())


def test_a_damaged_product_is_made_again(whole, tmp_path):
    toy(tmp_path)
    for name, data in (("b", whole["b.fits"][:-2880]), ("d", whole["d.fits"].replace(b"toy", b"boy"))):
        (tmp_path / f"{name}.fits").write_bytes(data)
    (tmp_path / "e.fits").unlink()
    assert toy(tmp_path, Execution(resume=True)) == ["b", "d", "e"]
    assert contents(tmp_path) == whole


def test_another_configuration_is_refused(whole, tmp_path):
    toy(tmp_path)
    with pytest.raises(ProductError, match=r"holds toys of another configuration \(size: 4 -> 5\); choose"):
        toy(tmp_path, Execution(resume=True), size=5)
    with pytest.raises(ProductError, match=r"holds toys already; go on with --resume, or choose another --out$"):
        toy(tmp_path)
    (tmp_path / "config.txt").unlink()
    with pytest.raises(ProductError, match=r"holds a\.fits but no config\.txt; choose another --out$"):
        toy(tmp_path, Execution(resume=True))
    whole = {name: data for name, data in whole.items() if name != "config.txt"}
    assert contents(tmp_path) == whole


def test_free_keys_may_differ():
    old, new = {"a": 1, "b": {"c": 2, "d": 3}, "bc": 4}, {"a": 1, "b": {"c": 5, "d": 6}, "bc": 7}
    assert differences(old, new) == ["b.c: 2 -> 5", "b.d: 3 -> 6", "bc: 4 -> 7"]
    assert differences(old, new, ("b.c",)) == ["b.d: 3 -> 6", "bc: 4 -> 7"]
    assert differences(old, new, ("b",)) == ["bc: 4 -> 7"]


def test_an_interrupt_between_results_ends_the_workers():
    ended = []

    def workers(compute):
        def results(jobs):
            try:
                yield from (compute(job, 1) for job in jobs)
            finally:
                ended.append(True)

        return Workers("watched", 1, results)

    def collect():
        with Execution(workers).results(square, ["a", "b"], [1, 2]) as results:
            assert next(results) == 1
            assert not ended
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect()
    assert ended


def test_a_reporter_ends_the_work():
    def interrupted():
        raise KeyboardInterrupt

    execution = Execution(reporter=Reporter(quiet=True, check=interrupted))
    with pytest.raises(KeyboardInterrupt), execution.results(square, ["a"], [1], title="squares") as results:
        list(results)


@pytest.mark.parametrize("name", ["workers", "threads", "resume", "reporter"])
def test_a_field_of_the_execution_is_no_argument(name, tmp_path):
    text = rf"^{name}: no argument of run; expected execution=Execution\({name}=\.\.\.\)$"
    with pytest.raises(ConfigError, match=text):
        pachon.run(pachon.Configuration(), tmp_path / "run", **{name: None})


_DRIVER = """
import os, signal, time
from functools import partial
from pachon.core.long_work import Execution
from pachon.core.workers import process_workers

def wait(seconds, threads):
    if seconds:
        print(os.getpid(), flush=True)
        time.sleep(seconds)

if __name__ == "__main__":
    # A shell lets its jobs in the background ignore Ctrl-C, and so does what they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    execution = Execution(lambda compute: process_workers(compute, 2))
    with execution.results(wait, ["a", "b"], [0.0, 60.0]) as results:
        for _ in results:
            time.sleep(60.0)
"""


@pytest.mark.slow
def test_an_interrupt_while_a_result_is_collected_does_not_wait_for_others(tmp_path):
    (tmp_path / "driver.py").write_text(_DRIVER)
    with subprocess.Popen(
        [sys.executable, "driver.py"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
    ) as driver:
        int(driver.stdout.readline())
        driver.send_signal(signal.SIGINT)
        try:
            errors = driver.communicate(timeout=10.0)[1]
        finally:
            driver.kill()
    assert "KeyboardInterrupt" in errors


@pytest.mark.long
def test_processes_leave_the_same_bytes(whole, tmp_path):
    toy(tmp_path / "out", Execution(lambda compute: process_workers(compute, 2)))
    assert contents(tmp_path / "out") == whole
