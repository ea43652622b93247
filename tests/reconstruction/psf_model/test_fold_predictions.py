"""Predictions of stars that are left out together, under the covariances of all stars."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.reconstruction.psf_model.covariance import krige_mean, predict
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.pixel_fields import SignalCovariance, krige_residuals
from pachon.reconstruction.psf_model.polynomial import mapped


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
    predicted = interpolation.left_out([np.array([star]) for star in range(24)], model.coefficients)
    # Rounding of two ways to solve.
    assert model.coefficients - predicted == pytest.approx(expected, abs=1e-7 * np.abs(model.mean).max())


@pytest.mark.parametrize("colour", [False, True])
def test_stars_left_out_together_are_predicted_by_the_others_alone(colour):
    """Against the kriging of the others alone, under the same covariances, drawn at the places of those left out."""
    images, places, colours = stars(colour=colour)
    model = PsfModel.fit(images, places, colour=colours if colour else None)
    interpolation, noise = model.interpolation, 1.0 / model.weights
    held_out = np.array([2, 5, 11, 17])
    others = np.setdiff1d(np.arange(24), held_out)
    predicted = interpolation.left_out([others, held_out], model.coefficients)[held_out]

    points, terms, fields = mapped(places, model.extent), interpolation.terms(), interpolation.fields
    count = len(interpolation.colour.slope) if colour else 0
    numbers, residuals = fields.split(model.coefficients[others])
    arguments = points[others], terms[others]
    shape_trend, shape_dual = krige_mean(
        arguments[0], numbers, arguments[1], interpolation.covariances, noise[others], colour_count=count
    )
    signal = SignalCovariance.of(interpolation.kernel, *arguments, count)
    trend, dual = krige_residuals(residuals, fields, signal, noise[others])
    trend, dual = shape_trend @ fields.response + trend, shape_dual @ fields.response + dual
    expected = terms[held_out] @ trend + predict(points[others], points[held_out], interpolation.kernel, dual)
    assert predicted == pytest.approx(expected, abs=1e-7 * np.abs(model.mean).max())
    # Nearly what a fit of the others predicts, which has covariances and a response of its own.
    options = {"colour": colours[others]} if colour else {}
    at = {"colour": colours[held_out]} if colour else {}
    refitted = PsfModel.fit(images[others], places[others], **options).at(places[held_out], **at)
    difference = model.basis.at(predicted) - refitted
    assert np.sqrt(np.mean(difference**2)) < 0.5 * 8.0 / 1e5  # of the noise


def test_principal_components_take_another_fit():
    images, places, _ = stars()
    model = PsfModel.fit(images, places, recipe="paper", n_components=3, order=1)
    assert not model.interpolation.predicts_left_out
