"""Strehl ratio at the brightest point of the image, against a fine search over all tilts."""

import numpy as np
import pytest

from pachon.design.metrics.wavefront_strehl import brightest_strehl
from pachon.models.zernike_polynomials import annular_zernikes

RINGS, SPOKES = 12, 64


@pytest.mark.parametrize("obscuration", [0.0, 0.6])
@pytest.mark.parametrize("kind", ["defocus", "any"])
def test_the_brightest_point_may_be_far_from_the_middle(obscuration, kind):
    """Defocus alone makes the middle dark at some ranges, and a ring around it the brightest place."""
    node, weight = np.polynomial.legendre.leggauss(RINGS)
    low = obscuration**2
    radius, angle = np.sqrt(0.5 * (1 + low + (1 - low) * node)), 2 * np.pi * np.arange(SPOKES) / SPOKES
    pupil = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()], axis=-1)
    weights = np.repeat(0.5 * weight / SPOKES, SPOKES)
    terms = annular_zernikes(22, *pupil.T, obscuration)[3:]
    tilts = np.arange(-4.0, 4.01, 0.05)
    across, along = (np.exp(-2j * np.pi * np.outer(tilts, u)) for u in pupil.T)
    rng = np.random.default_rng(4)
    for _ in range(12):
        coefficients = rng.normal(size=len(terms)) if kind == "any" else np.eye(len(terms))[0]
        waves = rng.uniform(0.1, 0.35) * coefficients / np.linalg.norm(coefficients) @ terms
        field = weights * np.exp(2j * np.pi * waves)
        brightest = (np.abs((along * field) @ across.T) ** 2).max()
        # A peak falls by 3e-4 of a perfect one within half of a step of the search.
        assert brightest_strehl(weights, pupil, waves) == pytest.approx(brightest, abs=1e-3, rel=0.01)
