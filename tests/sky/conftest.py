import numpy as np
import pytest
from astropy.io import fits

from pachon.core.units import ARCSEC
from pachon.sky.galaxies import Galaxies
from pachon.sky.population import draw_galaxies

PIXEL = 0.03 * ARCSEC
SIDE = 800
ZERO_POINT = 25.65
#: Of the Gaussian PSF [pixel], and of the noise.
SIGMA, NOISE = 1.2, 0.003


class Sky:
    """A mosaic drawn from random galaxies and stars, and what is in it."""

    def __init__(self, path):
        self.path = path
        self.pixel, self.zero_point, self.side, self.noise = PIXEL, ZERO_POINT, SIDE, NOISE
        self.psf_radius = np.sqrt(2.0 * np.log(2.0)) * SIGMA * PIXEL
        # East to the left, north up.
        self.jacobian = np.array([[-1.0, 0.0], [0.0, 1.0]]) / PIXEL
        self.galaxies = draw_galaxies(0.45 * SIDE * PIXEL, 26.5, 7)
        rng = np.random.default_rng(1)
        self.stars = rng.uniform(60, SIDE - 60, (12, 2))
        # Points, to the resolution of the mosaic.
        points = Galaxies.single(np.zeros(12), np.zeros(12), np.linspace(21.0, 24.0, 12), 1e-3 * ARCSEC)
        image = np.zeros((SIDE + 256, SIDE + 256))
        centers = np.stack([self.galaxies.xi, self.galaxies.eta], axis=-1) @ self.jacobian.T + SIDE / 2
        for galaxies, places in ((self.galaxies, centers), (points, self.stars)):
            n = len(galaxies)
            pixels = np.rint(places).astype(int)
            jacobian = np.broadcast_to(self.jacobian, (n, 2, 2))
            transform = galaxies.transform(np.arange(n), jacobian, places - pixels, 128)
            k = np.fft.rfftfreq(128) ** 2 + np.fft.fftfreq(128)[:, None] ** 2
            stamps = np.fft.fftshift(np.fft.irfft2(transform * np.exp(-2 * (np.pi * SIGMA) ** 2 * k)), axes=(1, 2))
            for stamp, magnitude, (x, y) in zip(stamps, galaxies.magnitude, pixels, strict=True):
                image[y + 64 : y + 192, x + 64 : x + 192] += stamp * 10.0 ** (-0.4 * (magnitude - ZERO_POINT))
        self.image = image[128:-128, 128:-128] + rng.normal(0.0, NOISE, (SIDE, SIDE))
        self.header = fits.Header()
        cards = {
            "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 53.16, "CRVAL2": -27.79, "CRPIX1": SIDE / 2,
            "CRPIX2": SIDE / 2, "CD1_1": -0.03 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.03 / 3600,
            "MAGZPT": ZERO_POINT,
        }  # fmt: skip
        self.header.update(cards)
        fits.PrimaryHDU(self.image.astype(np.float32), self.header).writeto(path)


@pytest.fixture(scope="session")
def mosaic(tmp_path_factory):
    """A mosaic of 24 arcsec, with galaxies to 26.5 and twelve stars."""
    return Sky(tmp_path_factory.mktemp("mosaic") / "mosaic.fits")
