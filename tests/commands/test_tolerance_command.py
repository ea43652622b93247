"""`pachon tolerance` and `pachon optimize --config`: products, tables, JSON, one line for bad input."""

import json
from pathlib import Path

import pytest

import pachon
from pachon.commands.cli import main

# The pictures are drawn in test_hostile_names.py.
pytestmark = pytest.mark.usefixtures("empty_pictures")

LENS = str(Path(__file__).parents[1] / "data" / "zmx" / "lens1.zmx")
TOLERANCES = """
fields_deg: [[0, 0], [0, 8]]
rings: 2
tolerances: [{name: L2.dy_um, size: 10}, {name: S4.thickness_um, size: 20}]
compensators: [Image.dz_um]
requirement: 6
draws: 12
"""
OPTIMIZATION = """
variables: [S1.radius, S2.thickness, Image.dz]
fields_deg: [[0, 0], [0, 8]]
n_pupil: 2
max_steps: 2
operands: [{kind: focal_length_mm, target: 25}, {kind: edge_thickness_mm, surface: S1, min: 0.5}]
"""


@pytest.fixture
def written(in_folder):
    """``written(name, text)``: a file in the folder."""

    def write(name, text):
        (in_folder / name).write_text(text)
        return name

    return write


@pytest.mark.long
def test_a_study_is_written_shown_and_resumed(capsys, in_folder, written):
    command = ["tolerance", LENS, written("tol.yaml", TOLERANCES)]
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("tolerances: ")
    folder = in_folder / "tolerance_lens1"
    assert {p.name for p in folder.iterdir()} == {
        "draws.ecsv",
        "draws.png",
        "inverse.png",
        "points.tolerance",
        "report.html",
        "sensitivity.ecsv",
        "sensitivity.png",
        "summary.json",
        "yield.png",
    }
    page = (folder / "report.html").read_text()
    mean = "mean of the drawn telescopes, and its standard error"
    merit = "distance of the rays from the centroid of their field"
    for words in ("L2.dy_um", "size for 10 %", "yield: fraction that meets it", "Image.dz_um", mean, merit):
        assert words in page
    assert page.count('<img src="data:image/png;base64,') == 4
    # Nothing of another file or site.
    assert "http" not in page.replace("http-equiv", "")
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "points.tolerance"}
    written("tol.yaml", TOLERANCES.replace("draws: 12", "draws: 13"))
    assert main([*command, "--resume"]) == 2
    assert "store of another tolerance study (draws: 12 -> 13)" in capsys.readouterr().err
    written("tol.yaml", TOLERANCES)
    assert main(command) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    out = capsys.readouterr().out
    for words in ("L2.dy_um", "lower end [um]", "10 % loss at", "12 telescopes, traced", "requirement 6 um: met by"):
        assert words in out
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "points.tolerance"} == before


def test_json_and_options(capsys, in_folder, written):
    command = ["tolerance", LENS, written("tol.yaml", TOLERANCES), "-o", "other", "--json", "--quiet"]
    assert main([*command, "--method", "linear", "-n", "40", "--seed", "3"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["method"], summary["draws"], summary["folder"]) == ("linear", 40, "other")
    assert len(summary["worst_offenders"]) == 2
    assert summary["yield"]["low"] < summary["yield"]["fraction"] + 1e-9 < summary["yield"]["high"] + 1e-6


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("tolerances: [{name: S99.dz_um, size: 1}]", [], "S99"),
        ("tolerances: []", [], "at least one"),
        ("merit: beauty", [], "tol.yaml: merit"),
        (TOLERANCES, ["--method", "guess"], "guess"),
        (TOLERANCES.replace("Image.dz_um", "Image.dy_um"), [], "Image.dy_um' has no effect"),
    ],
)
def test_bad_input_is_one_line(capsys, written, text, options, words):
    assert main(["tolerance", LENS, written("tol.yaml", text), "--quiet", *options]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.long
def test_an_optimization_from_a_file(capsys, in_folder, written):
    assert main(["optimize", LENS, "--config", written("opt.yaml", OPTIMIZATION), "--out", "better.yaml"]) == 0
    out = capsys.readouterr().out
    for words in (
        "rms of spots: ",
        "with operands: ",
        "focal_length: 25 -> ",
        " mm (= 25)",
        # The scale on the detector, which is out of focus, is another number.
        "is image_scale, 24.",
        "edge_thickness(S1): ",
        "(>= 0.5)",
    ):
        assert words in out
    assert (in_folder / "optimize_lens1.png").read_bytes().startswith(b"\x89PNG")
    better = pachon.load_telescope(in_folder / "better.yaml")
    assert better.surface("S1").shape.radius != pachon.load_telescope(LENS).surface("S1").shape.radius


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "either --variables or --config"),
        (["--config", "opt.yaml", "--variables", "S1.radius"], "either --variables or --config"),
        (["--config", "opt.yaml", "--merit", "spots"], "--merit is given beside --config"),
        (["--config", "opt.yaml", "--field-deg", "0"], "in the file"),
        (["--config", "none.yaml"], "none.yaml"),
    ],
)
def test_options_that_exclude_each_other(capsys, written, options, words):
    written("opt.yaml", OPTIMIZATION)
    assert main(["optimize", LENS, *options]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "name", "text", "words"),
    [
        ("tolerance", "tol.yaml", "tolerances: [{name: S99.dz_um, size: 1}]", "tol.yaml: tolerances.0: unknown"),
        ("tolerance", "tol.yaml", "surfaces: {radius_percent: 1}\nfields_deg: [[0, 85]]", "tol.yaml: field = (0, 85)"),
        ("optimize", "opt.yaml", "variables: [S1.radius]\nfields_deg: [[0, 85]]", "opt.yaml: field = (0, 85)"),
        ("optimize", "opt.yaml", "variables: [S1.radius, S1.radius]", "opt.yaml: variable 'S1.radius' occurs"),
    ],
)
def test_errors_of_the_content_name_the_file(capsys, in_folder, written, command, name, text, words):
    options = ["--config", written(name, text)] if command == "optimize" else [written(name, text)]
    assert main([command, LENS, *options]) == 2
    assert words in capsys.readouterr().err


def test_an_optimum_that_its_format_cannot_hold_is_not_lost(capsys, written, in_folder):
    """The format is found out before, unless the optimisation makes what it has no place for, here a glass."""
    telescope = pachon.models.doublet(diameter=0.02, f_number=10.0)
    pachon.save_telescope(telescope, "lens.yaml")
    name = telescope.surfaces[0].name
    config = written("opt.yaml", f"variables: [{name}.n]\nfields_deg: [[0, 0]]\nn_pupil: 2\nmax_steps: 2\n")
    assert main(["optimize", "lens.yaml", "--config", config, "--out", "better.seq"]) == 2
    assert "better.seq, in place of which better.yaml was written: " in capsys.readouterr().err
    better = pachon.load_telescope(in_folder / "better.yaml")
    assert better.surface(name).medium_after != telescope.surface(name).medium_after


@pytest.mark.slow
def test_glasses_that_were_tried_are_shown(capsys, in_folder, written):
    config = written(
        "opt.yaml",
        "{variables: [S7.radius], glasses: [N-SF2], nearest_glasses: 2, max_steps: 2, n_pupil: 2}",
    )
    assert main(["optimize", LENS, "--config", config]) == 0
    out = capsys.readouterr().out
    tried = out.partition("tried, rms with operands in µm: ")[2].partition("\n")[0]
    # Two near the best model glass, and the one that the lens has.
    assert len(tried.split(", ")) == 3
    # The best stands first, and it is the one that was chosen.
    assert f"glass: N-SF2 -> {tried.split()[0]}\n" in out


@pytest.mark.slow
def test_files_of_an_optimised_lens_leave_those_of_its_source(capsys, in_folder):
    command = ["--variables", "S7.thickness"]
    assert main(["optimize", LENS, *command]) == 0
    assert pachon.load_telescope("optimized_lens1.yaml").name == "optimized_lens1"
    before = (in_folder / "optimize_lens1.png").read_bytes()
    assert main(["optimize", "optimized_lens1.yaml", *command]) == 0
    assert main(["spots", "optimized_lens1.yaml"]) == 0
    assert (in_folder / "optimize_lens1.png").read_bytes() == before
    names = {path.name for path in in_folder.iterdir()}
    assert {"optimized_2_lens1.yaml", "optimize_optimized_lens1.png"} <= names
    assert "spots_optimized_lens1.png" in names
