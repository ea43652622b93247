"""Predictions of stars that are left out together, under the covariances of all stars."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.reconstruction.psf_model.model import PsfModel


def stars(count=24, size=11, colour=False):
    """Gaussian stars whose widths are linear in the position, with noise, and colours that widen them."""
    rng = np.random.default_rng(3)
    places, colours = rng.uniform(-1.0, 1.0, (count, 2)), rng.normal(0.0, 1.0, count)
    y, x = np.mgrid[:size, :size] - size // 2
    width = 1.7 + 0.1 * places[:, :1, None] + 0.05 * colour * colours[:, None, None]
    images = np.exp(-0.5 * (x**2 / width**2 + y**2 / 1.7**2))
    images *= 1e5 / images.sum(axis=(1, 2), keepdims=True)
    return images + rng.normal(0.0, 8.0, images.shape), places, colours


@pytest.mark.parametrize("colour", [False, True])
def test_one_star_left_out_is_dubrules_formula(colour):
    """``PsfModel.leave_one_out`` solves for all stars at once, and divides by the precision of each."""
    images, places, colours = stars(colour=colour)
    # One form alone: with several the mean over forms of what single stars leave is no prediction by mean covariances.
    model = PsfModel.fit(images, places, colour=colours if colour else None)
    covariances = model.interpolation.covariances
    best = int(np.argmax(covariances.probabilities))
    one_form = replace(covariances, kernels=covariances.kernels[best : best + 1], probabilities=np.ones(1))
    interpolation = replace(model.interpolation, covariances=one_form)
    expected = interpolation.leave_one_out(model.coefficients)
    for star in (0, 7, 23):
        without = interpolation.without(np.array([star]), model.coefficients)
        predicted = without.with_colour(places[star], colours[star : star + 1] if colour else None)
        difference = (model.coefficients[star] - predicted)[0]
        # Rounding of two ways to solve.
        assert difference == pytest.approx(expected[star], abs=1e-7 * np.abs(model.mean).max())


def test_stars_left_out_together_do_not_count():
    images, places, _ = stars()
    model = PsfModel.fit(images, places)
    held_out = np.array([2, 5, 11, 17])
    without = model.interpolation.without(held_out, model.coefficients)
    changed = model.coefficients.copy()
    changed[held_out] += 1.0
    assert without.at(places[held_out]).tobytes() == (
        model.interpolation.without(held_out, changed).at(places[held_out]).tobytes()
    )
    assert len(without.positions) == 20
    # Nearly what a fit of the others predicts, which has covariances and a response of its own.
    others = np.setdiff1d(np.arange(24), held_out)
    predicted = replace(model, interpolation=without).at(places[held_out])
    refitted = PsfModel.fit(images[others], places[others]).at(places[held_out])
    noise = 8.0 / 1e5
    assert np.sqrt(np.mean((predicted - refitted) ** 2)) < 0.5 * noise


def test_principal_components_take_another_fit():
    images, places, _ = stars()
    model = PsfModel.fit(images, places, recipe="paper", n_components=3, order=1)
    assert model.interpolation.without(np.array([1]), model.coefficients) is None
