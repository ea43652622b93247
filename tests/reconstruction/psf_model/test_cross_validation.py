"""Weights by noise, and order and components that held-out stars choose: brute force, drawn noise, known fields."""

from functools import partial

import numpy as np
import pytest

from pachon.core.errors import ConfigError
from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.polynomial import automatic_orders, design_matrix
from pachon.reconstruction.psf_model.shape_noise import ShapeNoise

#: The recipe of the paper, where a test does not say otherwise.
fit = partial(PsfModel.fit, recipe="paper")
SIZE, SKY = 21, 22.0
EXTENT = (-1.0, 1.0, -1.0, 1.0)


def field(seed, count, order, rough=0.0, holdouts=150):
    """Moffat stars of S/N 30 to 600, places, PSFs elsewhere; shapes are polynomials, and a process besides."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count + holdouts, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    process = np.linalg.cholesky(np.exp(-2.0 * distance) + 1e-9 * np.eye(len(points)))
    terms = design_matrix(points, EXTENT, order)
    e1, e2, width = (
        (0.006 * (terms @ rng.normal(size=terms.shape[1]) + rough * process @ rng.normal(size=len(points))))[
            :, None, None
        ]
        for _ in range(3)
    )
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    square = (x**2 * (1 - 2 * e1) + y**2 * (1 + 2 * e1) - 4 * e2 * x * y) / (3.3 * (1.0 + width)) ** 2
    images = (1.0 + square) ** -3
    images /= images.sum(axis=(1, 2), keepdims=True)
    electrons = 4000.0 * 10.0 ** rng.uniform(0.0, 2.0, count)
    stars = electrons[:, None, None] * images[:count]
    stars = stars + rng.normal(size=stars.shape) * np.sqrt(SKY**2 + stars)
    return stars, points[:count], images[count:], points[count:]


def error(model, truth, elsewhere):
    made, true = (measure_shapes(i, 0.2, 0.7) for i in (model.at(elsewhere), truth))
    return np.sqrt(np.mean((made.e1 - true.e1) ** 2 + (made.e2 - true.e2) ** 2))


# --- what a model leaves, and weights ------------------------------------------------------------------------------


def test_the_variance_of_a_model_is_found_under_any_noise():
    rng = np.random.default_rng(1)
    noise = np.geomspace(1e-2, 1e2, 3000)
    shapes = ShapeNoise(np.eye(3), noise)
    for variance in (0.03, 0.5, 20.0):
        residuals = rng.normal(size=(3000, 3)) * np.sqrt(variance + noise)[:, None]
        # Some thousand stars of less noise than that, three numbers each: 2 %; 10 % where they are few.
        assert shapes.model_variance(residuals) == pytest.approx(variance, rel=0.1)
    assert shapes.model_variance(rng.normal(size=(3000, 3)) * np.sqrt(noise)[:, None]) < 0.01


def test_weights_are_those_of_noise_and_what_polynomials_leave():
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (2000, 2))
    noise = np.geomspace(1e-2, 1e2, 2000)
    terms = design_matrix(points, EXTENT, 1)
    trend = terms @ rng.normal(size=(3, 3))
    for variance in (0.3, 10.0):
        deviations = trend + rng.normal(size=(2000, 3)) * np.sqrt(variance + noise)[:, None]
        expected = 1.0 / (variance + noise)
        found = ShapeNoise(np.eye(3), noise).star_weights(deviations, terms)
        np.testing.assert_allclose(found, expected / expected.mean(), rtol=0.12)


def test_weighted_eigen_psfs_are_those_of_repeated_stars():
    """Twice the weight is the star twice, in mean, components and polynomials."""
    stars, places, _, _ = field(3, 30, 1)
    model = fit(stars, places, weights="noise", order=1, n_components=4, clipping=None, extent=EXTENT)
    unit = (stars / stars.sum(axis=(1, 2), keepdims=True)).reshape(30, -1)
    weights = model.weights
    assert weights.mean() == pytest.approx(1.0)
    mean = weights @ unit / weights.sum()
    np.testing.assert_allclose(model.mean.ravel(), mean, atol=1e-14)
    covariance = (unit - mean).T @ ((unit - mean) * weights[:, None])
    values, vectors = np.linalg.eigh(covariance)
    np.testing.assert_allclose(model.eigenvalues[:4], values[::-1][:4] / 29.0, rtol=1e-9)
    overlap = np.abs(model.components.reshape(4, -1) @ vectors[:, ::-1][:, :4])
    np.testing.assert_allclose(overlap, np.eye(4), atol=1e-6)
    terms = design_matrix(places, EXTENT, 1)
    coefficients = (unit - mean) @ model.components.reshape(4, -1).T
    root = np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(terms * root, coefficients * root, rcond=None)[0]
    np.testing.assert_allclose(model.interpolation.polynomial, expected, atol=1e-12)


def test_without_noise_in_the_names_nothing_is_weighted():
    stars, places, _, _ = field(3, 30, 1)
    given = np.linspace(0.5, 2.0, 30)
    model = fit(stars, places, weights=given, n_components=4, clipping=None, extent=EXTENT)
    plain = fit(stars, places, n_components=4, clipping=None, extent=EXTENT)
    assert np.array_equal(model.components, plain.components)
    assert np.array_equal(model.weights, given)


# --- choices -------------------------------------------------------------------------------------------------------


def test_orders_leave_twice_as_many_stars_as_terms():
    assert automatic_orders(200) == [0, 1, 2, 3, 4]
    # Forty stars, of which 32 are fitted to at a time: 16 terms at most; ten of twelve: four.
    assert automatic_orders(40) == [0, 1, 2, 3, 4]
    assert automatic_orders(20) == [0, 1, 2]
    assert automatic_orders(10) == [0, 1]
    assert automatic_orders(3) == [0]


@pytest.mark.parametrize("order", [1, 2])
def test_the_order_of_a_field_is_found(order):
    options = {"basis": "pixels", "order": "auto", "extent": EXTENT}
    assert np.median([fit(*field(seed, 120, order)[:2], **options).order for seed in range(3)]) == order


@pytest.mark.long
@pytest.mark.parametrize("rough", [0.0, 2.0])
def test_automatic_components_are_near_the_best_number(rough):
    """Once the number was chosen by pixels without weights, and was 1 on such stars, ten times as bad as the best."""
    ratios = []
    for seed in range(3):
        stars, places, truth, elsewhere = field(50 + seed, 50, 2, rough)
        model = fit(stars, places, n_components="auto", order=2, extent=EXTENT)
        assert model.n_components > 1
        tried = [
            fit(stars, places, n_components=k, order=2, weights="noise", extent=EXTENT) for k in (1, 3, 10, 20, 30, 45)
        ]
        ratios.append(error(model, truth, elsewhere) / min(error(each, truth, elsewhere) for each in tried))
    assert np.exp(np.mean(np.log(ratios))) < 1.25


def test_faint_stars_keep_few_components_and_the_same_bytes():
    stars, places, truth, elsewhere = field(7, 40, 1)
    faint = stars + 60.0 * np.random.default_rng(1).normal(size=stars.shape)
    model, again = (fit(faint, places, n_components="auto", order="auto", extent=EXTENT) for _ in range(2))
    assert model.at(elsewhere).tobytes() == again.at(elsewhere).tobytes()
    assert error(model, truth, elsewhere) < error(fit(faint, places, extent=EXTENT), truth, elsewhere)
    # As many terms as stars: nothing can be held out for them, and nothing fails.
    assert fit(stars[:10], places[:10], n_components="auto", extent=EXTENT).n_components >= 1


@pytest.mark.parametrize("basis", ["pca", "shapelets"])
def test_stamps_of_unit_sum_and_shapelets_choose_too(basis):
    stars, places, _, elsewhere = field(8, 40, 1)
    unit = stars / stars.sum(axis=(1, 2), keepdims=True)
    model = fit(unit, places, basis=basis, n_components="auto", order=1, extent=EXTENT, scale=None)
    assert 1 <= model.n_components <= 65
    np.testing.assert_allclose(model.at(elsewhere[:5]).sum(axis=(1, 2)), 1.0, rtol=1e-12)


def test_an_order_of_a_process_is_not_chosen():
    stars, places, _, _ = field(8, 20, 1)
    with pytest.raises(ConfigError, match=r"order = 'auto': expected a number .* 'kriging'"):
        fit(stars, places, basis="pixels", order="auto", interpolation="kriging")
