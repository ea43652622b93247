"""Positions of stars in a user's tables: units, unusable rows and columns."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from drawn_fields import header_of

import pachon
from pachon.core.errors import PachonError
from pachon.imaging.star_positions import read_star_positions

PIXELS = np.array([[30.0, 50.0], [200.25, 17.5], [111.0, 222.0]])


@pytest.fixture(scope="module")
def image(field, tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "a.fits"
    fits.PrimaryHDU(field.image, header_of()).writeto(path)
    return pachon.load_image(path)


@pytest.mark.parametrize(
    ("ra_unit", "dec_unit", "ending"),
    [
        (u.deg, u.deg, "fits"),
        (u.hourangle, u.deg, "ecsv"),
        (u.arcsec, u.arcsec, "fits"),
        (u.rad, u.deg, "fits"),
        (u.mas, u.arcmin, "ecsv"),
    ],
)
def test_angles_are_in_the_units_of_the_table(image, tmp_path, ra_unit, dec_unit, ending):
    ra, dec = np.deg2rad(image.celestial(PIXELS)).T * u.rad
    path = tmp_path / f"stars.{ending}"
    Table({"ra": ra.to(ra_unit), "dec": dec.to(dec_unit)}).write(path)
    np.testing.assert_allclose(read_star_positions(path, image), PIXELS, atol=1e-6)


@pytest.mark.parametrize("name", ["DEG", "degrees", "Degree"])
def test_names_of_degrees(image, tmp_path, name):
    sky = image.celestial(PIXELS).T
    columns = [fits.Column(key, "D", unit=name, array=v) for key, v in zip(("RA", "DEC"), sky, strict=True)]
    path = tmp_path / "stars.fits"
    fits.BinTableHDU.from_columns(columns).writeto(path)
    np.testing.assert_allclose(read_star_positions(path, image), PIXELS, atol=1e-6)


def test_rows_without_a_place_on_the_sky_are_left_out(image, tmp_path):
    sky = np.vstack([image.celestial(PIXELS), [[-999.0, -999.0], [np.nan, 10.0], [10.0, 90.5]]])
    Table({"ra": sky[:, 0], "dec": sky[:, 1]}).write(tmp_path / "stars.csv")
    np.testing.assert_allclose(read_star_positions(tmp_path / "stars.csv", image), PIXELS, atol=1e-6)


@pytest.mark.parametrize(
    ("table", "text"),
    [
        (
            {"ra": ["10:20:30", "10:20:31"], "dec": [1.0, 2.0]},
            r"stars\.ecsv: column ra = '?10:20:30'?, \.\.\.: expected real numbers in deg",
        ),
        ({"x": ["a", "b"], "y": [1.0, 2.0]}, r"stars\.ecsv: column x = .*: expected real numbers"),
        ({"ra": [1.0, 2.0] * u.s, "dec": [1.0, 2.0] * u.deg}, r"stars\.ecsv: column ra = .*: expected .*rad"),
    ],
)
def test_columns_that_are_no_positions(image, tmp_path, table, text):
    Table(table).write(tmp_path / "stars.ecsv")
    with pytest.raises(PachonError, match=text):
        read_star_positions(tmp_path / "stars.ecsv", image)


def test_a_catalogue_of_several_ccds(image, tmp_path):
    """As SExtractor writes for an exposure; the pixels of its first CCD were taken for those of every image."""
    sky = image.celestial(PIXELS)
    columns = {
        "X_IMAGE": [5.0, 6.0, 7.0],
        "Y_IMAGE": [5.0, 6.0, 7.0],
        "ALPHA_J2000": sky[:, 0],
        "DELTA_J2000": sky[:, 1],
    }
    ccds = [fits.table_to_hdu(Table(columns)[rows]) for rows in (slice(2), slice(2, 3))]
    path = tmp_path / "ccds.cat"
    fits.HDUList([fits.PrimaryHDU(), *ccds]).writeto(path)
    np.testing.assert_allclose(read_star_positions(path, image), PIXELS, atol=1e-6)
    for ccd in ccds:
        ccd.columns.del_col("ALPHA_J2000")
        ccd.columns.del_col("DELTA_J2000")
    fits.HDUList([fits.PrimaryHDU(), *ccds]).writeto(path, overwrite=True)
    with pytest.raises(
        PachonError, match=r"ccds\.cat: has 2 tables with pixels of images: expected one, or columns ra"
    ):
        read_star_positions(path, image)


def test_a_catalogue_of_sextractor_in_ascii(image, tmp_path):
    """Its default, ASCII_HEAD, was said to have no positions."""
    head = (
        "#   1 NUMBER                 Running object number\n"
        "#   2 X_IMAGE                Object position along x                                    [pixel]\n"
        "#   3 Y_IMAGE                Object position along y                                    [pixel]\n"
        "#   4 ALPHA_J2000            Right ascension of barycenter (J2000)                      [deg]\n"
        "#   5 DELTA_J2000            Declination of barycenter (J2000)                          [deg]\n"
        "#   6 FLAGS                  Extraction flags\n"
    )
    sky = image.celestial(PIXELS)
    rows = [
        f"{i + 1:10d} {x + 1:10.4f} {y + 1:10.4f} {ra:11.7f} {dec:+11.7f} 0"
        for i, ((x, y), (ra, dec)) in enumerate(zip(PIXELS, sky, strict=True))
    ]
    path = tmp_path / "stars.cat"
    path.write_text(head + "\n".join(rows) + "\n")
    np.testing.assert_allclose(read_star_positions(path, image), PIXELS, atol=1e-9)
    np.testing.assert_allclose(read_star_positions(path, image, 2), PIXELS, atol=2e-3)


def test_pixels_are_of_one_of_several_images(image, tmp_path):
    """They were taken for those of every CCD of a file, also beside places on the sky."""
    (x, y), (ra, dec) = PIXELS.T, image.celestial(PIXELS).T
    path = tmp_path / "stars.csv"
    Table({"x": x + 20.0, "y": y, "ra": ra, "dec": dec}).write(path)
    np.testing.assert_allclose(read_star_positions(path, image, 2), PIXELS, atol=1e-6)
    np.testing.assert_array_equal(read_star_positions(path, image), PIXELS + np.array([20.0, 0.0]))
    Table({"x": x, "y": y}).write(path, overwrite=True)
    with pytest.raises(PachonError, match=r"stars\.csv: has pixels of one of 2 images: expected columns ra and"):
        read_star_positions(path, image, 2)
