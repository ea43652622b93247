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
