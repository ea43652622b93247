"""Frames of Euclid's VIS: three extensions a quadrant, and flags of which many mark objects and areas."""

import numpy as np
import pytest
from astropy.io import fits
from drawn_fields import header_of

import pachon
from pachon.core.errors import ProductError
from pachon.imaging.image_formats.load import image_sources

SATURATED, BAD = 1, 2


@pytest.fixture(scope="module")
def frame(field, tmp_path_factory):
    flags = np.full(field.image.shape, 1 << 24 | 1 << 18, dtype=np.int32)  # objects and light of stars
    flags[10, 10], flags[11, 11], flags[12, 12], flags[13, 13] = 1 << 3, 1 << 4, 1 << 6, 1 << 0 | 1 << 3
    hdus = [fits.PrimaryHDU()]
    for quadrant in ("3-4.E", "3-4.F"):
        hdus += [
            fits.ImageHDU(flags, name=f"{quadrant}.FLG"),
            fits.ImageHDU(field.image, header_of(), name=f"{quadrant}.SCI"),
            fits.ImageHDU(np.sqrt(field.variance).astype(np.float32), name=f"{quadrant}.RMS"),
        ]
    path = tmp_path_factory.mktemp("euclid") / "vis.fits"
    fits.HDUList(hdus).writeto(path)
    return path


def test_a_quadrant_has_its_planes(field, frame):
    assert [source.extension for source in image_sources(frame)] == ["3-4.E.SCI", "3-4.F.SCI"]
    image = pachon.load_image(frame, extension="3-4.F.SCI")
    np.testing.assert_allclose(image.variance[image.mask == 0], field.variance[image.mask == 0], rtol=1e-5)
    at = {(10, 10): SATURATED, (11, 11): BAD, (12, 12): 0, (13, 13): SATURATED, (100, 100): 0}
    assert {place: image.mask[place] for place in at} == at


def test_which_quadrant_is_asked_for(frame):
    with pytest.raises(ProductError, match=r"has 2 images: expected extension = one of 3-4\.E\.SCI, 3-4\.F\.SCI"):
        pachon.load_image(frame)
