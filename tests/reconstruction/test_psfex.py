"""PSFEx models against GalSim's drawing of them."""

import numpy as np
import pytest
from astropy.io import fits

import pachon
from pachon.core.errors import ProductError


def write_model(path, sampling=0.8, order=2, side=31, **cards):
    rng = np.random.default_rng(1)
    yy, xx = (np.indices((side, side)) - side // 2) * sampling
    base = (1.0 + (xx**2 + 1.1 * yy**2) / 8.0) ** -3.0
    base /= base.sum()
    count = (order + 1) * (order + 2) // 2
    terms = [0.02 * base * np.tanh(0.2 * (xx * a + yy * b + xx * yy * c)) for a, b, c in rng.normal(size=(count, 3))]
    images = np.stack([base, *terms[1:]]).astype(np.float32)
    column = fits.Column("PSF_MASK", format=f"{images.size}E", dim=f"({side},{side},{count})", array=[images])
    hdu = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    polynomial = {"POLNAXIS": 2, "POLGRP1": 1, "POLNAME1": "X_IMAGE", "POLZERO1": 1024.0, "POLSCAL1": 2000.0,
                  "POLGRP2": 1, "POLNAME2": "Y_IMAGE", "POLZERO2": 2048.0, "POLSCAL2": 4000.0, "POLNGRP": 1,
                  "POLDEG1": order}  # fmt: skip
    hdu.header.update(polynomial | {"PSF_FWHM": 4.0, "PSF_SAMP": sampling, "PSFNAXIS": 3, "PSFAXIS1": side})
    hdu.header.update({"PSFAXIS2": side, "PSFAXIS3": count} | cards)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize("sampling", [0.8, 1.0, 1.3])
def test_stamps_are_those_of_galsim(tmp_path, sampling):
    galsim = pytest.importorskip("galsim")
    des = pytest.importorskip("galsim.des")
    path = write_model(tmp_path / "a.psf", sampling)
    model, peer = pachon.reconstruction.load_psfex(path), des.DES_PSFEx(str(path))
    for place in ((100.0, 300.0), (1900.0, 3000.0)):
        image = peer.getPSF(galsim.PositionD(*place)).drawImage(nx=25, ny=25, scale=1.0, method="no_pixel").array
        # Single precision, and GalSim's Fourier transforms.
        np.testing.assert_allclose(model.at([place])[0], image / image.sum(), atol=1e-5 * image.max())


@pytest.mark.parametrize("kind", ["", "WIN", "PSF", "PEAK"])
def test_positions_of_each_kind_are_taken_along_both_axes(tmp_path, kind):
    names = {f"POLNAME{i}": f"{axis}{kind}_IMAGE" for i, axis in ((1, "X"), (2, "Y"))}
    assert pachon.reconstruction.load_psfex(write_model(tmp_path / "a.psf", **names)).order == 2


@pytest.mark.parametrize(
    ("cards", "text"),
    [
        ({"POLNAME1": "R_MAG"}, "POLNAME1 = 'R_MAG': expected X_IMAGE, the position in pixels"),
        ({"POLNAXIS": 3}, "POLNAXIS = 3: expected 0, or 2"),
        # Of degrees 2 and 1 there are six products of powers, too.
        ({"POLNGRP": 2, "POLGRP2": 2, "POLDEG2": 1}, "POLNGRP = 2: expected 1, x and y in one polynomial"),
        ({"POLDEG1": 3}, r"PSF_MASK has shape \(6, 31, 31\): expected 10 images"),
        ({"PSF_SAMP": "half"}, "PSF_SAMP = 'half': expected a number"),
        ({"PSF_SAMP": 0.0}, "PSF_SAMP = 0.0: expected a number above 0"),
        ({"POLSCAL1": 0.0}, "POLSCAL1 = 0.0: expected a number above 0"),
    ],
)
def test_what_is_no_model_of_pixels_is_one_line(tmp_path, cards, text):
    with pytest.raises(ProductError, match=rf"a\.psf: {text}"):
        pachon.reconstruction.load_psfex(write_model(tmp_path / "a.psf", **cards))


def test_files_that_are_no_models(tmp_path):
    with pytest.raises(ProductError, match="no such file"):
        pachon.reconstruction.load_psfex(tmp_path / "none.psf")
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "a.psf")
    with pytest.raises(ProductError, match="no model of PSFEx"):
        pachon.reconstruction.load_psfex(tmp_path / "a.psf")
    (tmp_path / "a.psf").write_bytes(b"text")
    with pytest.raises(ProductError, match="damaged or no FITS file of PSFEx"):
        pachon.reconstruction.load_psfex(tmp_path / "a.psf")


def test_models_of_several_images_are_refused(tmp_path):
    """SExtractor and PSFEx make one of each CCD of an exposure; the first one was taken for all."""
    path = write_model(tmp_path / "a.psf")
    with fits.open(path) as hdus:
        fits.HDUList([fits.PrimaryHDU(), hdus[1].copy(), hdus[1].copy()]).writeto(tmp_path / "b.psf")
    with pytest.raises(ProductError, match=r"b\.psf: has 2 models of PSFEx, those of as many images: expected a file"):
        pachon.reconstruction.load_psfex(tmp_path / "b.psf")
