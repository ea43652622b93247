"""Planes of images of other programs: kinds by their names, and axes of length one."""

import numpy as np
import pytest
from astropy.io import fits
from drawn_fields import header_of

import pachon


def write(path, *hdus):
    fits.HDUList(list(hdus)).writeto(path)
    return path


def test_planes_of_standard_deviations_and_quality(field, tmp_path):
    """Extensions STDDEV and QUALITY were taken for images: the file had three."""
    bad = np.zeros(field.image.shape, np.int16)
    bad[5, 7] = 1
    planes = fits.ImageHDU(np.sqrt(field.variance), name="STDDEV"), fits.ImageHDU(bad, name="QUALITY")
    image = pachon.load_image(write(tmp_path / "a.fits", fits.PrimaryHDU(field.image, header_of()), *planes))
    np.testing.assert_allclose(image.variance[bad == 0], field.variance[bad == 0], rtol=1e-5)
    np.testing.assert_array_equal(image.mask != 0, bad != 0)


@pytest.mark.parametrize(
    ("kind", "options"), [(fits.ImageHDU, {}), (fits.CompImageHDU, {"compression_type": "GZIP_2", "quantize_level": 0})]
)
def test_axes_of_length_one_are_none(field, tmp_path, kind, options):
    """Images with NAXIS3 = 1, as of one frequency, were said to have no two axes."""
    plane = header_of(WCSAXES=4, CTYPE3="FREQ", CRVAL3=4.8e14, CDELT3=1.0, CRPIX3=1.0, CTYPE4="STOKES")
    parts = kind(field.image[None, None], plane, **options), fits.ImageHDU(field.variance[None], name="VARIANCE")
    image = pachon.load_image(write(tmp_path / "a.fits", fits.PrimaryHDU(), *parts))
    flat = fits.PrimaryHDU(field.image, header_of()), fits.ImageHDU(field.variance, name="VARIANCE")
    expected = pachon.load_image(write(tmp_path / "b.fits", *flat))
    np.testing.assert_array_equal(image.image, expected.image)
    np.testing.assert_array_equal(image.variance, expected.variance)
    pixel = np.array([[10.0, 20.0]])
    np.testing.assert_array_equal(image.celestial(pixel), expected.celestial(pixel))


def test_flags_of_jwst_that_mark_corrected_pixels_are_harmless(field, tmp_path):
    """Jumps that were taken out of ramps stand in the cores of most bright stars: no star was left."""
    flags = np.full(field.image.shape, 4, np.uint32)
    flags[5, 7], flags[8, 9], flags[11, 12] = 1 | 4, 2 | 4, 1 | 2
    planes = fits.ImageHDU(np.sqrt(field.variance), name="ERR"), fits.ImageHDU(flags, name="DQ")
    primary = fits.PrimaryHDU(header=fits.Header({"TELESCOP": "JWST", "INSTRUME": "NIRCAM"}))
    path = write(tmp_path / "a_cal.fits", primary, fits.ImageHDU(field.image, header_of(), name="SCI"), *planes)
    image = pachon.load_image(path)
    saturated, bad = 1, 2
    assert [image.mask[place] for place in ((5, 7), (8, 9), (11, 12))] == [bad, saturated, saturated]
    assert (image.mask != 0).sum() == 3
