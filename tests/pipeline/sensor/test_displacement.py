"""Tree rings and edge roll-off: closed forms."""

import numpy as np
import pytest
from scipy.special import erf

import pachon
from pachon.core.errors import DomainError
from pachon.pipeline.sensor.displacement import EdgeRolloff, TreeRings, displace_stamps

PIXEL, SIGMA = 10e-6, 1.5
HALF = 0.02048


def line(boundary):
    """Integral of a Gaussian of sigma 1.5 pixels at 0 between boundaries [pixel]."""
    return np.diff(0.5 * (1.0 + erf(boundary / (SIGMA * np.sqrt(2.0)))))


@pytest.fixture
def star():
    along = line(np.arange(32) - 15.5)
    return np.outer(along, along)


def moments(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] - image.shape[0] // 2
    cx, cy = (image * x).sum(), (image * y).sum()
    return np.array([cx, cy]), np.array([(image * x * x).sum() - cx**2, (image * y * y).sum() - cy**2])


def test_rings_displace_along_the_radius():
    rings = TreeRings(2e-7, 6e-4, (0.03, -0.01), phase=0.3)
    x, y = np.array([0.01, -0.005, 0.03]), np.array([0.002, 0.02, -0.01])
    found = rings.at(x, y)
    for i in range(2):
        radius = np.hypot(x[i] - 0.03, y[i] + 0.01)
        size = 2e-7 * np.cos(2.0 * np.pi * radius / 6e-4 + 0.3)
        expected = size * np.array([(x[i] - 0.03) / radius, (y[i] + 0.01) / radius])
        np.testing.assert_allclose(found[i], expected, atol=1e-20)
    # On the axis there is no direction.
    np.testing.assert_array_equal(found[2], 0.0)


def test_an_edge_pushes_outwards_and_falls_by_e():
    edge = EdgeRolloff(3e-6, 5e-5, HALF)
    found = edge.at([HALF, HALF - 5e-5, -HALF, 0.0], [0.0, 0.0, 0.0, 1e-5 - HALF])
    np.testing.assert_allclose(found[:, 0], [3e-6, 3e-6 / np.e, -3e-6, 0.0], atol=1e-15)
    np.testing.assert_allclose(found[:, 1], [0.0, 0.0, 0.0, -3e-6 * np.exp(-0.2)], atol=1e-15)


def test_a_star_between_two_rings_is_stretched(star):
    # Light that lands at b fell at b - d(b): where d rises by g a length, a star is 1/(1 - g) times as long.
    amplitude, period = 3e-6, 6e-3
    rings = TreeRings(amplitude, period, (-0.03, 0.0), phase=-0.5 * np.pi)
    place = np.array([[0.0, 0.0]])  # 5 whole periods from the axis, where the displacement is 0 and rises
    gradient = 2.0 * np.pi * amplitude / period
    centre, found = moments(displace_stamps(star[None], [rings], place, PIXEL)[0])
    # Light is stretched, and then falls into pixels of 1/12 pixel^2. Across the radius it is stretched by d/r only.
    assert found[0] == pytest.approx(SIGMA**2 / (1.0 - gradient) ** 2 + 1.0 / 12.0, rel=2e-5)
    assert found[1] == pytest.approx(SIGMA**2 + 1.0 / 12.0, rel=1e-6)
    assert found[0] - found[1] > 5e-3 * SIGMA**2
    np.testing.assert_allclose(centre, 0.0, atol=1e-4)


def test_stars_stay_in_place_as_a_whole(star):
    # On a crest of the rings: 2 um for all of the star, which is left out, and hardly a distortion.
    rings = TreeRings(2e-6, 6e-2, (-0.06, 0.0))
    place = np.array([[0.0, 0.0]])
    np.testing.assert_allclose(rings.at(*place[0]), [2e-6, 0.0], atol=1e-15)
    found = displace_stamps(star[None], [rings], place, PIXEL)[0]
    # The crest is curved by 2 pi / 6 cm in the square times 2 um: over a star, 3e-5.
    np.testing.assert_allclose(found, star, atol=5e-5 * star.max())


def test_a_star_near_an_edge(star):
    amplitude, length = 5e-6, 2e-4
    place = np.array([[HALF - 2.5e-4, 0.0]])
    found = displace_stamps(star[None], [EdgeRolloff(amplitude, length, HALF)], place, PIXEL)[0]
    # Closed form: boundaries at b - d(b), less the displacement of the star itself.
    boundary = np.arange(32) - 15.5
    shift = amplitude * (np.exp(-2.5e-4 / length) - np.exp(-(2.5e-4 - boundary * PIXEL) / length)) / PIXEL
    row = star.sum(axis=0)
    np.testing.assert_allclose(found.sum(axis=0), line(boundary + shift), atol=1e-4 * row.max())
    assert np.abs(found.sum(axis=0) - row).max() > 5e-3 * row.max()
    np.testing.assert_allclose(found.sum(axis=1), row, atol=1e-9)


def test_effects_add_up_and_none_leaves_the_stamps(star):
    stamps = star[None]
    assert displace_stamps(stamps, [], np.zeros((1, 2)), PIXEL) is stamps
    half = TreeRings(1e-7, 6e-4, (0.03, 0.03))
    whole = TreeRings(2e-7, 6e-4, (0.03, 0.03))
    place = np.array([[0.004, -0.003]])
    np.testing.assert_allclose(
        displace_stamps(stamps, [half, half], place, PIXEL), displace_stamps(stamps, [whole], place, PIXEL), atol=1e-15
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: pachon.pipeline.TreeRings(1e-7, 0.0, (0.0, 0.0)),
        lambda: pachon.pipeline.TreeRings(np.nan, 1e-3, (0.0, 0.0)),
        lambda: pachon.pipeline.EdgeRolloff(1e-6, -1.0, HALF),
        lambda: pachon.pipeline.EdgeRolloff(np.inf, 1e-5, HALF),
    ],
)
def test_bad_numbers(make):
    with pytest.raises(DomainError, match="expected finite numbers"):
        make()


def test_places_are_one_for_each_stamp(star):
    with pytest.raises(DomainError, match=r"expected \[n, ny, nx\] and \[n, 2\]"):
        displace_stamps(star[None], [EdgeRolloff(1e-6, 1e-5, HALF)], np.zeros((2, 2)), PIXEL)
