"""Commands in processes of their own that hand out work, and what becomes of their processes when some are killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


def start(folder, *arguments):
    """Start a command in a folder; what it says on standard error is kept."""
    return subprocess.Popen([sys.executable, "-m", "pachon", *map(str, arguments)], cwd=folder, text=True,
                            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                            env={**os.environ, "PYTHONPATH": os.getcwd()})  # fmt: skip


def wait_for(condition, driver):
    """Wait until a function returns something true while a driver lives, and return that."""
    while not (found := condition()):
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.02)
    return found


def children(driver):
    """Return the numbers of the processes that a driver has started, those that ended left out."""
    found = subprocess.run(["pgrep", "-P", str(driver.pid)], capture_output=True, text=True, check=False).stdout
    return [int(number) for number in found.split() if lives(int(number))]


def workers(driver):
    """Return the numbers of the worker processes of a driver, which have begun to work."""
    return [
        n for n in children(driver) if "spawn_main" in _file(n, "cmdline") and len(os.listdir(f"/proc/{n}/task")) > 1
    ]


def lives(process):
    """Return whether a process lives; one that ended but of which its new parent has not taken notice does not."""
    return _file(process, "stat").rpartition(")")[2].split()[:1] not in ([], ["Z"])


def _file(process, name):
    try:
        return Path(f"/proc/{process}/{name}").read_text()
    except OSError:
        return ""


def _threads(process):
    return int((_file(process, "stat").rpartition(")")[2].split()[17:18] or [0])[0])


def kill_a_worker(driver):
    """Kill one of the workers of a driver with -9, as soon as there are some."""
    os.kill(wait_for(lambda: workers(driver), driver)[-1], signal.SIGKILL)


def seconds_that_children_outlive(driver):
    """Kill a driver with -9, and return for how long a process of its own lives on [s]."""
    left = children(driver)
    driver.kill()
    begin = time.monotonic()
    while any(map(lives, left)):
        if time.monotonic() > begin + 20.0:
            for process in filter(lives, left):
                os.kill(process, signal.SIGKILL)
            return float("inf")
        time.sleep(0.02)
    seconds = time.monotonic() - begin
    driver.communicate()
    return seconds


def killed_again_and_again(begin, content, folder, kills, *, resumes=True, after_kill=lambda out, expected: None):
    """Kill work with -9 at random instants; each time that it reaches its end its content is that of whole work.

    `begin(out)` starts the work that leaves `out`, or goes on with what is there, in a process; `after_kill` checks
    what a killed one has left. Returns how often it reached its end, and the seconds of whole work.
    """

    def whole(out):
        process = begin(out)
        process.join()
        assert process.exitcode == 0
        return content(out)

    expected = whole(folder / "warm")
    assert len(expected) > 0
    start_time = time.monotonic()
    assert whole(folder / "timed") == expected
    seconds = time.monotonic() - start_time
    rng, killed, ended = np.random.default_rng(7), 0, 0
    out = folder / "killed0"
    while killed < kills:
        # What is left of work that goes on is shorter.
        longest = 0.5 * seconds if resumes and content(out) else seconds
        process = begin(out)
        process.join(rng.uniform(0.0, longest))
        if process.exitcode is None:
            process.kill()
            process.join()
            killed += 1
            after_kill(out, expected)
            continue
        assert process.exitcode == 0
        assert content(out) == expected
        ended += 1
        out = folder / f"killed{ended}"
    assert whole(out) == expected
    return ended + 1, seconds
