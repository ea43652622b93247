"""Wavefronts that are strong beside their defocus, as those of small telescopes are."""

import numpy as np
import pytest
from donut_images import WAVELENGTH, donut, noisy

import pachon


@pytest.mark.long
def test_further_terms_do_not_lead_astray():
    """Fitted with all others from the start, they ended at another wavefront: 175 nm off, two of six donuts."""
    telescope, pixel = pachon.load_telescope("auxtel").perturbed("M2", shift=(0.0, 0.0, -0.8e-3)), 40e-6
    random = np.random.default_rng(0)
    true = random.standard_normal(19)
    true *= 300e-9 / np.linalg.norm(true)
    light = donut(telescope, (0.0, 0.0), zernikes=[0.0] * 3 + list(true), flux=8e5, size=71, pixel=pixel, rays=300)
    fit = pachon.fit_donuts(
        telescope,
        noisy(light, 300.0, 0)[None],
        [(0.0, 0.0)],
        WAVELENGTH,
        pixel_size=pixel,
        sky_variance=300.0,
        model=pachon.DonutModel(diffraction=False),
        threads=1,
    )
    error = fit.zernikes[0] - true
    assert np.linalg.norm(error) < 25e-9
    assert error @ np.linalg.solve(fit.covariance[0], error) < 2.0 * len(error)
