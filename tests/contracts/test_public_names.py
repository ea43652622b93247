"""The public face: every name resolves, and importing it is light and silent."""

import subprocess
import sys

import pytest

import pachon


@pytest.mark.parametrize("name", sorted(set(pachon.__all__)))
def test_every_public_name_resolves(name):
    assert getattr(pachon, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="telescope_x"):
        _ = pachon.telescope_x


def test_import_is_silent_and_loads_no_warp():
    code = "import sys, pachon; print(pachon.__version__, 'warp' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [pachon.__version__, "False"]
    assert done.stderr == ""


def test_tracing_is_silent():
    code = (
        "import pachon; t = pachon.load_telescope('lsst_v3.3_r');"
        "pachon.trace(t, pachon.launch_rays(t, (0, 0), 6e-7, ([3.0], [0.0])))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    # A first compilation says so in one line of ours; nothing else, no banner, no warning about CUDA.
    assert all(line.startswith("compiling ") for line in done.stderr.splitlines())
