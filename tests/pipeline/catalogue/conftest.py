import numpy as np
import pytest

galsim = pytest.importorskip("galsim")

#: Sum of two Gaussians apart from each other, so that the PSF is neither round nor symmetric; pixels of unit side.
PSF = galsim.Convolve(
    galsim.Gaussian(sigma=1.4).shear(g1=0.05, g2=-0.03) + 0.3 * galsim.Gaussian(sigma=2.0).shift(0.4, -0.3),
    galsim.Pixel(1.0),
).withFlux(1.0)
EXACT = galsim.GSParams(folding_threshold=1e-5, kvalue_accuracy=1e-9, maxk_threshold=1e-7, maximum_fft_size=8192)


@pytest.fixture(scope="session")
def psf():
    """The PSF on 33 x 33 pixels, of unit sum to 1e-7."""
    return draw(PSF, 33)


@pytest.fixture(scope="session")
def psf_profile():
    return PSF


@pytest.fixture(scope="session")
def render():
    """``render(profile, side, x, y)``: a profile before the PSF on a stamp, x and y from its centre, by GalSim."""

    def of(profile, side=32, x=0.0, y=0.0):
        return draw(galsim.Convolve(profile.shift(x, y), PSF), side)

    return of


def draw(profile, side):
    sharp = profile.withGSParams(EXACT)
    return sharp.drawImage(nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float).array.copy()


@pytest.fixture(scope="session")
def gaussians(render):
    """Stamps of elliptical Gaussians of many sizes, shapes and places, and what they are."""
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
    stamps = [
        render(
            galsim.Gaussian(sigma=true["size"][i], flux=true["flux"][i]).shear(g1=true["e1"][i], g2=true["e2"][i]),
            32,
            true["x"][i],
            true["y"][i],
        )
        for i in range(n)
    ]
    return np.stack(stamps), true
