"""Measured heights from files: tables of points and of Zernike coefficients, FITS images, and errors in them."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

import pachon
from pachon import FocalPlane
from pachon.core.errors import DomainError, PachonError, PrescriptionError, UnknownNameError
from pachon.errors import HeightWarning
from pachon.models.camera.camera import Camera
from pachon.models.camera.lsst import lsst_camera

HALF = 20.48e-3
NAMES = ("A_S00", "A_S01")
CENTERS = np.array([[-21e-3, 5e-3], [21e-3, 5e-3]])
SMALL = Camera("small", NAMES, ("A",), np.zeros(2, dtype=int), CENTERS, np.array([4096, 4096]), 10e-6)


def bowl(ccd, dx, dy):
    """Return the height [m] of a bowl of 5 um on a step that differs from CCD to CCD."""
    return (3e-6, -4e-6)[ccd] + 5e-6 * (dx**2 + dy**2) / HALF**2


def points(n=60):
    axis = np.linspace(-1.0, 1.0, n) * HALF * (1 - 1e-9)
    dx, dy = (a.ravel() for a in np.meshgrid(axis, axis))
    x, y = (np.concatenate([CENTERS[i, k] + d for i in (0, 1)]) for k, d in enumerate((dx, dy)))
    return x, y, np.concatenate([bowl(i, dx, dy) for i in (0, 1)])


def zernike_table(names=NAMES, unit="mm", **change):
    """Return a table of the bowl in imSim's columns and frame."""
    n, radius = len(names), 30.0
    # Z4 = sqrt(3) (2 rho^2 - 1)
    focus = 5e-3 * (radius * 1e-3) ** 2 / HALF**2 / (2 * np.sqrt(3))
    zk = np.zeros((n, 29))
    zk[:, 0] = 99.0
    zk[:, 1] = [-(1e3 * bowl(i, 0, 0) + np.sqrt(3) * focus) for i in range(n)]
    zk[:, 4] = -focus
    x, y = 1e3 * CENTERS[:n].T
    columns = {"DET_NAME": list(names), "ORIGIN_X": x, "ORIGIN_Y": y, "MIN_X": x - 20, "MAX_X": x + 20,
               "MIN_Y": y - 20.2, "MAX_Y": y + 20.2, "R_OUTER": np.full(n, radius), "ZK": zk}  # fmt: skip
    table = Table({k: v for k, v in (columns | change).items() if v is not None})
    for name in table.colnames[1:]:
        table[name].unit = unit
    return table


def images(step=0.7e-3, frame=None, names=NAMES, **cards):
    """Return FITS images of the bowl, a CCD each."""
    n = int(2 * HALF / step) - 1
    made = fits.HDUList([fits.PrimaryHDU()])
    axis = (np.arange(n) - 0.5 * (n - 1)) * step
    for i, name in enumerate(names):
        data = bowl(i, axis[None, :], axis[:, None]) * 1e6
        x, y = 1e3 * CENTERS[i]
        if frame == "CCS":
            data = -data
        hdu = fits.ImageHDU(data.astype(np.float32), name=name)
        middle = 0.5 * (n + 1)
        grid = {
            "CRPIX1": middle,
            "CRPIX2": middle,
            "CRVAL1": x,
            "CRVAL2": y,
            "CDELT1": 1e3 * step,
            "CDELT2": 1e3 * step,
        }
        hdu.header.update(grid | {"BUNIT": "um", "CUNIT1": "mm", "CUNIT2": "mm"})
        if frame is not None:
            hdu.header["FRAME"] = frame
        for key, value in cards.items():
            if value is None:
                del hdu.header[key]
            else:
                hdu.header[key] = value
        made.append(hdu)
    return made


def check(plane, atol, reach=0.97):
    """Compare a focal plane with the bowls away from the rims."""
    rng = np.random.default_rng(1)
    for i in (0, 1):
        dx, dy = rng.uniform(-reach * HALF, reach * HALF, (2, 300))
        assert np.allclose(plane.height(*(CENTERS[i, :, None] + [dx, dy])), bowl(i, dx, dy), rtol=0, atol=atol)
    assert plane.measured.all()


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error", HeightWarning)
        yield


@pytest.mark.parametrize("ending", ["ecsv", "fits"])
def test_a_table_of_points_keeps_units_steps_and_bowls(tmp_path, ending):
    x, y, z = points()
    path = tmp_path / f"heights.{ending}"
    Table({"x": 1e3 * x, "y": 1e3 * y, "z": 1e6 * z}, units={"x": "mm", "y": "mm", "z": "um"}).write(path)
    plane = FocalPlane.from_file(path, SMALL)
    # A bowl is in the span of the fit; 1e-10 of the ridge of its splines.
    check(plane, 1e-12)
    assert plane.residual.max() < 1e-12


def test_the_residual_is_the_noise_of_the_points(tmp_path):
    x, y, z = points()
    rng = np.random.default_rng(8)
    path = tmp_path / "heights.ecsv"
    noisy = z + rng.normal(0, 1e-7, z.size)
    Table({"x": x, "y": y, "z": noisy}, units=dict.fromkeys("xyz", "m")).write(path)
    # 3600 points leave the noise but for the 10 + 400 coefficients of the fit, which smoothing makes fewer.
    assert FocalPlane.from_file(path, SMALL).residual == pytest.approx([0.97e-7, 0.97e-7], rel=0.04)


def test_heights_in_the_frame_of_the_camera_change_sign(tmp_path):
    x, y, z = points()
    path = tmp_path / "heights.ecsv"
    Table({"x": x, "y": y, "z": -z}, units=dict.fromkeys("xyz", "m"), meta={"frame": "CCS"}).write(path)
    check(FocalPlane.from_file(path, SMALL), 1e-12)


@pytest.mark.parametrize("ending", ["ecsv", "fits"])
def test_a_table_of_zernikes_is_taken_as_it_is(tmp_path, ending):
    path = tmp_path / f"zernikes.{ending}"
    zernike_table().write(path)
    # Rounding of coefficients of 1e-2 mm.
    plane = FocalPlane.from_file(path, SMALL)
    check(plane, 1e-17)
    assert np.isnan(plane.residual).all()


def test_the_bundled_table_is_such_a_file():
    from pachon.models.io.heights.zernike_table import _DATA, AS_MEASURED

    with pytest.warns(HeightWarning, match=r"gaps, .*: R01_S00 \(80 % measured\), R03_S02 \(80 %.*R41_S20.*R43_S22"):
        plane = FocalPlane.from_file(_DATA / AS_MEASURED["lsstcam"][1])
    x, y = np.random.default_rng(2).uniform(-0.3, 0.3, (2, 2000))
    assert np.array_equal(plane.height(x, y), FocalPlane.as_measured("lsstcam").height(x, y), equal_nan=True)


@pytest.mark.parametrize("frame", [None, "telescope", "CCS"])
def test_images_keep_steps_and_bowls(tmp_path, frame):
    path = tmp_path / "heights.fits"
    images(frame=frame).writeto(path)
    plane = FocalPlane.from_file(path, SMALL)
    # Single precision: 8 um to 6e-8.
    check(plane, 2e-12)
    assert plane.residual.max() < 1e-12


@pytest.mark.parametrize("matrix", ["CD", "PC", "PC and CDELT"])
def test_images_with_turned_pixels(tmp_path, matrix):
    made = images()
    for hdu in made[1:]:
        step = hdu.header["CDELT1"]
        if matrix == "PC and CDELT":
            hdu.header.update({"PC1_1": 0.0, "PC1_2": 1.0, "PC2_1": -1.0, "PC2_2": 0.0})
        else:
            for key in ("CDELT1", "CDELT2"):
                del hdu.header[key]
            # Columns along -y, rows along x.
            hdu.header.update({f"{matrix}1_2": step, f"{matrix}2_1": -step})
            if matrix == "PC":
                hdu.header.update({"PC1_1": 0.0, "PC2_2": 0.0})
        # Higher towards +x, so that the bowl is none in any direction.
        slope = 1e-4 * step * (np.arange(hdu.data.shape[1]) - 0.5 * (hdu.data.shape[1] - 1))
        hdu.data = (hdu.data + 1e3 * slope).T[:, ::-1].copy()
    made.writeto(tmp_path / "heights.fits")
    plane = FocalPlane.from_file(tmp_path / "heights.fits", SMALL)
    dx, dy = np.random.default_rng(1).uniform(-0.97 * HALF, 0.97 * HALF, (2, 300))
    for i in (0, 1):
        expected = bowl(i, dx, dy) + 1e-4 * dx
        assert np.allclose(plane.height(*(CENTERS[i, :, None] + [dx, dy])), expected, rtol=0, atol=2e-12)


def test_names_of_extensions_are_those_of_ccds_in_any_case(tmp_path):
    """astropy writes EXTNAME in capitals, and CCDs of HSC have small letters."""
    images().writeto(tmp_path / "heights.fits")
    camera = replace(SMALL, ccd_names=tuple(name.lower() for name in NAMES))
    check(FocalPlane.from_file(tmp_path / "heights.fits", camera), 2e-12)


def test_large_images_are_averaged(tmp_path):
    made = images(step=0.1e-3)
    assert made[1].data.shape[0] > 400
    rng = np.random.default_rng(4)
    for hdu in made[1:]:
        hdu.data += rng.normal(0.0, 0.1, hdu.data.shape).astype(np.float32)
    made.writeto(tmp_path / "heights.fits")
    plane = FocalPlane.from_file(tmp_path / "heights.fits", SMALL)
    # Blocks of 7 x 7 pixels leave a seventh of the noise.
    assert plane.residual == pytest.approx([0.1e-6 / 7] * 2, rel=0.1)
    # 59 x 59 blocks leave the rms of noise of 400 coefficients, 5 nm, at most four times that within the rims.
    check(plane, 20e-9)


def test_gaps_are_named(tmp_path):
    made = images()
    made[2].data[:22] = np.nan
    made.writeto(tmp_path / "heights.fits")
    with pytest.warns(HeightWarning, match=r"gaps, across which heights are continued: A_S01 \([56]\d % measured\)"):
        plane = FocalPlane.from_file(tmp_path / "heights.fits", SMALL)
    # A bowl bridges its gap by itself.
    check(plane, 1e-11, reach=0.9)


def test_missing_ccds_are_named_and_flat(tmp_path):
    images(names=NAMES[:1]).writeto(tmp_path / "one.fits")
    zernike_table(NAMES[:1]).write(tmp_path / "one.ecsv")
    for name in ("one.fits", "one.ecsv"):
        with pytest.warns(HeightWarning, match=r"one\.\w+: no heights, taken as zero: A_S01$"):
            plane = FocalPlane.from_file(tmp_path / name, SMALL)
        assert list(plane.measured) == [True, False]
        assert plane.height(*CENTERS[1]) == 0.0
        assert plane.height(*CENTERS[0]) == pytest.approx(3e-6, abs=1e-12)


def test_heights_of_millimetres_are_doubted(tmp_path):
    x, y, z = points()
    path = tmp_path / "heights.ecsv"
    Table({"x": x, "y": y, "z": 1e6 * z}, units={"x": "m", "y": "m", "z": "mm"}).write(path)
    with pytest.warns(
        HeightWarning, match=r"heights of more than 0.2 mm; is the unit right\? A_S00 \(11.\d mm\), A_S01"
    ):
        FocalPlane.from_file(path, SMALL)


def test_sensors_of_another_camera_are_named(tmp_path):
    images().writeto(tmp_path / "heights.fits")
    with fits.open(tmp_path / "heights.fits") as made:
        extra = made[1].copy()
        extra.name = "R00_SW0"
        fits.HDUList([*made, extra]).writeto(tmp_path / "more.fits")
    with pytest.warns(HeightWarning, match="left out, not on the camera: R00_SW0"):
        FocalPlane.from_file(tmp_path / "more.fits", SMALL)


UNITS = {"x": "mm", "y": "mm", "z": "um"}


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        (Table({"x": [1.0], "y": [1.0]}, units={"x": "m"}), ["columns x, y: expected x, y, z, or DET_NAME"]),
        (Table({"x": [1.0], "y": [1.0], "z": [1.0]}), ["column x in no unit", "a unit of length"]),
        (Table({"x": [1.0], "y": [1.0], "z": [1.0]}, units=UNITS | {"z": "deg"}), ["column z in deg"]),
        (Table({"x": [1.0, np.nan], "y": [1.0, 2.0], "z": [1.0, 1.0]}, units=UNITS), ["x, row 1: expected finite"]),
        (Table({"x": [9e9], "y": [1.0], "z": [1.0]}, units=UNITS), ["none of 1 point lies on a CCD"]),
        (Table({"x": [1.0], "y": [1.0], "z": [1.0]}, units=UNITS, meta={"frame": "DVCS"}), ["frame = 'DVCS'", "CCS"]),
        (zernike_table(unit=None), ["column ORIGIN_X in no unit"]),
        (zernike_table(ZK=None), ["column ZK is missing"]),
        (zernike_table(ZK=np.zeros(2)), ["ZK has the shape (2,)"]),
        (zernike_table(R_OUTER=[30.0, np.nan]), ["column R_OUTER, A_S01: expected finite numbers"]),
        (zernike_table(R_OUTER=[30.0, 0.0]), ["column R_OUTER, A_S01: expected a positive radius"]),
        (zernike_table(MIN_X=[30.0, -30.0]), ["A_S00: expected MIN_X below MAX_X"]),
        (zernike_table(("A_S00", "A_S00")), ["A_S00 occurs more than once"]),
        (zernike_table(("B_S00", "B_S01")), ["none of 2 sensors is a CCD of small: expected names such as A_S00"]),
        (zernike_table(NAMES[::-1]), ["A_S00 at (x, y) = (21.00, 5.00) mm", "expected (-21.00, 5.00) mm", "frame"]),
    ],
)  # fmt: skip
def test_bad_tables_are_refused_in_one_line(tmp_path, table, parts):
    path = tmp_path / "bad.ecsv"
    table.write(path)
    with pytest.raises((PrescriptionError, DomainError)) as caught:
        FocalPlane.from_file(path, SMALL)
    assert str(caught.value).startswith(f"{path}")
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("cards", "parts"),
    [
        ({"BUNIT": None}, ["A_S00", "BUNIT = 'no unit': expected a unit of length"]),
        ({"BUNIT": "counts"}, ["A_S00", "BUNIT = 'counts'"]),
        ({"CUNIT2": None}, ["A_S00", "CUNIT2 = 'no unit'"]),
        ({"CDELT1": None}, ["A_S00", "CDELT1 is missing"]),
        ({"CRVAL1": "left"}, ["A_S00", "CRVAL1 = 'left'"]),
        ({"FRAME": "DM"}, ["frame = 'DM': expected one of telescope, CCS"]),
        ({"EXTNAME": "A_S00"}, ["image 2: EXTNAME = 'A_S00': expected the name of a CCD, once"]),
        ({"EXTNAME": None}, ["image 1: EXTNAME = ''"]),
        ({"CRVAL1": 21.0}, ["image A_S00: has pixels on A_S01"]),
        ({"CRVAL1": -19.8}, ["image A_S01: has pixels on A_S00"]),
        ({"CROTA2": 30.0}, ["A_S00", "CROTA1, CROTA2: expected a rotation as CDi_j, or CDELTi and PCi_j"]),
    ],
)
def test_bad_images_are_refused_in_one_line(tmp_path, cards, parts):
    path = tmp_path / "bad.fits"
    images(**cards).writeto(path)
    with pytest.raises(PrescriptionError) as caught:
        FocalPlane.from_file(path, SMALL)
    assert str(caught.value).startswith(f"{path}")
    for part in parts:
        assert part in str(caught.value)


def test_other_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "empty.fits").write_bytes(b"")
    (tmp_path / "text.ecsv").write_text("not a table")
    images().writeto(tmp_path / "card.fits")
    damaged = (tmp_path / "card.fits").read_bytes().replace(b"CRVAL2  =", b"CRVAL2  '=")
    (tmp_path / "card.fits").write_bytes(damaged)
    (tmp_path / "short.fits").write_bytes(damaged[:20000])
    fits.HDUList([fits.PrimaryHDU()]).writeto(tmp_path / "nothing.fits")
    images(names=("B", "C")).writeto(tmp_path / "others.fits")
    for name, part in [
        ("empty.fits", "cannot be read"),
        ("text.ecsv", "cannot be read"),
        ("nothing.fits", "cannot be read"),
        ("card.fits", "cannot be read"),
        ("short.fits", "cannot be read"),
        ("missing.fits", "no such file"),
        ("heights.txt", "expected a file of heights that ends in .ecsv, .fits, .fit"),
        ("others.fits", "images B, C: expected names such as A_S00"),
    ]:
        with pytest.raises(PachonError, match=part) as caught:
            FocalPlane.from_file(tmp_path / name, SMALL)
        assert "\n" not in str(caught.value)
    with pytest.raises(UnknownNameError, match="unknown camera 'lst': did you mean lsst"):
        FocalPlane.from_file(tmp_path / "others.fits", "lst")


def test_quantities_of_the_camera_as_built_do_not_depend_on_the_reader():
    assert pachon.FocalPlane.as_measured().height(0 * u.mm, 0 * u.mm) == FocalPlane.as_measured().height(0.0, 0.0)
    assert lsst_camera().name == FocalPlane.as_measured().camera.name


def test_names_of_ccds_in_a_table_are_those_of_the_camera(tmp_path):
    path = tmp_path / "named.ecsv"
    for names, problem in (
        (("B0", "B1"), "column ccd, B0: expected names of small, such as A_S00"),
        (NAMES[::-1], "points of A_S00: some lie on A_S01; are coordinates and frame right?"),
    ):
        columns = dict(zip("xyz", points(4), strict=True))
        table = Table({"ccd": np.repeat(names, 16), **columns}, units=dict.fromkeys("xyz", "m"))
        table.write(path, overwrite=True)
        with pytest.raises(PrescriptionError, match=problem):
            FocalPlane.from_file(path, SMALL)
