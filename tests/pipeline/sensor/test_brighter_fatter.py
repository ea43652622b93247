"""The brighter-fatter effect: against brute force, and what must hold whatever the coefficients are."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.pipeline.sensor.brighter_fatter import COEFFICIENTS, boundary_shifts, brighter_fatter


@pytest.fixture
def star():
    y, x = np.mgrid[:31, :31] - 15
    image = np.exp(-(x**2 + y**2) / (2.0 * 1.5**2))
    return image / image.sum()


def second_moments(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] - image.shape[0] // 2
    return np.array([(image * x * x).sum(), (image * y * y).sum()]) / image.sum()


@pytest.mark.parametrize("sensor", ["itl", "e2v"])
def test_boundaries_move_towards_charge(sensor):
    # One pixel with 100 000 electrons; every boundary within reach by hand.
    charge = np.zeros((1, 15, 15))
    charge[0, 7, 7] = 1e5
    shift_x, shift_y = boundary_shifts(charge, sensor)
    along_x, along_y = COEFFICIENTS[sensor]
    expected_x, expected_y = np.zeros((15, 16)), np.zeros((16, 15))
    for along in range(-3, 4):
        for across in range(4):
            # Boundary k lies between pixels k - 1 and k.
            expected_x[7 + along, 8 + across] = -1e-4 * along_x[abs(along), across]
            expected_x[7 + along, 7 - across] = 1e-4 * along_x[abs(along), across]
            expected_y[8 + across, 7 + along] = -1e-4 * along_y[abs(along), across]
            expected_y[7 - across, 7 + along] = 1e-4 * along_y[abs(along), across]
    np.testing.assert_allclose(shift_x[0], expected_x, atol=1e-18)
    np.testing.assert_allclose(shift_y[0], expected_y, atol=1e-18)
    # Lage et al. 2017: a pixel that is full loses some per cent of its area, more along y than along x.
    assert 0.02 < expected_y[7, 7] < 0.08
    assert expected_y[7, 7] > 1.5 * expected_x[7, 7]


def test_even_light_moves_nothing(star):
    for shift in boundary_shifts(np.full((1, 12, 12), 5e4), "itl"):
        assert np.abs(shift).max() < 1e-15
    # Nor does a star without electrons to speak of.
    assert np.abs(brighter_fatter(star[None], [1e-3])[0] - star).max() < 1e-10


def test_growth_is_proportional_to_the_electrons_and_no_charge_is_lost(star):
    counts = np.array([1e4, 2e4, 1e5])
    found = brighter_fatter(np.repeat(star[None], 3, axis=0), counts)
    growth = [second_moments(image) - second_moments(star) for image in found]
    np.testing.assert_allclose(growth[1], 2.0 * growth[0], rtol=1e-2)
    np.testing.assert_allclose(growth[2], 10.0 * growth[0], rtol=1e-2)
    # Brighter is fatter, and more so along the columns.
    assert growth[2][1] > growth[2][0] > 1e-4
    np.testing.assert_allclose(found.sum(axis=(1, 2)), 1.0, atol=1e-12)


def test_the_sky_under_a_star_is_pushed_away_too(star):
    # Sky and star are one charge: a pedestal under the star is collected within the same boundaries.
    flat = np.full_like(star, 1e-3)
    sky = 1e-3 * 5e5
    together = brighter_fatter((star + flat)[None], [5e5])[0] - flat
    np.testing.assert_allclose(brighter_fatter(star[None], [5e5], sky=sky)[0], together, atol=1e-12)
    assert np.abs(together - brighter_fatter(star[None], [5e5])[0]).max() > 1e-6


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"electrons": [0.0]}, DomainError, "positive"),
        ({"electrons": [np.nan]}, DomainError, "positive"),
        ({"electrons": [1.0, 2.0]}, DomainError, r"\[n, ny, nx\] and \[n\]"),
        ({"sky": -1.0}, DomainError, "not negative"),
        ({"sensor": "kodak"}, ConfigError, "itl, e2v"),
    ],
)
def test_bad_arguments(star, options, error, words):
    with pytest.raises(error, match=words):
        pachon.pipeline.brighter_fatter(star[None], **({"electrons": [1e5]} | options))
