from pathlib import Path

import pytest
from astropy.io import fits

from pachon.core.errors import ProductError
from pachon.core.mask_planes import bad_bits, plane_card, planes_in

FILE = Path("mask.fits")


def test_all_planes_but_harmless_ones_are_bad():
    header = fits.Header({"MP_BAD": 0, "MP_SAT": 1, "HIERARCH MP_DETECTED": 5, "MP_HOT": 6, "HIERARCH MP_CROSSTALK": 9})
    assert planes_in(header, FILE) == {"BAD": 0, "SAT": 1, "DETECTED": 5, "HOT": 6, "CROSSTALK": 9}
    # Of planes that are not known the pixels are bad.
    assert bad_bits(header, FILE) == 1 | 2 | 64
    assert bad_bits(fits.Header(), FILE) == -1
    with pytest.raises(
        ProductError, match=r"mask\.fits: MP_BAD = 63: expected the number of a bit of the mask, 0 to 62"
    ):
        bad_bits({"MP_BAD": 63}, FILE)


def test_pixels_that_an_image_of_a_stack_is_left_out_of_are_harmless():
    """INEXACT_PSF is the union of the three; bright cores of stars are often clipped."""
    names = ("CLIPPED", "REJECTED", "SENSOR_EDGE", "INEXACT_PSF", "NO_DATA")
    header = fits.Header({f"HIERARCH MP_{name}": bit for bit, name in enumerate(names)})
    assert bad_bits(header, FILE) == 1 << names.index("NO_DATA")


@pytest.mark.parametrize("name", ["SAT", "NO_DATA"])
def test_cards_of_planes_are_read_as_they_were_written(name):
    header = fits.Header()
    header.append(plane_card(name, 8))
    assert planes_in(header, FILE) == {name: 3}
