"""``pachon sweep`` and ``pachon baseline``: their own commands, the word that may be left out, and mistyped words."""

import json
import re

import pytest
import typer
from astropy.table import Table

from pachon.commands.cli import app, main
from pachon.commands.panels import PANELS
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import PointResult, SweepPoint, SweepStore, create_store

pytestmark = pytest.mark.usefixtures("in_folder")


@pytest.fixture
def store(tmp_path):
    """A store with 300 points, all but the last computed, and one of these without a result."""
    sweep = read_sweep({"parameters": {"M2.dz_um": {"nominal": 0, "range": [-5, 5]}}}, "test")
    path = tmp_path / "small.sweep"
    create_store(path, sweep, [SweepPoint(i, {"M2.dz_um": i / 400}, 7) for i in range(300)], {})
    with SweepStore(path) as opened:
        for i in range(299):
            failed = i == 3
            metrics = None if failed else {"rms_e": 0.01 * i}
            opened.write(PointResult(i, metrics, "no light" if failed else None, 1.0 / 3.0, "here"))
    return path


@pytest.mark.parametrize(
    "command",
    ["sweep run", "sweep status", "sweep export", "sweep report", "baseline", "baseline save", "baseline update"],
)
def test_every_command_has_help_with_an_example(capsys, command):
    assert main([*command.split(), "--help"]) == 0
    out = capsys.readouterr().out
    assert f"Usage: pachon {command}" in out
    # The word "run" may be left out, and is left out in the examples.
    assert f"pachon {command.replace(' run', '')} " in out.partition("Examples")[2]


def test_help_of_the_sweep_shows_its_options_and_its_commands(capsys):
    assert main(["sweep", "--help"]) == 0
    out = capsys.readouterr().out
    for word in ("--resume", "--scheduler", "status", "export", "report"):
        assert word in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sweep"], "expected a sweep file, or --example NAME"),
        (["sweep", "none.yaml"], "none.yaml: no such file"),
        (["sweep", "run", "none.yaml"], "none.yaml: no such file"),
        (["sweep", "status.yaml"], "status.yaml: no such file"),
        (["sweep", "statsu", "small.sweep"], "'status'"),
        (["sweep", "status"], "'STORE'"),
        (["sweep", "status", "none.sweep"], "none.sweep: no such file"),
        (["sweep", "a.yaml", "b.yaml"], "b.yaml"),
        (["sweep", "a.yaml", "--processes", "1", "--workers", "2"], "expected one of them"),
        (["sweep", "--example", "table2"], "did you mean table1"),
        (["baseline", "upadte", "x.json"], "'update'"),
        (["baseline", "save", "paul_baker"], "'--out'"),
    ],
)
def test_bad_arguments_are_one_line(capsys, in_folder, arguments, words):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pachon: error: ")
    assert err.count("\n") == 1
    assert words in err
    assert list(in_folder.iterdir()) == []


@pytest.mark.parametrize("options", [["-o", "x.csv", "--json"], ["--json", "--out=x.csv"]])
def test_options_may_stand_before_the_command(capsys, store, options):
    assert main(["sweep", *options, "export", "small.sweep"]) == 0
    assert json.loads(capsys.readouterr().out) == {"table": "x.csv", "points": 299}
    assert main(["sweep", "-o", "status", "none.yaml"]) == 2
    assert "none.yaml: no such file" in capsys.readouterr().err


def test_a_file_with_the_name_of_almost_a_command_is_a_sweep(capsys, in_folder):
    (in_folder / "reports").write_text("parameter: {}\n")
    assert main(["sweep", "reports"]) == 2
    assert "reports: unknown key parameter" in capsys.readouterr().err


def test_status_counts_points(capsys, store):
    assert main(["sweep", "status", "small.sweep", "--json"]) == 0
    status = json.loads(capsys.readouterr().out)
    assert [status[key] for key in ("points", "computed", "failed", "missing")] == [300, 298, 1, 1]
    assert status["seconds_a_point"] == 0.333
    assert main(["sweep", "status", "small.sweep"]) == 0
    assert "no light" in capsys.readouterr().out


def test_exports_of_a_store_and_of_what_is_left_of_a_damaged_one(capsys, store):
    assert main(["sweep", "export", "small.sweep", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"table": "small.ecsv", "points": 299}
    assert len(Table.read("small.ecsv")) == 299
    data = bytearray(store.read_bytes())
    # A page of 4096 bytes near the end, where the results are.
    start = (len(data) // 4096 - 2) * 4096
    data[start : start + 4096] = b"\xff" * 4096
    store.write_bytes(data)
    assert main(["sweep", "status", "small.sweep"]) == 2
    assert "pachon sweep export saves what it can" in capsys.readouterr().err
    assert main(["sweep", "export", "small.sweep", "-o", "saved.csv", "--json"]) == 0
    saved = json.loads(capsys.readouterr().out)
    assert 100 < saved["points"] < 299
    assert saved["damaged"].startswith("small.sweep: damaged")
    assert len(Table.read("saved.csv", format="ascii.csv", comment="#")) == saved["points"]


def test_each_command_stands_in_one_panel_of_the_help(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    panels = re.findall(r"^╭─ (.*?) ─+╮$", text, re.MULTILINE)
    assert panels == ["Options", *PANELS]
    names = [name for line in PANELS.values() for name in line.split()]
    assert len(names) == len(set(names))
    assert set(names) == set(typer.main.get_command(app).commands)
