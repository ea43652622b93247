"""Workers of a sweep end with the process that hands out its points."""

import os
import signal
import subprocess
import sys
import time

import pytest
from drivers import lives

_HALFWAY = """
import os, signal, struct, sys, time
from pachon.core.errors import ProductError
from pachon.core.workers import process_workers

def halfway(number, threads):
    if number:
        time.sleep(0.2)
        return number
    queue = sys._getframe(1).f_locals["result_queue"]
    with queue._wlock:
        os.write(queue._writer.fileno(), struct.pack("!i", 1000) + b"begun")
        os.kill(ENDED, SIGNAL)
        time.sleep(60.0)

def interrupted(*_):
    raise KeyboardInterrupt

if __name__ == "__main__":
    signal.signal(signal.SIGINT, interrupted)
    try:
        list(process_workers(halfway, 2).results(range(6)))
    except (ProductError, KeyboardInterrupt) as error:
        print(repr(error))
"""
_DRIVER = """
import os, signal, time
from pachon.core.workers import process_workers

def wait(point, threads):
    print(os.getpid(), flush=True)
    time.sleep(60.0)

if __name__ == "__main__":
    # A shell lets its jobs in the background ignore Ctrl-C, and so does what they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    list(process_workers(wait, 1).results([0]))
"""


def start(folder):
    """Driver whose worker has begun a job of a minute, and the number of that worker."""
    (folder / "driver.py").write_text(_DRIVER)
    driver = subprocess.Popen([sys.executable, "driver.py"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                              text=True, env={**os.environ, "PYTHONPATH": os.getcwd()})  # fmt: skip
    return driver, int(driver.stdout.readline())


@pytest.mark.long
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processes are looked up in /proc")
def test_workers_end_after_their_driver_is_killed(tmp_path):
    driver, worker = start(tmp_path)
    assert lives(worker)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    driver.stdout.close()
    driver.stderr.close()
    for _ in range(40):
        if not lives(worker):
            break
        time.sleep(0.1)
    else:
        os.kill(worker, signal.SIGKILL)
        pytest.fail("the worker outlived its driver by 4 s")


@pytest.mark.long
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processes are looked up in /proc")
def test_an_interrupt_does_not_wait_for_jobs_under_way(tmp_path):
    driver, worker = start(tmp_path)
    assert lives(worker)
    with driver:
        driver.send_signal(signal.SIGINT)
        try:
            said = driver.communicate(timeout=10.0)[1]
        finally:
            driver.kill()
    assert "KeyboardInterrupt" in said
    assert not lives(worker)


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills a process")
@pytest.mark.parametrize(
    ("ended", "sent", "said"),
    [
        # The pool waited for the rest of the result, and the other worker for the lock, without end.
        ("os.getpid()", "signal.SIGKILL", "ProductError('a worker process died, killed or short of memory"),
        ("os.getppid()", "signal.SIGINT", "KeyboardInterrupt()"),
    ],
)
def test_work_ends_that_stops_halfway_through_a_result(ended, sent, said, tmp_path):
    (tmp_path / "driver.py").write_text(_HALFWAY.replace("ENDED", ended).replace("SIGNAL", sent))
    driver = subprocess.run([sys.executable, "driver.py"], cwd=tmp_path, capture_output=True, text=True, timeout=30.0,
                            env={**os.environ, "PYTHONPATH": os.getcwd()}, check=True)  # fmt: skip
    assert driver.stdout.startswith(said)
