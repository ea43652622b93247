"""Functionals, responses and noise against closed forms, finite differences and drawn noise."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.measure.shear.functionals import renoising
from pachon.measure.shear.weight import WEIGHT_SIGMA

SIDE, SCALE = 64, 0.2 * np.pi / 648000
#: Variance of the weight [pixel^2].
WEIGHT = (WEIGHT_SIGMA / SCALE) ** 2
GALAXY = np.array([[3.0, 0.4], [0.4, 2.0]])


def functionals_of_gaussian(covariance):
    """Closed form: a Gaussian times the weight is a Gaussian of the inverse sum of inverses, with known moments."""
    c = np.linalg.inv(np.linalg.inv(covariance) + np.eye(2) / WEIGHT)
    x4, y4, x2y2 = 3 * c[0, 0] ** 2, 3 * c[1, 1] ** 2, c[0, 0] * c[1, 1] + 2 * c[0, 1] ** 2
    x3y, xy3 = 3 * c[0, 0] * c[0, 1], 3 * c[1, 1] * c[0, 1]
    square = 2.0 * (c[0, 0] + c[1, 1]) / WEIGHT
    values = [1.0, (c[0, 0] - c[1, 1]) / WEIGHT, 2.0 * c[0, 1] / WEIGHT]
    values += [square - (x4 - 2 * x2y2 + y4) / WEIGHT**2, square - 4 * x2y2 / WEIGHT**2, -2 * (x3y - xy3) / WEIGHT**2]
    return np.sqrt(np.linalg.det(c) / np.linalg.det(covariance)) * np.array(values)


def sheared(covariance, g1, g2):
    matrix = np.array([[1.0 + g1, g2], [g2, 1.0 - g1]]) / np.sqrt(1.0 - g1**2 - g2**2)
    return matrix @ covariance @ matrix.T


def test_functionals_of_gaussians_under_elliptical_psfs(gaussian, psf_covariances, psfs):
    estimator = pachon.measure.ShearEstimator(psfs, SCALE, 1.0)
    rng = np.random.default_rng(1)
    offsets, psf_index = rng.uniform(-1.0, 1.0, (6, 2)), np.arange(6) % 2
    stamps = [
        gaussian(GALAXY + psf_covariances[k], SIDE, *offset) for k, offset in zip(psf_index, offsets, strict=True)
    ]
    moments = estimator.moments(stamps, offsets, psf_index=psf_index)
    # Pixels are kept in single precision; the PSFs are cut off at 15 pixels, ten of their widths.
    np.testing.assert_allclose(moments, np.tile(functionals_of_gaussian(GALAXY), (6, 1)), atol=2e-6)


def test_stamps_of_any_sampling_and_an_odd_side(gaussian, psf_covariances, psfs):
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, 1.0, side=45)
    stamps = gaussian(GALAXY + psf_covariances[0], 45, 0.3, 0.1)[None]
    np.testing.assert_allclose(estimator.moments(stamps, [[0.3, 0.1]])[0], functionals_of_gaussian(GALAXY), atol=3e-6)


def test_functionals_are_linear_and_no_byte_depends_on_threads_or_batches(psfs):
    estimator = pachon.measure.ShearEstimator(psfs, SCALE, 1.0)
    rng = np.random.default_rng(2)
    one, two = rng.standard_normal((2, 300, SIDE, SIDE))
    offsets, psf_index = rng.uniform(-0.5, 0.5, (300, 2)), rng.integers(0, 2, 300)
    moments = [estimator.moments(v, offsets, psf_index=psf_index, threads=2) for v in (one, two, one + two)]
    np.testing.assert_allclose(moments[2], moments[0] + moments[1], atol=1e-3 * moments[2].std())
    np.testing.assert_array_equal(moments[0], estimator.moments(one, offsets, psf_index=psf_index, threads=1))
    batch = estimator.moments(one[7:30], offsets[7:30], psf_index=psf_index[7:30], threads=1)
    np.testing.assert_array_equal(moments[0][7:30], batch)


@pytest.mark.parametrize("min_snr", [None, 20.0])
def test_responses_are_the_derivatives_of_drawn_galaxies(gaussian, psf_covariances, psfs, min_snr):
    """Central differences of galaxies drawn under shears of +-0.003."""
    step = 3e-3
    galaxies = [sheared(GALAXY, *g) for g in ((0, 0), (step, 0), (-step, 0), (0, step), (0, -step))]
    stamps = np.stack([gaussian(g + psf_covariances[0]) for g in galaxies])
    moment = functionals_of_gaussian(GALAXY)[0]
    # With a limit, the S/N is in the middle of the range in which the weight rises.
    noise = moment / 22.0 / np.sqrt(pachon.measure.ShearEstimator(psfs[0], SCALE, 1.0).covariance[0, 0, 0])
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, noise)
    moments = estimator.moments(stamps, np.zeros((5, 2)))
    shapes = estimator.ellipticity_and_response(moments, min_snr=min_snr)
    assert shapes.snr[0] == pytest.approx(22.0, rel=1e-4)
    assert shapes.weight[0] == pytest.approx(1.0 if min_snr is None else 0.5, abs=1e-3)
    slopes = [(getattr(shapes, e)[k] - getattr(shapes, e)[k + 1]) / (2 * step) for e in ("e1", "e2") for k in (1, 3)]
    r12 = shapes.r12[0]
    np.testing.assert_allclose(slopes, [shapes.r11[0], r12, r12, shapes.r22[0]], atol=3e-4 * shapes.r11[0])


def test_a_point_source_has_no_response(psfs):
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, 1e-3)
    stamp = np.zeros((1, SIDE, SIDE))
    stamp[0, 17:48, 17:48] = psfs[0]
    shapes = estimator.ellipticity_and_response(estimator.moments(stamp, [[0.5, 0.5]]))
    np.testing.assert_allclose([shapes.e1, shapes.e2, shapes.r11, shapes.r22, shapes.r12], 0.0, atol=2e-6)


@pytest.mark.long
def test_the_covariance_of_the_noise_is_that_of_drawn_noise(psfs):
    noise, n = 3.0, 6000
    estimator = pachon.measure.ShearEstimator(psfs[0], SCALE, noise, side=40)
    rng = np.random.default_rng(3)
    stamps = noise * rng.standard_normal((n, 40, 40), np.float32)
    drawn = np.cov(estimator.moments(stamps, rng.uniform(-0.5, 0.5, (n, 2))).T)
    errors = np.sqrt(np.diag(estimator.covariance[0]))
    # Correlations are known to 1 / sqrt(n), the variances to sqrt(2 / n).
    scale = np.outer(errors, errors)
    np.testing.assert_allclose(drawn / scale, estimator.covariance[0] / scale, atol=4.5 * np.sqrt(2.0 / n))


def test_added_noise_is_rotated_and_independent_of_that_of_the_derivatives(psfs):
    covariance = pachon.measure.ShearEstimator(psfs, SCALE, 2.0).covariance
    measured, derivatives, turn = np.arange(3), np.arange(1, 6), np.diag([1.0, -1.0, -1.0])
    for c, added, subtracted in zip(covariance, *renoising(covariance, measured, derivatives, turn), strict=True):
        scale = np.sqrt(np.diag(c))
        square = c[:3, :3]
        rotated = turn @ square @ turn
        np.testing.assert_allclose(added @ added.T, rotated, atol=1e-10 * c[0, 0])
        # Covariance of M + n + N with M + n - X: elliptical PSFs correlate M0 and M1, and yet nothing is left.
        assert np.abs(square[0, 1:]).max() > 0.01 * c[0, 0]
        independent = c[:3, 1:] - added @ subtracted.T
        np.testing.assert_allclose(independent / np.outer(scale[:3], scale[1:]), 0.0, atol=1e-10)


@pytest.mark.long
def test_noise_and_selection_do_not_bias_the_shear(gaussian, psf_covariances, psfs):
    """Gaussian galaxies at random angles at S/N 3 to 12: noise in the space of functionals."""
    g, n, limit = 0.02, 100_000, 5.0
    rng = np.random.default_rng(4)
    angles = np.pi * np.arange(10) / 10
    turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles]
    noise = functionals_of_gaussian(GALAXY)[0] / 6.0
    estimator = pachon.measure.ShearEstimator(psfs[1], SCALE, noise)
    estimator = pachon.measure.ShearEstimator(psfs[1], SCALE, noise**2 / np.sqrt(estimator.covariance[0, 0, 0]))
    flux = rng.uniform(0.5, 2.0, n)
    galaxy = rng.integers(0, 10, n)
    drawn_noise = rng.standard_normal((n, 6)) @ np.linalg.cholesky(estimator.covariance[0]).T
    sums = []
    for sign in (1.0, -1.0):
        clean = np.stack([functionals_of_gaussian(sheared(t @ GALAXY @ t.T, sign * g, 0.0)) for t in turns])
        parts = [
            estimator.ellipticity_and_response(
                flux[:, None] * clean[galaxy] + s * drawn_noise, seed=1, key=("noise", k), min_snr=limit
            )
            for k, s in enumerate((1.0, -1.0))
        ]
        sums.append(type(parts[0])(*(np.stack([getattr(p, c) for p in parts], 1).mean(1) for c in parts[0]._table)))
    bias = pachon.measure.shear_bias(*sums, g, 0.0)
    assert bias.m_error[0] < 4e-3
    assert abs(bias.m[0]) < 4.0 * bias.m_error[0] + 2.0 * g**2
    assert (np.abs(bias.c) < 4.0 * bias.c_error).all()
    # Without added noise the bias is 0.038 +- 0.003.
    wrong = [
        estimator.ellipticity_and_response(flux[:, None] * clean[galaxy] + drawn_noise, min_snr=limit)
        for clean in (
            np.stack([functionals_of_gaussian(sheared(t @ GALAXY @ t.T, s * g, 0.0)) for t in turns]) for s in (1, -1)
        )
    ]
    assert abs(pachon.measure.shear_bias(*wrong, g, 0.0).m[0]) > 0.03


def test_bad_input_is_one_line(gaussian, psfs):
    cases = [
        ({"noise": 0.0}, r"noise = 0.0: expected a positive rms"),
        ({"noise": -1.0}, r"noise = -1.0: expected a positive rms"),
        ({"noise": [1.0, 2.0, 3.0]}, "of all or of each of 2 PSFs"),
        ({"side": 24}, r"side = 24: too small for a weight of sigma = 2.60 pixels; expected at least 32 pixels"),
        ({"sigma": 0.0}, "sigma"),
        ({"psf_images": psfs[:, :30, :30]}, "expected .n, m, m. with m odd"),
        ({"psf_images": 2.0 * psfs}, r"psf_images\[0\]: sum 2, expected 1"),
    ]
    wide = gaussian(9.0 * np.eye(2), 63)
    wide /= wide.sum()
    cases.append(
        ({"psf_images": wide, "sigma": 2.6 * SCALE}, r"psf_images\[0\]: too wide for a weight of sigma = 2.60")
    )
    # Without a width the weight is wide enough for the PSF: 1.2 half-light radii of 3.53 pixels.
    cases.append(({"psf_images": wide, "side": 48}, r"side = 48: too small for a weight of sigma = 4.2. pixels"))
    for change, message in cases:
        arguments = {"psf_images": psfs, "pixel_scale": SCALE, "noise": 1.0} | change
        with pytest.raises(DomainError, match=message) as problem:
            pachon.measure.ShearEstimator(**arguments)
        assert "\n" not in str(problem.value)
    estimator = pachon.measure.ShearEstimator(psfs, SCALE, 1.0)
    stamps, offsets = np.zeros((2, SIDE, SIDE)), np.zeros((2, 2))
    for arguments, message in (
        ((stamps, offsets, None), "psf_index: expected the PSF of each galaxy, as there are 2"),
        ((stamps, offsets, [0, 2]), "psf_index: expected 2 integers from 0 to 1"),
        ((stamps[:, :50], offsets, [0, 1]), "stamps have shape"),
        ((stamps, offsets[:1], [0, 1]), "offsets have shape"),
        ((stamps + np.nan, offsets, [0, 1]), "stamps: expected finite pixels"),
    ):
        with pytest.raises(DomainError, match=message):
            estimator.moments(arguments[0], arguments[1], psf_index=arguments[2])
    with pytest.raises(DomainError, match="moments have shape"):
        estimator.ellipticity_and_response(np.zeros((2, 5)), psf_index=[0, 1])
    with pytest.raises(DomainError, match="min_snr = 0"):
        estimator.ellipticity_and_response(np.zeros((2, 6)), psf_index=[0, 1], min_snr=0.0)
