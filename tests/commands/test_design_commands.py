"""The commands on the design of a telescope: pictures, tables, JSON and nothing else, one line for bad input."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

import pachon
from pachon.commands.cli import main

MAGIC = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
TWO = ["--field-deg", "0", "--field-deg", "0.4"]
#: Options that make every command quick, and words of its table.
COMMANDS = {
    "spots": ([*TWO, "--sampling", "rings", "--rays", "6"], ("rms [µm]", "80 % [arcsec]")),
    "focus": (
        [*TWO, "--range-um", "-10", "10", "--steps", "3"],
        ("best for the spot [µm]", "are smallest with the detector at"),
    ),
    "zernikes": ([*TWO, "--jmax", "11"], ("7 coma y", "obscuration")),
    "rays": (TWO, ("incidence [deg]", "[arcsec/µm]")),
    "distortion": ([], ("focal length at the axis", "largest distortion")),
    "vignetting": (["--field-deg", "0.3,0.4", *TWO, "--rays", "500"], ("light [%]", "0.5", "annular pupil is lit")),
    "footprint": (["--surface", "M2", *TWO], ("reaches to [mm]", "M2")),
    "draw": ([], ("vertex [mm]", "M3")),
    "psf": (["--field-deg", "0", "--pixels", "16"], ("Strehl", "FWHM [arcsec]")),
    "ee": (["--field-deg", "0", "--pixels", "48"], ("80 % [µm]", "about the centroid")),
    "mtf": ([*TWO, "--pupil-points", "56"], ("50 % [cycles/mm]", "tangential, sagittal")),
    "ghosts": (["--rays", "1000"], ("peak [mag/arcsec²]", "Filter_exit")),
    "opd": (["--grid", "32", "--zernikes", "11"], ("[waves]", "4 defocus", "rms")),
    "sensitivity": ([*TWO, "--parameters", "M2.dz", "--zernikes", "11"], ("largest Noll terms", "singular values")),
    "optimize": ([*TWO, "--variables", "Detector.dz"], ("effect of the change [µm]", "rms of spots")),
}
#: Names of the telescope in the metrics, and of the pictures, that are not like those of the other commands.
MODEL_KEY = {"opd": "model"}
STEM = {"opd": "opd_{}_0_0_{:g}nm"}


def model_of(command):
    """A telescope without lens surfaces has no ghosts."""
    return ("lsst_v3.3_r", 624.0) if command == "ghosts" else ("paul_baker", 600.0)


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS)
def test_json_is_the_only_output_and_writes_no_picture(capsys, in_folder, command):
    model, wavelength = model_of(command)
    assert main([command, model, *COMMANDS[command][0], "--json", "--table", "numbers.ecsv"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics[MODEL_KEY.get(command, "telescope")] == model
    assert metrics.get("wavelength_nm", wavelength) in (wavelength, [wavelength])
    assert "picture" not in metrics
    assert list(in_folder.glob("*.png")) == []
    assert len(QTable.read(in_folder / "numbers.ecsv")) > 0


@pytest.mark.long
@pytest.mark.parametrize("command", sorted(COMMANDS)[::4])
def test_the_picture_has_its_name(capsys, in_folder, command):
    model, wavelength = model_of(command)
    assert main([command, model, *COMMANDS[command][0]]) == 0
    name = STEM.get(command, f"{command}_{{}}").format(model, wavelength) + ".png"
    assert capsys.readouterr().out.splitlines()[-1] == f"picture: {in_folder / name}"
    assert (in_folder / name).read_bytes().startswith(MAGIC["png"])


@pytest.mark.parametrize("table", ["numbers.txt", "numbers"])
def test_the_ending_of_a_table_is_checked_first(capsys, in_folder, table):
    assert main(["spots", "paul_baker", "--table", table]) == 2
    assert (
        capsys.readouterr().err
        == f"pachon: error: --table = {table}: expected a name that ends in .ecsv, .csv, .fits, .parquet\n"
    )


def test_tables_of_spots_have_their_numbers_and_no_picture(capsys, in_folder):
    for ending in ("csv", "fits"):
        options = ["spots", "paul_baker", "--field-deg", "0.3", "--no-picture", "--table", f"spots.{ending}"]
        assert main(options) == 0
        assert capsys.readouterr().out.splitlines()[-1] == f"table: {in_folder / f'spots.{ending}'}"
    spots = pachon.spots(pachon.paul_baker(), [np.deg2rad([0.3, 0.0])])
    assert QTable.read(in_folder / "spots.csv")["rms_radius [m]"][0] == pytest.approx(spots.rms_radius.item())
    assert QTable.read(in_folder / "spots.fits")["rms_radius"][0].to_value("m") == pytest.approx(
        spots.rms_radius.item()
    )
    assert sorted(path.name for path in in_folder.iterdir()) == ["spots.csv", "spots.fits"]


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS)
def test_the_table_and_the_path_of_the_picture(capsys, in_folder, command):
    options, words = COMMANDS[command]
    # As SVG the picture of ghosts, of many rays, has megabytes.
    kind = "png" if command == "ghosts" else "svg"
    assert main([command, model_of(command)[0], *options, "--picture", f"picture.{kind}"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == f"picture: {in_folder / f'picture.{kind}'}"
    assert (in_folder / f"picture.{kind}").read_bytes().startswith(MAGIC[kind])
    for part in words:
        assert part in out
    # No column is cut short.
    assert "…" not in out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples(capsys, command):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"pachon {command} " in out.partition("Examples")[2]
    for option in ("--picture", "--projection", "--lenient", "--threads", "--json"):
        assert option in out


@pytest.mark.long
def test_spots_across_the_band_and_over_fields(capsys, in_folder):
    fields = ["--field-deg", "0", "--field-deg", "0.3,0.4"]
    assert main(["spots", "lsst_v3.3_r", *fields, "--across-band", "3", "--json", "--picture", "s.pdf"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["field_deg"] == [[0.0, 0.0], [0.3, 0.4]]
    assert metrics["wavelength_nm"] == pytest.approx([545, 624, 703])
    assert (in_folder / "s.pdf").read_bytes().startswith(MAGIC["pdf"])


@pytest.mark.long
def test_equal_commands_leave_equal_bytes(in_folder, capsys):
    for kind in ("png", "svg"):
        for name in ("a", "b"):
            assert (
                main(
                    [
                        "spots",
                        "lsst_v3.3_r",
                        "--sampling",
                        "rings",
                        "--rays",
                        "6",
                        "--picture",
                        f"{name}.{kind}",
                        "--threads",
                        "1",
                    ]
                )
                == 0
            )
        one, two = ((in_folder / f"{name}.{kind}").read_bytes() for name in "ab")
        assert one == two
        assert one.startswith(MAGIC[kind])


@pytest.mark.long
def test_maps_and_double_zernikes(capsys, in_folder):
    assert main(["zernikes", "paul_baker", "--jmax", "6", "--map", "--picture", "map.png"]) == 0
    assert "4 defocus" in capsys.readouterr().out
    assert main(["zernikes", "paul_baker", "--jmax", "6", "--double", "6", "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert np.shape(metrics["double_zernike_nm"]) == (6, 6)
    assert main(["zernikes", "paul_baker", "--jmax", "6", "--double", "6"]) == 0
    assert (in_folder / "double_zernikes_paul_baker.png").exists()


def test_zernikes_of_strongly_vignetted_fields_are_those_of_the_light(capsys, in_folder):
    # At 0.64 degrees HSC lights two thirds of the annulus; at 0.75 rays of the others miss the detector.
    assert main(["zernikes", "hsc", "--jmax", "11", "--json"]) == 0
    by_default = json.loads(capsys.readouterr().out)
    assert main(["zernikes", "hsc", "--jmax", "11", "--pupil", "lit", "--json"]) == 0
    assert by_default == json.loads(capsys.readouterr().out)
    assert np.abs(by_default["zernike_nm"]).max() < 1500.0
    # The LSST lights 70 % of it at the rim of its wavefront sensors, where stopped rays have a smooth wavefront.
    assert main(["zernikes", "lsst_v3.3_r", "--field-deg", "1.83", "--jmax", "11", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pupil"] == "full"
    # It was taken for the rms of the light, 162 nm at the edge.
    assert main(["zernikes", "hsc", "--no-picture"]) == 0
    assert "to 1313.21 nm rms over 5 fields, of the whole annulus; that of the light" in capsys.readouterr().out
    assert main(["zernikes", "hsc", "--pupil", "full"]) == 2
    assert "pupil = lit" in capsys.readouterr().err


@pytest.mark.long
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


@pytest.mark.long
def test_the_model_in_three_dimensions(capsys, in_folder):
    assert main(["draw", "lsst_v3.3_r", "--glb", "model.glb"]) == 0
    assert f"model: {in_folder / 'model.glb'}" in capsys.readouterr().out
    assert (in_folder / "model.glb").read_bytes().startswith(b"glTF")


@pytest.mark.long
def test_coatings(capsys, in_folder):
    metrics = []
    for options in (["0.01"], ["Filter_exit=0.01", "--reflectivity", "Filter_entrance=0.01"]):
        arguments = ["ghosts", "lsst_v3.3_r", "--rays", "1000", "--json", "--reflectivity", *options]
        assert main([*arguments, "--detector-reflectivity", "0"]) == 0
        metrics.append(json.loads(capsys.readouterr().out))
    for found in metrics:
        first = [
            a == "Filter_exit" and b == "Filter_entrance" for a, b in zip(found["first"], found["second"], strict=True)
        ]
        assert np.array(found["flux"])[first] == pytest.approx(1e-4, rel=0.02)
    assert metrics[0]["total_flux"] < metrics[1]["total_flux"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["spots", "lsst_v3.3_r", "--field-deg", "a,b"], ("--field-deg = 'a,b'", "two numbers in degrees")),
        (["spots", "lsst_v3.3_r", "--field-deg", "9"], ("field = (0, 9) deg", "2.5 deg")),
        (["spots", "lsst_v3.3_r", "--wavelength-nm", "600", "--across-band", "3"], ("expected one of them",)),
        (["spots", "lsst_v3.3_r", "--picture", "spots.gif"], ("--picture = spots.gif", ".png, .pdf or .svg")),
        (["spots", "lsst_v3.3_r", "--picture", "nowhere/spots.png"], ("cannot write nowhere/spots.png",)),
        (["spots", "lsst_v3.3_r", "--sampling", "dots"], ("sampling = 'dots'", "gauss, rings, spiral, square")),
        (["focus", "lsst_v3.3_r", "--range-um", "5", "-5"], ("--range-um = 5 -5", "the lower height first")),
        (["zernikes", "lsst_v3.3_r", "--map", "--double", "6"], ("--field-deg, --map and --double",)),
        (["zernikes", "lsst_v3.3_r", "--pupil", "half"], ("pupil = 'half'", "full, lit")),
        (["distortion", "lsst_v3.3_r", "--field-deg", "0"], ("at least three points",)),
        (["footprint", "lsst_v3.3_r", "--surface", "M9"], ("unknown surface", "'M9'")),
        (["rays", "lsst_v9"], ("lsst_v9",)),
        (["vignetting", "lsst_v3.3_r", "--projection", "flat"], ("projection = 'flat'", "zemax, gnomonic, postel")),
        (["ghosts", "paul_baker"], ("lens surface",)),
        (["ghosts", "lsst_v3.3_r", "--reflectivity", "x"], ("--reflectivity = 'x'",)),
        (["ghosts", "lsst_v3.3_r", "--reflectivity", "0.1", "--reflectivity", "0.2"], ("one number alone",)),
        (["ghosts", "lsst_v3.3_r", "--field-deg", "9"], ("expected within",)),
        (["draw", "lsst_v3.3_r", "--glb", "model.stl"], ("ends in .glb",)),
        (["psf", "lsst_v3.3_r", "--huygens", "--pupil-points", "64"], ("expected one of them",)),
        (
            ["psf", "lsst_v3.3_r", "--pixel-um", "200"],
            ("points across the pupil", "(a smaller image, --pupil-points, or rays alone)"),
        ),
        (["psf", "lsst_v3.3_r", "--field-deg", "0", "--pupil-points", "16"], ("--pupil-points = 16: the pattern",)),
        (["mtf", "lsst_v3.3_r", "--field-deg", "1.7", "--pupil-points", "16"], ("--pupil-points = 16: too few",)),
        (["ee", "lsst_v3.3_r", "--picture", "ee.xyz"], ("ee.xyz",)),
        (["mtf", "no_such_telescope"], ("no_such_telescope",)),
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
