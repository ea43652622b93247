"""Compressed FITS files: read as the plain file is, and refused where they unpack to far more than they are."""

import bz2
import gzip
import lzma
import zipfile
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

import pachon
from pachon.core import fits_files
from pachon.core.errors import PachonError, ProductError
from pachon.core.fits_files import open_fits, unpacked_bytes
from pachon.models.io.heights.file import read_heights
from pachon.sky.cutouts import read_mosaic

VALUES = np.random.default_rng(1).normal(size=(40, 30)).astype(np.float32)


def image_bytes(tmp_path):
    path = tmp_path / "plain.fits"
    fits.PrimaryHDU(VALUES).writeto(path, overwrite=True)
    return path.read_bytes()


def zipped(data, tmp_path):
    path = tmp_path / "file.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("plain.fits", data)
    return path.read_bytes()


PACKERS = {"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress, "zip": None}


@pytest.mark.parametrize("kind", PACKERS)
def test_compressed_files_hold_what_the_plain_one_does(tmp_path, kind):
    data = image_bytes(tmp_path)
    packed = PACKERS[kind](data) if PACKERS[kind] else zipped(data, tmp_path)
    path = tmp_path / "packed.fits"
    path.write_bytes(packed)
    with open_fits(path, ProductError, memmap=False) as hdus:
        np.testing.assert_array_equal(hdus[0].data, VALUES)
    assert unpacked_bytes(path, packed, ProductError) == data
    assert unpacked_bytes(path, data, ProductError) is data


@pytest.fixture(scope="module")
def bomb(tmp_path_factory):
    """A file of 0.02 MB whose image has 15 MB of zeros."""
    header = fits.Header([("SIMPLE", True), ("BITPIX", -32), ("NAXIS", 2), ("NAXIS1", 10**3), ("NAXIS2", 3750)])
    path = tmp_path_factory.mktemp("bomb") / "bomb.fits"
    with gzip.open(path, "wb") as file:
        file.write(header.tostring().encode())
        for _ in range(15):
            file.write(bytes(10**6))
    return path


READERS = {
    "grid": pachon.models.read_grid,
    "mosaic": read_mosaic,
    "heights": lambda path: read_heights(path, pachon.lsst_camera()),
    "psfex": pachon.reconstruction.load_psfex,
    "piff": pachon.load_piff,
    "image": pachon.imaging.CcdImage.read,
    "foreign image": pachon.load_image,
}


@pytest.mark.parametrize("reader", READERS)
def test_bombs_are_refused(bomb, reader, monkeypatch):
    # A tenth of the product's limit and of the bomb that passes it, to be quick.
    monkeypatch.setattr(fits_files, "_UNPACKED", fits_files._UNPACKED // 10)
    with pytest.raises(PachonError, match=r"bomb\.fits: compressed file of 0\.0 MB .* unpack it"):
        READERS[reader](bomb)


def test_a_file_cut_short_is_an_error(tmp_path):
    path = tmp_path / "short.fits"
    path.write_bytes(image_bytes(tmp_path)[:-2880])
    with pytest.raises(AstropyUserWarning, match="truncated"), open_fits(path, ProductError):
        pass


def test_what_is_compressed_twice_is_refused(tmp_path):
    path = tmp_path / "twice.fits"
    path.write_bytes(gzip.compress(gzip.compress(image_bytes(tmp_path))))
    with pytest.raises(ProductError, match="compressed twice"), open_fits(path, ProductError):
        pass


def test_larger_files_may_unpack_to_ten_times_their_size(tmp_path, monkeypatch):
    monkeypatch.setattr(fits_files, "_UNPACKED", 1000)
    data = image_bytes(tmp_path)
    noise = gzip.compress(data)
    assert unpacked_bytes(Path("noise.fits"), noise, ProductError) == data
    with pytest.raises(ProductError, match=r"zeros\.fits: compressed file"):
        unpacked_bytes(Path("zeros.fits"), gzip.compress(bytes(10**6)), ProductError)


def test_large_images_of_fpack_are_refused_by_their_header(tmp_path, monkeypatch):
    path = tmp_path / "tiles.fits.fz"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((300, 400), np.int32), name="MASK")]).writeto(path)
    with open_fits(path, ProductError) as hdus:
        assert hdus[1].data.shape == (300, 400)
    monkeypatch.setattr(fits_files, "_TILED", 479_999)
    message = r"tiles\.fits\.fz: compressed image MASK of 0\.5 MB"
    with pytest.raises(ProductError, match=message), open_fits(path, ProductError):
        pass


def test_cards_that_cannot_be_read_are_named(tmp_path):
    """Astropy reads a card when it is asked for."""
    path = tmp_path / "damaged.fits"
    hdu = fits.PrimaryHDU(np.zeros((2, 2)))
    hdu.header["CTYPE2"] = "DEC--TAN"
    hdu.writeto(path)
    path.write_bytes(path.read_bytes().replace(b"'DEC--TAN'", b"'DEC--\x07AN "))
    with (
        pytest.raises(ProductError, match=r"damaged\.fits: CTYPE2 of the header cannot be read: expected KEY = value"),
        open_fits(path, ProductError) as hdus,
    ):
        assert hdus[0].header["CTYPE2"]
