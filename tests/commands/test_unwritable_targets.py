"""Commands whose targets cannot be written: exit status 2, one line, and no partial file."""

import os
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from pachon.commands.cli import main
from pachon.core import files

resource = pytest.importorskip("resource")
pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")

LENS = str(Path(__file__).parents[2] / "tests/data/zmx/lens1.zmx")
TOLERANCES = "tolerances: [{name: S1.dz_um, size: 10}]\ndraws: 3\nrings: 2\n"
SWEEP = """
base: {ccds: [R22_S11], wavelengths_nm: [624], stars: {truth: 12}, psf: {engine: long_exposure},
       reconstruction: {components: 5, truth_order: 2}}
parameters: {M2.dz_um: {nominal: 0, range: [-10, 10]}}
design: {points: 2}
metrics: [fwhm]
"""
#: Arguments of each command, {out} being what it writes and {here} a folder with the files that it reads.
COMMANDS = {
    "new": "new singlet {out}.yaml",
    "convert": f"convert {LENS} {{out}}.yaml",
    "convert to Zemax": f"convert {LENS} {{out}}.zmx",
    "draw": f"draw {LENS} --picture {{out}}.png",
    "spots": f"spots {LENS} --picture {{out}}.pdf",
    "mtf": f"mtf {LENS} --picture {{out}}.svg",
    "opd": "opd paul_baker --picture {out}.png",
    "sensitivity": "sensitivity paul_baker --out {out}.json",
    "optimize": f"optimize {LENS} --variables S1.radius --out {{out}}.yaml",
    "design-report": f"design-report {LENS} --out {{out}}.html",
    "tolerance": f"tolerance {LENS} {{here}}/tol.yaml --out {{out}}",
    "camera": "camera lsstcam --picture {out}.png",
    "run": "run {here}/run.yaml --out {out}",
    "images": "images {here}/images.yaml --out {out}",
    "visits": "visits {here}/visits.yaml --out {out}",
    "study": "study {here}/run.yaml --out {out}",
    "attribute": "attribute {here}/run.yaml --out {out}",
    "sweep": "sweep {here}/sweep.yaml --out {out}.sweep",
    "shim": "shim {here}/run.yaml --out {out}",
    "align": "align --out {out}",
    "reproduce": "reproduce fig1 --out {out}",
}


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """Make a folder with the files that the commands read."""
    folder = tmp_path_factory.mktemp("read")
    (folder / "tol.yaml").write_text(TOLERANCES)
    (folder / "sweep.yaml").write_text(SWEEP)
    settings = {
        "ccds": ["R22_S11"],
        "wavelengths_nm": [620.0],
        "stars": {"truth": 14, "observed": 12},
        "psf": {"engine": "long_exposure"},
        "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
    }
    (folder / "run.yaml").write_text(yaml.safe_dump(settings))
    (folder / "images.yaml").write_text(yaml.safe_dump({"run": settings}))
    (folder / "visits.yaml").write_text(yaml.safe_dump({"run": settings, "visits": {"count": 2}}))
    return folder


@contextmanager
def files_of_at_most(size):
    """Bound the size of files [byte], as a quota does: Python ignores the signal, and a write fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def refused(command, here, out, capsys):
    """Run a command, and return the line with which it ended."""
    assert main(command.format(here=here, out=out).split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert "Traceback" not in "".join(lines)
    assert [line.startswith("pachon: error: ") for line in lines].count(True) == 1, lines
    return lines[-1]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_target_under_a_file(name, here, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    line = refused(COMMANDS[name], here, tmp_path / "file/out", capsys)
    assert str(tmp_path / "file") in line
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_in_which_nothing_can_be_made(name, here, capsys):
    assert "/proc/out" in refused(COMMANDS[name], here, "/proc/out", capsys)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_quota_that_is_used_up_before_the_work(name, here, tmp_path, capsys):
    with files_of_at_most(100):
        assert "cannot write" in refused(COMMANDS[name], here, tmp_path / "out", capsys)
    assert os.listdir(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_quota_that_is_used_up_when_the_work_is_done(name, here, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(files, "require_writable", lambda *_, **__: None)
    # The first of them compiles kernels, or reads them, and that needs no quota.
    with files_of_at_most(100):
        refused(COMMANDS[name], here, tmp_path / "out", capsys)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.name.endswith(".partial")]


def test_a_picture_in_a_folder_that_is_not_there(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pachon.design.report.report.design_report", pytest.fail)
    for command in (f"design-report {LENS} --out {{out}}/a.html", f"draw {LENS} --glb {{out}}/a.glb"):
        assert "No such file or directory" in refused(command, "", tmp_path / "none", capsys)
