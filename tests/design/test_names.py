"""Names in any script, with dollar signs, come through products and pictures; control characters are refused."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from pachon.core.errors import PrescriptionError
from pachon.core.plotting import png_bytes
from pachon.core.products import write_fits
from pachon.design.layout.layout import layout
from pachon.design.metrics.footprint import footprint
from pachon.design.metrics.spots import spots
from pachon.design.optimize.sensitivity import sensitivity
from pachon.design.optimize.sensitivity_file import write_sensitivity
from pachon.models.io.prescription import load_telescope
from pachon.wavefront.opd import wavefront_opd

NAME = "Müller 望 $x^{$"
ESCAPED = r"M\xfcller \u671b $x^{$"


@pytest.fixture(scope="module")
def telescope():
    plain = load_telescope("paul_baker")
    surfaces = (replace(plain.surfaces[0], name=NAME), *plain.surfaces[1:])
    return replace(plain, name=NAME, surfaces=surfaces, groups={})


def test_products_have_names_in_ascii(telescope, tmp_path):
    write_fits(tmp_path / "a.fits", [], None, [("TELESCOP", telescope.name, "prescription"), ("N", 3, "")])
    header = fits.getheader(tmp_path / "a.fits")
    assert (header["TELESCOP"], header["N"]) == (ESCAPED, 3)
    write_sensitivity(tmp_path / "b.fits", sensitivity(telescope, [f"{NAME}.dz"], np.zeros((1, 2)), n_zernike=4))
    with fits.open(tmp_path / "b.fits") as hdus:
        assert hdus[0].header["TELESCOP"] == ESCAPED
        assert list(hdus["PARAMETERS"].data["ADDRESS"]) == [f"{ESCAPED}.dz"]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Glyph .* missing from font")
def test_pictures_draw_names_letter_by_letter(telescope):
    opd = wavefront_opd(telescope, field=(0.0, 0.0), wavelength=500e-9, grid=8)
    figures = [
        layout(telescope).plot(),
        spots(telescope, [(0.0, 0.0)]).plot(),
        footprint(telescope, telescope.surfaces[0].name, [(0.0, 0.0)]).plot(),
        sensitivity(telescope, [f"{NAME}.dz", f"{NAME}.dx"], np.zeros((1, 2)), n_zernike=4).plot(),
        opd.plot(name=telescope.name),
    ]
    for figure in figures:
        assert png_bytes(figure).startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["a\tb", "a\x1b[31m", "a\nb", "a\x00", "\ud800"])
def test_control_characters_in_names_are_refused_in_one_line(telescope, name):
    with pytest.raises(PrescriptionError, match=r"^name = ") as caught:
        replace(telescope, name=name)
    assert str(caught.value).isprintable()
    first, *others = telescope.surfaces
    with pytest.raises(PrescriptionError, match=r"^surface name = "):
        replace(telescope, surfaces=(replace(first, name=name), *others))
