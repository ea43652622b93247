"""``pachon camera``: tables, JSON and nothing else, pictures, one line for bad input."""

import json

import numpy as np
import pytest
from astropy.table import Table

from pachon import FocalPlane
from pachon.commands.cli import main
from pachon.models import height_statistics


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_the_table_has_the_vendors_and_the_picture_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["camera"]) == 0
    out = capsys.readouterr().out
    lines = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    expected = height_statistics(FocalPlane.as_measured())
    for name in ("all", "itl", "e2v"):
        assert int(lines[name][1]) == expected[name].n_ccd
        assert float(lines[name][3]) == pytest.approx(expected[name].rms * 1e6, abs=0.005)
    assert (tmp_path / "camera_lsstcam.png").read_bytes().startswith(b"\x89PNG")


def test_json_of_a_file_has_the_residuals_and_no_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    x, y = np.random.default_rng(1).uniform(-0.02, 0.02, (2, 300))
    z = 2.0 + 50 * x
    Table({"x": x, "y": y, "z": z}, units={"x": "m", "y": "m", "z": "um"}).write("mine.ecsv")
    assert main(["camera", "mine.ecsv", "--json"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert "pachon: warning: mine.ecsv: no heights, taken as zero: R01_S00" in captured.err
    assert result["statistics_m"]["all"]["n_ccd"] == 1
    assert result["statistics_m"]["all"]["mean"] == pytest.approx(2e-6, abs=1e-9)
    assert result["fit_residual_m"]["R22_S11"] < 1e-12
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.ecsv"]


def test_heights_of_another_camera(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plane = FocalPlane.from_budget("decam", seed=3)
    plane.to_table(8).write("decam.ecsv")
    # They were fitted to the CCDs of the LSST that lie there: 93 of 62, 51 um from peak to valley in place of 22.
    assert main(["camera", "decam.ecsv", "--json"]) == 2
    assert "column ccd, S1: expected names of lsst, such as R01_S00" in capsys.readouterr().err
    assert main(["camera", "decam.ecsv", "--camera", "decam", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["statistics_m"]["all"]
    assert result["n_ccd"] == 62
    assert result["rms"] == pytest.approx(height_statistics(plane)["all"].rms, rel=0.02)


@pytest.mark.long
def test_a_configuration_names_its_heights(tmp_path, capsys):
    path = tmp_path / "run.yaml"
    path.write_text("focal_plane: {heights: lsstcam, moved: {R22: {dz_um: 100}}}\n")
    assert main(["camera", str(path), "--json"]) == 0
    moved = json.loads(capsys.readouterr().out)["statistics_m"]["e2v"]["mean"]
    built = height_statistics(FocalPlane.as_measured())["e2v"].mean
    # Nine CCDs of 117, by 100 um, all of one measured area to some per cent.
    assert moved - built == pytest.approx(100e-6 * 9 / 117, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["camera", "lsstcm"], "unknown camera 'lsstcm': did you mean lsstcam or lsst"),
        (["camera", "hsc", "--camera", "decam"], "--camera = decam: expected a file of heights in place of hsc"),
        (["camera", "missing.fits"], "heights: missing.fits: no such file"),
        (["camera", "--picture", "heights.gif"], "expected a name that ends in .png, .pdf or .svg"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, part):
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pachon: error: ")
    assert part in line


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("camera", "half.yaml: pixel_um is missing"),
        ("run", "half.yaml: a camera file; expected a configuration"),
        ("align", "half.yaml: a camera file; expected a configuration"),
        ("images", "half.yaml: a camera file; expected a configuration"),
        ("donuts", "half.yaml: expected FITS files of stamps"),
    ],
)
def test_a_camera_file_without_pixel_um_is_one_all_the_same(command, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "half.yaml").write_text("name: half\nsource: a drawing\nccds: [{name: A1, x_mm: 0, y_mm: 0}]\n")
    assert main([command, "half.yaml"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["camera", "hsc", "--picture", "a.png", "--no-picture"], "--picture and --no-picture: expected one of them"),
        (["rays", "paul_baker", "--picture", "a.png", "--no-picture"], "--picture and --no-picture: expected one"),
        (["donuts", "a.fits", "--picture", "a.png", "--no-picture"], "--picture and --no-picture: expected one of"),
        (["model", "a.fits", "--picture", "a.png", "--no-picture"], "--picture and --no-picture: expected one of"),
        (["info", "--configuration", "2"], "--configuration: expected MODEL with it"),
    ],
)
def test_options_that_exclude_one_another(arguments, message, capsys, tmp_path, monkeypatch):
    """The first was ignored."""
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
