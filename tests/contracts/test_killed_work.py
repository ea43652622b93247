"""Work killed with -9 at random instants: it goes on, or is done again, to the same bytes; no half file is in place.

``pytest -s -m slow tests/contracts/test_killed_work.py`` prints the counts. Runs, sweeps and tolerances with their
workers have tests of their own (``tests/studies/test_killed_commands.py``).
"""

import multiprocessing
import os
import time

import numpy as np
import pytest
from small_work import MODULES, WORK, content

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="needs a server of forks")]

#: Kills of each.
KILLS = int(os.environ.get("PACHON_KILLS", "10"))
KILLED = ("tolerance", "align", "measure", "reproduce", "shim", "null-test", "stack-images", "donuts", "model",
          "optimize", "fit_static_heights")  # fmt: skip


def call(name, here, out, resume):
    """Do work in a process of its own."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os._exit(WORK[name].run(here, out, resume))


@pytest.fixture(scope="module")
def forks():
    """Processes that have imported what the work needs, so that kills fall into the work."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(MODULES)
    return context


@pytest.mark.parametrize("name", KILLED)
def test_killed_work_ends_with_the_same_bytes(name, forks, tmp_path):
    work, here = WORK[name], tmp_path / "here"
    here.mkdir()
    work.make(here)

    def started(out):
        if not (resume := out.exists()):
            work.begin(here, out)
        process = forks.Process(target=call, args=(name, here, out, resume))
        process.start()
        return process

    def whole(out):
        process = started(out)
        process.join()
        assert process.exitcode == 0
        return content(out)

    expected = whole(tmp_path / "warm")
    begin = time.monotonic()
    assert whole(tmp_path / "timed") == expected
    seconds = time.monotonic() - begin
    rng, kills, ended = np.random.default_rng(7), 0, 0
    out = tmp_path / "killed0"
    while kills < KILLS:
        # What is left of work that goes on is shorter.
        longest = 0.5 * seconds if work.resumes and out.exists() else seconds
        process = started(out)
        process.join(rng.uniform(0.0, longest))
        if process.exitcode is None:
            process.kill()
            process.join()
            kills += 1
            if not work.resumes:
                inputs = content(here / work.start) if work.start else {}
                in_place = {file: data for file, data in content(out).items() if not file.endswith(".partial")}
                assert {file: data for file, data in in_place.items() if (expected | inputs)[file] != data} == {}
            continue
        assert process.exitcode == 0
        assert content(out) == expected
        ended += 1
        out = tmp_path / f"killed{ended}"
    assert whole(out) == expected
    print(f"{name}: {kills} kills, {ended + 1} times to the end, {seconds:.1f} s without kills")
