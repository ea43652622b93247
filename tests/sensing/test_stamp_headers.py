"""Files of observatories: headers, planes, places on CCDs, and which way stamps lie."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from donut_images import donut, noisy

import pachon
from pachon.core.errors import ProductError
from pachon.sensing.frames import along_camera
from pachon.sensing.stamp_files import read_stamps, sky_of_variance
from pachon.sensing.stamp_headers import header_values
from pachon.sensing.stamp_places import on_camera, stamp_places

ANGLES = {"BORESIGHT_ROT_ANGLE_RAD": 0.3, "BORESIGHT_PAR_ANGLE_RAD": 2.4}


def donut_stamps(path, stamps, *, detectors, pixels, band="r", kind="extra", camera="LSSTCam", angles=None):
    """Write stamps as ts_wep's DonutStamps are: lists in the primary header, IMAGE, MASK and VARIANCE of each."""
    primary = fits.PrimaryHDU()
    lists = {
        "CENT_X": [float(x) for x, _ in pixels],
        "CENT_Y": [float(y) for _, y in pixels],
        "DET_NAME": detectors,
        "CAM_NAME": [camera] * len(stamps),
        "DFC_TYPE": [kind] * len(stamps),
        "DFC_DIST": [1.5] * len(stamps),
        "BANDPASS": [band] * len(stamps),
    }
    for key, values in lists.items():
        for value in values:
            primary.header.append((key, value))
    for key, value in (ANGLES if angles is None else angles).items():
        primary.header[f"HIERARCH {key}"] = value
    units = [primary]
    for number, stamp in enumerate(stamps, start=1):
        for name, data in stamp.items():
            header = fits.Header({"EXTNAME": name, "EXTVER": number})
            if name == "MASK":
                header["MP_BAD"], header["MP_SAT"], header["HIERARCH MP_DETECTED"] = 0, 1, 5
            units.append(fits.ImageHDU(data, header))
    fits.HDUList(units).writeto(path)


@pytest.fixture
def corner_file(tmp_path):
    mask = np.zeros((20, 20), np.int32)
    mask[3, 4], mask[5, 6], mask[7, 8] = 1, 1 << 5, 2 | 1 << 5
    stamp = {
        "IMAGE": np.arange(400, dtype=np.float32).reshape(20, 20),
        "MASK": mask,
        "VARIANCE": np.full((20, 20), 9.0, np.float32),
    }
    names = ["R00_SW0", "R04_SW1", "R22_S11"]
    donut_stamps(tmp_path / "d.fits", [stamp] * 3, detectors=names, pixels=[(100, 200), (300, 400), (2035, 1999)])
    return tmp_path / "d.fits"


def test_donut_stamps_have_places_planes_and_angles(corner_file, focused):
    stamps = read_stamps(corner_file)
    assert stamps.detectors == ["R00_SW0", "R04_SW1", "R22_S11"]
    np.testing.assert_array_equal(stamps.pixels, [(100, 200), (300, 400), (2035, 1999)])
    np.testing.assert_array_equal(stamps.defocus, [1.5e-3] * 3)
    assert stamps.header.model == "rubin_v3.14_r"
    # ts_wep, estimateZernikesBase.py: q - rotation of the sky - 90 deg.
    assert stamps.header.rotator == pytest.approx(2.4 - 0.3 - np.pi / 2.0)
    # Detected pixels are good ones, bad and saturated ones are not.
    assert np.argwhere(stamps.masks[1]).tolist() == [[3, 4], [7, 8]]
    assert sky_of_variance(stamps.variances[0], stamps.masks[0]) == 9.0


def test_corner_stamps_turn_as_ts_wep_turns_them(corner_file, focused):
    stamps = read_stamps(corner_file)
    assert on_camera(stamps)
    places = stamp_places(stamps, focused, corner_file, "zemax")
    image = stamps.images[0]
    # ts_wep, donutStamp.py: rot90(image, -yaw / 90 deg).T; yaws of obs_lsst: SW0 of R00 180, SW1 of R04 90 deg, S11 0.
    for axes, turns in zip(places.axes, (2, 1, 0), strict=True):
        np.testing.assert_array_equal(along_camera(image, axes), np.rot90(image, -turns).T)
    # Corner sensors stand where their names say: the first digit grows with the telescope's x, the second with its y.
    assert (np.sign(places.fields[:2]) == [(-1, -1), (-1, 1)]).all()
    np.testing.assert_allclose(np.rad2deg(np.hypot(*places.fields[:2].T)), 1.65, atol=0.2)
    # 2.5 pixels along y and 12.5 along x of DVCS from the middle of 4096 x 4004, x and y of the telescope; 10.31 m.
    np.testing.assert_allclose(places.fields[2], np.array([-2.5, -12.5]) * 10e-6 / 10.31, rtol=2e-3)
    np.testing.assert_allclose(places.heights, [1.5e-3, -1.5e-3, 0.0])


def test_a_rotator_turns_the_fields_of_ccds(corner_file, focused):
    stamps = read_stamps(corner_file)
    still, turned = (
        stamp_places(stamps, t, corner_file, "zemax").fields for t in (focused, focused.with_rotator(np.pi / 2.0))
    )
    # +x of the camera lies along +y of the telescope.
    np.testing.assert_allclose(turned, np.stack([-still[:, 1], still[:, 0]], axis=1), atol=1e-8)


DECAM = {"EXTNAME": "S25", "IX": 377, "IY": 3198, "XDECAM": -161.8695, "YDECAM": -78.5775,
         "DTACQNAM": "/data_local/images/DTS/2013A-9999/DECam_00284696.fits.fz",
         "FILTER": "i DECam SDSS c0003 7835.0 1470.0"}  # fmt: skip


def test_stamps_of_decam_lie_where_their_headers_have_them(tmp_path):
    """Cards of DECam_00284696.S25.0001.stamp.fits (aaronroodman/Donut, MIT), positions among them."""
    path = tmp_path / "s.fits"
    fits.PrimaryHDU(np.ones((64, 64), np.float32), fits.Header(DECAM)).writeto(path)
    stamps = read_stamps(path)
    telescope = pachon.load_telescope(stamps.header.model)
    places = stamp_places(stamps, telescope, path, "zemax")
    expected = pachon.fields_at(telescope, [(-161.8695e-3, -78.5775e-3)])
    np.testing.assert_allclose(places.fields, expected, atol=1e-9)
    np.testing.assert_array_equal(places.axes, [np.eye(2)])
    assert stamps.header.wavelength == pytest.approx(783.5e-9)
    assert stamps.header.rotator is None


@pytest.mark.parametrize(
    ("name", "x", "y", "height"), [("FS1", -152.172, 143.7525, 1.5), ("FN3", 219.804, 15.9725, -1.5)]
)
def test_focus_chips_of_decam_stand_out_of_focus(tmp_path, name, x, y, height):
    path = tmp_path / "s.fits"
    middle = {"IX": 1023.5, "IY": 1023.5, "EXTNAME": name}
    fits.PrimaryHDU(np.ones((64, 64), np.float32), fits.Header(DECAM | middle)).writeto(path)
    telescope = pachon.load_telescope("decam")
    places = stamp_places(read_stamps(path), telescope, path, "zemax")
    np.testing.assert_allclose(places.fields, pachon.fields_at(telescope, [(x * 1e-3, y * 1e-3)]), atol=1e-9)
    np.testing.assert_allclose(places.heights, height * 1e-3)


def test_an_exposure_of_the_lsst_is_cut_at_pixels_of_its_ccd(tmp_path):
    header = fits.Header({"INSTRUME": "LSSTCam", "RAFTBAY": "R22", "CCDSLOT": "S01", "FILTER": "i_39"})
    header.update({"BUNIT": "electron", "BORE-AZ": 180.0, "BORE-ALT": 60.0, "ROTTYPE": "SKY"})
    header["HIERARCH BORE-ROTANG"] = 10.0
    header["LTV1"], header["LTV2"] = -1000, -500
    image = np.arange(300 * 200, dtype=np.float32).reshape(300, 200)
    image[:, 30] = np.nan
    quality = fits.ImageHDU((image > 59000).astype(np.int16), name="MASK")
    archive = fits.BinTableHDU(Table({"cat.archive": [1, 2, 3]}), name="ARCHIVE_INDEX")
    units = [fits.PrimaryHDU(header=header), fits.CompImageHDU(image, name="IMAGE"), quality, archive]
    fits.HDUList(units).writeto(tmp_path / "e.fits")
    Table({"x": [100.0, 40.0], "y": [150.0, 60.0]}).write(tmp_path / "at.csv")
    stamps = read_stamps(tmp_path / "e.fits", tmp_path / "at.csv", 40)
    # The middle of a stamp of even size lies half a pixel before the star's.
    np.testing.assert_array_equal(stamps.pixels, [(1099.5, 649.5), (1039.5, 559.5)])
    np.testing.assert_array_equal(stamps.images[0], image[130:170, 80:120])
    assert np.isnan(stamps.images[1][:, 10]).all()
    assert stamps.detectors == ["R22_S01"] * 2
    values = stamps.header
    # The zenith of -30 deg is north of a star in the south.
    assert values.parallactic_angle == pytest.approx(0.0, abs=1e-9)
    assert values.rotator == pytest.approx(np.angle(np.exp(1j * (values.parallactic_angle - np.deg2rad(100.0)))))
    assert (values.gain, values.model) == (1.0, "rubin_v3.14_i")


def test_the_latitude_of_a_telescope_on_the_equator_counts(tmp_path):
    """Seen from the equator the pole is on the horizon: 90 degrees from the zenith of a star in the east."""
    header = fits.Header({"INSTRUME": "LSSTCam", "BORE-AZ": 90.0, "BORE-ALT": 45.0, "OBS-LAT": 0.0})
    east = np.deg2rad(90.0)
    assert abs(header_values([header], tmp_path).parallactic_angle) == pytest.approx(east, abs=1e-12)
    header["OBS-LAT"] = -30.244639
    there = header_values([header], tmp_path).parallactic_angle
    del header["OBS-LAT"]
    assert header_values([header], tmp_path).parallactic_angle == there != pytest.approx(east, abs=0.1)


def test_weights_and_planes_of_files_of_their_own(tmp_path):
    image = np.ones((2, 12, 12), np.float32)
    weight = np.full((2, 12, 12), 0.25, np.float32)
    weight[0, 1, 1] = 0.0
    fits.HDUList([fits.PrimaryHDU(image), fits.ImageHDU(weight, name="WGT")]).writeto(tmp_path / "a.fits")
    fits.PrimaryHDU((weight == 0).astype(np.int16) * 4).writeto(tmp_path / "dq.fits")
    fits.PrimaryHDU(weight * 4 + 1).writeto(tmp_path / "var.fits")
    stamps = read_stamps(tmp_path / "a.fits")
    assert [m.sum() for m in stamps.masks] == [1, 0]
    assert sky_of_variance(stamps.variances[1], stamps.masks[1]) == 4.0
    separate = read_stamps(tmp_path / "a.fits", mask=tmp_path / "dq.fits", variance=tmp_path / "var.fits")
    assert [m.sum() for m in separate.masks] == [1, 0]
    assert sky_of_variance(separate.variances[1], separate.masks[1]) == 2.0


@pytest.mark.parametrize(
    ("cards", "part"),
    [
        ({"DET_NAME": "R22_S77"}, "unknown CCD of lsst 'R22_S77'"),
        ({"DETECTOR": 250}, "DETECTOR = 250: expected a number from 0 to 204"),
        ({"DET_NAME": "R22_S11", "CENT_X": 5000.0}, "pixel (5000, 7) of R22_S11: expected one of 4096 x 4004 from 0"),
        ({"DET_NAME": "R22_S11", "CENT_X": "left"}, "CENT_X = 'left': expected a number"),
        ({"DET_NAME": "R22_S11", "DFC_TYPE": "inside"}, "DFC_TYPE = 'inside': expected extra or intra"),
        ({"DET_NAME": "R22_S11", "GAIN": -1.0}, "GAIN = -1.0: expected electrons of a unit, above 0"),
    ],
)
def test_wrong_headers_are_one_line(tmp_path, focused, cards, part):
    path = tmp_path / "s.fits"
    header = fits.Header({"INSTRUME": "LSSTCam", "CENT_X": 7.0, "CENT_Y": 7.0} | cards)
    fits.PrimaryHDU(np.ones((12, 12), np.float32), header).writeto(path)
    with pytest.raises(ProductError) as raised:
        stamp_places(read_stamps(path), focused, path, "zemax")
    assert part in str(raised.value)
    assert str(path) in str(raised.value)


def test_wrong_planes_are_one_line(tmp_path):
    image = np.ones((12, 12), np.float32)
    fits.HDUList([fits.PrimaryHDU(image), fits.ImageHDU(image[:6], name="DQ")]).writeto(tmp_path / "a.fits")
    with pytest.raises(ProductError, match=r"planes of mask: 1 of shape \[6, 12\] for 1 image of \[12, 12\]: expected"):
        read_stamps(tmp_path / "a.fits")


@pytest.mark.parametrize(
    ("text", "band"),
    [
        ("r_57", "r"),
        ("i_39", "i"),
        ("SDSSr_65mm~empty", "r"),
        ("g", "g"),
        ("Y", "y"),
        ("empty", None),
        ("VR DECam", None),
    ],
)
def test_filters_by_their_names(tmp_path, text, band):
    assert header_values([fits.Header({"FILTER": text})], tmp_path).band == band


@pytest.fixture(scope="module")
def wide_field(focused):
    """Two donuts off the axis, of a decentred M2."""
    tel = focused.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    true = tel.perturbed("M2", shift=(2e-4, 1e-4, 0.0))
    fields = np.deg2rad([(0.8, 1.1), (-1.2, 0.4)])
    images = [noisy(donut(true, f, flux=2e6, rays=200), 300.0, k) for k, f in enumerate(fields)]
    model = pachon.DonutModel(detector=pachon.DonutDetector(pixel_size=20e-6))
    return lambda stamps: pachon.sensing.check_orientation(
        tel, stamps, fields, 622e-9, sky_variance=300.0, model=model, threads=1
    ), images


@pytest.mark.long
def test_right_stamps_are_confirmed(wide_field):
    check, images = wide_field
    right = check(images)
    assert "confirmed" in repr(right)
    assert len(right.donuts) == 1
    assert (right.best, right.doubtful, right.decided) == ("x,y", False, True)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["y,x", "-x,y", "x,-y", "-y,-x", "-x,-y", "-y,x", "y,-x"])
def test_all_orientations_are_told(wide_field, axes):
    from pachon.sensing.frames import stamp_axes_text, stamp_matrix

    check, images = wide_field
    wrong = check([along_camera(image, stamp_matrix(axes)) for image in images])
    # What undoes a change of axes is its inverse.
    assert wrong.best == stamp_axes_text(stamp_matrix(axes).T)
    assert wrong.doubtful
    assert "another fits better" in repr(wrong)


@pytest.mark.slow
def test_donuts_near_the_axis_tell_nothing(focused):
    tel = focused.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    fields = np.deg2rad([(0.06, 0.08), (-0.09, 0.03), (0.02, -0.1)])
    images = [noisy(donut(tel, f, flux=2e6), 300.0, k) for k, f in enumerate(fields)]
    model = pachon.DonutModel(detector=pachon.DonutDetector(pixel_size=20e-6))
    check = pachon.sensing.check_orientation(tel, images, fields, 622e-9, sky_variance=300.0, model=model, threads=1)
    assert not check.doubtful
    assert not check.decided


def test_the_sky_of_stamps_with_masked_edges():
    """It was zero, as if the sky had no noise."""
    variance, edge = np.full((60, 60), 100.0), np.ones((60, 60), dtype=bool)
    variance[20:40, 20:40], edge[3:-3, 3:-3] = 2000.0, False
    assert sky_of_variance(variance, edge) == 100.0
    assert sky_of_variance(variance, np.ones_like(edge)) == 0.0


@pytest.mark.parametrize("name", ["VARIANCE", "WGT", "ERR"])
def test_planes_of_zeros_say_nothing(tmp_path, name):
    """As ts_wep writes them where it has no variances: all pixels were masked, and all donuts lost."""
    image = np.arange(400.0).reshape(20, 20)
    fits.HDUList([fits.PrimaryHDU(image), fits.ImageHDU(0.0 * image, name=name)]).writeto(tmp_path / "a.fits")
    stamps = read_stamps(tmp_path / "a.fits")
    assert stamps.variances is None
    assert not stamps.masks[0].any()


def test_each_image_has_its_own_gain(tmp_path):
    """Stamps of several CCDs: all had that of the first, and so the light of the others was wrong."""
    cards = {"GAIN": 4.0}, {"GAINA": 3.0, "GAINB": 3.4}, {"BUNIT": "electron"}
    stamps = [fits.ImageHDU(np.ones((20, 20)), header) for header in map(fits.Header, cards)]
    fits.HDUList([fits.PrimaryHDU(), *stamps]).writeto(tmp_path / "a.fits")
    assert read_stamps(tmp_path / "a.fits").gains == pytest.approx([4.0, 3.2, 1.0])


def test_positions_of_a_spreadsheet(tmp_path):
    """Semicolons, and the byte order mark of spreadsheets before the name of the first column."""
    image = np.arange(150.0 * 160.0).reshape(150, 160)
    fits.PrimaryHDU(image).writeto(tmp_path / "ccd.fits")
    (tmp_path / "stars.csv").write_text("\ufeffx;y;field_x;field_y\n85;65;0.6;0.9\n")
    stamps = read_stamps(tmp_path / "ccd.fits", positions=tmp_path / "stars.csv", size=91)
    np.testing.assert_array_equal(stamps.images[0], image[20:111, 40:131])


def cube_with(path, **columns):
    """Write a cube of two stamps with a table."""
    stamps = fits.PrimaryHDU(np.ones((2, 12, 12), np.float32))
    fits.HDUList([stamps, fits.BinTableHDU(Table(columns))]).writeto(path)
    return path


def test_units_of_columns_count(tmp_path):
    """Radians and millimetres were read as degrees and micrometres."""
    path = cube_with(
        tmp_path / "a.fits",
        field_x=[0.01, 0.02] * u.rad,
        field_y=[36.0, 72.0] * u.arcsec,
        defocus_um=[1.5, -1.5] * u.mm,
    )
    stamps = read_stamps(path)
    np.testing.assert_allclose(stamps.fields, [(0.01, np.deg2rad(0.01)), (0.02, np.deg2rad(0.02))], rtol=1e-14)
    np.testing.assert_allclose(stamps.defocus, [1.5e-3, -1.5e-3], rtol=1e-14)


@pytest.mark.parametrize(
    ("columns", "part"),
    [
        ({"field_x": [0.1, np.nan], "field_y": [0.1, 0.2]}, "field_x = nan in row 2: expected a finite number"),
        ({"field_x": ["a", "b"], "field_y": [0.1, 0.2]}, "column field_x of shape (2,)"),
        ({"field_x": [0.1, 0.2] * u.mm, "field_y": [0.1, 0.2]}, "column field_x in mm: expected deg"),
        ({"field_x": [0.1, 0.2]}, "columns field_x: expected x and y [pixels], field_x and field_y [deg]"),
    ],
)
def test_bad_columns_name_file_and_row(tmp_path, columns, part):
    path = cube_with(tmp_path / "a.fits", **columns)
    with pytest.raises(ProductError) as raised:
        read_stamps(path)
    assert part in str(raised.value)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("x,y,field_x,field_y\n,20,0.6,0.9\n30,20,0.1,0.2\n", "x = nan in row 1: expected a finite number"),
        ("x,y,field_x,field_y\nnan,20,0.6,0.9\n", "x = nan in row 1: expected a finite number"),
        ("x,y,field_x,field_y\n", "table of 0 rows: expected one row a stamp"),
        ("X_IMAGE,Y_IMAGE\n20,20\n", "columns X_IMAGE, Y_IMAGE: expected x and y [pixels]"),
        ("", "columns none: expected x and y [pixels]"),
    ],
)
def test_bad_positions_name_file_and_row(tmp_path, text, part):
    """A number that is left out was read as 0."""
    fits.PrimaryHDU(np.ones((40, 50), np.float32)).writeto(tmp_path / "ccd.fits")
    (tmp_path / "stars.csv").write_text(text)
    with pytest.raises(ProductError) as raised:
        read_stamps(tmp_path / "ccd.fits", positions=tmp_path / "stars.csv", size=16)
    assert part in str(raised.value)
    assert "stars.csv" in str(raised.value)


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("ERR", None, 3.0),
        ("RMS_1", None, 3.0),
        ("UNCERT", "StdDevUncertainty", 3.0),
        ("UNCERT", "VarianceUncertainty", 9.0),
        ("UNCERT", "InverseVariance", 1.0 / 9.0),
    ],
)
def test_planes_of_standard_deviations(tmp_path, name, kind, value):
    """Extensions ERR, and UNCERT of astropy's CCDData, were taken for images of donuts."""
    image = np.ones((12, 12))
    plane = fits.ImageHDU(np.full_like(image, value), name=name)
    if kind is not None:
        plane.header["UTYPE"] = kind
    fits.HDUList([fits.PrimaryHDU(image), plane]).writeto(tmp_path / "a.fits")
    stamps = read_stamps(tmp_path / "a.fits")
    assert len(stamps) == 1
    np.testing.assert_allclose(stamps.variances[0], 9.0, rtol=1e-14)


def test_errors_count_before_weights(tmp_path):
    """Weights of drizzled images are exposure times, and no inverse variances."""
    image = np.ones((12, 12))
    planes = [fits.ImageHDU(value * image, name=name) for name, value in (("SCI", 1.0), ("WHT", 900.0), ("ERR", 3.0))]
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(tmp_path / "a.fits")
    np.testing.assert_array_equal(read_stamps(tmp_path / "a.fits").variances[0], 9.0)


@pytest.mark.parametrize("axes", [(1,), (1, 1)])
def test_images_of_ccds_with_axes_of_length_one(tmp_path, axes):
    """NAXIS3 = 1 made a cube of one stamp of it, for which a table of two donuts was refused."""
    image = np.arange(40.0 * 50.0).reshape(40, 50)
    (tmp_path / "stars.csv").write_text("x,y\n10,12\n30,20\n")
    fits.PrimaryHDU(image.reshape(*axes, 40, 50)).writeto(tmp_path / "ccd.fits")
    stamps = read_stamps(tmp_path / "ccd.fits", positions=tmp_path / "stars.csv", size=16)
    np.testing.assert_array_equal(stamps.images, [image[4:20, 2:18], image[12:28, 22:38]])


def test_small_stamps_are_said_to_be(tmp_path):
    fits.PrimaryHDU(np.ones((2, 7, 7))).writeto(tmp_path / "a.fits")
    with pytest.raises(ProductError, match=r"image of shape \[2, 7, 7\]: expected .* of at least 8 pixels a side"):
        read_stamps(tmp_path / "a.fits")
