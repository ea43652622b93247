"""The commands that make and check files: ``new``, ``validate``, ``schema`` and ``design-report``."""

import json

import pytest

from pachon.commands.cli import main


@pytest.mark.slow
@pytest.mark.parametrize("command", ["new", "validate", "schema", "design-report"])
def test_help_has_examples(capsys, command):
    assert main([command, "--help"]) == 0
    assert f"pachon {command} " in capsys.readouterr().out.partition("Examples")[2]


def test_a_new_telescope_is_valid(capsys, in_folder):
    assert main(["new", "cassegrain", "--diameter-mm", "800", "--f-number", "10", "--field-deg", "0.2"]) == 0
    assert "Classical Cassegrain telescope, 0.8 m, f/10: written to cassegrain.yaml" in capsys.readouterr().out
    assert main(["validate", "cassegrain.yaml"]) == 0
    assert capsys.readouterr().out == "cassegrain.yaml: prescription, no problems\n"


def test_problems_are_lines_and_status_2(capsys, in_folder):
    (in_folder / "run.yaml").write_text("band: q\nstarz: 3\n")
    assert main(["validate", "run.yaml"]) == 2
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("run.yaml, line 2: unknown key starz")
    assert second.startswith('run.yaml, line 1: band = "q"')
    assert main(["validate", "run.yaml", "--json"]) == 2
    (found,) = json.loads(capsys.readouterr().out)
    assert [p["key"] for p in found["problems"]] == ["starz", "band"]


def test_every_problem_names_its_file_and_key_and_an_unknown_kind_hides_no_other(capsys, in_folder):
    (in_folder / "what.yaml").write_text("nonsense: 1\n")
    (in_folder / "sky.yaml").write_text("stars: {catalogue: none.csv}\n")
    (in_folder / "air.yaml").write_text("band: r\natmosphere: {site: none.yaml}\n")
    (in_folder / "optics.yaml").write_text("band: r\ntelescope: gone.yaml\n")
    assert main(["validate", "what.yaml", "sky.yaml", "air.yaml", "optics.yaml"]) == 2
    captured = capsys.readouterr()
    what, sky, air, optics = captured.out.splitlines()
    assert captured.err == ""
    assert what.startswith("what.yaml: none of the keys of")
    assert sky.startswith("sky.yaml, line 1: stars.catalogue")
    assert air.startswith("air.yaml, line 2: atmosphere.site")
    assert optics.startswith("optics.yaml, line 2: telescope")


@pytest.mark.long
def test_a_schema_is_json(capsys):
    assert main(["schema", "sweep"]) == 0
    assert "metrics" in json.loads(capsys.readouterr().out)["properties"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["new", "refractor"], "kind = 'refractor'"),
        (["new", "singlet", "lens.zmx"], "ends in .yaml"),
        (["new", "singlet", "--back-focus-mm", "3"], "back_focus = 0.003"),
        (["schema", "x"], "kind = 'x'"),
        (["validate", "none.docx"], "none.docx"),
        (["design-report", "paul_baker", "--field-deg", "9"], "expected within"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, in_folder, arguments, part):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert part in line


@pytest.mark.slow
def test_a_design_report(capsys, in_folder):
    assert main(["design-report", "paul_baker", "-o", "report.html", "--field-deg", "0", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert (in_folder / "report.html").read_text().startswith("<!DOCTYPE html>")
