"""Donuts that noise hides: flagged where Zernikes would be those of the noise, right a little above."""

import numpy as np
import pytest

import pachon
from pachon.sensing.flags import DonutFlag
from pachon.wavefront.aberration import ResidualWavefront

TERMS = 1e-9 * np.array([60.0, -90.0, 40.0, 70.0, -50.0, 30.0, -80.0, 20.0])
FIELDS = np.deg2rad([[0.9, 0.5], [-0.6, 1.1], [0.3, -1.2]])


def fitted(lsst_r, electrons, count=1, **options):
    """Fit some donuts of so many electrons each, on a sky of 100 electrons a pixel."""
    camera = lsst_r.perturbed("Camera", shift=(0.0, 0.0, 1.2e-3))
    wave = ResidualWavefront(TERMS, lsst_r.pupil_diameter, lsst_r.pupil_obscuration)
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1, exposure=30.0)
    fields, light = FIELDS[:count], [620e-9]
    stars = pachon.draw_donuts(
        camera, fields, light, atmosphere=air, electrons=electrons, sky=100.0, seed=4, aberration=wave
    )
    return pachon.fit_donuts(camera, stars.images, fields, light, threads=1, **options)


def test_zernikes_of_noise_are_not_reported(lsst_r):
    """They were wrong by up to 5 um, with 0.5 um claimed and no flag, after 10 s."""
    fit = fitted(lsst_r, 3e4)
    assert fit.flags.tolist() == [DonutFlag.TOO_FEW_PHOTONS]
    assert np.isnan(fit.zernikes).all()


def test_few_terms_of_a_faint_donut_are_told(lsst_r):
    fit = fitted(lsst_r, 3e4, noll=[4, 5, 6])
    assert all(DonutFlag(flag).usable for flag in fit.flags)


@pytest.mark.slow
def test_errors_of_a_donut_that_tells_little_are_right(lsst_r):
    fit = fitted(lsst_r, 1.2e5, count=3)
    assert all(DonutFlag(flag).usable for flag in fit.flags)
    error = fit.zernikes.copy()
    error[:, : len(TERMS)] -= TERMS
    chi2 = [e @ np.linalg.solve(c, e) for e, c in zip(error, fit.covariance, strict=True)]
    # Of 57 terms, three standard deviations.
    assert np.sum(chi2) < 57.0 + 3.0 * np.sqrt(2.0 * 57.0)
