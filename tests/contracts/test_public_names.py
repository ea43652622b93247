"""The public names: each is the object of its line in a stub, and importing them is light and silent."""

import ast
import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from public_names import MODULES, public_names, public_objects

import pachon
from pachon.core import stability
from pachon.core.deprecation import public_names as names_of_package

ROOT = Path(__file__).parents[2]
#: Most names in pachon itself, sub-packages counted.
MOST_NAMES = 125


def listed(package):
    """Module of each public name of a package, by its stub."""
    folder = ROOT / package.partition(".")[2] if "." in package else ROOT / "pachon"
    stub = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8"))
    return {alias.asname: n.module for n in stub.body if isinstance(n, ast.ImportFrom) for alias in n.names}


PACKAGES = ["pachon", *(f"pachon.{p}" for p in stability.PACKAGES if p not in ("errors", "testing"))]
LISTED = [(package, name, module) for package in PACKAGES for name, module in listed(package).items() if module]


@pytest.mark.parametrize("package", PACKAGES)
def test_all_lists_the_names_of_the_stub(package):
    assert set(importlib.import_module(package).__all__) == set(listed(package))


def test_every_public_name_is_the_object_of_its_module():
    for package, name, module in LISTED:
        owner = importlib.import_module(f"{package}.{module}")
        assert getattr(importlib.import_module(package), name) is getattr(owner, name), name


def test_few_names_stand_in_pachon_itself():
    assert len(pachon.__all__) <= MOST_NAMES
    assert {name for name, module in listed("pachon").items() if module is None} == MODULES


def test_a_name_is_public_in_one_place():
    assert len(public_objects()) == len(public_names()) > 380


def test_no_name_is_that_of_a_file_or_folder_beside_it():
    """Importing ``pachon.design.layout`` would set the attribute ``layout`` of ``pachon.design`` to the module."""
    for package, name, _ in LISTED:
        folder = ROOT / package.partition(".")[2]
        assert not (folder / name).is_dir(), (package, name)
        assert not (folder / f"{name}.py").exists(), (package, name)


def test_provisional_names_are_public():
    assert set(public_names()) >= stability.PROVISIONAL
    assert 0 < len(stability.PROVISIONAL) < len(public_names()) / 2
    assert stability.stability("pachon.trace") == "stable"
    assert {stability.stability(name) for name in stability.PROVISIONAL} == {"provisional"}


def test_the_policy_page_explains_the_marks():
    page = next((ROOT / "docs").rglob("public_names.md")).read_text(encoding="utf-8")
    for word in ("*stable*", "*provisional*", "DeprecationWarning", "core/stability.py"):
        assert word in page


OLD_SPELLINGS = """
import pickle, warnings
import pachon
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    first = pachon.Annulus
    second = pachon.Annulus
    from pachon import Annulus, Circle
assert first is second is Annulus is pachon.models.Annulus
assert Circle is pachon.models.Circle
texts = [str(w.message) for w in caught]
assert texts == [f"pachon.{n} is deprecated; use pachon.models.{n}" for n in ("Annulus", "Circle")], texts
assert {w.category for w in caught} == {DeprecationWarning}
# The warning names the line of the caller, not of the library.
assert {w.filename for w in caught} == {"<string>"}, caught
assert pickle.loads(pickle.dumps(Annulus(1.0, 2.0))) == Annulus(1.0, 2.0)
"""


def test_old_spellings_warn_once_and_name_the_new_one():
    subprocess.run([sys.executable, "-c", OLD_SPELLINGS], check=True)


def test_objects_are_pickled_by_their_modules():
    circle = pachon.models.Circle(0.5)
    assert b"aperture" in pickle.dumps(circle)
    assert pickle.loads(pickle.dumps(circle)) == circle


@pytest.mark.parametrize(
    ("package", "name", "hint"),
    [
        ("pachon", "telescope_x", "did you mean pachon.Telescope"),
        ("pachon", "Anulus", "did you mean pachon.models.Annulus?"),
        ("pachon.design", "throughputs", "did you mean pachon.design.throughput"),
        ("pachon", "zzzz", "no attribute 'zzzz'$"),
    ],
)
def test_an_unknown_name_is_an_attribute_error(package, name, hint):
    with pytest.raises(AttributeError, match=hint.replace("?", "[?]")):
        getattr(importlib.import_module(package), name)


def test_a_removed_name_says_what_replaced_it():
    load, _, _ = names_of_package("pachon", str(ROOT / "pachon" / "__init__.py"), removed={"old": "pachon.trace"})
    with pytest.raises(AttributeError, match=r"^pachon\.old was removed; use pachon\.trace$"):
        load("old")


def test_import_is_silent_and_loads_no_warp():
    code = "import sys, pachon; print(pachon.__version__, 'warp' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [pachon.__version__, "False"]
    assert done.stderr == ""


@pytest.mark.long
def test_models_of_stars_and_traces_are_silent():
    """The first array of Warp, of whatever part, must not start it with its warning that there is no CUDA driver.

    Nor do traces print a banner; that a kernel is compiled goes to the logger, at a level that is not shown.
    """
    code = (
        "import numpy as np, pachon; rng = np.random.default_rng(1); y, x = np.mgrid[-8:9, -8:9];"
        "stars = 1e4 * np.exp(-(x * x + y * y) / 8.0) + rng.normal(size=(12, 17, 17));"
        "pachon.PsfModel.fit(stars, rng.uniform(0.0, 1.0, (12, 2)));"
        "t = pachon.load_telescope('lsst_v3.3_r');"
        "pachon.trace(t, pachon.launch_rays(t, (0, 0), 6e-7, ([3.0], [0.0])))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
