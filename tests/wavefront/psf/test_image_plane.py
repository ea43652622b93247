"""The detector's transfer function against the closed form of a diffused point seen by square pixels."""

import numpy as np
import pytest
from astropy import units as u
from scipy.special import erf

from pachon.core.errors import DomainError
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.psf.image_plane import ImagePlane, focal_length, square_transfer
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

ARCSEC = np.pi / 180 / 3600


@pytest.mark.parametrize(("diffusion", "jitter"), [(4e-6, 0.0), (0.0, 4e-6), (2.4e-6, 3.2e-6)])
def test_transfer_is_that_of_a_gaussian_integrated_over_pixels(diffusion, jitter):
    """Diffusion and jitter add in quadrature, here to 4 um always."""
    plane = ImagePlane(9, 10e-6, diffusion, jitter)
    # Inverse transform of pixel and diffusion on a period of 400 um, at the pixel centres.
    side, count = 400e-6, 400
    k = 2 * np.pi * np.fft.fftfreq(count, side / count)
    to_pixels = np.exp(1j * np.outer(plane.pixel_centers - 1.7e-6, k))
    to_rows = np.exp(1j * np.outer(plane.pixel_centers + 3.1e-6, k))
    image = (to_rows @ plane.transfer(k, k[:, None]) @ to_pixels.T).real * (plane.pixel_size / side) ** 2

    def share(center):
        edges = plane.pixel_centers[:, None] + np.array([-5e-6, 5e-6]) - center
        return np.diff(0.5 * erf(edges / (np.sqrt(2) * 4e-6)), axis=1)[:, 0]

    # The Gaussian has fallen to 1e-11 at the highest frequency (pi/um) and to nothing at half the period.
    np.testing.assert_allclose(image, np.outer(share(-3.1e-6), share(1.7e-6)), atol=1e-9)


def test_square_transfer_is_the_mean_of_a_wave_over_the_square():
    x = (np.arange(1000) + 0.5) / 1000 * 3e-6 - 1.5e-6
    kx, ky = 4e5, -9e5
    mean = np.mean(np.cos(kx * x)) * np.mean(np.cos(ky * x))
    # The midpoint rule over 1000 strips is good to (k h)^2 / 24.
    assert square_transfer(kx, ky, 3e-6) == pytest.approx(mean, abs=1e-6)


def test_stamp_geometry():
    odd, even = ImagePlane(5, 2e-6, 0.0), ImagePlane(4, 2e-6, 0.0)
    np.testing.assert_allclose(odd.pixel_centers, np.array([-2, -1, 0, 1, 2]) * 2e-6)
    np.testing.assert_allclose(even.pixel_centers, np.array([-2, -1, 0, 1]) * 2e-6)
    assert odd.side == pytest.approx(10e-6)
    assert odd.transfer(np.array(0.0), np.array(0.0)) == 1.0


def test_focal_length_of_a_turned_and_stretched_jacobian():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    jacobian = turn @ np.diag([10.0, -10.4]) @ turn.T
    np.testing.assert_allclose(focal_length(np.stack([jacobian, 2 * np.eye(2)])), [np.sqrt(104.0), 2.0])


@pytest.mark.parametrize("engine", ["fast", pytest.param("wave", marks=pytest.mark.slow)])
def test_jitter_adds_to_the_variance_of_an_image(lsst_r, engine):
    """Seeing of 0.5 arcsec, unweighted moments over 13 arcsec, in which all but the far wings lie."""
    atmosphere = Atmosphere.from_site(
        "cerro_pachon",
        4,
        exposure=0.2,
        screens=ScreenSampling(screen_size=256, screen_length=40.96, fine_size=1024, fine_pixel=0.02),
    )
    sigma = 0.3
    options = {"atmosphere": atmosphere, "engine": engine, "threads": 2}
    variance = []
    for jitter in (0.0, sigma * u.arcsec):
        psf = make_psfs(lsst_r, [[0.01, 0.005]], [620e-9], stamps=Stamps(63, jitter=jitter), **options)
        image, place = psf.image[0].astype(float), (np.arange(63) - 31) * psf.pixel_scale / ARCSEC
        x, y = np.meshgrid(place, place)
        x, y = (v - np.average(v, weights=image) for v in (x, y))
        variance.append([np.average(v, weights=image) for v in (x * x, y * y, x * y)])
    # Wings that leave the stamp take half a per cent of the variance along; so does the scale of the field.
    np.testing.assert_allclose(np.diff(variance, axis=0)[0], [sigma**2, sigma**2, 0.0], atol=0.01 * sigma**2)


@pytest.mark.parametrize(
    ("jitter", "named"), [(-1e-7, "jitter = -1e-07"), (np.nan, "jitter = nan"), (1 * u.m, "jitter"), ([0, 0], "jitter")]
)
def test_bad_jitter_is_named(jitter, named):
    with pytest.raises(DomainError, match=named):
        Stamps(jitter=jitter)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((2, 1e-5, 0.0), "size"),
        ((9.5, 1e-5, 0.0), "size"),
        ((9, 0.0, 0.0), "pixel_size"),
        ((9, np.nan, 0.0), "pixel_size"),
        ((9, 1e-5, -1e-6), "diffusion"),
        ((9, 1e-5, np.inf), "diffusion"),
        ((9, 1e-5, 0.0, -1e-6), "jitter"),
        ((9, 1e-5, 0.0, np.nan), "jitter"),
    ],
)
def test_refuses_what_is_no_stamp(arguments, named):
    with pytest.raises(DomainError, match=named):
        ImagePlane(*arguments)
