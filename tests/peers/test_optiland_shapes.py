"""Sags of aspheres and toroids against optiland's geometries."""

import numpy as np
import pytest

import pachon

pytest.importorskip("optiland")

# optiland takes seconds to load.
pytestmark = pytest.mark.slow
X, Y = np.random.default_rng(1).uniform(-9.0, 9.0, (2, 50))


@pytest.mark.parametrize("conic", [0.0, -0.5])
def test_qbfs_terms(conic):
    from optiland.coordinate_system import CoordinateSystem
    from optiland.geometries.forbes.geometry import (
        ForbesQNormalSlopeGeometry,
        ForbesSolverConfig,
        ForbesSurfaceConfig,
    )

    terms = (0.02, 0.01, -0.004, 0.002, 0.001)
    config = ForbesSurfaceConfig(200.0, conic, 20.0, dict(enumerate(terms)))
    peer = ForbesQNormalSlopeGeometry(CoordinateSystem(), config, ForbesSolverConfig())
    shape = pachon.models.QbfsAsphere(0.2, conic, 0.02, tuple(1e-3 * a for a in terms))
    assert np.abs(peer.sag(X, Y) * 1e-3 - shape.sag(1e-3 * X, 1e-3 * Y)).max() < 1e-17


def test_toroids_with_powers():
    from optiland.coordinate_system import CoordinateSystem
    from optiland.geometries.toroidal import ToroidalGeometry

    peer = ToroidalGeometry(CoordinateSystem(), 300.0, -200.0, 0.4, [2e-4, -3e-8, 1e-13])
    shape = pachon.models.Toroid(0.3, -0.2, 0.4, (0.2, -30.0, 100.0))
    # It is the difference of two radii there.
    assert np.abs(peer.sag(X, Y) * 1e-3 - shape.sag(1e-3 * X, 1e-3 * Y)).max() < 2e-16
