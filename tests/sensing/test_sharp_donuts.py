"""Sharp, large and small donuts: wavefronts within the claimed errors, at a cost that hardly depends on the blur."""

import time

import numpy as np
import pytest
from donut_images import WAVELENGTH, blurred, donut, fine_bins, noisy

import pachon

FIELD = np.deg2rad([0.6, 0.9])
PIXEL, SIZE, SKY = 10e-6, 182, 500.0


@pytest.fixture(scope="module")
def wave():
    values = np.zeros(22)
    values[3:] = np.random.default_rng(8).normal(size=19)
    return 100e-9 * values / np.linalg.norm(values)


@pytest.fixture(scope="module")
def bins(behind_focus, wave):
    return fine_bins(behind_focus, FIELD, wave, (0.7, -1.2), 2000, SIZE, PIXEL, fine=4)


def fitted(tel, image, blur, **air):
    detector = pachon.DonutDetector(pixel_size=PIXEL, diffusion=0.0 if blur is None else blur * PIXEL)
    model = pachon.DonutModel(
        air=pachon.DonutAir(fwhm=0.0 if blur is not None else None), detector=detector, diffraction=False
    )
    start = time.process_time()
    fit = pachon.fit_donuts(tel, image[None], [FIELD], WAVELENGTH, sky_variance=SKY, model=model, threads=1)
    return fit, time.process_time() - start


def drawn(bins, blur, seed=3):
    return np.random.default_rng(seed).poisson(blurred(bins, blur, 5e6, fine=4) + SKY) - SKY


@pytest.mark.slow
def test_a_sharp_donut_costs_little_more_than_a_blurred_one(behind_focus, wave, bins):
    """Before, 200 times as much: grids of five cells a pixel, with Fourier transforms for every derivative."""
    images = {blur: drawn(bins, blur) for blur in (0.0, 2.0)}
    least = dict.fromkeys(images, np.inf)
    for _ in range(3):
        for blur, image in images.items():
            fit, seconds = fitted(behind_focus, image, blur)
            least[blur] = min(least[blur], seconds)
            error = fit.zernikes[0] - wave[3:]
            assert fit.reasons == [""]
            assert error @ np.linalg.solve(fit.covariance[0], error) < 45.0  # 19 terms
    assert least[0.0] < 10.0 * least[2.0]


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0.0, 0.5])
def test_free_seeing_of_sharp_donuts_converges(behind_focus, wave, bins, blur):
    fit, _ = fitted(behind_focus, drawn(bins, blur), None)
    assert fit.reasons == [""]
    error = fit.zernikes[0] - wave[3:]
    assert error @ np.linalg.solve(fit.covariance[0], error) < 45.0
    # Of a Gaussian of so many pixels of 0.2"; one of half a pixel is 0.24" wide, and no Kolmogorov's.
    width = np.rad2deg(fit.fwhm[0]) * 3600.0
    assert width < 0.02 if blur == 0.0 else 0.1 < width < 0.26


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0.0, 0.2, 0.5, 1.0])
def test_sharp_donuts_without_noise(behind_focus, wave, blur):
    """By images of 5000 rays across: 0.3 to 0.4 nm."""
    bins = fine_bins(behind_focus, FIELD, wave, (0.7, -1.2), 5000, SIZE, PIXEL, fine=12)
    fit, _ = fitted(behind_focus, blurred(bins, blur, 5e6, fine=12), blur)
    assert fit.reasons == [""]
    assert np.linalg.norm(fit.zernikes[0] - wave[3:]) < 0.8e-9


@pytest.mark.long
def test_a_wide_stamp_is_fitted_about_its_donut(focused):
    """Sky far from a donut tells nothing of its wavefront: place, background and wavefront are those of the stamp."""
    tel = focused.perturbed("Detector", shift=(0.0, 0.0, 0.5e-3))
    wave = np.zeros(22)
    wave[[4, 7]] = 60e-9, -40e-9
    shift, slope = (14.3, -9.6), (0.2, -0.1)
    clean = donut(tel, FIELD, zernikes=wave, blur=2.0, shift=shift, size=181, pixel=PIXEL, rays=300)
    rows, columns = np.mgrid[-90:91, -90:91]
    image = noisy(clean, SKY, 4) + 30.0 + slope[0] * columns + slope[1] * rows
    detector = pachon.DonutDetector(pixel_size=PIXEL, diffusion=2.0 * PIXEL)
    model = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.0), detector=detector, diffraction=False)
    fit = pachon.fit_donuts(tel, image[None], [FIELD], WAVELENGTH, sky_variance=SKY, model=model, threads=1)
    assert fit.reasons == [""]
    error = fit.zernikes[0] - wave[3:]
    assert error @ np.linalg.solve(fit.covariance[0], error) < 45.0  # 19 terms
    # Five standard deviations.
    assert (np.abs(fit.center[0] - shift) < 5.0 * fit.center_error[0] + 0.01).all()
    assert fit.background[0] == pytest.approx(30.0, abs=5.0 * np.sqrt(SKY / fit.n_pixels[0]))
    np.testing.assert_allclose(fit.background_slope[0], slope, atol=0.03)
    # Less than half of the stamp, and all of the donut's light.
    assert 0.2 * image.size < fit.n_pixels[0] < 0.5 * image.size
    assert clean[fit.used[0]].sum() > 0.999 * clean.sum()
    assert np.isfinite(fit.model[0][fit.used[0]]).all()
    assert np.isnan(fit.model[0][0, 0])
    pull = (fit.residuals[0] / np.sqrt(SKY + np.maximum(fit.model[0], 0.0)))[fit.used[0]]
    assert (pull**2).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / pull.size))
