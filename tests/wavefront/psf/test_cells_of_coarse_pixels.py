"""Pixels as wide as the image of a star or wider: each holds the light that finer pixels share there."""

import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC
from pachon.models.ideal_telescope import ideal_telescope

WAVE, SHARE = 650e-9, 5
#: Without aberrations, so that images are as sharp as diffraction lets them be.
IDEAL = ideal_telescope(pachon.load_telescope("lsst_v3.3_r"))
FIELDS = [(0.0, 0.0), (1e-4, -2e-4)]


def light(pixel, size, air, offset, diffusion):
    """Light in pixels of an angle [arcsec], as a fraction of all of the star's, [star, y, x]; diffusion [arcsec]."""
    pixel, diffusion = (angle * ARCSEC * IDEAL.reference_sphere_radius for angle in (pixel, diffusion))
    stamps = pachon.Stamps(size, pixel, diffusion=diffusion, offsets=[offset] * len(FIELDS))
    psfs = pachon.make_psfs(IDEAL, FIELDS, [WAVE], stamps=stamps, atmosphere=air, threads=1)
    return psfs.image * psfs.inside[:, None, None]


def turbulence():
    screens = pachon.ScreenSampling(screen_size=1024, screen_length=200.0)
    site = pachon.models.load_site("cerro_pachon").with_layers([0.0, 8000.0], [0.6, 0.4], [5.0, 12.0])
    return pachon.Atmosphere.from_site(site, 3, exposure=2.0, screens=screens)


@pytest.mark.parametrize(
    ("pixel", "air", "diffusion", "largest"),
    [
        (0.8, turbulence, 0.0, 2e-3),
        (2.5, turbulence, 0.0, 2e-3),
        (2.5, turbulence, 1.0, 2e-3),
        (0.1, None, 0.0, 6e-3),
        (0.2, None, 0.0, 6e-3),
    ],
)
def test_light_of_a_coarse_pixel_is_that_of_its_fine_ones(pixel, air, diffusion, largest):
    """With the usual cells of half a pixel, the brightest pixel of 2.5 arcsec had 1.3 of the light of the star."""
    air = air and air()
    offset = np.array([0.0, 0.4])
    coarse = light(pixel, 7, air, offset, diffusion)
    fine = light(pixel / SHARE, 7 * SHARE, air, SHARE * offset, diffusion)
    binned = fine.reshape(len(FIELDS), 7, SHARE, 7, SHARE).sum(axis=(2, 4))
    inner = np.s_[:, 1:-1, 1:-1]
    assert coarse[inner] == pytest.approx(binned[inner], abs=largest * binned.max())
