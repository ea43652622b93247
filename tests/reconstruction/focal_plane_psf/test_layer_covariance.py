"""The covariance of all shapes by the theory of layers: between places, in any frame, and in predictions."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.models.camera.cameras import load_camera
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.kriging import leave_one_out, neighbourhood
from pachon.reconstruction.focal_plane_psf.layer_fit import LayerTheory
from pachon.wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance
from pachon.wavefront.atmosphere.moment_covariance import (
    ExposedAir,
    MomentResponse,
    MomentSampling,
    as_matrices,
    moment_covariance,
)

#: A layer on the ground and two above it.
AIR = ExposedAir((0.0, 3000.0, 12000.0), (0.6, 0.3, 0.1), ((5.0, 1.0), (-3.0, 8.0), (20.0, 6.0)), 15.0, 0.16, 25.0, 40.0, 8.4, 0.6)  # fmt: skip  # noqa: E501
RESPONSE = MomentResponse(6.4e10, 6.7e10, (1e10, 1e20), (1e10, 1e20))
FOCAL_LENGTH = 10.3
#: Derivatives of e1, e2 and ln size with respect to Z4 to Z11 [1/m].
SENSITIVITY = np.random.default_rng(3).normal(0.0, 1e4, (8, 3))
CONSTANT, NUGGET = np.array([4e-4, 4e-4, 1e-4]), np.array([2e-7, 2e-7, 3e-7])
#: Sums of covariances that are right within 0.3 %.
DENSE = MomentSampling(0.5, 0.35, 0.5, 0.25)
MIRROR = np.diag([-1.0, 1.0])
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


def theory(turn=None, sensitivity=SENSITIVITY):
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    products = np.stack([np.outer(sensitivity[:, i], sensitivity[:, j]) for i, j in pairs])
    jacobian = FOCAL_LENGTH * (np.eye(2) if turn is None else turn)
    return LayerTheory(RESPONSE, jacobian, products, load_camera("lsst"), 1)


def at(xy):
    return Places(np.asarray(xy), np.zeros(len(xy), dtype=np.int64), np.zeros((len(xy), 2)))


@pytest.fixture(scope="module")
def covariance():
    return theory().covariance(AIR, CONSTANT, NUGGET)


@pytest.fixture(scope="module")
def stars():
    return at(np.random.default_rng(0).uniform(-0.02, 0.02, (40, 2)))


def test_between_two_places_it_is_that_of_moments_and_of_the_mean_wavefront(covariance):
    rng = np.random.default_rng(1)
    apart = rng.uniform(0.0, 1.0, 12)[:, None] ** 2 * rng.normal(0.0, 0.2, (12, 2))
    lags = apart / FOCAL_LENGTH
    moments = as_matrices(moment_covariance(AIR, lags, sampling=DENSE).total(RESPONSE))
    expected = RESPONSE.shapes(moments)
    above = AIR._replace(altitudes=AIR.altitudes[1:], weights=AIR.weights[1:], velocities=AIR.velocities[1:])
    for k, lag in enumerate(lags):
        of_pair = mean_wavefront_covariance(above, [lag, (0.0, 0.0)], range(4, 12), AIR.diameter, AIR.obscuration)
        one_way = SENSITIVITY.T @ of_pair[0, :, 1] @ SENSITIVITY
        expected[k] += 0.5 * (one_way + one_way.T)
    found = covariance.between(at([(0.0, 0.0)]), at(apart)).reshape(3, 3, 12)
    # Cubics between rings and spokes, and baselines: 1 % of the variance.
    scale = np.sqrt(np.outer(covariance.variance, covariance.variance))[..., None]
    by_theory = np.moveaxis(expected, 0, -1)
    np.testing.assert_allclose((found - np.diag(CONSTANT)[..., None]) / scale, by_theory / scale, atol=0.015)
    # Shapes of stars at one place covary as one star's do.
    same = covariance.between(at([(0.1, 0.0)]), at([(0.1, 0.0)]))
    np.testing.assert_allclose(np.diagonal(same), covariance.at(at([(0.1, 0.0)])), rtol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("turn", [MIRROR, MIRROR @ QUARTER], ids=["mirror", "both"])
def test_a_turned_detector_sees_turned_winds(turn, covariance, stars):
    # Without aberrations, whose Zernikes would have to be turned too.
    aligned = theory(sensitivity=np.zeros((8, 3)))
    turned_air = AIR._replace(velocities=tuple(map(tuple, (np.array(AIR.velocities) @ turn.T).tolist())))
    through_frame = theory(turn, np.zeros((8, 3))).covariance(AIR, CONSTANT, NUGGET).between(stars, stars)
    by_winds = aligned.covariance(turned_air, CONSTANT, NUGGET).between(stars, stars)
    # Baselines and spokes lie differently: 1 % of the variance.
    np.testing.assert_allclose(through_frame, by_winds, atol=0.01 * covariance.variance.max())
    straight = aligned.covariance(AIR, CONSTANT, NUGGET).between(stars, stars)
    assert np.abs(through_frame - straight).max() > 0.05 * covariance.variance.max()


def test_amplitudes_multiply_all_but_what_stars_share(covariance, stars):
    amplitude = np.random.default_rng(9).uniform(0.8, 1.6, len(stars))
    scaled = replace(stars, amplitude=amplitude)
    common = np.kron(np.diag(CONSTANT), np.ones((len(stars), len(stars))))
    expected = common + np.outer(*[np.tile(amplitude, 3)] * 2) * (covariance.between(stars, stars) - common)
    found = covariance.between(scaled, scaled)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(np.diagonal(found), covariance.at(scaled), rtol=1e-4)


def test_predictions_are_dense_linear_algebra_of_all_shapes(covariance, stars):
    rng = np.random.default_rng(5)
    values, noise = rng.normal(0.0, 0.004, (40, 3)), rng.uniform(1e-7, 1e-5, (40, 3))
    elsewhere = at(rng.uniform(-0.02, 0.02, (4, 2)))
    near = neighbourhood(covariance, stars, values, noise, np.arange(40))
    between = covariance.between(stars, elsewhere)
    total = covariance.between(stars, stars) + np.diag(noise.T.ravel() + np.repeat(NUGGET, 40))
    expected = between.T @ np.linalg.solve(total, values.T.ravel())
    np.testing.assert_allclose(near.predict(between), expected, atol=1e-8)
    left, variance = leave_one_out(near)
    for i in (0, 17):
        others = np.delete(np.arange(40), i)
        alone = neighbourhood(covariance, stars, values, noise, others)
        from_others = covariance.between(stars[others], stars[i : i + 1])
        np.testing.assert_allclose(left[i], values[i] - alone.predict(from_others), atol=1e-8)
        own = covariance.at(stars[i : i + 1]) - (from_others * alone.weights(from_others)).sum(axis=0)
        np.testing.assert_allclose(variance[i], own + noise[i] + NUGGET, rtol=1e-4)
