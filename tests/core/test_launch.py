"""Launches of kernels: on several threads, from several threads, and in a forked process."""

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.file_lock import file_lock
from pachon.core.kernel_modules import kernels_by_module
from pachon.core.stability import PACKAGES
from pachon.wavefront.pupil_optics import trace_pupils

FIELDS = np.radians(np.stack(np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 8)), axis=-1).reshape(-1, 2))
PUPIL = np.array([[3.0, 0.5], [-2.8, 2.0], [0.1, -3.5]])


def paths(telescope, threads):
    return trace_pupils(telescope, FIELDS, np.array([620e-9]), PUPIL, threads=threads).path


def test_launches_of_several_threads_at_once():
    telescope = pachon.load_telescope("lsst_v3.3_r")
    alone = paths(telescope, 1)
    with ThreadPoolExecutor(6) as pool:
        for together in pool.map(lambda _: paths(telescope, 5), range(12)):
            np.testing.assert_array_equal(together, alone)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are not forked elsewhere")
def test_launches_in_a_forked_process():
    code = """
import os, signal, sys, warnings
import numpy as np
import pachon
from pachon.wavefront.pupil_optics import trace_pupils

telescope = pachon.load_telescope("lsst_v3.3_r")
fields, points = np.zeros((9, 2)), np.array([[3.0, 0.5]])

def paths():
    return trace_pupils(telescope, fields, np.array([620e-9]), points, threads=3).path

before = paths()
warnings.simplefilter("ignore", DeprecationWarning)
if (child := os.fork()) == 0:
    signal.alarm(60)
    os._exit(0 if np.array_equal(paths(), before) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="files have no such locks")
def test_one_process_compiles_and_the_others_wait(tmp_path):
    # A lock belongs to the open file: two of one process are as those of two processes.
    entered, order = threading.Event(), []

    def second():
        entered.set()
        with file_lock(tmp_path / "cache" / "kernels.lock"):
            order.append("second")

    waiting = threading.Thread(target=second)
    with file_lock(tmp_path / "cache" / "kernels.lock"):
        waiting.start()
        entered.wait()
        waiting.join(0.2)
        order.append("first")
    waiting.join()
    assert order == ["first", "second"]


def test_without_a_place_for_a_lock_work_goes_on(tmp_path):
    (tmp_path / "file").write_text("")
    with file_lock(tmp_path / "file" / "kernels.lock"):
        pass


def test_files_of_kernels_are_warmed_up():
    names = {name.removesuffix("_plain").removesuffix("_special") for name in kernels_by_module()}
    root = Path(pachon.core.__file__).parent.parent
    files = [path for folder in ("core", *PACKAGES) for path in (root / folder).rglob("*_kernels.py")]
    files = [path for path in files if "@wp.kernel" in path.read_text()]
    # Models of the PSF wait for those of core at their first evaluation.
    assert {".".join(("pachon", *path.relative_to(root).with_suffix("").parts)) for path in files} <= names
