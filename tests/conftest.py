import numpy as np
import pytest

import pachon


@pytest.fixture(scope="session")
def lsst_r():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.fixture(scope="session")
def zemax_lsst():
    """The design that the Zemax listings in tests/data/zemax belong to."""
    return pachon.load_telescope("lsst_v3.3_g_vacuum_zemax_check")


@pytest.fixture(scope="session")
def annulus_points():
    """Uniform random points of the LSST's unvignetted entrance pupil, ``points(n, seed)`` [m]."""

    def points(n, seed=0):
        rng = np.random.default_rng(seed)
        radius = np.sqrt(rng.uniform(2.558**2, 4.18**2, n))
        angle = rng.uniform(0, 2 * np.pi, n)
        return radius * np.cos(angle), radius * np.sin(angle)

    return points


@pytest.fixture(scope="session")
def slope():
    """``slope(function, step)``: central differences at 0, extrapolated from two steps, so good to step^4."""

    def of(function, step):
        near, far = ((function(h) - function(-h)) / (2 * h) for h in (step, 2 * step))
        return (4 * near - far) / 3

    return of
