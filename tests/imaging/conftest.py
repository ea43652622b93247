import numpy as np
import pytest

import pachon
from pachon.imaging.psf_field import PsfField
from pachon.imaging.wcs import ccd_wcs
from pachon.pipeline.experiment import Experiment

PIXELS = 4096


@pytest.fixture(scope="session")
def wcs(lsst_r):
    """World coordinates of a CCD away from the axis, rolled."""
    return ccd_wcs(lsst_r, pachon.lsst_camera(), "R22_S12", pointing=(1.0, -0.5), position_angle=0.4)


@pytest.fixture(scope="session")
def gaussian():
    """``gaussian(size, covariance, center)``: unit sum, sampled at the centres of pixels, about the middle one."""

    def image(size, covariance, center=(0.0, 0.0)):
        y, x = np.indices((size, size)) - size // 2
        d = np.stack([x - center[0], y - center[1]], axis=-1)
        value = np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(covariance), d))
        return value / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))

    return image


@pytest.fixture(scope="session")
def psf_covariance():
    """Covariance of the Gaussian PSF at a pixel of the CCD [pixel^2]: larger and more elongated towards its corners."""

    def covariance(pixel):
        u, v = 2.0 * np.asarray(pixel) / PIXELS - 1.0
        return np.array([[2.0 + 0.3 * u, 0.25 * v], [0.25 * v, 1.7 - 0.2 * v]])

    return covariance


@pytest.fixture(scope="session")
def psf(gaussian, psf_covariance):
    """Gaussian PSFs whose covariance changes over the CCD, and a lit fraction that falls along x."""
    rng = np.random.default_rng(3)
    places = rng.uniform(0, PIXELS, (60, 2))
    stamps = np.stack([gaussian(31, psf_covariance(place)) for place in places])
    return PsfField.fit(stamps, places, PIXELS, lit_fraction=1.0 - 0.1 * places[:, 0] / PIXELS)


@pytest.fixture(scope="session")
def small_run(tiny):
    """Experiment whose PSFs take a tenth of a second: the mean over all turbulence."""
    return Experiment.from_config(
        tiny(ccds=("R22_S11",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=63, stars__truth=24)
    )
