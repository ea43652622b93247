"""Transforms of Sersic profiles against direct integration and closed forms, and the accuracy of their table."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, gammaincinv, j0

from pachon.sky.galaxies import Galaxies
from pachon.sky.sersic import GREATEST_INDEX, LEAST_INDEX, sersic_transform


def hankel(n, k):
    """Hankel transform of exp(-b r^(1/n)) of unit flux, in u = r^(1/n), where it is smooth."""
    b = gammaincinv(2 * n, 0.5)
    end = (gammaincinv(2 * n, 1 - 1e-13)) / b
    integral, _ = quad(
        lambda u: u ** (2 * n - 1) * np.exp(-b * u) * j0(k * u**n), 0.0, end, limit=2000, epsabs=1e-13, epsrel=1e-12
    )
    return integral * b ** (2 * n) / gamma(2 * n)


# The integrand of great indices oscillates a thousand times, which is what 1e-8 leaves room for.
@pytest.mark.parametrize("n", [0.3, 0.45, 0.8, 1.5, 2.5, 4.0, 6.2])
def test_transform_is_the_integral(n):
    for k in (0.01, 0.3, 1.0, 3.0, 9.0):
        assert sersic_transform(np.array([n]), np.array([k]))[0, 0] == pytest.approx(hankel(n, k), abs=1e-8)


def test_closed_forms():
    k = np.geomspace(1e-3, 100.0, 50)
    gaussian, exponential = sersic_transform(np.array([0.5, 1.0]), k)
    assert np.abs(gaussian - np.exp(-(k**2) / (4.0 * np.log(2.0)))).max() < 1e-11
    assert np.abs(exponential - (1.0 + (k / 1.678346990016661) ** 2) ** -1.5).max() < 1e-11


def test_the_table_is_interpolated_to_1e_5_of_the_flux():
    rng = np.random.default_rng(0)
    index = np.exp(rng.uniform(np.log(LEAST_INDEX), np.log(GREATEST_INDEX), 100))
    radius = np.exp(rng.uniform(np.log(0.02), np.log(300.0), 100))
    round_galaxies = Galaxies.single(np.zeros(100), 0.0, 24.0, radius, sersic=index)
    got = round_galaxies.transform(np.arange(100), np.tile(np.eye(2), (100, 1, 1)), np.zeros((100, 2)), 12)
    kx, ky = np.meshgrid(np.fft.rfftfreq(12), np.fft.fftfreq(12))
    k = 2.0 * np.pi * np.hypot(kx, ky).ravel()
    k[0] = 1e-3
    for i in range(100):
        expected = sersic_transform(index[i : i + 1], radius[i] * k)[0]
        expected[0] = 1.0
        assert np.abs(got[i].ravel() - expected).max() < 1e-5
