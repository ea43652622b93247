"""The Kalman filter of the loop: against Bayes' formula, and against the scatter of simulated loops."""

import numpy as np
import pytest

from pachon.studies.alignment.estimator import estimate_state, steady_covariance


@pytest.fixture(scope="module")
def linear():
    """Sensitivity, noise, prior and drift of nanometres; the last state is not observed."""
    rng = np.random.default_rng(1)
    sensitivity = 50e-9 * rng.normal(size=(12, 4))
    sensitivity[:, 3] = 0.0
    mixed = rng.normal(size=(12, 12))
    return sensitivity, 1e-16 * (mixed @ mixed.T), np.diag([4.0, 4.0, 1.0, 2.0]), 0.01 * np.eye(4)


def test_the_estimate_is_that_of_bayes(linear):
    sensitivity, noise, prior, drift = linear
    wavefront = 1e-8 * np.random.default_rng(2).normal(size=12)
    found = estimate_state(wavefront, noise, sensitivity, prior, drift, 1.0)
    information = sensitivity.T @ np.linalg.solve(noise, sensitivity) + np.linalg.inv(prior)
    expected = np.linalg.solve(information, sensitivity.T @ np.linalg.solve(noise, wavefront))
    assert found.state == pytest.approx(expected, rel=1e-8)
    assert found.covariance == pytest.approx(np.linalg.inv(information) + drift, rel=1e-8, abs=1e-12)
    assert found.state[3] == 0.0
    assert found.covariance[3, 3] == pytest.approx(2.01)


def test_without_donuts_only_the_drift_is_added(linear):
    _, _, prior, drift = linear
    found = estimate_state(np.zeros(0), np.zeros((0, 0)), np.zeros((0, 4)), prior, drift, 1.0)
    assert not found.state.any()
    assert found.covariance == pytest.approx(prior + drift)


@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_states_scatter_as_their_covariance(linear, gain):
    sensitivity, noise, prior, drift = linear
    rng, visits, loops = np.random.default_rng(3), 6, 4000
    root, steps = np.linalg.cholesky(noise), np.sqrt(np.diag(drift))
    states = rng.normal(size=(loops, 4)) * np.sqrt(np.diag(prior))
    covariance = prior
    for _ in range(visits):
        # The estimate is linear in the wavefront: its matrix from unit wavefronts.
        columns = [estimate_state(unit, noise, sensitivity, covariance, drift, gain).state for unit in np.eye(12)]
        wavefront = states @ sensitivity.T + rng.normal(size=(loops, 12)) @ root.T
        states = states - gain * wavefront @ np.array(columns) + steps * rng.normal(size=states.shape)
        covariance = estimate_state(np.zeros(12), noise, sensitivity, covariance, drift, gain).covariance
    # 4000 loops: variances are good to 2.2 %.
    assert np.var(states, axis=0) == pytest.approx(np.diag(covariance), rel=0.09)
    assert steady_covariance(noise, sensitivity, prior, drift, gain, visits) == pytest.approx(covariance)
