"""Correlated noise: its correlation on images, and the covariance of functionals, against drawn noise."""

import numpy as np
import pytest
from scipy.ndimage import convolve

import pachon
from pachon.core.errors import DomainError
from pachon.measure.shear import detection
from pachon.measure.shear.functionals import psf_frequencies

SCALE = 0.2 * np.pi / 648000
#: White noise is convolved with it; of no symmetry.
KERNEL = np.array([[0.0, 0.3, 0.0], [0.2, 1.0, 0.5], [0.0, 0.1, -0.2]])


def drawn_noise(shape, rng):
    return convolve(rng.standard_normal(shape), KERNEL, mode="wrap")


def known_noise():
    """Closed form: the autocorrelation of the kernel."""
    correlation = np.zeros((5, 5))
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            rows, columns = slice(max(0, -dy), 3 - max(0, dy)), slice(max(0, -dx), 3 - max(0, dx))
            there = KERNEL[max(0, dy) : 3 + min(0, dy), max(0, dx) : 3 + min(0, dx)]
            correlation[2 + dy, 2 + dx] = (KERNEL[rows, columns] * there).sum()
    return pachon.measure.CorrelatedNoise(np.sqrt(correlation[2, 2]), correlation / correlation[2, 2])


def test_the_noise_of_an_image_is_that_of_its_sky():
    rng = np.random.default_rng(1)
    image, known = drawn_noise((400, 300), rng), known_noise()
    objects = np.zeros(image.shape)
    objects[30:390:40, 20:290:40] = 5000.0
    mask = np.zeros(image.shape, dtype=bool)
    mask[:, 100:140] = True
    y, x = np.mgrid[-6:7, -6:7]
    image += convolve(objects, np.exp(-(x**2 + y**2) / 8.0) / (8.0 * np.pi), mode="constant")
    image[mask] = np.nan
    estimate = pachon.measure.CorrelatedNoise.of_image(image, mask=mask, reach=3)
    assert estimate.rms == pytest.approx(known.rms, rel=0.01)
    # 78 000 pixels, less those of the objects, and fewer where they are correlated.
    np.testing.assert_allclose(estimate.correlation, np.pad(known.correlation, 1), atol=0.02)
    assert estimate.neighbour_correlation == pytest.approx(known.neighbour_correlation, abs=0.02)
    assert pachon.measure.CorrelatedNoise(2.0, [[1.0]]).neighbour_correlation == 0.0


def test_power_is_that_of_the_transform_of_the_kernel(psfs):
    frequencies, _ = psf_frequencies(psfs[:1], 40, 2.6)
    wide = np.zeros((40, 40))
    wide[:3, :3] = KERNEL
    np.testing.assert_allclose(known_noise().power(frequencies), np.abs(frequencies.of(wide[None])[0]) ** 2, atol=1e-12)


def test_white_noise_is_correlated_noise_without_correlations(psfs):
    one, two = (
        pachon.measure.ShearEstimator(psfs, SCALE, noise).covariance
        for noise in (3.0, pachon.measure.CorrelatedNoise(3.0, [[1.0]]))
    )
    np.testing.assert_allclose(one, two, rtol=1e-12)


@pytest.mark.long
def test_the_covariance_of_functionals_is_that_of_drawn_noise(psfs):
    n, rng = 4000, np.random.default_rng(3)
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, known_noise(), side=40)
    noise = np.stack([drawn_noise((40, 40), rng) for _ in range(n)])
    drawn = np.cov(estimator.moments(noise, rng.uniform(-0.5, 0.5, (n, 2))).T)
    errors = np.sqrt(np.diag(estimator.covariance[0]))
    scale = np.outer(errors, errors)
    # Correlations are known to 1 / sqrt(n), the variances to sqrt(2 / n).
    np.testing.assert_allclose(drawn / scale, estimator.covariance[0] / scale, atol=4.5 * np.sqrt(2.0 / n))
    white = pachon.measure.ShearEstimator(psfs[0], SCALE, known_noise().rms, side=40).covariance[0]
    assert np.abs(white / scale - drawn / scale).max() > 0.3


def test_peaks_have_the_covariance_of_stamps_and_noise_is_rotated_with_its_correlation(psfs):
    noise = known_noise()
    stamps = pachon.measure.ShearEstimator(psfs[0], SCALE, noise, sigma=2.6 * SCALE).covariance[0]
    detector = detection._Detector.of(psfs[:1], 2.6, noise, 10.0)
    np.testing.assert_allclose(detector.errors[0][:6], np.sqrt(np.diag(stamps)), rtol=1e-4)
    turned = pachon.measure.CorrelatedNoise(noise.rms, np.rot90(noise.correlation))
    rotated = pachon.measure.ShearEstimator(np.rot90(psfs[0]), SCALE, turned, sigma=2.6 * SCALE).covariance[0]
    added = detector.noise[0][0][:3, :3] @ detector.noise[0][0][:3, :3].T
    np.testing.assert_allclose(added / rotated[0, 0], rotated[:3, :3] / rotated[0, 0], atol=1e-4)


def test_bad_input_is_one_line():
    blank = np.zeros((40, 40))
    for call, message in (
        (lambda: pachon.measure.CorrelatedNoise(0.0, [[1.0]]), "rms = 0.0: expected"),
        (
            lambda: pachon.measure.CorrelatedNoise(1.0, [[1.0, 0.0]]),
            r"correlation has shape \(1, 2\): expected .m, m. with m odd",
        ),
        (lambda: pachon.measure.CorrelatedNoise(1.0, [[2.0]]), "correlation: 2 in the middle"),
        (lambda: pachon.measure.CorrelatedNoise(1.0, [[0, 0, 0], [0.5, 1, 0.1], [0, 0, 0]]), r"the same of \(dx, dy\)"),
        (lambda: pachon.measure.CorrelatedNoise.of_image(blank[:20, :20]), "400 pixels of sky, expected at least 1000"),
        (lambda: pachon.measure.CorrelatedNoise.of_image(blank), "the noise of its sky is zero"),
        (lambda: pachon.measure.CorrelatedNoise.of_image(blank, reach=-1), "reach"),
    ):
        with pytest.raises(DomainError, match=message) as problem:
            call()
        assert "\n" not in str(problem.value)
