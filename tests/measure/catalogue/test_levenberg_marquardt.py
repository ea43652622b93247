"""Bounds against eigenvalues, and steps that never raise chi-square."""

import numpy as np
import pytest

import pachon
from pachon.measure.catalogue.gaussian_model import GaussianStamps
from pachon.measure.catalogue.levenberg_marquardt import Bounds, LevenbergMarquardt


def test_bounds_clip_centres_and_eigenvalues():
    rng = np.random.default_rng(1)
    params = rng.normal(0.0, 4.0, (50, 6))
    params[0, 3:] = 20.0, 0.0, 20.0
    params[1, 3:] = 3.0, 0.0, 3.0
    bounds = Bounds(np.full((60, 2), 0.5), 3.0, np.linspace(-0.5, 0.1, 60), 9.0)
    which = np.arange(50) + 5
    inside = bounds.project(params, which)
    for found, given, i in zip(inside, params, which, strict=True):
        values, vectors = np.linalg.eigh([[given[3], given[4]], [given[4], given[5]]])
        matrix = vectors @ np.diag(np.clip(values, bounds.least[i], 9.0)) @ vectors.T
        np.testing.assert_allclose(found[3:], [matrix[0, 0], matrix[0, 1], matrix[1, 1]], rtol=0, atol=1e-13)
        assert found[0] == given[0]
        np.testing.assert_array_equal(found[1:3], np.clip(given[1:3], -2.5, 3.5))
    np.testing.assert_array_equal(inside[1], np.where(np.isin(np.arange(6), [1, 2]), inside[1], params[1]))


def test_chi_square_never_rises(psf):
    # Noise alone, and starts far from any minimum.
    rng = np.random.default_rng(2)
    count = 40
    data = rng.normal(size=(count, 32, 32))
    stamps = GaussianStamps(psf[None], np.zeros(count, dtype=int), data, np.ones(data.shape))
    start = np.stack(
        [
            rng.normal(0.0, 30.0, count),
            *rng.uniform(-6.0, 6.0, (2, count)),
            *rng.uniform(0.1, 9.0, (1, count)),
            np.zeros(count),
            np.full(count, 2.0),
        ],
        axis=1,
    )
    bounds = Bounds(np.zeros((count, 2)), 8.0, np.full(count, -0.5), 256.0)
    runs = [LevenbergMarquardt(max_evaluations=n).minimize(stamps, start, bounds) for n in range(1, 14)]
    chi2 = np.array([run.equations.chi2 for run in runs])
    assert (np.diff(chi2, axis=0) <= 0.0).all()
    assert (chi2[-1] < (data**2).sum(axis=(1, 2))).all()
    # What is returned belongs together.
    again = stamps.normal_equations(runs[-1].params, np.arange(count))
    assert np.array_equal(again.chi2, runs[-1].equations.chi2)
    assert np.array_equal(again.matrix, runs[-1].equations.matrix)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"max_evaluations": 0}, "max_evaluations = 0"), ({"tolerance": -1.0}, "tolerance = -1")],
)
def test_a_solver_that_never_ends_is_refused(options, message):
    with pytest.raises(pachon.errors.DomainError, match=message):
        LevenbergMarquardt(**options)


def test_options_of_before_are_told_where_they_are():
    with pytest.raises(pachon.errors.ConfigError, match=r"expected solver=LevenbergMarquardt\(max_evaluations=...\)"):
        pachon.measure.fit_galaxy_stamps(np.zeros((1, 9, 9)), 1.0, np.ones((1, 1)), max_evaluations=2)
