"""Peaks of images: functionals and responses against finite differences, noise against drawn noise, whole images."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
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
    pixels = [(0, 0), (4, 3)]
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
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, 1.0)
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
    white = np.ones((1, 1, 1))
    covariance = detection.noise_covariance(weights, inverse, white, frequencies)[0]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(drawn / scale, covariance / scale, atol=5.0 * np.sqrt(2.0 / len(values)))
    # Of an image rotated by 90 degrees, under the PSF rotated.
    turned = detection.psf_frequencies(np.rot90(psfs[:1], axes=(1, 2)), 64, 2.6)
    rotated = detection.noise_covariance(
        detection._peak_transforms(turned[0], 2.6), turned[1], np.ones((1, 1, 1)), turned[0]
    )
    square = detector.noise[0][0] @ detector.noise[0][0].T
    block = np.ix_(detection._MEASURED, detection._MEASURED)
    np.testing.assert_allclose(square / scale[block], rotated[0][block] / scale[block], atol=1e-6)


def blended_pairs(gaussian, psf_covariance, turn, g, cells=10, spacing=56):
    """Pairs of Gaussians, 3 to 6 pixels apart at all angles, sheared about their middles at random places in pixels."""
    rng = np.random.default_rng(3)
    matrix = shear_matrix(g.real, g.imag)
    image = np.zeros((cells * spacing,) * 2)
    for row in range(cells):
        for column in range(cells):
            angle, distance = rng.uniform(0.0, np.pi) + turn, rng.uniform(3.0, 6.0)
            apart = 0.5 * distance * np.array([np.cos(angle), np.sin(angle)])
            middle = rng.uniform(-0.5, 0.5, 2)
            rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            covariance = matrix @ rotation @ GALAXY @ rotation.T @ matrix.T + psf_covariance
            tile = np.s_[row * spacing : (row + 1) * spacing, column * spacing : (column + 1) * spacing]
            for sign, flux in ((1.0, 1.0), (-1.0, rng.uniform(0.3, 1.0))):
                image[tile] += flux * gaussian(covariance, spacing, *(middle + matrix @ (sign * apart)))
    return image


@pytest.mark.slow
def test_blends_are_in_the_response(gaussian, psf_covariances, psfs):
    """A hundred blended pairs without noise; half of them are one peak, and shear makes two of some of them."""
    g, noise = 0.01, 1e-3
    found = {
        sign: [
            pachon.measure.detect_shear(
                blended_pairs(gaussian, psf_covariances[0], turn, sign * g), psfs[0], SCALE, noise, min_snr=5.0
            )
            for turn in (0.0, 0.5 * np.pi)
        ]
        for sign in (1.0, -1.0)
    }
    plus, minus = (pachon.measure.ShearShapes.joined([peaks.shapes for peaks in found[sign]]) for sign in (1.0, -1.0))
    cell = [np.concatenate([peaks.y // 56 for peaks in found[sign]]).astype(int) for sign in (1.0, -1.0)]
    bias = pachon.measure.shear_bias(plus, minus, g, 0.0, patch=cell[0], minus_patch=cell[1])
    assert bias.m_error[0] < 0.02
    assert abs(bias.m[0]) < 3.0 * bias.m_error[0]
    # Pixels about a peak share its weight.
    assert 100 < plus.weight.sum() < 800
    assert len(plus) > plus.weight.sum()


def test_no_byte_depends_on_threads_and_masked_peaks_are_left_out(gaussian, psf_covariances, psfs):
    rng = np.random.default_rng(4)
    image = blended_pairs(gaussian, psf_covariances[0], 0.0, 0j, cells=6) + 1e-3 * rng.standard_normal((336, 336))
    one, two = (pachon.measure.detect_shear(image, psfs[0], SCALE, 1e-3, seed=1, threads=n) for n in (1, 2))
    for name in ("x", "y", "e1", "weight"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    mask = np.zeros(image.shape, dtype=int)
    mask[100:180, 100:180] = 1
    masked = pachon.measure.detect_shear(np.where(mask, np.nan, image), psfs[0], SCALE, 1e-3, mask=mask, seed=1)
    assert 0 < len(masked) < len(one)
    # Four widths of the weight of 2.6 pixels.
    near = (masked.x > 89) & (masked.x < 191) & (masked.y > 89) & (masked.y < 191)
    assert not near.any()
    # Sums at objects keep what the peaks have.
    sums = one.at_objects([10.0, 300.0], [10.0, 300.0])
    np.testing.assert_allclose(sums.sums.sum(axis=0), one.shapes.sums.sum(axis=0), rtol=1e-10)
    assert sums.weight.sum() == pytest.approx(one.weight.sum())


def test_psfs_of_parts_of_an_image(gaussian, psf_covariances, psfs):
    """The left and the right half of an image under two PSFs give what each gives alone."""
    noise = 1e-3
    halves = [blended_pairs(gaussian, c, 0.0, 0j, cells=8) for c in psf_covariances]
    image = np.concatenate([halves[0][:, :256], halves[1][:, 256:]], axis=1)
    places = [[100.0, 200.0], [400.0, 200.0]]
    found = pachon.measure.detect_shear(image, psfs, SCALE, noise, psf_positions=places)
    for k, inside in enumerate((found.x < 220, found.x > 290)):
        alone = pachon.measure.detect_shear(halves[k], psfs[k], SCALE, noise)
        rows = (alone.x < 220) if k == 0 else (alone.x > 290)
        np.testing.assert_array_equal(found.x[inside], alone.x[rows])
        np.testing.assert_allclose(found.e1[inside], alone.e1[rows], atol=1e-6)


def test_pixels_that_are_not_finite_are_those_of_the_mask(psfs):
    image = np.random.default_rng(3).normal(0.0, 1.0, (100, 100))
    masked = np.zeros((100, 100), dtype=bool)
    masked[40:44, 50:53] = True
    by_mask = pachon.measure.detect_shear(image, psfs[0], SCALE, 1.0, mask=masked, seed=1)
    by_value = pachon.measure.detect_shear(np.where(masked, np.nan, image), psfs[0], SCALE, 1.0, seed=1)
    assert by_value.x.tobytes() == by_mask.x.tobytes()
    assert by_value.shapes.e1.tobytes() == by_mask.shapes.e1.tobytes()


def test_bad_input_is_one_line(psfs):
    image = np.zeros((100, 100))
    for arguments, options, message in (
        ((image, psfs, SCALE, 1.0), {}, "psf_positions: expected the places of 2 PSFs"),
        ((image, psfs, SCALE, 1.0), {"psf_positions": [[0.0, 0.0]]}, "psf_positions have shape"),
        ((image, psfs[0], SCALE, 0.0), {}, r"noise = 0\.0: expected a positive"),
        ((image, psfs[0], SCALE, 1.0), {"mask": np.zeros((9, 9))}, "mask has shape"),
        ((image[0], psfs[0], SCALE, 1.0), {}, "image has shape"),
        ((image, psfs[0], SCALE, 1.0), {"sigma": 1.2 * SCALE}, "too wide for a weight of sigma = 1.20 pixels"),
    ):
        with pytest.raises(DomainError, match=message) as problem:
            pachon.measure.detect_shear(*arguments, **options)
        assert "\n" not in str(problem.value)
    assert len(pachon.measure.detect_shear(image, psfs[0], SCALE, 1.0)) == 0
