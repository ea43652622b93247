"""Work killed with -9 at random instants: it goes on, or is done again, to the same bytes; no half file is in place.

``pytest -s -m slow tests/contracts/test_killed_work.py`` prints the counts. Runs, sweeps and tolerances with their
workers have tests of their own (``tests/studies/test_killed_commands.py``).
"""

import multiprocessing
import os

import pytest
from drivers import killed_again_and_again
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

    def begin(out):
        if not (resume := out.exists()):
            work.begin(here, out)
        process = forks.Process(target=call, args=(name, here, out, resume))
        process.start()
        return process

    def no_half_file(out, expected):
        if not work.resumes:
            inputs = content(here / work.start) if work.start else {}
            in_place = {file: data for file, data in content(out).items() if not file.endswith(".partial")}
            assert {file: data for file, data in in_place.items() if (expected | inputs)[file] != data} == {}

    ended, seconds = killed_again_and_again(
        begin, content, tmp_path, KILLS, resumes=work.resumes, after_kill=no_half_file
    )
    print(f"{name}: {KILLS} kills, {ended} times to the end, {seconds:.1f} s without kills")
