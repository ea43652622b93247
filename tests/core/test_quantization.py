"""Values in steps: their step, and medians of them with a dither."""

import numpy as np
import pytest

from pachon.core.quantization import dithered

NONE = np.zeros((200, 200), dtype=bool)


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(1).normal(size=NONE.shape)


@pytest.mark.parametrize("step", [1.0, 2.3, 1e-9])
@pytest.mark.parametrize("width", [0.7, 1.5, 40.0])
def test_medians_and_noise_of_rounded_values(noise, step, width):
    """The median alone is up to half a step off, the noise by the median absolute deviation up to a third."""
    level = 1000.4
    rounded = np.rint(level + width * noise).astype(np.float32) * np.float32(step)
    result = dithered(rounded.astype(float), NONE)
    assert result.step == pytest.approx(step, rel=1e-3)
    # Standard error of the median.
    error = 1.25 * width / np.sqrt(noise.size)
    assert np.median(result.values) / step == pytest.approx(level, abs=4.0 * error + 0.03)
    rms = 1.4826 * np.median(np.abs(result.values - np.median(result.values)))
    # Three steps and their dither are no Gaussian, of which the absolute deviation has the rms.
    tolerance = 0.03 if width > 1.0 else 0.07
    assert result.noise(rms) / step == pytest.approx(np.hypot(width, np.sqrt(1.0 / 12.0)), rel=tolerance)


def test_values_in_no_steps_stay_as_they_are(noise):
    for values in (noise, np.float32(1000.0 + noise), np.zeros(NONE.shape), np.where(noise > 0.5, noise, 0.0)):
        result = dithered(values, NONE)
        assert result.values is values
        assert (result.step, result.noise(2.0)) == (0.0, 2.0)


def test_values_that_do_not_count_have_no_part_in_the_step(noise):
    unfit = NONE.copy()
    unfit[:50] = True
    values = np.where(unfit, np.nan, np.rint(5.0 * noise))
    assert dithered(values, unfit).step == 1.0
    assert dithered(values[:50], unfit[:50]).step == 0.0
