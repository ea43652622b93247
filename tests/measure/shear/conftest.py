import numpy as np
import pytest

SIDE, SCALE = 64, 0.2 * np.pi / 648000


@pytest.fixture(scope="session")
def gaussian():
    """``gaussian(covariance, side, x, y)``: unit sum, sampled at pixel centres, (x, y) from the centre of the stamp."""

    def image(covariance, side=SIDE, x=0.0, y=0.0):
        v, u = np.indices((side, side)) - 0.5 * (side - 1)
        d = np.stack([u - x, v - y], axis=-1)
        value = np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(covariance), d))
        return value / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))

    return image


@pytest.fixture(scope="session")
def psf_covariances():
    """Of two elliptical PSFs [pixel^2]."""
    return np.array([[[2.5, 0.15], [0.15, 2.2]], [[1.9, -0.1], [-0.1, 2.3]]])


@pytest.fixture(scope="session")
def psfs(gaussian, psf_covariances):
    images = np.stack([gaussian(c, 31) for c in psf_covariances])
    return images / images.sum(axis=(1, 2), keepdims=True)
