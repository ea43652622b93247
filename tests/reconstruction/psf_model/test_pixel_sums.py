"""Sums over stars and powers of pixels, against NumPy."""

import numpy as np
import pytest

from pachon.core.row_sums import sums_of_products
from pachon.reconstruction.psf_model.pixel_sums import log_powers_and_variances


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 40, 32), (60, 41, 961), (7, 0, 5), (0, 4, 5)])
def test_sums_are_added_row_after_row_whatever_the_batch(shape):
    positions, rows, columns = shape
    rng = np.random.default_rng(sum(shape))
    weights, values = rng.normal(size=(positions, rows)), rng.normal(size=(rows, columns))
    restated = np.zeros((positions, columns))
    for weight, row in zip(weights.T, values, strict=True):
        restated += weight[:, None] * row
    assert np.array_equal(sums_of_products(weights, values), restated)
    for i in range(min(positions, 3)):
        assert np.array_equal(sums_of_products(weights[i : i + 1], values), restated[i : i + 1])


@pytest.mark.parametrize(("axes", "pixels"), [(1, 1), (39, 961), (299, 40)])
def test_powers_and_logarithms_of_variances(axes, pixels):
    rng = np.random.default_rng(axes)
    squares, spectrum, relative = rng.chisquare(1, (axes, pixels)), rng.uniform(0, 1, axes), rng.uniform(0, 1, pixels)
    # The largest that there are: all variance along one axis, of the brightest pixel.
    spectrum[:] *= axes / spectrum.sum()
    spectrum[0], relative[0] = axes, 1.0
    factors = np.array([0.0, 1e-3, 1.0, 4.0**12])
    squares[:, -1] = 0.0  # of a pixel without light
    powers, variances = log_powers_and_variances(squares, spectrum, relative, factors)
    restated = 1.0 + factors[:, None, None] * spectrum[:, None] * relative
    power = (squares / restated).sum(axis=1)[:, :-1]
    np.testing.assert_allclose(powers, np.log(power).sum(axis=1), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(variances, np.log(restated).sum(axis=(1, 2)), rtol=1e-12)


def test_powers_of_stars_without_noise_have_no_bound():
    squares = np.array([[1e300, 1e-200, 0.0]])
    powers, _ = log_powers_and_variances(squares, np.ones(1), np.zeros(3), np.ones(1))
    assert powers[0] == pytest.approx(np.log(1e100) + np.log(1e-150), rel=1e-12)
