"""The commands of design studies: pictures, tables, JSON and nothing else, one line for bad input."""

import json

import numpy as np
import pytest

from pachon.commands.cli import main

MAGIC = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
QUICK = {
    "spots": ["--sampling", "rings", "--rays", "6"],
    "focus": ["--range-um", "-10", "10", "--steps", "3"],
    "zernikes": ["--jmax", "11"],
    "distortion": [],
    "vignetting": ["--field-deg", "1.2", "--field-deg", "0.3,1.2", "--rays", "500"],
    "footprint": ["--surface", "M2"],
    "rays": [],
}


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", QUICK)
def test_json_is_all_there_is_and_the_picture_has_its_name(capsys, in_folder, command):
    assert main([command, "lsst_v3.3_r", *QUICK[command], "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["telescope"] == "lsst_v3.3_r"
    assert figures["wavelength_nm"] in (624.0, [624.0])
    assert (in_folder / f"{command}_lsst_v3.3_r.png").read_bytes().startswith(MAGIC["png"])
    assert figures["picture"] == f"{command}_lsst_v3.3_r.png"


def test_a_table_and_where_the_picture_is(capsys, in_folder):
    for command, words in {
        "spots": ("rms [µm]", "80 % [arcsec]"),
        "focus": ("best for the spot [µm]", "smallest at"),
        "zernikes": ("7 coma y", "obscuration"),
        "distortion": ("focal length at the axis", "largest distortion"),
        "rays": ("incidence [deg]", "[arcsec/µm]"),
    }.items():
        arguments = [] if command == "distortion" else ["--field-deg", "0", "--field-deg", "0.4"]
        assert main([command, "paul_baker", *arguments, "-o", f"{command}.svg"]) == 0
        out = capsys.readouterr().out
        assert out.splitlines()[-1] == f"picture: {in_folder / command}.svg"
        for part in words:
            assert part in out


@pytest.mark.parametrize("command", QUICK)
def test_help_teaches_by_example(capsys, command):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert "Examples" in out
    assert f"pachon {command} lsst_v3.3_r" in out


def test_spots_across_the_band_and_over_fields(capsys, in_folder):
    fields = ["--field-deg", "0", "--field-deg", "0.3,0.4"]
    assert main(["spots", "lsst_v3.3_r", *fields, "--across-band", "3", "--json", "-o", "s.pdf"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["field_deg"] == [[0.0, 0.0], [0.3, 0.4]]
    assert figures["wavelength_nm"] == pytest.approx([545, 624, 703])
    assert (in_folder / "s.pdf").read_bytes().startswith(MAGIC["pdf"])


def test_equal_commands_leave_equal_bytes(in_folder, capsys):
    for kind in ("png", "svg"):
        for name in ("a", "b"):
            assert main(["spots", "lsst_v3.3_r", *QUICK["spots"], "-o", f"{name}.{kind}", "--threads", "1"]) == 0
        one, two = ((in_folder / f"{name}.{kind}").read_bytes() for name in "ab")
        assert one == two
        assert one.startswith(MAGIC[kind])


def test_maps_and_double_zernikes(capsys, in_folder):
    assert main(["zernikes", "lsst_v3.3_r", "--jmax", "6", "--map", "-o", "map.png"]) == 0
    assert "4 defocus" in capsys.readouterr().out
    assert main(["zernikes", "lsst_v3.3_r", "--jmax", "6", "--double", "6", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert np.shape(figures["double_zernike_nm"]) == (6, 6)
    assert (in_folder / "double_zernikes_lsst_v3.3_r.png").exists()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["spots", "lsst_v3.3_r", "--field-deg", "a,b"], ("--field-deg = 'a,b'", "two numbers in degrees")),
        (["spots", "lsst_v3.3_r", "--field-deg", "9"], ("field = (0, 9) deg", "2.5 deg")),
        (["spots", "lsst_v3.3_r", "--wavelength-nm", "600", "--across-band", "3"], ("expected one of them",)),
        (["spots", "lsst_v3.3_r", "-o", "spots.gif"], ("--picture = spots.gif", ".png, .pdf or .svg")),
        (["spots", "lsst_v3.3_r", "-o", "nowhere/spots.png"], ("cannot write nowhere/spots.png",)),
        (["spots", "lsst_v3.3_r", "--sampling", "dots"], ("sampling = 'dots'", "gauss, rings, spiral, square")),
        (["focus", "lsst_v3.3_r", "--range-um", "5", "-5"], ("--range-um = 5 -5", "the lower height first")),
        (["zernikes", "lsst_v3.3_r", "--map", "--double", "6"], ("--field-deg, --map and --double",)),
        (["zernikes", "lsst_v3.3_r", "--pupil", "half"], ("pupil = 'half'", "full, lit")),
        (["distortion", "lsst_v3.3_r", "--field-deg", "0"], ("at least three points",)),
        (["footprint", "lsst_v3.3_r", "--surface", "M9"], ("unknown surface", "'M9'")),
        (["rays", "lsst_v9"], ("lsst_v9",)),
        (["vignetting", "lsst_v3.3_r", "--projection", "flat"], ("projection = 'flat'", "zemax, gnomonic, postel")),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, in_folder, arguments, parts):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("pachon: error: ")
    for part in parts:
        assert part in line
