"""Mean shears, biases and their errors against sums restated here."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError


def shapes_of(shear, response, rng, noise, weight=None):
    """Shapes with a response matrix [[r11, r12], [r12, r22]] of each galaxy, under a shear."""
    n = len(response)
    e = np.einsum("nij,j->ni", response, shear) + noise * rng.standard_normal((n, 2))
    weight = np.ones(n) if weight is None else weight
    r11, r12, r22 = response[:, 0, 0], response[:, 0, 1], response[:, 1, 1]
    return pachon.measure.ShearShapes(*(weight * v for v in (*e.T, r11, r12, r22)), weight, np.full(n, 20.0))


def responses(n, rng):
    values = 0.4 * np.eye(2) + 0.05 * rng.standard_normal((n, 2, 2))
    return 0.5 * (values + values.swapaxes(1, 2)) + np.array([[0.0, 0.02], [0.02, 0.0]])


def test_mean_shear_is_the_one_that_the_responses_give():
    rng = np.random.default_rng(1)
    response = responses(5000, rng)
    weight = rng.uniform(0.0, 1.0, 5000)
    found = pachon.measure.mean_shear(shapes_of((0.03, -0.02), response, rng, 0.0, weight))
    np.testing.assert_allclose([found.g1, found.g2], [0.03, -0.02], rtol=1e-12)
    mean = (weight[:, None, None] * response).sum(axis=0) / weight.sum()
    np.testing.assert_allclose(found.response, mean, rtol=1e-12)
    assert found.galaxies == pytest.approx(weight.sum())
    noisy = pachon.measure.mean_shear(shapes_of((0.03, -0.02), response, rng, 0.1))
    # A shear has the error of the mean ellipticity over the mean response.
    expected = 0.1 / np.sqrt(5000) / 0.4
    assert noisy.g1_error == pytest.approx(expected, rel=0.3)
    assert abs(noisy.g1 - 0.03) < 4.0 * expected


def test_errors_are_those_of_a_jackknife_over_patches():
    rng = np.random.default_rng(2)
    shapes = shapes_of((0.01, 0.0), responses(60, rng), rng, 0.1)
    patch = np.array([3, 5, 9])[np.arange(60) % 3]
    found = pachon.measure.mean_shear(shapes, patch=patch)
    without = []
    for name in (3, 5, 9):
        kept = patch != name
        matrix = np.array([[shapes.r11, shapes.r12], [shapes.r12, shapes.r22]])[:, :, kept].sum(axis=2)
        without.append(np.linalg.solve(matrix, [shapes.e1[kept].sum(), shapes.e2[kept].sum()]))
    expected = np.sqrt(2.0 / 3.0 * ((without - np.mean(without, axis=0)) ** 2).sum(axis=0))
    np.testing.assert_allclose([found.g1_error, found.g2_error], expected, rtol=1e-10)


def test_bias_is_that_of_the_shears_and_shapes_cancel_in_it():
    rng = np.random.default_rng(3)
    n, g = 4000, 0.02
    response, component = responses(n, rng), np.arange(n) % 2
    shape = 0.2 * rng.standard_normal((n, 2))
    pair = []
    for sign in (1.0, -1.0):
        shear = sign * g * np.array([[1.01, 0.0], [0.0, 0.98]])[component] + np.array([1e-3, -2e-3])
        e = np.einsum("nij,nj->ni", response, shear) + shape
        columns = response[:, 0, 0], response[:, 0, 1], response[:, 1, 1]
        pair.append(pachon.measure.ShearShapes(*e.T, *columns, np.ones(n), np.full(n, 20.0)))
    # Patches of one direction each; along x = y the pairs are the other way round.
    direction = np.array([[g, 0.0], [0.0, -g]])[np.arange(200) % 2]
    patch = 2 * (np.arange(n) // 40) + component
    swapped = [
        type(pair[0])(*(np.where(component == 1, getattr(b, c), getattr(a, c)) for c in a._table))
        for a, b in (pair, pair[::-1])
    ]
    found = pachon.measure.shear_bias(*swapped, *direction.T, patch=patch)
    np.testing.assert_allclose(found.m, [0.01, -0.02], atol=1e-10)
    assert found.c_error[0] == pytest.approx(0.2 / np.sqrt(n) / 0.4, rel=0.3)
    np.testing.assert_allclose(found.c, [1e-3, -2e-3], atol=4.0 * found.c_error.max())


def test_galaxies_of_unequal_numbers_by_patch():
    """Detected objects differ under a shear and its opposite: patches pair them."""
    rng = np.random.default_rng(4)
    numbers = np.arange(900) // 9
    plus, minus = (shapes_of((s * 0.02, 0.0), responses(900, rng), rng, 0.0) for s in (1.0, -1.0))
    kept = rng.uniform(size=900) < 0.9
    found = pachon.measure.shear_bias(plus, minus.take(kept), 0.02, 0.0, patch=numbers, minus_patch=numbers[kept])
    np.testing.assert_allclose(found.m[0], 0.0, atol=1e-10)
    with pytest.raises(DomainError, match="900 and "):
        pachon.measure.shear_bias(plus, minus.take(kept), 0.02, 0.0)


def test_patches_of_unequal_numbers_and_shears_have_no_bias():
    """A shear from all patches is their mean by response: 1900 galaxies under 0.01 and 100 under 0.05 give 0.012."""
    rng = np.random.default_rng(6)
    patch = np.repeat(np.arange(20), [190] * 10 + [10] * 10)
    shear = np.where(np.arange(20) < 10, 0.01, 0.05)
    response, zero = rng.uniform(0.3, 0.5, 2000), np.zeros(2000)
    sides = []
    for sign in (1.0, -1.0):
        e1 = 1.003 * sign * shear[patch] * response
        sides.append(pachon.measure.ShearShapes(e1, zero, response, zero, response, zero + 1.0, zero + 20.0))
    found = pachon.measure.shear_bias(*sides, shear, 0.0, patch=patch)
    np.testing.assert_allclose(found.m[0], 0.003, atol=1e-12)
    assert found.m_error[0] < 1e-12


def test_bad_input_is_one_line():
    rng = np.random.default_rng(5)
    shapes = shapes_of((0.0, 0.0), responses(10, rng), rng, 0.1)
    with pytest.raises(DomainError, match="1 galaxy, expected at least two"):
        pachon.measure.mean_shear(shapes.take([0]))
    with pytest.raises(DomainError, match="patch: 1 different, expected at least two"):
        pachon.measure.mean_shear(shapes, patch=np.zeros(10, dtype=int))
    with pytest.raises(DomainError, match=r"patch: shape \(3,\), expected the patch of each of 10 galaxies"):
        pachon.measure.mean_shear(shapes, patch=np.zeros(3))
    nothing = pachon.measure.ShearShapes(*np.zeros((7, 10)))
    with pytest.raises(DomainError, match="their mean response is not positive"):
        pachon.measure.mean_shear(nothing)
