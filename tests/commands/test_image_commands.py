"""``pachon psf | ee | mtf | ghosts | draw``: pictures, tables, JSON and nothing else, one line for bad input."""

import json

import numpy as np
import pytest
from astropy.io import fits

from pachon.commands.cli import main

TWO = ["--field-deg", "0", "--field-deg", "1.2"]
QUICK = {
    "psf": [*TWO, "--pixels", "32"],
    "ee": [*TWO, "--pixels", "48"],
    "mtf": [*TWO, "--pupil-points", "48"],
    "ghosts": ["--rays", "1000"],
    "draw": [],
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
    assert figures["picture"] == f"{command}_lsst_v3.3_r.png"
    assert (in_folder / figures["picture"]).read_bytes().startswith(b"\x89PNG")


def test_a_table_and_where_the_picture_is(capsys, in_folder):
    for command, words in {
        "psf": ("Strehl", "FWHM [arcsec]"),
        "ee": ("80 % [µm]", "about the centroid"),
        "mtf": ("50 % [cycles/mm]", "tangential, sagittal"),
        "ghosts": ("peak [mag/arcsec²]", "Filter_exit"),
        "draw": ("vertex [mm]", "M3"),
    }.items():
        assert main([command, "lsst_v3.3_r", *QUICK[command], "-o", f"{command}.svg"]) == 0
        out = capsys.readouterr().out
        assert out.splitlines()[-1] == f"picture: {in_folder / command}.svg"
        for part in words:
            assert part in out


@pytest.mark.parametrize("command", QUICK)
def test_help_teaches_by_example(capsys, command):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert "Examples" in out
    assert f"pachon {command} lsst_v3.3_" in out


def test_images_go_to_fits_and_the_two_ways_agree(capsys, in_folder):
    common = ["--field-deg", "0.4", "--pixels", "32", "--pixel-um", "0.4", "--json"]
    assert main(["psf", "paul_baker", *common, "--fits", "one.fits"]) == 0
    assert main(["psf", "paul_baker", *common, "--huygens", "--fits", "two.fits"]) == 0
    first, second = (fits.getdata(in_folder / name, "PSF") for name in ("one.fits", "two.fits"))
    assert first.shape == (1, 32, 32)
    # The rim of the pupil, 128 or 160 points across: some thousandths.
    assert np.abs(first - second).max() < 5e-3 * first.max()
    assert fits.getheader(in_folder / "two.fits", 0)["METHOD"] == "huygens"
    capsys.readouterr()


def test_the_model_in_three_dimensions(capsys, in_folder):
    assert main(["draw", "lsst_v3.3_r", "--glb", "model.glb"]) == 0
    assert f"model: {in_folder / 'model.glb'}" in capsys.readouterr().out
    assert (in_folder / "model.glb").read_bytes().startswith(b"glTF")


def test_coatings(capsys, in_folder):
    figures = []
    for options in (["0.01"], ["Filter_exit=0.01", "--reflectivity", "Filter_entrance=0.01"]):
        arguments = ["ghosts", "lsst_v3.3_r", "--rays", "1000", "--json", "--reflectivity", *options]
        assert main([*arguments, "--detector-reflectivity", "0"]) == 0
        figures.append(json.loads(capsys.readouterr().out))
    for found in figures:
        first = [
            a == "Filter_exit" and b == "Filter_entrance" for a, b in zip(found["first"], found["second"], strict=True)
        ]
        assert np.array(found["flux"])[first] == pytest.approx(1e-4, rel=0.02)
    assert figures[0]["total_flux"] < figures[1]["total_flux"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["ghosts", "paul_baker"], "lens surface"),
        (["ghosts", "lsst_v3.3_r", "--reflectivity", "x"], "--reflectivity = 'x'"),
        (["ghosts", "lsst_v3.3_r", "--reflectivity", "0.1", "--reflectivity", "0.2"], "one number alone"),
        (["ghosts", "lsst_v3.3_r", "--field-deg", "9"], "expected within"),
        (["draw", "lsst_v3.3_r", "--glb", "model.stl"], "ends in .glb"),
        (["psf", "lsst_v3.3_r", "--huygens", "--pupil-points", "64"], "expected one of them"),
        (["psf", "lsst_v3.3_r", "--pixel-um", "200"], "points across the pupil"),
        (["ee", "lsst_v3.3_r", "-o", "ee.xyz"], "ee.xyz"),
        (["mtf", "no_such_telescope"], "no_such_telescope"),
    ],
)
def test_bad_input_is_one_line(capsys, in_folder, arguments, text):
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    # A stage that failed has no line of its own.
    assert len(lines) == 1
    assert text in lines[0]
