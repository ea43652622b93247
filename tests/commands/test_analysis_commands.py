"""The commands of the analyses: JSON and nothing else, tables, pictures, one line for bad input."""

import json

import numpy as np
import pytest

import pachon
from pachon.commands.cli import main

FIELD = ["--field-deg", "0", "--field-deg", "0.4"]
#: Options that make every command quick, and words of its table.
COMMANDS = {
    "fans": ([*FIELD, "--points", "5"], "largest, tangential, sagittal"),
    "opd-fans": ([*FIELD, "--points", "5"], "peak to valley [waves]"),
    "field-curvature": (FIELD, "sagittal focus [µm]"),
    "lateral-color": (FIELD, "spread [µm]"),
    "focal-shift": (["--zone", "0.9"], "zone by zone"),
    "seidel": (["--field-deg", "0.4"], "W131 coma"),
    "spot-matrix": (
        ["--field-deg", "0", "--rays", "3", "--range-um", "-9", "9", "--steps", "2"],
        "rms [µm] at -9, 9 µm",
    ),
    "illumination": ([*FIELD, "--rays", "50"], "relative illumination [%]"),
    "throughput": (FIELD, "wavelength [nm]"),
    "strehl": (["--field-deg", "0", "--no-psf"], "of the wavefront"),
    "target": (["--rays", "2"], "pixel of the image"),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples(capsys, command):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"pachon {command} " in out.partition("Examples")[2]
    for option in ("--picture", "--threads", "--json"):
        assert option in out


def check(capsys, folder, command):
    options, words = COMMANDS[command]
    assert main([command, "paul_baker", *options, "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["telescope"] == "paul_baker"
    assert list(folder.iterdir()) == []
    assert main([command, "paul_baker", *options, "--picture", "picture.svg"]) == 0
    out = capsys.readouterr().out
    assert words in out
    assert out.splitlines()[-1] == f"picture: {folder / 'picture.svg'}"


@pytest.mark.long
@pytest.mark.parametrize("command", ["seidel"])
def test_json_table_and_picture(capsys, in_folder, command):
    check(capsys, in_folder, command)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_json_table_and_picture_of_every_command(capsys, in_folder, command):
    check(capsys, in_folder, command)


@pytest.mark.slow
def test_a_picture_as_target_and_fringe_zernikes(capsys, in_folder):
    from matplotlib.image import imsave

    imsave("grey.png", [[0.0, 1.0], [0.5, 0.0]], cmap="gray")
    assert main(["target", "paul_baker", "--image", "grey.png", "--rays", "5", "--width-arcsec", "2"]) == 0
    assert main(["zernikes", "paul_baker", "--fringe", "--jmax", "11", "--field-deg", "0.3"]) == 0
    assert "9 spherical" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["focal-shift", "paul_baker", "--field-deg", "0"], ("--field-deg: expected none",)),
        (["focal-shift", "paul_baker", "--zone", "2"], ("zones = ",)),
        (["seidel", "paul_baker", *FIELD], ("--field-deg: expected one field",)),
        (["spot-matrix", "paul_baker", "--against", "time"], ("against = 'time'", "focus, wavelength")),
        (["throughput", "paul_baker", "--coatings", "none.yaml"], ("none.yaml",)),
        (["target", "paul_baker", "--image", "none.png"], ("none.png", "expected a picture")),
        (["zernikes", "paul_baker", "--fringe", "--double", "6"], ("--fringe and --double",)),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, in_folder, arguments, parts):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    for part in parts:
        assert part in line


def test_the_angle_of_a_seidel_diagram_is_that_of_its_field_from_the_axis(capsys):
    """A field of two angles, and slopes in place of them, are other angles than the root of their squares."""
    lens, slopes = pachon.load_telescope("tests/data/zmx/lens1.zmx"), np.array([0.15, 0.12])
    expected = pachon.design.seidel_diagram(lens, field=float(np.arctan(np.hypot(*slopes)))).total
    for angles, projection in ((np.arctan(slopes), "zemax"), (slopes, "gnomonic")):
        field = ",".join(f"{angle:.12g}" for angle in np.rad2deg(angles))
        arguments = ["seidel", "tests/data/zmx/lens1.zmx", "--field-deg", field, "--projection", projection, "--json"]
        assert main(arguments) == 0
        assert json.loads(capsys.readouterr().out)["total_waves"] == pytest.approx(expected.tolist(), rel=1e-7)
