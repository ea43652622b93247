from dataclasses import replace

import numpy as np
import pytest

from pachon.reconstruction.focal_plane_psf.covariance import Covariance, Places, ccd_terms

HALF = 0.02  # [m]
CENTERS = np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.05]])


def places(n, seed):
    rng = np.random.default_rng(seed)
    ccd = rng.integers(0, 3, n)
    uv = rng.uniform(-1.0, 1.0, (n, 2))
    return Places(CENTERS[ccd] + HALF * uv, ccd, uv)


def two_components(ccd=(0.3, 0.2, 0.1), nugget=0.05):
    matrix = np.array([[[300.0, -120.0], [0.0, 80.0]], [[30.0, 45.0], [0.0, 10.0]]])
    return Covariance(2.0, np.array([1.5, 0.7]), matrix, np.array(ccd), nugget)


def by_loops(covariance, one, other, ripple_length=0.6):
    """The formula of the docstrings, a pair at a time; ripples fall by e over 0.3 sides, 0.6 halves of a side."""
    found = np.empty((len(one), len(other)))
    for i in range(len(one)):
        for k in range(len(other)):
            d = one.xy[i] - other.xy[k]
            value = covariance.constant
            for a, m in zip(covariance.amplitude, covariance.matrix, strict=True):
                value += a * np.exp(-np.linalg.norm(m @ d))
            if one.ccd[i] == other.ccd[k]:
                step, slope, ripple = covariance.ccd
                value += step + slope * (one.uv[i] @ other.uv[k])
                value += ripple * np.exp(-np.linalg.norm(one.uv[i] - other.uv[k]) / ripple_length)
            found[i, k] = value
    return found


@pytest.mark.parametrize("ccd", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.1)])
def test_between_is_the_formula(ccd):
    covariance, one, other = two_components(ccd), places(23, 1), places(17, 2)
    # Rounding alone: the same sums in another order.
    np.testing.assert_allclose(covariance.between(one, other), by_loops(covariance, one, other), rtol=1e-13)
    # The matrix is not symmetric under an exchange of x and y, so a transposed M would show.
    turned = Covariance(2.0, covariance.amplitude, covariance.matrix.transpose(0, 2, 1), covariance.ccd, 0.0)
    assert np.abs(by_loops(turned, one, other) - by_loops(covariance, one, other)).max() > 0.1


def test_a_covariance_is_symmetric_and_positive_definite():
    here = places(150, 3)
    for ccd in ((0.0, 0.0, 0.0), (0.3, 0.2, 0.1)):
        matrix = two_components(ccd).between(here, here)
        np.testing.assert_array_equal(matrix, matrix.T)
        # 150 distinct places: the smallest eigenvalue of an exponential covariance of them is of the order of the
        # distance of the closest two over the length; rounding is 1e-13 of the largest (some hundreds).
        assert np.linalg.eigvalsh(matrix)[0] > 1e-6


def test_at_is_the_diagonal_without_the_nugget():
    covariance, here = two_components(nugget=7.0), places(40, 4)
    np.testing.assert_allclose(covariance.at(here), np.diagonal(by_loops(covariance, here, here)), rtol=1e-13)
    np.testing.assert_allclose(covariance.at(here), np.diagonal(covariance.between(here, here)), rtol=1e-13)


def test_amplitudes_multiply_all_but_what_stars_share():
    covariance, plain, other = two_components(), places(30, 7), places(20, 8)
    amplitudes = [np.random.default_rng(9).uniform(0.8, 1.6, len(p)) for p in (plain, other)]
    here, there = (replace(p, amplitude=a) for p, a in zip((plain, other), amplitudes, strict=True))
    about_common = by_loops(covariance, plain, other) - covariance.constant
    expected = covariance.constant + np.outer(*amplitudes) * about_common
    np.testing.assert_allclose(covariance.between(here, there), expected, rtol=1e-13)
    np.testing.assert_allclose(covariance.at(here), np.diagonal(covariance.between(here, here)), rtol=1e-13)
    np.testing.assert_array_equal(here[np.array([4, 2])].amplitude, amplitudes[0][[4, 2]])


def test_variance_is_that_at_the_centre_of_a_ccd_about_the_mean():
    covariance = two_components()
    centre = Places(CENTERS[:1], np.array([0]), np.zeros((1, 2)))
    assert covariance.variance == pytest.approx(covariance.at(centre)[0] - covariance.constant, rel=1e-14)


def test_axes_of_known_lengths_and_direction():
    along, across = np.array([0.3, 0.05]), np.array([0.02, 0.04])
    angle = np.array([0.4, 2.5])
    matrices = []
    for a, b, t in zip(along, across, angle, strict=True):
        rotation = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])
        # |M d|^2 = d^T R diag(1/a^2, 1/b^2) R^T d; M is its upper Cholesky factor.
        matrices.append(np.linalg.cholesky(rotation @ np.diag([a**-2, b**-2]) @ rotation.T).T)
    covariance = Covariance(0.0, np.ones(2), np.array(matrices), np.zeros(3), 0.0)
    found = covariance.axes
    # Condition 225 of the form: rounding of some 1e-14.
    for got, true in zip(found, (along, across, angle), strict=True):
        np.testing.assert_allclose(got, true, rtol=1e-11)
    # Along the first axis of a component the exponent is 1 at its length.
    tip = np.stack([along[0] * np.array([np.cos(angle[0]), np.sin(angle[0])]), [0.0, 0.0]])
    alone = Covariance(0.0, np.array([1.0, 0.0]), np.array(matrices), np.zeros(3), 0.0)
    ends = Places(tip, np.zeros(2, dtype=int), np.zeros((2, 2)))
    assert alone.between(ends, ends)[0, 1] == pytest.approx(np.exp(-1.0), rel=1e-12)


def test_terms_of_ccds_are_one_within_and_zero_between():
    here = places(30, 5)
    same = here.ccd[:, None] == here.ccd
    step, slope, ripple = ccd_terms(here, here)
    np.testing.assert_array_equal(step, same)
    for term in (slope, ripple):
        assert not term[~same].any()
    np.testing.assert_array_equal(np.diagonal(ripple), 1.0)


def test_places_are_chosen_by_index_and_mask():
    here = places(10, 6)
    some = here[np.array([7, 2])]
    assert len(some) == 2
    np.testing.assert_array_equal(some.xy, here.xy[[7, 2]])
    np.testing.assert_array_equal(some.ccd, here.ccd[[7, 2]])
    np.testing.assert_array_equal(some.uv, here.uv[[7, 2]])
