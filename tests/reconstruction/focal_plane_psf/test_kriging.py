import numpy as np
import pytest

from pachon.reconstruction.focal_plane_psf.covariance import Covariance, Places
from pachon.reconstruction.focal_plane_psf.kriging import leave_one_out, map_on_threads, neighbourhood, neighbours_of

COVARIANCE = Covariance(
    50.0,
    np.array([1.0, 0.4]),
    np.array([[[20.0, 8.0], [0.0, 60.0]], [[150.0, -40.0], [0.0, 90.0]]]),
    np.array([0.2, 0.1, 0.05]),
    0.03,
)


def drawn(n, seed):
    rng = np.random.default_rng(seed)
    ccd = rng.integers(0, 2, n)
    uv = rng.uniform(-1.0, 1.0, (n, 2))
    return Places(np.array([[0.0, 0.0], [0.05, 0.01]])[ccd] + 0.02 * uv, ccd, uv)


STARS, ELSEWHERE = drawn(60, 1), drawn(25, 2)
NOISE = np.random.default_rng(3).uniform(0.05, 0.5, 60)
VALUES = 3.0 + np.random.default_rng(4).normal(0.0, 1.0, 60)


def total(stars, noise):
    return COVARIANCE.between(stars, stars) + np.diag(noise + COVARIANCE.nugget)


def test_predictions_and_variances_are_dense_linear_algebra():
    near = neighbourhood(COVARIANCE, STARS, VALUES, NOISE, np.arange(60))
    k = COVARIANCE.between(STARS, ELSEWHERE)
    inverse = np.linalg.inv(total(STARS, NOISE))
    # The constant makes a condition of 1e5: rounding of 1e-11 of values of 3.
    np.testing.assert_allclose(near.predict(k), k.T @ inverse @ VALUES, rtol=1e-9)
    np.testing.assert_allclose(near.weights(k), inverse @ k, atol=1e-10)
    spread = COVARIANCE.at(ELSEWHERE) - (k * near.weights(k)).sum(axis=0)
    expected = np.diagonal(COVARIANCE.between(ELSEWHERE, ELSEWHERE) - k.T @ inverse @ k)
    # Differences of numbers of 50: 1e-11.
    np.testing.assert_allclose(spread, expected, atol=1e-9)
    assert (spread > 0.0).all()


def test_a_subset_of_the_stars_predicts_as_if_it_were_all():
    some = np.array([3, 10, 11, 40, 59])
    near = neighbourhood(COVARIANCE, STARS, VALUES, NOISE, some)
    k = COVARIANCE.between(STARS[some], ELSEWHERE)
    expected = k.T @ np.linalg.solve(total(STARS[some], NOISE[some]), VALUES[some])
    np.testing.assert_allclose(near.predict(k), expected, rtol=1e-10)


def test_leave_one_out_is_a_fit_without_each_star():
    near = neighbourhood(COVARIANCE, STARS, VALUES, NOISE, np.arange(60))
    left, variance = leave_one_out(near)
    for i in range(60):
        others = np.delete(np.arange(60), i)
        k = COVARIANCE.between(STARS[others], STARS[i : i + 1])[:, 0]
        weights = np.linalg.solve(total(STARS[others], NOISE[others]), k)
        # Rounding at a condition of 1e5; the variance of the difference holds the noise of the star itself.
        assert left[i, 0] == pytest.approx(VALUES[i] - weights @ VALUES[others], abs=1e-9)
        own = COVARIANCE.at(STARS[i : i + 1])[0] + NOISE[i] + COVARIANCE.nugget
        assert variance[i, 0] == pytest.approx(own - weights @ k, abs=1e-9)


def test_the_mean_is_free():
    wide = Covariance(1e8, COVARIANCE.amplitude, COVARIANCE.matrix, COVARIANCE.ccd, COVARIANCE.nugget)
    k = wide.between(STARS, ELSEWHERE)
    low, high = (neighbourhood(wide, STARS, VALUES + shift, NOISE, np.arange(60)).predict(k) for shift in (0.0, 1000.0))
    # 1000 times the variance of the mean (0.5) over 1e8 is 5e-6; rounding of 1000 at a condition of 1e10 is 1e-3 at
    # most.
    np.testing.assert_allclose(high - low, 1000.0, atol=1e-3)


def test_neighbours_are_the_nearest():
    center = np.array([0.01, -0.005])
    order = np.argsort(np.hypot(*(STARS.xy - center).T))
    for count in (1, 7, 59):
        np.testing.assert_array_equal(neighbours_of(STARS, center, count), np.sort(order[:count]))
    np.testing.assert_array_equal(neighbours_of(STARS, center, 60), np.arange(60))
    np.testing.assert_array_equal(neighbours_of(STARS, center, 700), np.arange(60))


def test_no_byte_depends_on_the_threads():
    groups = [np.arange(60)[i::7] for i in range(7)]

    def job(stars):
        near = neighbourhood(COVARIANCE, STARS, VALUES, NOISE, stars)
        k = COVARIANCE.between(STARS[stars], ELSEWHERE)
        return np.concatenate([near.predict(k), near.weights(k).ravel(), *(v.ravel() for v in leave_one_out(near))])

    one, two = (np.concatenate(map_on_threads(job, groups, threads)) for threads in (1, 2))
    assert one.tobytes() == two.tobytes()
    # In the order of the items, whichever ends first.
    assert map_on_threads(lambda item: item, range(100), 2) == list(range(100))
