"""Models of galaxies against a sum over frequencies, their derivatives against differences."""

import numpy as np
import pytest

from pachon.measure.catalogue.gaussian_model import PARAMETERS, GaussianStamps

SIDE = 32
PARAMS = np.array(
    [[50.0, 0.31, -0.44, 4.0, 1.1, 2.5], [20.0, -0.2, 0.1, 0.6, -0.2, 0.3], [9.0, 0.0, 0.3, -0.1, 0.0, 0.2]]
)


def plain_model(psf, params, side, period):
    """The sum over frequencies of the module's docstring, all written out."""
    flux, x0, y0, xx, xy, yy = params
    k = 2.0 * np.pi * np.fft.fftfreq(period)
    kx, ky = np.meshgrid(k, k)
    at = np.arange(len(psf)) - len(psf) // 2
    transform = np.exp(-1j * np.outer(k, at)) @ psf @ np.exp(-1j * np.outer(at, k))
    spectrum = transform * np.exp(-0.5 * (xx * kx**2 + 2.0 * xy * kx * ky + yy * ky**2) - 1j * (kx * x0 + ky * y0))
    place = np.arange(side) - 0.5 * (side - 1)
    image = np.exp(1j * np.outer(place, k)) @ spectrum @ np.exp(1j * np.outer(k, place))
    return flux * image.real / period**2


@pytest.fixture(scope="module")
def stamps(psf):
    rng = np.random.default_rng(2)
    data, weight = rng.normal(size=(2, len(PARAMS), SIDE, SIDE))
    return GaussianStamps(psf[None], np.zeros(len(PARAMS), dtype=int), data, weight**2, threads=1), data, weight**2


def test_models_are_the_sum_over_frequencies(stamps, psf):
    drawn = stamps[0].derivatives(PARAMS)[:, 0] * PARAMS[:, 0, None, None]
    for image, params in zip(drawn, PARAMS, strict=True):
        expected = plain_model(psf, params, SIDE, stamps[0].period)
        np.testing.assert_allclose(image, expected, rtol=0, atol=1e-13 * params[0])  # rounding


@pytest.mark.parametrize("k", range(len(PARAMETERS)))
def test_derivatives_are_central_differences(stamps, psf, k, slope):
    drawn = stamps[0].derivatives(PARAMS)[:, k]
    for image, params in zip(drawn, PARAMS, strict=True):
        moved = np.eye(len(PARAMETERS))[k]
        found = slope(lambda h, p=params, m=moved: plain_model(psf, p + h * m, SIDE, stamps[0].period), 1e-3)
        # Differences of fourth order: 1e-12 of the fifth derivative, rounding over the step.
        np.testing.assert_allclose(image, found, rtol=0, atol=1e-10 * params[0])


def test_normal_equations_are_sums_over_pixels(stamps):
    model, data, weight = stamps
    derivative = model.derivatives(PARAMS)
    residual = data - derivative[:, 0] * PARAMS[:, 0, None, None]
    found = model.normal_equations(PARAMS, np.arange(len(PARAMS)))
    np.testing.assert_allclose(found.chi2, (weight * residual**2).sum(axis=(1, 2)), rtol=1e-12)
    right = np.einsum("nyx,nyx,nkyx->nk", weight, residual, derivative)
    scale = np.sqrt(np.einsum("nyx,nkyx->nk", weight, derivative**2))
    np.testing.assert_allclose(found.right / scale, right / scale, rtol=0, atol=1e-12 * np.sqrt(found.chi2.max()))
    matrix = np.einsum("nyx,njyx,nkyx->njk", weight, derivative, derivative)
    np.testing.assert_allclose(found.matrix / (scale[:, :, None] * scale[:, None]),
                               matrix / (scale[:, :, None] * scale[:, None]), rtol=0, atol=1e-13)  # fmt: skip


def test_light_beyond_an_edge_does_not_come_in_at_the_other(psf):
    # A point at the edge of the stamp: its PSF reaches 16 pixels beyond, where a period of the stamp alone would wrap.
    stamps = GaussianStamps(psf[None], np.zeros(1, dtype=int), *np.ones((2, 1, SIDE, SIDE)))
    image = stamps.derivatives(np.array([[1.0, 15.5, 0.5, 0.0, 0.0, 0.0]]))[0, 0]
    np.testing.assert_allclose(image[16 - 16 : 16 + 16, -1], psf[:32, 16], rtol=0, atol=1e-15)
    assert np.abs(image[:, :15]).max() < 1e-15
