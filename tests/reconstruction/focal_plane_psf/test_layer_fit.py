"""Winds and strengths of layers from the shapes of stars that were drawn from their theory."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.models.camera.cameras import load_camera
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.layer_fit import LayerFit, LayerTheory
from pachon.reconstruction.focal_plane_psf.likelihood import log_likelihood
from pachon.wavefront.atmosphere.moment_covariance import ExposedAir, MomentResponse

AIR = ExposedAir((0.0, 4000.0), (0.65, 0.35), ((6.0, 2.0), (-4.0, 9.0)), 15.0, 0.16, 25.0, 40.0, 8.4, 0.6)
RESPONSE = MomentResponse(6.4e10, 6.7e10, (1e10, 1e20), (1e10, 1e20))
#: Of the prior: winds of some speed, strengths, Fried parameter, outer scale; nuggets have none.
CURVATURE = [20.0] * 4 + [44.0] * 2 + [1111.0, 11.1] + [0.0] * 3
CONSTANT = np.array([1e-6, 1e-6, 1e-6])


@pytest.fixture(scope="module")
def theory():
    return LayerTheory(RESPONSE, 10.3 * np.eye(2), np.zeros((6, 8, 8)), load_camera("lsst"), 1)


@pytest.fixture(scope="module")
def places():
    xy = np.random.default_rng(2).uniform(-0.06, 0.06, (420, 2))
    return Places(xy, np.zeros(len(xy), dtype=np.int64), np.zeros((len(xy), 2)))


@pytest.fixture(scope="module")
def drawn(theory, places):
    """Shapes of the theory, drawn exactly, with noise."""
    covariance = theory.covariance(AIR, CONSTANT, np.full(3, 1e-8))
    noise = np.full((len(places), 3), 1e-5)
    root = covariance.root(places, noise.T.ravel())
    values = root @ np.random.default_rng(7).standard_normal(3 * len(places))
    return values.reshape(3, -1).T, noise


def fit_of(theory, places, drawn, prior=AIR, spread=None):
    fit = LayerFit(theory, prior, places, CONSTANT)
    fit.observe(*drawn, spread)
    return fit


def test_gradients_are_those_of_the_likelihood(theory, places, drawn):
    def spread(index):
        return np.tile(1e-3 * np.array([[1.0], [0.5], [2.0]]), (1, 2)).repeat(len(index), axis=0)

    # As noisy as faint stars: the likelihood is smooth over the steps of the differences.
    vignetted = replace(places, amplitude=np.random.default_rng(5).uniform(0.9, 1.5, len(places)))
    fit = fit_of(theory, vignetted, (drawn[0], 100.0 * drawn[1]), spread=spread)
    start = fit._parameters(np.array([(5.0, 3.0), (-5.0, 7.0)]))
    start += 0.05 * np.random.default_rng(0).standard_normal(len(start))
    value, gradient = fit._negative_log_posterior(start)
    # The differences of the table are one-sided too.
    for k, size in enumerate([0.05] * 4 + [0.01] * 7):
        step = np.zeros(len(start))
        step[k] = size
        difference = (fit._negative_log_posterior(start + step)[0] - value) / size
        # The prior curves by up to 1 / 0.03^2 within a step.
        assert gradient[k] == pytest.approx(difference, abs=0.1 + 0.03 * abs(difference) + 0.5 * size * CURVATURE[k]), k


@pytest.mark.long
def test_winds_are_found_as_likely_as_the_true_ones(theory, places, drawn):
    # Nothing of their directions is known.
    prior = AIR._replace(velocities=((7.0, 0.0), (11.0, 0.0)))
    fit = fit_of(theory, places, drawn, prior)
    found = fit.improve(fit.search())
    truth = theory.covariance(AIR, CONSTANT, found.nugget)
    flat = theory.covariance(prior, CONSTANT, found.nugget)
    values, noise = drawn
    true, fitted, unfitted = (log_likelihood(c, places, values, noise, fit.blocks) for c in (truth, found, flat))
    assert fitted > true - 3.0
    assert unfitted < true - 10.0
    assert sum(found.air.weights) == pytest.approx(1.0)


@pytest.mark.long
def test_no_byte_depends_on_the_threads(theory, places, drawn):
    tables = []
    for threads in (1, 2):
        of_threads = LayerTheory(theory.response, theory.jacobian, theory.products, theory.camera, threads)
        few = slice(0, 150)
        found = fit_of(of_threads, places[few], (drawn[0][few], drawn[1][few])).search(forecast=True)
        tables.append(found.table.tobytes() + found.nugget.tobytes())
    assert tables[0] == tables[1]


@pytest.mark.long
@pytest.mark.parametrize("nugget", [0.0, 1e-6])
def test_noise_that_is_not_stated_is_found_and_none_is_made_up(theory, places, nugget):
    """By a prior of a hundredth of the variance, nuggets that stars hardly tell took 7 % of what layers have."""
    noise = np.full((len(places), 3), 1e-6)
    root = theory.covariance(AIR, CONSTANT, np.full(3, nugget)).root(places, noise.T.ravel())
    values = root @ np.random.default_rng(7).standard_normal(3 * len(places))
    fit = fit_of(theory, places, (values.reshape(3, -1).T, noise))
    found = fit.search(forecast=True)
    np.testing.assert_allclose(found.nugget, nugget, rtol=0.4, atol=2e-3 * fit._variance.max())
