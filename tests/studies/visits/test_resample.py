import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.studies.visits.resample import resample_stamps


def turned(angle, scale=1.0):
    return scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_quadratics_are_reproduced():
    # Cubic convolution with a = -1/2 is exact for them (Keys 1981).
    y, x = np.mgrid[-12.0:13.0, -12.0:13.0]
    image = 1.0 + 0.3 * x - 0.2 * y + 0.05 * x * y + 0.02 * x**2 - 0.03 * y**2
    matrix = turned(0.4, 1.1)
    found = resample_stamps(image[None], matrix[None], 11)[0]
    y, x = np.mgrid[-5.0:6.0, -5.0:6.0]
    u, v = np.einsum("ij,jyx->iyx", matrix, np.stack([x, y]))
    expected = 1.1**2 * (1.0 + 0.3 * u - 0.2 * v + 0.05 * u * v + 0.02 * u**2 - 0.03 * v**2)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_quarter_turns_move_pixels():
    image = np.random.default_rng(1).random((1, 15, 15)).astype(np.float32)
    # The matrix leads from the result to the stamp: x of the result is y of the stamp.
    found = resample_stamps(image, np.array([[[0.0, -1.0], [1.0, 0.0]]]), 9)
    np.testing.assert_array_equal(found[0], np.rot90(image[0])[3:-3, 3:-3])
    np.testing.assert_array_equal(resample_stamps(image, np.eye(2)[None], 9)[0], image[0, 3:-3, 3:-3])


def test_brute_force():
    rng = np.random.default_rng(2)
    image, matrix = rng.random((3, 15, 15)), np.stack([turned(a, s) for a, s in ((0.3, 1.0), (2.0, 0.9), (4.0, 1.05))])
    found = resample_stamps(image, matrix, 5)

    def keys(t):
        t = abs(t)
        return 1.5 * t**3 - 2.5 * t**2 + 1 if t < 1 else -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2 if t < 2 else 0.0

    for n in range(3):
        for i, j in ((0, 0), (2, 2), (1, 4)):
            u, v = matrix[n] @ (j - 2, i - 2) + 7.0
            expected = sum(image[n, k, m] * keys(u - m) * keys(v - k) for k in range(15) for m in range(15))
            assert found[n, i, j] == pytest.approx(expected * np.linalg.det(matrix[n]), rel=1e-5)


def test_flux_is_conserved_and_threads_change_nothing():
    y, x = np.mgrid[-24:25, -24:25]
    image = np.exp(-0.5 * ((x / 2.1) ** 2 + (y / 1.8) ** 2))
    image /= image.sum()
    matrix = np.stack([turned(a, 1.02) for a in np.linspace(0.0, 6.0, 7)])
    one, two = (resample_stamps(np.repeat(image[None], 7, axis=0), matrix, 31, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one, two)
    # Sums over the samples of an interpolation alias: 3e-4 at this width.
    np.testing.assert_allclose(one.sum(axis=(1, 2)), 1.0, atol=5e-4)


def test_shapes_that_do_not_fit():
    with pytest.raises(DomainError, match=r"\(2, 9, 9\), \(3, 2, 2\)"):
        resample_stamps(np.zeros((2, 9, 9)), np.zeros((3, 2, 2)), 5)
