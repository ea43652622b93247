"""Colours of stars in PSF models: taken where the stars ask for them, by brute force, in files, unknown ones."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.psf_model.colour import ColourTerm
from pachon.reconstruction.psf_model.covariance_posterior import Posterior, StarNumbers
from pachon.reconstruction.psf_model.kriging import Kriging
from pachon.reconstruction.psf_model.pixels import Pixels
from pachon.reconstruction.psf_model.polynomial import design_matrix
from pachon.reconstruction.psf_model.polynomial_fit import Polynomial
from pachon.reconstruction.psf_model.recipe import Recipe

SIZE = 21
EXTENT = (-1.0, 1.0, -1.0, 1.0)
KRIGING = Recipe(Pixels(), Kriging())
LINEAR = Recipe(Pixels(), Polynomial(1))
POLYNOMIAL = Recipe(Pixels(), Polynomial(1), "noise")


def psfs(e1, width):
    """Elliptical Moffat profiles of unit sum, (1 + r^2)^-3, of rms width about `width` pixels."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    e1, width = (np.asarray(v)[:, None, None] for v in (e1, width))
    images = (1.0 + (x**2 * (1 - 2 * e1) + y**2 * (1 + 2 * e1)) / (2.2 * width) ** 2) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


def coloured_psfs(places, colour, strength, varying=0.0):
    """PSFs that are linear in the place, whose e1 and size change with the colour by `strength`."""
    change = strength * (colour - 1.0) * (1.0 + varying * places[:, 0])
    return psfs(0.01 * places[:, 0] + change, 1.5 * (1.0 + 0.01 * places[:, 1] - 0.7 * change))


def stars(seed, count=40, strength=0.02, varying=0.0):
    """Stars in electrons with places and colours, g - i of 0 to 2.5."""
    rng = np.random.default_rng(seed)
    places, colour = rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(0.0, 2.5, count)
    electrons = 1e4 * 10.0 ** rng.uniform(0.0, 1.5, count)
    images = electrons[:, None, None] * coloured_psfs(places, colour, strength, varying)
    return images + rng.normal(size=images.shape) * np.sqrt(22.0**2 + images), places, colour


def fit(recipe, images, places, colour=None, **options):
    return pachon.PsfModel.fit(images, places, recipe=recipe, extent=EXTENT, colour=colour, **options)


def error(images, truth):
    """Rms error of e and of the relative size."""
    made, true = (measure_shapes(i, 0.2, 0.7) for i in (images, truth))
    return np.sqrt(np.mean((made.e1 - true.e1) ** 2 + (made.e2 - true.e2) ** 2 + (made.size / true.size - 1.0) ** 2))


@pytest.mark.long
@pytest.mark.parametrize("recipe", [KRIGING, POLYNOMIAL])
def test_colours_that_tell_nothing_change_no_byte(recipe):
    images, places, colour = stars(1)
    plain = fit(recipe, images, places)
    for same in (np.full(40, 0.7), np.full(40, np.nan), np.where(np.arange(40) < 39, np.nan, 0.7), 0.7):
        model = fit(recipe, images, places, same)
        assert model.colour is None
        assert model.at(places, colour=0.3).tobytes() == plain.at(places).tobytes()
        assert model.leave_one_out().tobytes() == plain.leave_one_out().tobytes()
        assert model.smoothness == plain.smoothness
    ignored = fit(Recipe(recipe.basis, recipe.interpolation, recipe.weights, colour=None), images, places, colour)
    assert ignored.colour is None
    assert ignored.at(places).tobytes() == plain.at(places).tobytes()


@pytest.mark.parametrize("recipe", [KRIGING, POLYNOMIAL])
def test_a_dependence_on_colour_is_found_and_predicts(recipe):
    elsewhere = np.random.default_rng(9).uniform(-1.0, 1.0, (100, 2))
    for seed in (1, 2):
        images, places, colour = stars(seed)
        model, plain = fit(recipe, images, places, colour), fit(recipe, images, places)
        assert model.colour.probability > 0.99
        for asked in (0.2, 1.2, 2.4):
            truth = coloured_psfs(elsewhere, np.full(100, asked), 0.02)
            # What is left is the noise of forty stars, less than half of what the colour does at the ends.
            assert error(model.at(elsewhere, colour=asked), truth) < 6e-3
            if abs(asked - 1.2) > 0.9:
                assert error(model.at(elsewhere, colour=asked), truth) < 0.5 * error(plain.at(elsewhere), truth)
        # Without a colour the model is that of the mean one; polynomials are fitted so, too.
        mean = model.at(elsewhere, colour=model.colour.mean)
        np.testing.assert_allclose(model.at(elsewhere), mean, atol=1e-15)
        assert model.at(elsewhere, colour=np.nan).tobytes() == mean.tobytes()


@pytest.mark.long
@pytest.mark.parametrize("recipe", [KRIGING, POLYNOMIAL])
def test_no_dependence_is_found_where_there_is_none(recipe):
    probabilities, ratios = [], []
    for seed in range(8):
        images, places, colour = stars(seed, strength=0.0)
        truth = coloured_psfs(places, colour, 0.0)
        model, plain = fit(recipe, images, places, colour), fit(recipe, images, places)
        probabilities.append(0.0 if model.colour is None else model.colour.probability)
        ratios.append(error(model.at(places, colour=colour), truth) / error(plain.at(places), truth))
    # Chance alone makes some sets of stars seem to depend on anything.
    assert np.median(probabilities) < 0.3
    assert np.sum(np.array(probabilities) > 0.5) <= 1
    assert np.exp(np.mean(np.log(ratios))) < 1.03


def test_shape_numbers_with_colours_are_the_mean_of_large_gaussians():
    images, places, colour = stars(3, count=25)
    model = fit(KRIGING, images, places, colour)
    filters = model.interpolation.fields.filters
    numbers = model.coefficients @ filters.T
    elsewhere = np.random.default_rng(4).uniform(-1.0, 1.0, (30, 2))
    asked = np.linspace(-0.5, 3.0, 30)

    def basis(points, colours):
        deviations = (colours - colour.mean()) / colour.std()
        return np.column_stack([design_matrix(points, EXTENT, 4), deviations])

    at_stars, there = basis(places, colour), basis(elsewhere, asked)
    expected, alone = 0.0, 0.0
    others = np.arange(25) != 7
    for (variance, length, floor, *trend, coloured), probability in model.interpolation.covariances.weighted():
        prior = np.diag([*np.repeat([1e4, *trend], [1, 2, 3, 4, 5]), coloured])

        def signal(a, b, terms_a, terms_b, variance=variance, length=length, prior=prior):
            distance = np.hypot(*np.moveaxis(a[:, None] - b, -1, 0))
            return variance * np.exp(-distance / length) + terms_a @ prior @ terms_b.T

        of_stars = signal(places, places, at_stars, at_stars) + np.diag(1.0 / model.weights + floor)
        between = signal(elsewhere, places, there, at_stars)
        expected = expected + probability * between @ np.linalg.solve(of_stars, numbers)
        weights = np.linalg.solve(of_stars[np.ix_(others, others)], of_stars[others, 7])
        alone = alone + probability * weights @ numbers[others]
    scale = np.abs(expected).max()
    np.testing.assert_allclose(model.amplitudes(elsewhere, colour=asked) @ filters.T, expected, atol=1e-9 * scale)
    left_out = (model.leave_one_out()[7] - model.mean).ravel()
    np.testing.assert_allclose(filters @ left_out, alone, atol=1e-8 * scale)


def test_polynomials_with_colours_are_least_squares():
    images, places, colour = stars(5, varying=0.5)
    weights = images.sum(axis=(1, 2))
    recipe = Recipe(Pixels(), Polynomial(1), colour=ColourTerm(order=1))
    model = fit(recipe, images, places, colour, weights=weights, clipping=None)
    profiles = (images / images.sum(axis=(1, 2), keepdims=True)).reshape(40, -1)
    linear = np.column_stack([np.ones(40), places])
    terms, root = np.column_stack([linear, (colour - 1.0)[:, None] * linear]), np.sqrt(weights)[:, None]
    solution = np.linalg.lstsq(root * terms, root * profiles, rcond=None)[0]
    asked = np.array([1.0, 0.3, -0.2, 1.3 - 1.0, 0.3 * 0.3, -0.2 * 0.3])
    drawn = model.draw(0.3, -0.2, colour=1.3)
    np.testing.assert_allclose(drawn.ravel(), asked @ solution, atol=1e-13)
    others = np.arange(40) != 3
    without = np.linalg.lstsq((root * terms)[others], (root * profiles)[others], rcond=None)[0]
    np.testing.assert_allclose(model.leave_one_out()[3].ravel(), terms[3] @ without, atol=1e-13)


def test_the_slope_of_the_posterior_with_colours_is_its_change():
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.0, 1.0, (25, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    terms = np.column_stack([design_matrix(points, EXTENT, 2), rng.normal(size=(25, 3))])
    both = np.zeros(2, dtype=int)
    for process in (True, False):
        stars = StarNumbers(distance, 3 * rng.normal(size=(25, 3)), rng.uniform(0.1, 2.0, 25), terms)
        posterior = Posterior.of([stars], np.zeros(6), np.full(6, 2.0), 3)
        at, present = rng.normal(size=6), np.array([process, process, True, True, True, True])
        exact = posterior.negative_log_posterior(at[None], present[None], both[:1])
        for column in range(6):
            step = np.eye(6)[column] * 1e-5
            around = posterior.negative_log_posterior(np.stack([at + step, at - step]), np.stack([present] * 2), both)
            above, below = around.value
            # Rounding of values near 100, over the step.
            assert exact.slope[0, column] == pytest.approx((above - below) / 2e-5, abs=1e-7 * abs(exact.value[0]))
            change = (around.slope[0] - around.slope[1]) / 2e-5
            np.testing.assert_allclose(exact.curvature[0, column], change, atol=1e-6 * np.abs(exact.curvature).max())


@pytest.mark.parametrize(
    "recipe",
    [KRIGING, POLYNOMIAL, pachon.reconstruction.Recipe(pachon.reconstruction.PrincipalComponents(6), Polynomial(1))],
)
def test_files_keep_the_colour_and_batches_do_not_matter(recipe, tmp_path):
    images, places, colour = stars(6)
    colour[[3, 8]] = np.nan
    model = fit(recipe, images, places, colour)
    assert model.colour.stars.n_unknown == 2
    asked = np.linspace(-1.0, 4.0, 40)
    together = model.at(places, colour=asked)
    assert np.array_equal(model.at(places[7], colour=asked[7])[0], together[7])
    np.testing.assert_allclose(together.sum(axis=(1, 2)), 1.0, atol=1e-12)
    model.write(tmp_path / "psf.fits")
    again = pachon.PsfModel.read(tmp_path / "psf.fits")
    assert np.array_equal(again.at(places, colour=asked), together)
    assert np.array_equal(again.leave_one_out(), model.leave_one_out())
    assert np.array_equal(again.colour.stars.values, colour, equal_nan=True)
    assert (again.colour.mean, again.colour.probability) == (model.colour.mean, model.colour.probability)
    assert again.smoothness == model.smoothness
    if recipe.basis.has_components:
        few = model.truncated(2)
        expected = model.amplitudes(places, colour=asked)[:, :2]
        assert np.array_equal(few.amplitudes(places, colour=asked), expected)


def test_unknown_colours_count_as_the_mean():
    images, places, colour = stars(7, count=60)
    unknown = np.arange(60) < 20
    model = fit(POLYNOMIAL, images, places, np.where(unknown, np.nan, colour))
    assert model.colour.mean == pytest.approx(colour[~unknown].mean(), abs=1e-15)
    filled = fit(POLYNOMIAL, images, places, np.where(unknown, colour[~unknown].mean(), colour))
    np.testing.assert_allclose(model.at(places, colour=colour), filled.at(places, colour=colour), atol=1e-13)


def test_wrong_colours_are_refused_in_one_line():
    images, places, colour = stars(8, count=12)
    model = fit(LINEAR, images, places)
    for wrong, match in (
        (colour[:5], r"colour has shape \(5,\): expected one number, or one for each of 12"),
        (np.where(colour > 1.0, np.inf, colour), "colour is infinite: expected finite numbers, or NaN"),
        (["red"] * 12, "colour = .*: expected real numbers"),
    ):
        with pytest.raises(DomainError, match=match):
            fit(LINEAR, images, places, wrong)
        with pytest.raises(DomainError, match=match):
            model.at(places, colour=wrong)
    with pytest.raises(ConfigError, match="order = 3: expected 0 to 2, of a colour term"):
        ColourTerm(order=3)
    with pytest.raises(DomainError, match="colour = 'g_i': expected a ColourTerm or None"):
        Recipe(Pixels(), Kriging(), colour="g_i")
