"""Peaks of images: functionals and responses against finite differences, noise against drawn noise, whole images."""

import numpy as np
import pytest

import pachon
from pachon.measure.shear import detection
from pachon.measure.shear.detection import CELL, _Detector

SCALE = 0.2 * np.pi / 648000
GALAXY = np.array([[3.0, 0.4], [0.4, 2.0]])
SIDE = CELL + 64
MIDDLE = SIDE // 2


def shear_matrix(g1, g2):
    return np.array([[1.0 + g1, g2], [g2, 1.0 - g1]]) / np.sqrt(1.0 - g1**2 - g2**2)


def functionals_at(detector, gaussian, psf_covariance, pixels, galaxies, g=(0.0, 0.0)):
    """Functionals at pixels (x, y) from the middle, of Gaussians (place, flux) sheared about each of the pixels."""
    values = []
    matrix = shear_matrix(*g)
    for pixel in np.array(pixels):
        image = 0.0
        for place, flux in galaxies:
            centre = pixel + matrix @ (np.array(place) - pixel) + 0.5
            image = image + flux * gaussian(matrix @ GALAXY @ matrix.T + psf_covariance, SIDE, *centre)
        maps = detector.maps(image, 0)
        values.append(detector.functionals(maps, np.array([MIDDLE + pixel[1]]), np.array([MIDDLE + pixel[0]]))[0])
    return np.array(values)


def test_functionals_of_pixels_change_by_shear_as_their_derivatives_say(gaussian, psf_covariances, psfs):
    """Two blended Gaussians, drawn under shears of +-0.003 about a pixel."""
    detector = _Detector.of(psfs[:1], 2.6, 1.0, 10.0)
    galaxies = [((0.3, -0.2), 1.0), ((4.1, 2.3), 0.7)]
    pixels = [(0, 0), (1, -1), (4, 3)]
    at = functionals_at(detector, gaussian, psf_covariances[0], pixels, galaxies)
    for j, direction in enumerate(np.eye(2)):
        steps = [
            functionals_at(detector, gaussian, psf_covariances[0], pixels, galaxies, s * 3e-3 * direction)
            for s in (1, -1)
        ]
        slope = (steps[0] - steps[1]) / 6e-3
        expected = np.column_stack([-at[:, 1 + j], at[:, [3, 5] if j == 0 else [5, 4]], at[:, 10 + 4 * j : 14 + 4 * j]])
        # Central differences are good to the square of the step.
        np.testing.assert_allclose(slope[:, [0, 1, 2, 6, 7, 8, 9]], expected, atol=1e-4 * at[0, 0])


def test_the_maps_are_the_functionals_of_stamps(gaussian, psf_covariances, psfs):
    detector = _Detector.of(psfs[:1], 2.6, 1.0, 10.0)
    image = gaussian(GALAXY + psf_covariances[0], SIDE, 0.8, 0.1)
    maps = detector.maps(image, 0)
    at = detector.functionals(maps, np.array([MIDDLE]), np.array([MIDDLE]))[0]
    estimator = pachon.ShearEstimator(psfs[0], SCALE, 1.0)
    stamp = image[MIDDLE - 32 : MIDDLE + 32, MIDDLE - 32 : MIDDLE + 32]
    np.testing.assert_allclose(at[:6], estimator.moments(stamp[None], [[0.5, 0.5]])[0], atol=3e-6)
    right = estimator.moments(stamp[None], [[1.5, 0.5]])[0]
    assert at[6] == pytest.approx(at[0] - right[0], abs=3e-6)


@pytest.mark.long
def test_the_covariance_of_the_noise_of_pixels_is_that_of_drawn_noise(psfs):
    detector = _Detector.of(psfs[:1], 2.6, 1.0, 10.0)
    rng = np.random.default_rng(1)
    grid = np.arange(40, SIDE - 40, 12)
    rows, columns = (v.ravel() for v in np.meshgrid(grid, grid))
    values = np.concatenate(
        [detector.functionals(detector.maps(rng.standard_normal((SIDE, SIDE)), 0), rows, columns) for _ in range(12)]
    )
    drawn = np.cov(values.T)
    frequencies, inverse = detection.psf_frequencies(psfs[:1], 64, 2.6)
    weights = detection._peak_transforms(frequencies, 2.6)
    covariance = detection.noise_covariance(weights, inverse, np.ones(1), frequencies)[0]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(drawn / scale, covariance / scale, atol=5.0 * np.sqrt(2.0 / len(values)))
    # Of an image rotated by 90 degrees, under the PSF rotated.
    turned = detection.psf_frequencies(np.rot90(psfs[:1], axes=(1, 2)), 64, 2.6)
    rotated = detection.noise_covariance(detection._peak_transforms(turned[0], 2.6), turned[1], np.ones(1), turned[0])
    square = detector.noise[0][0] @ detector.noise[0][0].T
    block = np.ix_(detection._MEASURED, detection._MEASURED)
    np.testing.assert_allclose(square / scale[block], rotated[0][block] / scale[block], atol=1e-6)
