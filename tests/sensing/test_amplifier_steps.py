"""Steps of sky and gain across donuts, where two amplifiers of a CCD meet."""

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon
from pachon.sensing import DonutFlag
from pachon.sensing.amplifier_steps import AmplifierStep, step_table, step_words

FIELD = np.deg2rad([(0.9, 0.6)])
DETECTOR = pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
MODEL = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.0), detector=DETECTOR, diffraction=False, neighbours=False)
NOISE = 1000.0
#: Wavefront from j = 4 [m].
WAVE = 30e-9 * np.random.default_rng(8).normal(size=19)
COLUMN, ROW = 37, 52
#: Most noise of an amplitude or wavefront over its claim: 5 of a standard deviation and, of 19 terms, of their mean.
DEVIATIONS, MEAN_SQUARE = 5.0, 1.0 + 5.0 * np.sqrt(2.0 / 19.0)


@pytest.fixture(scope="module")
def clean(behind_focus):
    """Image of a donut without noise."""
    return donut(behind_focus, FIELD[0], zernikes=[0.0, 0.0, 0.0, *WAVE])


def fitted(tel, image):
    fit = pachon.fit_donuts(tel, image[None], FIELD, WAVELENGTH, sky_variance=NOISE, model=MODEL)
    error = fit.zernikes[0] - WAVE
    return fit, error @ np.linalg.solve(fit.covariance[0], error) / 19


@pytest.mark.long
def test_steps_of_the_sky_are_found_and_fitted(behind_focus, clean):
    """Of a corner of four amplifiers: one between columns and one between rows."""
    image = noisy(clean, NOISE, 3)
    stepped = image.copy()
    stepped[:, COLUMN:] += 60.0
    stepped[ROW:] -= 45.0
    fit, chi2 = fitted(behind_focus, stepped)
    assert fit.flags[0] & DonutFlag.AMPLIFIER_STEP
    assert fit.usable[0]
    steps = {row["between"]: row for row in fit.amplifier_steps}
    assert (steps["columns"]["first"], steps["rows"]["first"]) == (COLUMN, ROW)
    for between, size in ("columns", 60.0), ("rows", -45.0):
        error = steps[between]["sky_err"].value
        assert abs(steps[between]["sky"].value - size) < DEVIATIONS * error < 0.5 * abs(size)
    assert chi2 < MEAN_SQUARE
    # The model has the steps: residuals are noise.
    pulls = fit.residuals[0][fit.used[0]] / np.sqrt(clean[fit.used[0]] + NOISE)
    assert abs(pulls.std() - 1.0) < 0.05
    without, _ = fitted(behind_focus, image)
    assert not without.flags[0] & DonutFlag.AMPLIFIER_STEP
    assert len(without.amplifier_steps) == 0
    # What the steps take of the image makes the errors by noise larger, the wavefront no other within them.
    of_noise, of_noise_without = (np.trace(result.error_parts.photons[0]) for result in (fit, without))
    assert of_noise > of_noise_without
    assert (np.abs(fit.zernikes[0] - without.zernikes[0]) < 2.0 * fit.errors[0]).all()


@pytest.mark.long
def test_steps_of_the_gain_are_found_and_fitted(behind_focus, clean):
    image = clean.copy()
    image[:, COLUMN:] *= 1.04
    fit, chi2 = fitted(behind_focus, noisy(image, NOISE, 4))
    assert fit.flags[0] & DonutFlag.AMPLIFIER_STEP
    (step,) = fit.amplifier_steps
    assert (step["between"], step["first"]) == ("columns", COLUMN)
    assert abs(step["gain"] - 0.04) < DEVIATIONS * step["gain_err"] < 0.02
    assert step["sky_err"] == 0.0
    assert chi2 < MEAN_SQUARE


def test_steps_taken_off_are_those_put_on():
    image = np.random.default_rng(1).normal(100.0, 5.0, (5, 7))
    step = AmplifierStep(1, 4, (3.0, 0.1), (1.0, 0.01))
    stepped = step.put_on(image, 90.0)
    np.testing.assert_array_equal(stepped[:, :4], image[:, :4])
    np.testing.assert_allclose(stepped[:, 4:], 90.0 + 1.1 * (image[:, 4:] - 90.0) + 3.0, rtol=1e-14)
    np.testing.assert_allclose(step.taken_off(stepped, 90.0), image, rtol=1e-14)


def test_steps_are_said_in_words():
    steps = {2: [AmplifierStep(1, 37, (40.0, 0.011), (1.0, 0.002)), AmplifierStep(0, 9, (-8.0, 0.0), (0.5, 0.0))]}
    assert step_words(step_table(steps)) == [
        "donut 2, column 37: sky +40 +- 1 e, gain +1.1 +- 0.2 %",
        "donut 2, row 9: sky -8 +- 0.5 e",
    ]
