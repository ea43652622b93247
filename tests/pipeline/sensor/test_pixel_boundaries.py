"""Charge within displaced boundaries: closed forms of a Gaussian star, conservation, even light."""

import numpy as np
import pytest
from scipy.special import erf

from pachon.pipeline.sensor.pixel_boundaries import collect, with_rim, without_rim

SIZE, SIGMA = 31, 1.5


def gaussian(boundary_x, boundary_y, sigma=SIGMA):
    """Integral of a Gaussian star at 0 between boundaries [pixel], [y, x]."""
    parts = [np.diff(0.5 * (1.0 + erf(b / (sigma * np.sqrt(2.0))))) for b in (boundary_x, boundary_y)]
    return np.outer(parts[1], parts[0])


@pytest.fixture
def boundary():
    return np.arange(SIZE + 1) - SIZE / 2


@pytest.fixture
def star(boundary):
    return gaussian(boundary, boundary)


def moved(image, dx, dy):
    """The image with boundaries displaced by dx(b), dy(b), the same in all rows and columns."""
    shift_x = np.broadcast_to(dx, (1, SIZE, SIZE + 1))
    shift_y = np.broadcast_to(np.asarray(dy)[:, None], (1, SIZE + 1, SIZE))
    return collect(image[None], shift_x, shift_y)[0]


@pytest.mark.parametrize(("shift", "stretch"), [((0.0, 0.0), 0.0), ((0.4, -1.3), 0.0), ((0.02, 0.01), 0.03)])
def test_displaced_boundaries_of_a_gaussian_star(boundary, star, shift, stretch):
    dx, dy = shift[0] + stretch * boundary, shift[1] - stretch * boundary
    found = moved(star, dx, dy)
    # A spline of degree 5 through pixels of a star of FWHM 3.5 pixels; the tests of displacements rest on it.
    assert np.abs(found - gaussian(boundary + dx, boundary + dy)).max() < 5e-4 * star.max()
    assert found.sum() == pytest.approx(1.0, abs=1e-6)
    if any(shift) or stretch:
        assert np.abs(found - star).max() > 0.01 * star.max()
    else:
        np.testing.assert_allclose(found, star, atol=1e-15)


def test_no_charge_is_lost_but_through_the_outermost_boundaries():
    rng = np.random.default_rng(1)
    images = rng.uniform(0.0, 1.0, (3, 20, 24))
    shift_x, shift_y = rng.normal(0.0, 0.05, (3, 20, 25)), rng.normal(0.0, 0.05, (3, 21, 24))
    for shift in (shift_x, shift_y.swapaxes(1, 2)):
        shift[:, :, [0, -1]] = 0.0
    found = collect(images, shift_x, shift_y)
    np.testing.assert_allclose(found.sum(axis=(1, 2)), images.sum(axis=(1, 2)), rtol=1e-13)
    assert np.abs(found - images).max() > 0.01


def test_even_light_is_the_area_of_the_pixels():
    rng = np.random.default_rng(2)
    shift = rng.normal(0.0, 0.05, (1, 20, 25))
    shift[:, :, [0, -1]] = 0.0
    found = collect(np.full((1, 20, 24), 7.0), shift, np.zeros((1, 21, 24)))
    np.testing.assert_allclose(found, 7.0 * (1.0 + np.diff(shift, axis=2)), rtol=1e-12)


def test_the_rim_continues_the_outermost_pixels(star):
    wide = with_rim(star[None])
    np.testing.assert_array_equal(without_rim(wide)[0], star)
    assert (wide[0, :8, :8] == star[0, 0]).all()
