"""``pachon donuts``: tables, pictures and JSON of FITS stamps, one line for bad input."""

import json
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import typer
from astropy.io import fits
from astropy.table import Table
from scipy.ndimage import gaussian_filter

import pachon
from pachon.commands.cli import app, main
from pachon.commands.donut_inputs import StampFiles, donut_inputs
from pachon.commands.donut_options import FrameOptions, SimulationOptions, TelescopeOptions
from pachon.commands.donut_report import motion_rows
from pachon.core.errors import ProductError
from pachon.sensing.observatory_zernikes import BodyMotions
from pachon.sensing.stamp_files import read_stamps

# The pictures are drawn in tests/sensing/test_fit_donuts.py.
pytestmark = pytest.mark.usefixtures("empty_pictures")

ROOT = Path(__file__).parents[2]
FIELD = (0.6, 0.9)
OPTIONS = ["--defocus-um", "1500", "--pixel-um", "20", "--zernikes", "11", "--higher-order-nm", "0", "--no-diffraction"]


# Words for options that take no number; those of others are 3.
VALUES = {"out": "a.ecsv", "picture": "a.png", "field_frame": "CCS", "frame": "CCS", "convention": "donut",
          "projection": "postel", "stamp": "30", "terms": "11"}  # fmt: skip


@pytest.fixture(scope="module")
def stamp():
    """A donut of 2e6 electrons from a square lattice of rays and a Gaussian blur, with a camera 10 um too high."""
    tel = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    tel = tel.perturbed("Camera", shift=(0.0, 0.0, 10e-6))
    x, y = np.meshgrid(*2 * [np.linspace(-4.2, 4.2, 901)])
    field = np.deg2rad(FIELD)
    end = pachon.trace(tel, pachon.launch_rays(tel, field, 622e-9, (x, y)))
    chief = pachon.trace(tel, pachon.launch_rays(tel, field, 622e-9, (0.0, 0.0)))
    place = (end.position - chief.position)[end.status == 0, :2] / 20e-6
    edges = np.arange(92) - 45.5
    image = gaussian_filter(np.histogram2d(place[:, 1], place[:, 0], [edges, edges])[0], 1.0)
    return np.random.default_rng(2).poisson(2e6 * image / image.sum() + 300.0) - 300.0


@pytest.mark.long
def test_a_cube_with_a_table(tmp_path, monkeypatch, capsys, stamp):
    monkeypatch.chdir(tmp_path)
    table = Table({"field_x": [FIELD[0]] * 2, "field_y": [FIELD[1]] * 2})
    cube = np.stack([stamp, np.zeros_like(stamp)])
    fits.HDUList([fits.PrimaryHDU(cube), fits.BinTableHDU(table)]).writeto("donuts.fits")
    assert main(["donuts", "donuts.fits", *OPTIONS, "-o", "out.ecsv", "--picture", "donuts.png", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    found = Table.read("out.ecsv")
    # A detector 10 um along +z adds 158 nm of Z4 (batoid too), the lenses that move with it a little.
    assert found["Z4"][0] == pytest.approx(165.0, abs=20.0)
    assert found["reasons"].tolist() == ["ok", "no donut, too few photons"]
    assert np.isnan(found["Z4"][1])
    assert (tmp_path / "donuts.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_stamps_without_donuts_are_listed_beside_a_good_one(tmp_path, monkeypatch, capsys, stamp):
    monkeypatch.chdir(tmp_path)
    rng, flat = np.random.default_rng(4), np.zeros_like(stamp)
    # Sky left in, no light, less than none, and what no detector counts.
    empty = [rng.poisson(level, flat.shape) for level in (1, 100, 10_000)] + [flat, flat - 50.0, flat + 1e200]
    fits.PrimaryHDU(np.stack([stamp, *empty]), fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1]})).writeto(
        "d.fits"
    )
    assert main(["donuts", "d.fits", *OPTIONS, "-o", "out.ecsv", "--picture", "donuts.png"]) == 0
    assert capsys.readouterr().out.count("no donut") == 5
    reasons = Table.read("out.ecsv")["reasons"].tolist()
    dark = "no donut, too few photons"
    assert reasons == ["ok", "no donut", "no donut", "no donut", dark, dark, "not finite"]


@pytest.mark.slow
def test_stamps_in_extensions_and_positions_on_an_image(tmp_path, monkeypatch, capsys, stamp):
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1], "DEFOC_UM": 1500.0})
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(stamp, header)]).writeto("stamps.fits")
    assert main(["donuts", "stamps.fits", *OPTIONS[2:], "--sky-variance", "300", "--json"]) == 0
    one = json.loads(capsys.readouterr().out)
    image = np.zeros((150, 160))
    image[20 : 20 + 91, 40 : 40 + 91] = stamp
    fits.PrimaryHDU(image).writeto("ccd.fits")
    Table({"x": [85.0, 1.0], "y": [65.0, 1.0], "field_x": [FIELD[0]] * 2, "field_y": [FIELD[1]] * 2}).write("at.ecsv")
    arguments = ["donuts", "ccd.fits", *OPTIONS, "--positions", "at.ecsv", "--stamp", "91", "--sky-variance", "300"]
    assert main([*arguments, "--json"]) == 0
    cut = json.loads(capsys.readouterr().out)
    assert cut["zernike_nm"][0] == one["zernike_nm"][0]
    assert cut["reasons"] == ["", "not finite"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["missing.fits"], "missing.fits: no such file"),
        (["text.fits"], "text.fits: cannot be read as FITS"),
        (["a.npy"], "a.npy: array of shape [2, 16] and type float32: expected FITS files of images; pachon.fit_donuts"),
        (["plain.fits", "--mask", "a.npz"], "a.npz: m of shape [2, 16, 16] and type bool: expected FITS files"),
        (["object.npy"], "object.npy: no file of plain NumPy arrays: expected FITS files of images"),
        (
            ["plain.fits"],
            "plain.fits: no field angles: expected FIELD_X and FIELD_Y, a table with them, or --field-deg",
        ),
        (["rows.fits"], "rows.fits: table of 1 row for 2 stamps: expected one row a stamp"),
        (["plain.fits", "--field-deg", "1,2,3"], "--field-deg = '1,2,3': expected"),
        (["plain.fits", "-o", "table.txt"], "--out = table.txt: expected a name that ends in"),
        (["plain.fits", "--picture", "a.gif"], "expected a name that ends in .png"),
        (["plain.fits", "-t", "no_such_telescope"], "no_such_telescope"),
        (["plain.fits", "--positions", "text.fits"], "text.fits: cannot be read as a table"),
        (
            ["plain.fits", "--field-deg", "0,1", "--moved", "Mirror"],
            "moved = 'Mirror': expected a group of lsst_v3.3_r (",
        ),
        (["plain.fits", "--perturb", "M2.dx=1um"], "--perturb: expected with --simulate alone"),
        (["new.fits", "--simulate"], "--defocus-um = 0: expected a shift that makes donuts"),
        (["new.fits", "--simulate", "--perturb", "M2.dx"], "--perturb = 'M2.dx': expected a parameter and its change"),
        (
            ["new.fits", "--simulate", "--perturb", "M2.dx=200"],
            "--perturb = 'M2.dx=200': expected a size in m, as 200um",
        ),
        (["new.fits", "--simulate", "--perturb", "M2.dx=1arcsec"], "--perturb = 'M2.dx=1arcsec': expected a size in m"),
        (["new.fits", "--simulate", "--set", "star=2"], "--set: unknown key star = 2"),
        (["new.fits", "--simulate", "--set", "stars"], "--set 'stars': expected KEY=VALUE"),
        (["new.fits", "--simulate", "--rotator-deg", "30", "-o", "a.ecsv"], "--rotator-deg, --out: expected without"),
        (["new.fits", "--simulate", "--json"], "--json: expected without --simulate"),
        (["plain.fits", "--field-deg", "0,0", "--site", "nowhere"], "unknown site 'nowhere'"),
        (["plain.fits", "--field-deg", "0,0", "--exposure-s", "15", "--site", "nowhere"], "unknown site 'nowhere'"),
        (["plain.fits", "--each-alone", "--degrees-of-freedom", "lsst"], "--each-alone and --degrees-of-freedom: exp"),
        (["new.txt", "--simulate"], "new.txt: --simulate: expected one FILE.fits"),
        (["plain.fits", "--frame", "XYZ"], "--frame = 'XYZ': expected"),
        (["plain.fits", "--field-frame", "ocs"], "--field-frame = 'ocs': expected"),
        (["plain.fits", "--convention", "noll"], "--convention = 'noll': expected"),
        (["plain.fits", "--stamp-axes", "x,x"], "--stamp-axes = 'x,x': expected DVCS, CCS, or axes"),
        (["plain.fits", "--rotator-deg", "nan"], "--rotator-deg = nan: expected a finite number of degrees"),
        (["plain.fits", "--frame", "sky"], "frame sky without a parallactic angle: expected --parallactic-deg"),
        # Only after the fit, whose results were lost.
        (
            ["plain.fits", "--zernikes", "14", "--frame", "CCS", "--rotator-deg", "20", "--field-deg", "0,0"],
            "--zernikes = 14, --frame = CCS: Z14 mixes with its partner of the same order in this frame: expected both",
        ),
        (["plain.fits", "--gain", "0", "--field-deg", "0,0"], "--gain = 0.0: expected electrons of a unit, above 0"),
        (["plain.fits", "--mask", "rows.fits", "--field-deg", "0,0"], "1 of shape [3, 16, 16] for 1 image of [2, 16"),
        (["plain.fits", "plain.fits", "--mask", "plain.fits"], "for 2 files: expected one file of stamps with it"),
        (
            ["plain.fits", "--defocus-um", "nan", "--field-deg", "0,0"],
            "--defocus-um = nan: expected -100000 to 100000 um",
        ),
        (["plain.fits", "--shared-air", "1", "--field-deg", "0,0"], "--shared-air = 1: expected 0.01 to 0.99"),
        (["plain.fits", "--pixel-um", "0", "--field-deg", "0,0"], "--pixel-um = 0: expected 1 to 10000 um"),
        (["plain.fits", "-o", "no_folder/a.ecsv", "--field-deg", "0,0"], "cannot write no_folder/a.ecsv"),
        (["plain.fits", "./plain.fits", "--field-deg", "0,0"], "plain.fits: given twice"),
        (["simulated.fits"], "simulated.fits: TELMODEL = 'gone.yaml': gone.yaml: no such file; give the telescope by"),
        (["some.fits"], "some.fits: stamp 2 has no defocus, others have one"),
        (["lsst.fits"], "lsst.fits: unknown CCD of lsst 'R22_S99'"),
        (["plain.fits", "lsst.fits", "--field-deg", "0,0"], "lsst.fits: lsst, band r: expected that of plain.fits"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, part):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.fits").write_text("no FITS at all\n")
    np.save("a.npy", np.zeros((2, 16), np.float32))
    np.save("object.npy", np.array([None]))
    np.savez("a.npz", m=np.zeros((2, 16, 16), bool))
    fits.PrimaryHDU(np.zeros((2, 16, 16))).writeto("plain.fits")
    table = fits.BinTableHDU(Table({"field_x": [0.0], "field_y": [0.0]}))
    fits.HDUList([fits.PrimaryHDU(np.zeros((2, 16, 16))), table]).writeto("rows.fits")
    table = fits.BinTableHDU(Table({"field_x": [0.0] * 2, "field_y": [0.0] * 2, "defocus_um": [1500.0, np.nan]}))
    fits.HDUList([fits.PrimaryHDU(np.zeros((2, 16, 16))), table]).writeto("some.fits")
    cards = {"TELMODEL": "gone.yaml", "WAVELEN": 600.0, "PIXEL_UM": 10.0, "FIELD_X": 0.0, "FIELD_Y": 0.0}
    fits.PrimaryHDU(np.zeros((16, 16)), fits.Header(cards)).writeto("simulated.fits")
    if "rows.fits" in arguments and "--mask" in arguments:
        fits.PrimaryHDU(np.zeros((3, 16, 16))).writeto("rows.fits", overwrite=True)
    lsst = {"CAM_NAME": "LSSTCam", "DET_NAME": "R22_S99", "CENT_X": 5.0, "CENT_Y": 5.0, "BANDPASS": "r"}
    fits.PrimaryHDU(np.zeros((16, 16)), fits.Header(lsst)).writeto("lsst.fits")
    assert main(["donuts", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("pachon: error: ")
    assert part in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.long
def test_a_simulated_file_says_of_what_it_is(tmp_path):
    """Donuts of AuxTel, 1.92 mm across, fit on their stamps; its telescope is not taken for the LSST."""
    path = tmp_path / "try.fits"
    of_auxtel = ["-t", "auxtel", "--moved", "M2", "--defocus-um", "800", "--wavelength-nm", "700"]
    assert main(["donuts", str(path), "--simulate", *of_auxtel, "--set", "stars=1", "--quiet"]) == 0
    stamps = read_stamps(path)
    assert stamps.header.model == "auxtel"
    assert stamps.header.pixel == pytest.approx(10e-6)
    assert stamps.header.wavelength == pytest.approx(700e-9)
    assert 192 < fits.getdata(path).shape[1] < 260


@pytest.mark.long
@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_command_on_the_first_page_runs(tmp_path, monkeypatch, page):
    """It lacked the defocus."""
    (command,) = re.findall(r"`pachon (donuts [^`]* --simulate[^`]*)`", (ROOT / page).read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    assert main([*command.split(), "--set", "stars=1", "--quiet"]) == 0
    assert len(read_stamps(tmp_path / "try.fits")) == 1


@pytest.mark.long
def test_a_simulated_file_names_a_telescope_of_any_path(tmp_path):
    """A path of more than a card's length once made a warning of FITS."""
    folder = tmp_path / ("an_observers_folder_" * 3)
    folder.mkdir()
    telescope, path = str(folder / "rc.yaml"), tmp_path / "try.fits"
    assert main(["new", "ritchey-chretien", telescope, "--diameter-mm", "1000", "--f-number", "8"]) == 0
    simulate = ["donuts", str(path), "--simulate", "-t", telescope, "--defocus-um", "4000", "--set", "stars=1"]
    for name in (telescope, str(Path(telescope).relative_to(tmp_path))):
        with pytest.MonkeyPatch.context() as patched:
            patched.chdir(tmp_path)
            assert main([*simulate[:4], name, *simulate[5:], "--quiet"]) == 0
        assert read_stamps(path).header.model == name


@pytest.mark.long
def test_a_simulated_file_is_read_from_any_folder(tmp_path, monkeypatch):
    """Its telescope was named as from the folder where it was made."""
    for name in ("telescopes", "nights", "elsewhere"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["new", "ritchey-chretien", "telescopes/rc.yaml", "--diameter-mm", "1000", "--f-number", "8"]) == 0
    simulate = ["donuts", "nights/try.fits", "--simulate", "-t", "telescopes/rc.yaml", "--defocus-um", "4000"]
    assert main([*simulate, "--set", "stars=1", "--quiet"]) == 0
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["donuts", "../nights/try.fits", "--no-diffraction", "--no-orientation-check", "--quiet"]) == 0


@pytest.mark.slow
def test_a_simulated_file_is_one_that_the_command_reads(tmp_path, monkeypatch, capsys):
    """A decentred M2 under a moved camera: file and fit know what moved, and the file has the truth."""
    monkeypatch.chdir(tmp_path)
    simulate = ["donuts", "try.fits", "--simulate", "--moved", "Camera", "--defocus-um", "-1500", "--pixel-um", "20"]
    scene = ["--perturb", "M2.dx=0.2mm", "--set", "stars=1", "--set", "stamp=91", "--set", "seed=3"]
    assert main([*simulate, *scene, "--quiet"]) == 0
    assert main(["donuts", "try.fits", "--zernikes", "11", "--json"]) == 0
    fitted = json.loads(capsys.readouterr().out)
    # One donut near the axis fits both sides of focus.
    assert fitted["reasons"] == ["ambiguous side"]
    row = Table.read("try.fits", hdu=1)[0]
    assert row["moved"] == "Camera"
    assert row["defocus_um"] == -1500.0
    # The truth by tracing, in the words of the API.
    believed = pachon.load_telescope("lsst_v3.3_r")
    field = np.deg2rad([[row["field_x"], row["field_y"]]])
    before, after = (
        pachon.wavefront_zernikes(t, field, jmax=22).coefficients[0]
        for t in (believed, believed.perturbed("M2", shift=(2e-4, 0.0, 0.0)))
    )
    truth = np.array([row[f"true_Z{j}"] for j in range(4, 23)])
    np.testing.assert_allclose(truth, 1e9 * (after - before)[3:22], atol=1e-6)
    assert np.linalg.norm(truth) > 100.0
    # A moved detector would be wrong by some 100 nm, photons leave some 40.
    error, claimed = np.array(fitted["zernike_nm"][0]) - truth[:8], np.array(fitted["zernike_error_nm"][0])
    assert np.linalg.norm(error) < 2.5 * np.linalg.norm(claimed)
    # The same seed makes the same bytes.
    first = (tmp_path / "try.fits").read_bytes()
    assert main([*simulate, *scene, "--quiet"]) == 0
    assert (tmp_path / "try.fits").read_bytes() == first


@pytest.mark.long
def test_stamps_of_the_lsst_come_out_in_its_frame_and_convention(tmp_path, monkeypatch, capsys, stamp):
    """The image of a donut as LSST stores it: transposed, on a CCD of its name, with its angles and planes."""
    monkeypatch.chdir(tmp_path)
    # At no rotation and FIELD (0.6, 0.9) deg the light lands on R31_S22 or beside: found by its position.
    tel, camera = pachon.load_telescope("lsst_v3.3_r"), pachon.load_camera("lsst")
    end = pachon.trace(tel, pachon.launch_rays(tel, np.deg2rad(FIELD), 622e-9, (0.0, 0.0)))
    place = end.position.reshape(-1, 3)[0, :2]
    ccd = int(camera.ccd_at(*place))
    x, y = camera.to_pixel(ccd, place)
    header = fits.Header({"CAM_NAME": "LSSTCam", "DET_NAME": camera.ccd_names[ccd], "CENT_X": x, "CENT_Y": y})
    header.update({"DFC_TYPE": "extra", "DFC_DIST": 1.5, "BANDPASS": "r"})
    # q - rotation of the sky - 90 deg is the rotator: zero.
    header["HIERARCH BORESIGHT_ROT_ANGLE_RAD"], header["HIERARCH BORESIGHT_PAR_ANGLE_RAD"] = 0.5, 0.5 + np.pi / 2.0
    stored = stamp.T.astype(np.float32)
    bad = np.zeros(stored.shape, np.int32)
    bad[40, 50], stored[40, 50] = 2, 1e6
    mask = fits.Header({"EXTNAME": "MASK", "MP_BAD": 0, "MP_SAT": 1})
    planes = [fits.ImageHDU(bad, mask), fits.ImageHDU(np.full(stored.shape, 300.0, np.float32), name="VARIANCE")]
    fits.HDUList([fits.PrimaryHDU(header=header), fits.ImageHDU(stored, name="IMAGE"), *planes]).writeto("stamps.fits")
    common = [*OPTIONS[2:], "-t", "lsst_v3.3_r", "--json"]
    assert main(["donuts", "stamps.fits", *common, "--frame", "CCS", "--convention", "ts_wep", "--quiet"]) == 0
    result = json.loads(capsys.readouterr().out)
    plain = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1], "DEFOC_UM": 1500.0})
    fits.PrimaryHDU(stamp, plain).writeto("plain.fits")
    plain_stamps = ["donuts", "plain.fits", *common, "--sky-variance", "300", "--no-orientation-check", "--quiet"]
    assert main([*plain_stamps, "--moved", "Camera"]) == 0
    expected = json.loads(capsys.readouterr().out)
    lsst = result["observatory"]
    assert (lsst["frame"], lsst["convention"], lsst["zernike_unit"]) == ("CCS", "ts_wep", "um")
    assert lsst["rotator_deg"] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(lsst["field_deg"][0], FIELD, atol=2e-5)
    # One pixel is left out.
    errors = np.array(expected["zernike_error_nm"][0])
    assert (np.abs(np.array(lsst["zernikes"][0]) * 1e3 - expected["zernike_nm"][0]) < 0.3 * errors).all()
    assert not result["orientation"]["doubtful"]
    assert result["flags"] == [0]


@pytest.mark.slow
def test_transposed_stamps_are_said_to_be(tmp_path, monkeypatch, capsys, stamp):
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1], "DEFOC_UM": 1500.0})
    fits.PrimaryHDU(stamp.T, header).writeto("d.fits")
    assert main(["donuts", "d.fits", *OPTIONS[2:], "--sky-variance", "300"]) == 0
    captured = capsys.readouterr()
    assert "try --stamp-axes=y,x" in captured.err
    assert "orientation" in captured.out
    assert main(["donuts", "d.fits", *OPTIONS[2:], "--sky-variance", "300", "--stamp-axes", "DVCS"]) == 0
    assert "try" not in capsys.readouterr().err


@pytest.mark.slow
def test_stamps_turned_by_half_are_not_taken_for_the_other_side_alone(tmp_path, monkeypatch, capsys, stamp):
    """A donut turned about looks like one on the other side of focus: both are said."""
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1], "DEFOC_UM": 1500.0})
    fits.PrimaryHDU(stamp[::-1, ::-1], header).writeto("d.fits")
    assert main(["donuts", "d.fits", *OPTIONS[2:], "--sky-variance", "300"]) == 0
    captured = capsys.readouterr()
    assert "defocus sign, orientation" in captured.out
    assert "try --stamp-axes=-x,-y, unless the defocus has the wrong sign" in captured.err


def lsst_exposures(folder, parallactic_angles, gains):
    """Files of a stamp each, at one rotation of the sky."""
    paths = [folder / f"{k}.fits" for k in range(len(parallactic_angles))]
    for path, angle, gain in zip(paths, parallactic_angles, gains, strict=True):
        header = fits.Header({"CAM_NAME": "LSSTCam", "BANDPASS": "r", "GAIN": gain, "FIELD_X": 0.0, "FIELD_Y": 0.0})
        header["HIERARCH BORESIGHT_ROT_ANGLE_RAD"], header["HIERARCH BORESIGHT_PAR_ANGLE_RAD"] = 0.5, angle
        fits.PrimaryHDU(np.ones((16, 16)), header).writeto(path)
    return StampFiles.read(paths, None, 180, None, None)


def test_two_exposures_in_a_row_have_rotators_that_differ_a_little(tmp_path):
    """Exposures on both sides of focus, 40 s apart, were refused: the rotator follows the sky, here through south."""
    half_a_turn = np.pi
    files = lsst_exposures(tmp_path, [half_a_turn - 2e-3, -half_a_turn + 3e-3], [1.5, 3.0])
    assert files.header().parallactic_angle == pytest.approx(half_a_turn - 2e-3)
    tel = pachon.load_telescope("lsst_v3.3_r")
    inputs = donut_inputs(files, FrameOptions(), pachon.sensing.DonutFrames(), tel, None, None)
    # Each has the gain of its own header.
    assert [image.max() for image in inputs.images] == [1.5, 3.0]


@pytest.mark.parametrize(
    ("cards", "gain", "expected"),
    [
        ({"BUNIT": "nJy"}, None, None),  # was taken for electrons
        ({"BUNIT": "adu"}, 2.0, 36.0),
        ({"BUNIT": "adu", "GAIN": 3.0}, None, 81.0),
        ({"BUNIT": "electron"}, None, 9.0),
        ({}, None, 9.0),
    ],
)
def test_variances_count_where_electrons_are_known(tmp_path, cards, gain, expected):
    """Photon noise is that of electrons: with variances in nJy, 30 to an electron, errors were a sixth too small."""
    primary = fits.PrimaryHDU(np.ones((16, 16)), fits.Header({"FIELD_X": 0.0, "FIELD_Y": 0.0, **cards}))
    plane = fits.ImageHDU(np.full((16, 16), 9.0), name="VARIANCE")
    fits.HDUList([primary, plane]).writeto(tmp_path / "a.fits")
    files, tel = StampFiles.read([tmp_path / "a.fits"], None, 180, None, None), pachon.load_telescope("lsst_v3.3_r")
    inputs = donut_inputs(files, FrameOptions(), pachon.sensing.DonutFrames(), tel, gain, None)
    assert inputs.variances == [expected]


def test_exposures_of_different_rotators_are_refused(tmp_path):
    files = lsst_exposures(tmp_path, [0.3, 0.35], [1.0, 1.0])
    with pytest.raises(ProductError, match="give files of one pointing"):
        files.header()


@pytest.mark.parametrize(
    ("detector", "moved"), [("S4", "DECam"), ("N31", "DECam"), ("FS1", None), ("R22_S11", "Camera"), ("R00_SW0", None)]
)
def test_what_each_camera_moves(tmp_path, detector, moved):
    """DECam's hexapod moves the camera; sensors that stand out of focus are moved detectors."""
    camera = "LSSTCam" if detector.startswith("R") else "DECam"
    header = fits.Header({"INSTRUME": camera, "DETPOS": detector, "FIELD_X": 0.0, "FIELD_Y": 0.0})
    fits.PrimaryHDU(np.zeros((16, 16)), header).writeto(tmp_path / "a.fits")
    assert StampFiles.read([tmp_path / "a.fits"], None, 180, None, None).moved() == moved


@pytest.mark.long
def test_a_forgotten_defocus_is_said_to_be(tmp_path, monkeypatch, capsys, stamp):
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1], "FILTER": "r_57"})
    fits.PrimaryHDU(stamp, header).writeto("d.fits")
    assert main(["donuts", "d.fits", *OPTIONS[2:]]) == 0
    said = capsys.readouterr().err
    assert "defocus is 0 um, that of the files and --defocus-um together" in said
    # The light that is taken, too: of other telescopes than the LSST the band is not that of the header.
    assert "band r of its header; lsst_v3.3_r at 624 nm" in said


@pytest.mark.long
def test_tables_have_one_unit_in_every_frame(tmp_path, monkeypatch, stamp):
    """In frames other than OCS Zernikes were written in m."""
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1]})
    fits.PrimaryHDU(stamp, header).writeto("d.fits")
    for table in ("OCS.csv", "CCS.ecsv"):
        arguments = ["donuts", "d.fits", *OPTIONS, "--quiet", "--frame", table[:3], "--no-orientation-check"]
        assert main([*arguments, "-o", table]) == 0
    telescope, camera = Table.read("OCS.csv"), Table.read("CCS.ecsv")
    assert telescope.colnames[:2] == ["field_x [deg]", "field_y [deg]"]
    assert camera["Z5"].unit == camera["Z5_err"].unit == "nm"
    assert camera.meta["zernike_unit"] == "nm"
    for name in ("Z4", "Z5", "Z8", "Z8_err"):
        assert camera[name][0] == pytest.approx(telescope[f"{name} [nm]"][0], rel=1e-9)


def test_simulations_refuse_all_options_of_fits_and_fits_those_of_simulations(tmp_path, monkeypatch, capsys):
    """An option that neither uses would be ignored."""
    monkeypatch.chdir(tmp_path)
    of_both = {f.name for f in fields(TelescopeOptions)}
    of_simulations = {f.name for f in fields(SimulationOptions)}
    command = typer.main.get_command(app).commands["donuts"]
    options = {p.name: p for p in command.params if p.param_type_name == "option"}
    assert len(options) > 35
    for name, option in options.items():
        value = [] if option.is_flag else [VALUES.get(name, "3")]
        given = (option.secondary_opts or option.opts)[0] if option.default is True else option.opts[0]
        simulate = [] if name in of_simulations else ["--simulate"]
        if name in of_both or name == "simulate":
            continue
        assert main(["donuts", "no.fits", *simulate, given, *value]) == 2
        expected = "expected with --simulate alone" if name in of_simulations else "expected without --simulate"
        assert capsys.readouterr().err == f"pachon: error: {option.opts[0]}: {expected}\n"


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.long
@pytest.mark.parametrize("joint", [False, True])
def test_an_interrupted_fit_writes_the_donuts_that_were_finished(tmp_path, monkeypatch, capsys, stamp, joint):
    monkeypatch.chdir(tmp_path)
    header = fits.Header({"FIELD_X": FIELD[0], "FIELD_Y": FIELD[1]})
    # The last ones are not reached.
    fits.PrimaryHDU(np.stack([stamp, stamp + 1.0, *[stamp] * 4]), header).writeto("donuts.fits")
    fits.PrimaryHDU(np.stack([stamp, stamp + 1.0]), header).writeto("two.fits")
    options = ["--threads", "1", "--quiet", *OPTIONS] + ["--each-alone"] * (not joint)
    assert main(["donuts", "two.fits", *options, "-o", "two.ecsv"]) == 0
    finished = 0

    def advance(stage, count=1):
        nonlocal finished
        finished += count
        if finished >= 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("pachon.core.progress.Stage.advance", advance)
    capsys.readouterr()
    assert main(["donuts", "donuts.fits", *options, "-o", "part.ecsv"]) == 130
    assert re.fullmatch(
        r"pachon: error: interrupted; [2-4] of 6 donuts fitted, in part\.ecsv\n", capsys.readouterr().err
    )
    found, whole = Table.read("part.ecsv"), Table.read("two.ecsv")
    assert found["reasons"][:2].tolist() == whole["reasons"].tolist() == ["ok", "ok"]
    assert found["reasons"][-1] == "interrupted"
    assert np.isnan(found["Z4"][-1])
    if not joint:
        assert found["Z4"][:2].tolist() == whole["Z4"].tolist()


def test_a_fit_that_is_interrupted_before_the_first_donut_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(np.zeros((2, 16, 16))).writeto("plain.fits")
    monkeypatch.setattr("pachon.sensing.fit.fit_donuts", interrupted)
    assert main(["donuts", "plain.fits", "--field-deg", "0,1", "--defocus-um", "1500", "-o", "a.ecsv"]) == 130
    error = "pachon: error: interrupted; no donut was finished\n"
    assert capsys.readouterr().err == error
    assert not (tmp_path / "a.ecsv").exists()


def test_a_defocus_beside_that_of_the_file_is_said(tmp_path, monkeypatch, capsys):
    """With that of the file given once more, no donut of a simulated file fitted."""
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(np.zeros((2, 16, 16)), fits.Header({"DEFOC_UM": 1500.0})).writeto("plain.fits")
    monkeypatch.setattr("pachon.sensing.fit.fit_donuts", interrupted)
    assert main(["donuts", "plain.fits", "--field-deg", "0,1", "--defocus-um", "1500"]) == 130
    assert "--defocus-um = 1500 is added to the defocus of the files, 1500 um\n" in capsys.readouterr().err


def test_motions_that_were_not_fitted_are_dashes():
    shift, error = np.array([[1.0, 0.0, 0.0]]), np.array([[0.5, 0.0, 0.0]])
    motions = BodyMotions(
        frame="OCS", body=np.array(["M2"]), shift=shift, shift_error=error, tilt=0.0 * shift, tilt_error=0.0 * error
    )
    assert motion_rows(motions)[1] == [("M2", "+1.00 +- 0.50", "-", "-", "-", "-", "-")]
