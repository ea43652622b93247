"""Gaussian processes over the CCD: the algebra against brute force, and what they are for."""

import itertools

import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError
from pachon.core.threads import one_blas_thread
from pachon.reconstruction.psf_model.gaussian_process import fit_kernels, krige, predict
from pachon.reconstruction.psf_model.model import PsfModel

SIZE = 15
EXTENT = (0.0, 4000.0, 0.0, 4000.0)


def field(seed, places, length=0.5):
    """A smooth random function on the CCD that is no polynomial: sixty waves with the spectrum of a Gaussian kernel."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0.0, 1.0 / length, (60, 2)), rng.uniform(0.0, 2 * np.pi, 60)
    return np.sqrt(2.0 / 60) * np.cos((places / 2000.0 - 1.0) @ waves.T + phases).sum(axis=1)


def psf(places):
    """Round stars whose width, and whose stretch along x, are such fields."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    width = 1.6 + 0.05 * field(1, places)[:, None, None]
    stretch = 1.0 + 0.03 * field(2, places)[:, None, None]
    image = np.exp(-0.5 * ((x / stretch) ** 2 + (y * stretch) ** 2) / width**2)
    return image / image.sum(axis=(1, 2), keepdims=True)


def kriging_case(n=30, seed=0):
    rng = np.random.default_rng(seed)
    points, values = rng.uniform(-1.0, 1.0, (n, 2)), rng.normal(size=(n, 3))
    terms = np.stack([np.ones(n), *points.T], axis=1)
    kernels = np.array([[1.3, 0.4, 0.2], [0.0, 1.0, 0.0], [0.7, 1.1, 0.01]])
    return points, values, terms, kernels, np.geomspace(0.03, 30.0, n)


def test_kriging_equals_its_normal_equations():
    points, values, terms, kernels, star_noise = kriging_case()
    trend, weights, _ = krige(points, values, terms, kernels, star_noise)
    at = np.random.default_rng(1).uniform(-1.0, 1.0, (7, 2))
    found = np.stack([np.ones(7), *at.T], axis=1) @ trend + predict(points, at, kernels, weights)
    n = len(points)
    for k, (variance, length, noise) in enumerate(kernels):
        noise = noise or 1.0  # no process: least squares, with the inverse noise as weights
        near = [variance * np.exp(-0.5 * ((points[:, None] - p) ** 2).sum(axis=2) / length**2) for p in (points, at)]
        # Universal kriging with the trend as Lagrange multipliers: weights that are unbiased and of least variance.
        system = np.block([[near[0] + noise * np.diag(star_noise), terms], [terms.T, np.zeros((3, 3))]])
        right = np.concatenate([near[1], np.stack([np.ones(7), *at.T])])
        expected = np.linalg.solve(system, right)[:n].T @ values[:, k]
        np.testing.assert_allclose(found[:, k], expected, atol=1e-10)


def test_left_out_equals_leaving_out():
    points, values, terms, kernels, star_noise = kriging_case()
    left_out = krige(points, values, terms, kernels, star_noise)[2]
    for i in (0, 17):
        keep = np.arange(30) != i
        trend, weights, _ = krige(points[keep], values[keep], terms[keep], kernels, star_noise[keep])
        predicted = terms[i] @ trend + predict(points[keep], points[i : i + 1], kernels, weights)[0]
        np.testing.assert_allclose(left_out[i], values[i] - predicted, atol=1e-10)


def test_each_place_alone():
    points, values, terms, kernels, star_noise = kriging_case()
    _, weights, _ = krige(points, values, terms, kernels, star_noise)
    at = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 2))
    whole = predict(points, at, kernels, weights)
    for i in range(0, 50, 7):
        assert predict(points, at[i : i + 7], kernels, weights).tobytes() == whole[i : i + 7].tobytes()
    assert predict(points, at[9:10], kernels, weights).tobytes() == whole[9].tobytes()


@pytest.mark.long
def test_kernel_of_a_drawn_process_is_found():
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (100, 2))
    squares = ((points[:, None] - points) ** 2).sum(axis=2)

    def covariance(variance, length, noise):
        return variance * np.exp(-0.5 * squares / length**2) + noise * np.eye(100)

    def likelihood(values, kernel):
        root = np.linalg.cholesky(covariance(*kernel))
        return -0.5 * (np.linalg.solve(root, values) ** 2).sum() - values.shape[1] * np.log(np.diag(root)).sum()

    drawn = (4e-4, 0.3, 1e-4)
    values = np.linalg.cholesky(covariance(*drawn)) @ rng.normal(size=(100, 20))
    constant, equal = np.ones((100, 1)), np.ones(100)
    # Twenty draws of some forty patches of correlated values each: 5 % of the variance, less of the length; 4 sigma.
    shared = fit_kernels(points, values, constant, equal, shared=True)
    np.testing.assert_allclose(shared, np.broadcast_to(drawn, (20, 3)), rtol=0.2)
    single = fit_kernels(points, values[:, :3], constant, equal, shared=False)
    assert len(np.unique(single, axis=0)) == 3
    for k in range(3):  # no kernel nearby is likelier, that of the draw neither
        column = values[:, k : k + 1] - values[:, k].mean()
        best = likelihood(column, single[k])
        others = [single[k] * np.where(np.arange(3) == i, f, 1.0) for i in range(3) for f in (0.97, 1.03)]
        assert best > max(likelihood(column, other) for other in [drawn, *others])
    assert fit_kernels(points, np.zeros((100, 1)), constant, equal, shared=False)[0, 0] == 0.0


@pytest.mark.long
def test_kernel_under_noise_that_differs_from_star_to_star():
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (100, 2))
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    star_noise = rng.permutation(np.geomspace(1e-2, 1e2, 100))
    drawn = (4e-4, 0.3, 1e-4)
    covariance = drawn[0] * np.exp(-0.5 * squares / drawn[1] ** 2) + drawn[2] * np.diag(star_noise)
    values = np.linalg.cholesky(covariance) @ rng.normal(size=(100, 20))
    with one_blas_thread():
        found = fit_kernels(points, values, np.ones((100, 1)), star_noise, shared=True)[0]
    np.testing.assert_allclose(found, drawn, rtol=0.2)
    # Taken as equal, the noise of the faint stars hides the process: a fifth of its variance is found, or less.
    assert fit_kernels(points, values, np.ones((100, 1)), np.ones(100), shared=True)[0, 2] > 10.0 * drawn[2]


@pytest.mark.parametrize("basis", ["pca", "pixels"])
def test_bright_stars_count_by_their_noise(basis):
    rng = np.random.default_rng(5)
    places, elsewhere = rng.uniform(0, 4000, (80, 2)), rng.uniform(300, 3700, (200, 2))
    electrons = 3e3 * 10.0 ** rng.uniform(0.0, 2.0, 80)
    stars = electrons[:, None, None] * psf(places)
    stars = stars + rng.normal(size=stars.shape) * np.sqrt(20.0**2 + stars)
    options = {"basis": basis, "interpolation": "gp", "extent": EXTENT} | (
        {"n_components": 5} if basis == "pca" else {}
    )
    model, truth = PsfModel.fit(stars, places, **options), psf(elsewhere)
    assert np.corrcoef(np.log(model.weights), np.log(electrons))[0, 1] > 0.97
    left = np.sqrt(((model.at(elsewhere) - truth) ** 2).mean())
    assert left < 0.6 * np.sqrt(((truth - truth.mean(axis=0)) ** 2).mean())
    # Faint stars that were nothing but noise would change nothing that the bright ones know.
    faint = electrons < np.quantile(electrons, 0.2)
    stars[faint] += 30.0 * rng.normal(size=stars[faint].shape)
    worse = PsfModel.fit(stars, places, **options)
    assert np.sqrt(((worse.at(elsewhere) - truth) ** 2).mean()) < 1.1 * left


def test_fields_that_are_no_polynomials():
    rng = np.random.default_rng(5)
    places, elsewhere = rng.uniform(0, 4000, (80, 2)), rng.uniform(300, 3700, (200, 2))
    stamps, truth = psf(places) + rng.normal(0.0, 1e-4, (80, SIZE, SIZE)), psf(elsewhere)

    def error(**options):
        model = PsfModel.fit(stamps, places, extent=EXTENT, n_components=5, **options)
        np.testing.assert_allclose(model.at(elsewhere).sum(axis=(1, 2)), 1.0, rtol=1e-12)
        return np.sqrt(((model.at(elsewhere) - truth) ** 2).mean())

    one = error(interpolation="gp")
    assert one == error(interpolation="gp")
    assert one < 0.3 * min(error(order=n) for n in (2, 3, 4, 5))


@pytest.mark.long
@pytest.mark.parametrize(("basis", "n_components"), [("pca", 6), ("pixels", None), ("shapelets", 27)])
def test_smooth_fields_without_noise(basis, n_components):
    rng = np.random.default_rng(5)
    places, elsewhere = rng.uniform(0, 4000, (100, 2)), rng.uniform(400, 3600, (100, 2))
    truth = psf(elsewhere)

    def error(interpolation):
        model = PsfModel.fit(
            psf(places),
            places,
            basis=basis,
            n_components=n_components,
            interpolation=interpolation,
            extent=EXTENT,
            clip_sigma=None,
        )
        return np.sqrt(((model.at(elsewhere) - truth) ** 2).mean())

    # A hundred stars are 0.2 apart where the field changes over 0.5: a hundredth of the change is left.
    assert error("gp") < 0.01 * np.sqrt(((truth - truth.mean(axis=0)) ** 2).mean()) < 0.1 * error("polynomial")


@pytest.mark.parametrize("basis", ["pca", "pixels"])
def test_polynomials_in_the_trend_are_recovered(basis):
    places = np.random.default_rng(5).uniform(0, 4000, (40, 2))
    u, v = places.T / 2000.0 - 1.0
    one, two, three = psf(places[:3])
    stars = one + (0.1 * u + 0.2 * u * v)[:, None, None] * (two - three)
    n_components = None if basis == "pixels" else 1
    model = PsfModel.fit(
        stars, places, basis=basis, n_components=n_components, interpolation="gp", order=2, extent=EXTENT
    )
    np.testing.assert_allclose(model.at(places), stars, atol=1e-13)
    np.testing.assert_allclose(model.leave_one_out(), stars, atol=1e-12)


def test_bad_input():
    places = np.random.default_rng(0).uniform(0, 4000, (20, 2))
    with pytest.raises(ConfigError, match="weights: expected none"):
        PsfModel.fit(psf(places), places, n_components=3, interpolation="gp", weights=np.ones(20))
    places[9] = places[2]
    with pytest.raises(DomainError, match=r"stars 2 and 9 are both at .* expected places apart"):
        PsfModel.fit(psf(places), places, n_components=3, interpolation="gp")


@pytest.mark.long
def test_no_kernel_is_likelier():
    """Where stars are few and noisy, a likelihood has several tops: of these eight, two from one start end lower."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (30, 2))
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    smooth = np.linalg.cholesky(np.exp(-0.5 * squares / 0.3**2) + 1e-6 * np.eye(30)) @ rng.normal(size=(30, 8))
    values = smooth + rng.normal(size=(30, 8)) * np.geomspace(0.5, 3.0, 8)
    kernels = fit_kernels(points, values, np.ones((30, 1)), np.ones(30), shared=False)
    rest = values - values.mean(axis=0)

    def likelihoods(variance, length, noise):
        root = np.linalg.cholesky(variance * np.exp(-0.5 * squares / length**2) + noise * np.eye(30))
        return -0.5 * (np.linalg.solve(root, rest) ** 2).sum(axis=0) - np.log(np.diag(root)).sum()

    found = np.array([likelihoods(*kernel)[k] for k, kernel in enumerate(kernels)])
    power = (rest**2).mean()
    grid = itertools.product(np.geomspace(1e-2, 1e2, 13), np.geomspace(0.05, 20.0, 21), np.geomspace(1e-4, 5.0, 15))
    best = np.max([likelihoods(v * power, length, n * power) for v, length, n in grid], axis=0)
    # The optimizer stops when it gains less than 2e-9 of the value.
    assert np.all(found > best - 1e-3)
