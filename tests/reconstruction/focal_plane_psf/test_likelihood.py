from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from scipy.stats import multivariate_normal

from pachon.reconstruction.focal_plane_psf.covariance import COMPONENTS, Covariance, Places
from pachon.reconstruction.focal_plane_psf.kriging import map_on_threads
from pachon.reconstruction.focal_plane_psf.likelihood import blocks_of, fit_covariance, log_likelihood

SIDE = 0.6  # of the field [m]
CCDS = 14  # along a side


def places(n, seed):
    """Stars at random over a square field that is tiled with CCDs."""
    xy = np.random.default_rng(seed).uniform(0.0, SIDE, (n, 2))
    cell = SIDE / CCDS
    column, row = np.minimum((xy // cell).astype(int), CCDS - 1).T
    centers = cell * (np.stack([column, row], axis=1) + 0.5)
    return Places(xy, CCDS * row + column, (xy - centers) / (0.5 * cell))


def axes_matrix(along, across, angle):
    """M of e^-|M d| with these lengths: the upper Cholesky factor of R diag(1/a^2, 1/b^2) R^T."""
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.linalg.cholesky(rotation @ np.diag([along**-2.0, across**-2.0]) @ rotation.T).T


def drawn(covariance, here, noise, seed):
    """Values of a Gaussian field of this covariance, by its Cholesky factor, and noise."""
    matrix = covariance.between(here, here) + np.diag(noise + covariance.nugget)
    return np.linalg.cholesky(matrix) @ np.random.default_rng(seed).standard_normal(len(here))


@pytest.fixture
def prepared(monkeypatch):
    """The function that is minimised, its arguments and the start of the search: ``prepared(places, ...)``."""

    def of(*args, **options):
        caught = {}

        def catch(function, first, args, **_):
            caught.update(function=function, first=first, args=args)
            raise InterruptedError

        with monkeypatch.context() as patch:
            patch.setattr(scipy.optimize, "minimize", catch)
            with pytest.raises(InterruptedError):
                fit_covariance(*args, **options)
        return caught["function"], caught["first"], caught["args"]

    return of


def some_spread(n):
    """A covariance of the values due to three fitted parameters."""
    design = np.random.default_rng(8).normal(0.0, 0.4, (n, 3))
    return lambda index: design[index] @ np.diag([1.0, 0.3, 0.1]) @ design[index].T


@pytest.mark.parametrize("with_ccds", [False, True])
@pytest.mark.parametrize("with_spread", [False, True])
def test_gradient_is_that_of_differences(prepared, with_ccds, with_spread):
    here, noise = places(90, 1), np.random.default_rng(2).uniform(0.1, 0.4, 90)
    if with_spread:
        here = replace(here, amplitude=np.random.default_rng(5).uniform(0.8, 1.6, 90))
    values = np.random.default_rng(3).normal(0.0, 1.0, 90)
    function, first, args = prepared(
        here,
        values,
        noise,
        with_ccds=with_ccds,
        spread=some_spread(90) if with_spread else None,
        blocks=blocks_of(here.xy, 50),
    )
    point = first + np.random.default_rng(4).normal(0.0, 0.5, len(first))
    assert len(point) == 4 * COMPONENTS + 3 * with_ccds + 1
    value, gradient = function(point, *args)
    assert np.isfinite(value)
    for i in range(len(point)):
        differences = []
        for step in (1e-3, 2e-3):
            ends = [function(point + sign * step * np.eye(len(point))[i], *args)[0] for sign in (1, -1)]
            differences.append((ends[0] - ends[1]) / (2 * step))
        # Richardson: good to step^4 = 1e-12; rounding of a value of 100 over the step is 1e-11.
        expected = (4 * differences[0] - differences[1]) / 3
        assert gradient[i] == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_the_function_is_minus_the_density_of_the_blocks(prepared):
    here, noise = places(70, 5), np.random.default_rng(6).uniform(0.1, 0.4, 70)
    values = np.random.default_rng(7).normal(0.0, 1.0, 70)
    blocks = blocks_of(here.xy, 30)
    fit = fit_covariance(here, values, noise, blocks=blocks, with_ccds=True)
    found, spread = fit.covariance, some_spread(70)
    expected = penalty = 0.0
    for index in blocks:
        part = here[index]
        matrix = found.between(part, part) + np.diag(noise[index] + found.nugget)
        expected += multivariate_normal(np.zeros(len(index)), matrix).logpdf(values[index])
        penalty += 0.5 * np.trace(np.linalg.solve(matrix, spread(index)))
    constant = 0.5 * 70 * np.log(2 * np.pi)
    # Rounding at a condition of 1e4, the constant of 100 times the variance, to the sum of 70 terms.
    assert log_likelihood(found, here, values, noise, blocks) == pytest.approx(expected + constant, abs=1e-8)
    assert fit.log_likelihood == pytest.approx(expected + constant, abs=1e-8)
    # With a spread S the expected logarithm of the density is less by tr(K^-1 S) / 2.
    plain, with_spread = (
        prepared(here, values, noise, blocks=blocks, with_ccds=True, start=found, constant=found.constant, spread=s)
        for s in (None, spread)
    )
    at = plain[1]
    assert with_spread[0](at, *with_spread[2])[0] - plain[0](at, *plain[2])[0] == pytest.approx(
        _penalty_at(at, plain, here, noise, blocks, spread), rel=1e-9
    )
    assert penalty > 0.0


def _penalty_at(packed, problem, here, noise, blocks, spread):
    """tr(K^-1 S) / 2 summed over blocks, K read back from the search: its function of values y is y^T K^-1 y / 2."""
    power = problem[2][0][0].fixed[0, 1]  # the constant over the power, off the diagonal
    constant_over_power = power
    extent = np.ptp(here.xy, axis=0).max()
    total = 0.0
    for block, index in zip(problem[2][0], blocks, strict=True):
        part = here[index]
        scale = (block.fixed[0, 0] - constant_over_power) / noise[index][0]  # 1 / power
        amplitude, matrix = [], []
        for j in range(COMPONENTS):
            a, u, v, s = packed[4 * j : 4 * j + 4]
            amplitude.append(np.exp(a))
            matrix.append(np.array([[np.exp(u), np.exp(u) * s], [0.0, np.exp(v)]]) / extent)
        rest = np.exp(packed[4 * COMPONENTS :])
        c = Covariance(constant_over_power, np.array(amplitude), np.array(matrix), rest[:3], rest[3])
        k = c.between(part, part) + np.diag(scale * noise[index] + c.nugget)
        total += 0.5 * np.trace(np.linalg.solve(k, scale * spread(index)))
    return total


LAGS = 0.6 / 210.0 * np.array([3.0, 8.0, 16.0])  # 3, 8 and 16 arcmin of 210 over the field [m]


@pytest.mark.slow
def test_variance_and_correlation_of_a_known_field_are_found():
    # One anisotropic component of 0.10 by 0.02 m; shapes of 1 % rms, noise of half that.
    angle = 0.5
    true = Covariance(0.0, np.array([1e-4]), axes_matrix(0.10, 0.02, angle)[None], np.zeros(3), 0.0)

    def fitted(seed):
        here, noise = places(1500, seed), np.full(1500, 2.5e-5)
        return fit_covariance(here, drawn(true, here, noise, seed + 10), noise).covariance

    variance, along, across = [], [], []
    for found in map_on_threads(fitted, range(3), 2):
        variance.append(found.variance + found.nugget)
        for store, direction in ((along, angle), (across, angle + np.pi / 2)):
            offsets = LAGS[:, None] * np.array([np.cos(direction), np.sin(direction)])
            ends = Places(np.vstack([[0.0, 0.0], offsets]), np.zeros(4, dtype=int), np.zeros((4, 2)))
            store.append(found.between(ends, ends)[0, 1:] - found.constant)
    # 0.6^2 / (pi 0.1 0.02) = 57 independent patches a field: the variance of one is known to sqrt(2 / 57) = 19 %, of
    # three to 11 %, so 15 % is 1.4 sigma of the draw. What is compared is therefore the correlation, in which the
    # variance drops out, and the variance within 2.5 sigma.
    assert np.mean(variance) == pytest.approx(1e-4, rel=0.27)
    for store, length in ((along, 0.10), (across, 0.02)):
        correlation = (np.array(store) / np.array(variance)[:, None]).mean(axis=0)
        np.testing.assert_allclose(correlation, np.exp(-LAGS / length), atol=0.15)
        np.testing.assert_allclose(correlation[:2], np.exp(-LAGS[:2] / length), rtol=0.15)
    # Along and across cannot be mistaken for each other.
    assert np.mean(along, axis=0)[2] > 1.5 * np.mean(across, axis=0)[2]


@pytest.mark.parametrize("n", [1, 7, 300, 301, 1000, 1501])
def test_blocks_take_every_star_once(n):
    xy = np.random.default_rng(n).uniform(0.0, [0.6, 0.2], (n, 2))
    for size in (50, 300):
        blocks = blocks_of(xy, size)
        np.testing.assert_array_equal(np.sort(np.concatenate(blocks)), np.arange(n))
        assert max(map(len, blocks)) <= size
        # Halves: none is less than half as large as it may be, but for a star lost to rounding at each cut.
        assert len(blocks) == 1 or min(map(len, blocks)) >= size // 2 - 1


def test_blocks_are_neighbours():
    xy = np.random.default_rng(0).uniform(0.0, 1.0, (1024, 2))
    # 16 blocks of 64 stars, each a 16th of the square: halves along the longer side are a fourth by a fourth, with
    # edges where the median of the stars is, 1 / (2 sqrt(64)) = 6 % off at most three times.
    for index in blocks_of(xy, 64):
        assert np.ptp(xy[index], axis=0).max() < 0.25 + 3 * 0.06


def test_stars_of_little_weight_change_little():
    """The scatter of faint stars was taken for that of turbulence in the first guess, and the fit stayed near it."""
    here, rng = places(60, 4), np.random.default_rng(5)
    lengths = axes_matrix(0.1, 0.05, 0.4)
    true = Covariance(0.0, np.array([1.6e-5, 0.0]), np.stack([lengths] * COMPONENTS), np.zeros(3), 0.0)
    noise = np.where(np.arange(60) < 40, 1e-6, 0.04)
    values = drawn(true, here, noise, 6)
    bright = np.arange(60) < 40
    alone = fit_covariance(here[bright], values[bright], noise[bright]).covariance
    together = fit_covariance(here, values, noise).covariance
    assert together.variance == pytest.approx(alone.variance, rel=0.1)
    # Stars that say nothing have no effect.
    noise[~bright], values[~bright] = 1e12, 1e6 * rng.normal(size=20)
    without = fit_covariance(here, values, noise, constant=4e-4).covariance
    alone = fit_covariance(here[bright], values[bright], noise[bright], constant=4e-4).covariance
    assert without.variance == pytest.approx(alone.variance, rel=0.03)


def test_stars_at_one_place_are_finite():
    here = Places(np.zeros((3, 2)), np.zeros(3, dtype=int), np.zeros((3, 2)))
    fit = fit_covariance(here, np.array([0.01, 0.02, 0.015]), np.full(3, 1e-6), constant=1e-4)
    assert np.isfinite(fit.log_likelihood)
    assert np.isfinite(fit.covariance.variance)
