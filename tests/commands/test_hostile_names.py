"""Names out of files: nothing is written outside the working folder, and brackets are no markup of the terminal."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import pytest

import pachon
from pachon.commands.cli import main
from pachon.commands.design.command import app as design_app
from pachon.core.progress import Reporter
from pachon.core.terminal import print_line, terminal_json, terminal_text
from pachon.models.starting_designs.new import new_prescription

#: Name of the telescope, and those of its two lens surfaces; rich takes ``[/b]`` for the end of a style never begun.
NAME, SURFACES = "x/../../pwned [/b]", ("S1 [red]", "[/bold] :smile:")
ON_AXIS = ["--field-deg", "0"]
TOLERANCES = "fields_deg: [[0, 0]]\nrings: 2\ntolerances: [{name: Detector.dz_um, size: 10}]\ndraws: 3\n"
OPTIMIZATION = "variables: [Detector.dz]\nfields_deg: [[0, 0]]\nn_pupil: 2\nmax_steps: 1\n"
#: Quick arguments of every command with a default path that is made from the name of a telescope.
COMMANDS = {
    "spots": [*ON_AXIS, "--rays", "4"],
    "focus": [*ON_AXIS, "--steps", "3"],
    "zernikes": [*ON_AXIS, "--jmax", "6"],
    "rays": ON_AXIS,
    "fans": ON_AXIS,
    "opd-fans": ON_AXIS,
    "field-curvature": [],
    "lateral-color": [],
    "focal-shift": [],
    "seidel": [],
    "spot-matrix": [],
    "illumination": ["--rays", "200"],
    "throughput": ON_AXIS,
    "strehl": ON_AXIS,
    "target": ["--rays", "5"],
    "distortion": [],
    "vignetting": [*ON_AXIS, "--rays", "200"],
    "footprint": ON_AXIS,
    "draw": [],
    "psf": [*ON_AXIS, "--pixels", "16"],
    "ee": [*ON_AXIS, "--pixels", "32"],
    "mtf": [*ON_AXIS, "--pupil-points", "56"],
    "ghosts": ["--rays", "500"],
    "opd": ["--grid", "32", "--zernikes", "6"],
    "sensitivity": [*ON_AXIS, "--parameters", "Detector.dz", "--zernikes", "6"],
    "optimize": ["--config", "opt.yaml"],
    "design-report": [*ON_AXIS, "--quiet"],
    "tolerance": ["tol.yaml"],
}
#: Names that the tables of commands show.
SHOWN = {
    **dict.fromkeys(("seidel", "footprint", "draw", "ghosts"), SURFACES),
    **dict.fromkeys(("throughput", "zernikes"), (NAME,)),
}
#: One of those that share the place where their path is made; those with a place of their own, or with names in tables.
IN_CI = {"spots", "optimize", "sensitivity", "tolerance", *SHOWN}


def lens(name, surfaces=SURFACES):
    """A singlet with names of one's own."""
    made, _ = new_prescription("singlet")
    front, back, *image = made.surfaces
    named = (replace(front, name=surfaces[0]), replace(back, name=surfaces[1]), *image)
    return replace(made, name=name, surfaces=named, groups={}, group_frames={})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder two levels deep, with a lens of hostile names."""
    here = tmp_path / "a" / "b"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    pachon.save_telescope(lens(NAME), "lens.yaml")
    (here / "tol.yaml").write_text(TOLERANCES)
    (here / "opt.yaml").write_text(OPTIMIZATION)
    return here


def outside(tmp_path, here):
    """All files and folders beside the way to the working folder and what is in it."""
    return {p for p in tmp_path.rglob("*") if here not in p.parents and p not in (here, here.parent)}


def test_every_design_command_is_tried():
    # The one that lists operands writes no file.
    names = {command.name for command in design_app.registered_commands} - {"operands"}
    assert names | {"tolerance"} == set(COMMANDS)


@pytest.mark.long
@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=[pytest.mark.slow] * (name not in IN_CI)) for name in COMMANDS]
)
def test_nothing_is_written_outside_the_folder_and_names_are_shown(tmp_path, folder, capsys, command):
    before = set(folder.iterdir())
    assert main([command, "lens.yaml", *COMMANDS[command]]) == 0, capsys.readouterr().err
    written = set(folder.iterdir()) - before
    assert written
    assert all("x_.._.._pwned [_b]" in path.name for path in written)
    assert not outside(tmp_path, folder)
    out = capsys.readouterr().out
    for name in SHOWN.get(command, ()):
        assert name in out


@pytest.mark.long
def test_info_and_convert_show_names_as_they_are(tmp_path, folder, capsys):
    assert main(["info", "lens.yaml"]) == 0
    out = capsys.readouterr().out
    for name in (NAME, *SURFACES):
        assert name in out
    assert main(["convert", "lens.yaml", "copy.yaml"]) == 0
    assert capsys.readouterr().out.startswith(f"{NAME}: ")
    assert not outside(tmp_path, folder)


@pytest.mark.long
def test_everyday_names_with_a_slash_draw(folder, capsys):
    pachon.save_telescope(lens("Newton f/5"), "newton.yaml")
    pachon.save_telescope(lens("Newton f:5"), "other.yaml")
    for file in ("newton.yaml", "other.yaml"):
        assert main(["draw", file]) == 0
    # Two names, two files.
    assert len(list(folder.glob("draw_Newton f_5-*.png"))) == 2


@pytest.mark.long
def test_cameras_of_any_name_are_drawn_in_the_folder(tmp_path, folder, capsys):
    ccds = "ccds: [{name: A1, x_mm: 0, y_mm: 0, vendor: '[/b]'}]"
    (folder / "camera.yaml").write_text(
        f"name: '{NAME}'\nsource: test\npixel_um: 10\npixels: [100, 100]\nheight_budget: flat\n{ccds}\n"
    )
    assert main(["camera", "camera.yaml"]) == 0
    assert "[/b]" in capsys.readouterr().out
    assert len(list(folder.glob("camera_x_.._.._pwned*.png"))) == 1
    assert not outside(tmp_path, folder)


def test_progress_bars_show_names_as_they_are(capsys, monkeypatch):
    # rich draws bars as on a terminal.
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Reporter().stage("PSF of a [/b] [red] \x1b[2J", 1) as stage:
        stage.advance()
    assert "PSF of a [/b] [red] \\x1b[2J" in capsys.readouterr().err


def test_control_characters_are_escaped(capsys):
    print_line("M2 [red]\x1b]0;pwned\x07 \u009b31m \u202e \ud800 µ 望\nM3")
    assert capsys.readouterr().out == "M2 [red]\\x1b]0;pwned\\x07 \\x9b31m \\u202e \\ud800 µ 望\nM3\n"
    content = {"name": "\x1b\u009b\u202e\ud800\U000e0001 µ"}
    text = terminal_json(json.dumps(content, ensure_ascii=False))
    assert text.isprintable()
    assert json.loads(text) == content
    assert terminal_text("a\nb") == "a\nb"


def test_descriptions_and_tolerances_with_escapes_are_shown_harmless(folder, capsys):
    pachon.save_telescope(replace(lens("lens"), description="to be replaced"), "escape.yaml")
    text = (folder / "escape.yaml").read_text()
    (folder / "escape.yaml").write_text(text.replace("to be replaced", r'"[/b] \e[2J\x9b2J"'))
    assert main(["info", "escape.yaml"]) == 0
    assert "[/b] \\x1b[2J\\x9b2J" in capsys.readouterr().out
    assert main(["info", "escape.yaml", "--json"]) == 0
    out = capsys.readouterr().out
    assert all(line.isprintable() for line in out.split("\n"))
    assert json.loads(out)["description"] == "[/b] \x1b[2J\x9b2J"
    assert main(["spots", "no\x1b[2Jfile.yaml"]) == 2
    assert capsys.readouterr().err.startswith("pachon: error: no\\x1b[2Jfile.yaml: ")


def test_all_lines_of_the_command_line_go_through_one_place():
    root = Path(__file__).parents[2]
    wrong = []
    for path in [*(root / "commands").rglob("*.py"), *(root / "core").glob("*.py")]:
        if path.name == "terminal.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name in ("print", "typer.echo", "typer.secho", "click.echo", "sys.stdout.write", "Console"):
                    wrong.append(f"{path.relative_to(root)}:{node.lineno} {ast.unparse(node)}")
    # JSON has escapes of its own; progress bars are texts without markup.
    allowed = ("print(terminal_json(", "Console(stderr=True)")
    assert [line for line in wrong if not any(part in line for part in allowed)] == []
