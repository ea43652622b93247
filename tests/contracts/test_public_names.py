"""The public names: each is the object of its line in the stub, and importing them is light and silent."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import pachon

STUB = ast.parse((Path(__file__).parents[2] / "pachon" / "__init__.pyi").read_text(encoding="utf-8"))
#: Module of each public name.
LISTED = {alias.asname: node.module for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names}


def test_all_lists_the_names_of_the_stub():
    assert set(pachon.__all__) == set(LISTED)


@pytest.mark.parametrize("name", sorted(LISTED))
def test_every_public_name_is_the_object_of_its_module(name):
    module = import_module(".".join(filter(None, ("pachon", LISTED[name]))))
    assert getattr(pachon, name) is getattr(module, name)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="telescope_x"):
        _ = pachon.telescope_x


def test_import_is_silent_and_loads_no_warp():
    code = "import sys, pachon; print(pachon.__version__, 'warp' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [pachon.__version__, "False"]
    assert done.stderr == ""


@pytest.mark.long
def test_a_model_of_own_stars_is_silent(tmp_path):
    """The first array of Warp, of whatever part, must not start it with its warning that there is no CUDA driver."""
    code = (
        "import numpy as np, pachon; rng = np.random.default_rng(1); y, x = np.mgrid[-8:9, -8:9];"
        "stars = 1e4 * np.exp(-(x * x + y * y) / 8.0) + rng.normal(size=(12, 17, 17));"
        "print(pachon.PsfModel.fit(stars, rng.uniform(0.0, 1.0, (12, 2))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.returncode == 0


@pytest.mark.long
def test_tracing_is_silent():
    code = (
        "import pachon; t = pachon.load_telescope('lsst_v3.3_r');"
        "pachon.trace(t, pachon.launch_rays(t, (0, 0), 6e-7, ([3.0], [0.0])))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    # No banner, no warning about CUDA; that a kernel is compiled goes to the logger, at a level that is not shown.
    assert done.stderr == ""
