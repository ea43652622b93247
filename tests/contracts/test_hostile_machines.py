"""Clocks that jump, workers that are stopped, installations that cannot be written: the same bytes, nothing twice."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from drivers import children, lives, start, wait_for, workers
from small_work import RUN, SWEEP, WORK, content

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")

ROOT = Path(__file__).parents[2]
YEAR = 365.25 * 86400.0


def test_no_module_asks_the_clock_for_the_date():
    """Times are those of a clock that no one sets; no product has a date, no claim of work ends at one."""
    asking = (
        "time.time(",
        "time.time_ns(",
        "datetime.now(",
        "datetime.utcnow(",
        "date.today(",
    )
    folders = [path.parent for path in ROOT.glob("*/__init__.py")]
    sources = {path: path.read_text() for folder in folders for path in folder.rglob("*.py")}
    assert len(sources) > 300
    assert not [f"{path.name}: {word}" for path, text in sources.items() for word in asking if word in text]


class JumpingClock:
    """A clock that is a year ahead or behind at every other call."""

    def __init__(self):
        self.calls, self.rng, self.time, self.time_ns = 0, np.random.default_rng(4), time.time, time.time_ns

    def jump(self):
        self.calls += 1
        return int(self.rng.integers(-1, 2)) * YEAR


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sweep", "tolerance", "measure", "align", "run"])
def test_work_under_a_clock_that_jumps_leaves_the_same_bytes(name, tmp_path, monkeypatch):
    work, here = WORK[name], tmp_path / "here"
    here.mkdir()
    work.make(here)
    work.begin(here, tmp_path / "straight")
    assert work.run(here, tmp_path / "straight") == 0
    expected = content(tmp_path / "straight")
    clock, out = JumpingClock(), tmp_path / "jumping"
    monkeypatch.setattr(time, "time", lambda: clock.time() + clock.jump())
    monkeypatch.setattr(time, "time_ns", lambda: clock.time_ns() + int(1e9 * clock.jump()))
    work.begin(here, out)
    assert work.run(here, out) == 0
    assert content(out) == expected
    # Between two stages too: what is there is of next year, of last year, and gone on with.
    products = sorted(out.glob(work.products or "*"))
    for number, path in enumerate(products):
        now = clock.time() + (YEAR if number % 2 else -YEAR)
        os.utime(path, (now, now))
    if work.products:
        products[-1].unlink()
    assert work.run(here, out, resume=True) == 0
    assert content(out) == expected
    print(f"{name}: {clock.calls} calls of the clock, {len(products)} files of another year")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run", "sweep"])
@pytest.mark.parametrize("stopped", ["worker", "all workers", "driver"])
def test_processes_that_are_stopped_and_go_on_lose_nothing(name, stopped, tmp_path):
    # Long enough for both workers to be seen at work.
    settings = {"run": RUN, "sweep": SWEEP | {"design": {"kind": "latin_hypercube", "points": 30}}}[name]
    (tmp_path / "file.yaml").write_text(yaml.safe_dump(settings))
    out = {"run": "{}", "sweep": "{}/s.sweep"}[name]
    for folder in ("alone", "stopped"):
        (tmp_path / folder).mkdir()
    driver = start(tmp_path, name, "file.yaml", "--out", out.format("alone/out"), "--processes", "1", "--quiet")
    said = driver.communicate()[1]
    assert (driver.returncode, said) == (0, "")
    driver = start(tmp_path, name, "file.yaml", "--out", out.format("stopped/out"), "--processes", "2", "--quiet")
    ready = wait_for(lambda: len(workers(driver)) == 2 and workers(driver), driver)
    for process in {"worker": ready[:1], "all workers": ready, "driver": [driver.pid]}[stopped]:
        os.kill(process, signal.SIGSTOP)
        time.sleep(2.0)
        os.kill(process, signal.SIGCONT)
    said = driver.communicate()[1]
    assert (driver.returncode, said) == (0, "")
    assert not [process for process in children(driver) if lives(process)]
    assert content(tmp_path / "stopped") == content(tmp_path / "alone")


def namespaces():
    if shutil.which("unshare") is None:
        return False
    return subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not namespaces(), reason="needs namespaces of users")
def test_an_installation_that_cannot_be_written_works(tmp_path):
    """The package and the home with its caches on file systems mounted for reading alone."""
    home, folder = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    folder.mkdir()
    command = "-m pachon spots paul_baker --field-deg 0 --rays 4 --json --picture spots.png"
    mounts = "".join(f"mount --bind {place} {place} && mount -o remount,bind,ro {place} && " for place in (ROOT, home))
    bare = {key: value for key, value in os.environ.items() if key not in ("WARP_CACHE_PATH", "MPLCONFIGDIR")}
    bare = {key: value for key, value in bare.items() if not key.startswith("XDG_")}
    environment = {**bare, "PYTHONPATH": str(ROOT), "HOME": str(home)}
    told = {}
    for name, shell in (
        ("read only", f"{mounts} ! touch {ROOT}/x && ! touch {home}/x && cd {folder} && {sys.executable} {command}"),
        ("writable", f"cd {folder} && {sys.executable} {command}"),
    ):
        done = subprocess.run(["unshare", "-rm", "sh", "-c", shell], env=environment, capture_output=True, text=True,
                              check=False)  # fmt: skip
        assert done.returncode == 0, done.stderr
        told[name] = done.stdout, (folder / "spots.png").read_bytes()
        lines = [line for line in done.stderr.splitlines() if not line.startswith(("compiling ", "touch: "))]
        print(name, lines)
        if name == "read only":
            assert [line.startswith("cannot write compiled kernels to") for line in lines] == [True]
        else:
            assert not lines
    assert told["read only"] == told["writable"]
