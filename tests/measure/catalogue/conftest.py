import numpy as np
import pytest


@pytest.fixture(scope="session")
def psf_profile():
    """Sum of two Gaussians apart from each other, neither round nor symmetric; pixels of unit side included."""
    galsim = pytest.importorskip("galsim")
    core = galsim.Gaussian(sigma=1.4).shear(g1=0.05, g2=-0.03)
    both = core + 0.3 * galsim.Gaussian(sigma=2.0).shift(0.4, -0.3)
    return galsim.Convolve(both, galsim.Pixel(1.0)).withFlux(1.0)


@pytest.fixture(scope="session")
def draw():
    """``draw(profile, side)``: the profile on side x side pixels, by GalSim at an accuracy of 1e-6 or better."""
    galsim = pytest.importorskip("galsim")
    exact = galsim.GSParams(folding_threshold=1e-5, kvalue_accuracy=1e-9, maxk_threshold=1e-7, maximum_fft_size=8192)

    def of(profile, side):
        sharp = profile.withGSParams(exact)
        return sharp.drawImage(nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float).array.copy()

    return of


@pytest.fixture(scope="session")
def psf(psf_profile, draw):
    """The PSF on 33 x 33 pixels, of unit sum to 1e-7."""
    return draw(psf_profile, 33)


@pytest.fixture(scope="session")
def render(psf_profile, draw):
    """``render(profile, side, x, y)``: a profile before the PSF on a stamp, x and y from its centre."""
    galsim = pytest.importorskip("galsim")

    def of(profile, side=32, x=0.0, y=0.0):
        return draw(galsim.Convolve(profile.shift(x, y), psf_profile), side)

    return of


@pytest.fixture(scope="session")
def gaussians(render):
    """Stamps of elliptical Gaussians of many sizes, shapes and places, and what they are."""
    galsim = pytest.importorskip("galsim")
    rng = np.random.default_rng(11)
    n = 24
    true = {
        "flux": rng.uniform(10.0, 1000.0, n),
        "size": rng.uniform(0.4, 3.0, n),
        "x": rng.uniform(-0.7, 0.7, n),
        "y": rng.uniform(-0.7, 0.7, n),
    }
    e, angle = rng.uniform(0.0, 0.6, n), rng.uniform(0.0, np.pi, n)
    true |= {"e1": e * np.cos(2.0 * angle), "e2": e * np.sin(2.0 * angle)}
    profiles = [
        galsim.Gaussian(sigma=size, flux=flux).shear(g1=e1, g2=e2)
        for size, flux, e1, e2 in zip(true["size"], true["flux"], true["e1"], true["e2"], strict=True)
    ]
    return np.stack([render(p, 32, x, y) for p, x, y in zip(profiles, true["x"], true["y"], strict=True)]), true
