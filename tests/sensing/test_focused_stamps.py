"""Stars in focus that are given as donuts are said to be none."""

import numpy as np
import pytest

import pachon
from pachon.sensing import DonutFlag, DonutRims

SKY = 381.0


@pytest.mark.parametrize(("rms", "electrons"), [(2.5, 1e5), (4.0, 1e6)])
def test_stars_in_focus_have_no_wavefront(rms, electrons):
    """One is explained by a wavefront of 20 um, with 1 um claimed; of the other all is clipped, and noise fitted."""
    telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    y, x = np.mgrid[:181, :181] - 90.0
    star = electrons / (2.0 * np.pi * rms**2) * np.exp(-0.5 * (x**2 + y**2) / rms**2)
    image = np.random.default_rng(1).poisson(star + SKY) - SKY
    model = pachon.DonutModel(diffraction=False, rims=DonutRims(search=False))
    field = np.deg2rad([(0.3, -0.5)])
    fit = pachon.fit_donuts(telescope, image[None], field, 620e-9, sky_variance=SKY, model=model, threads=1)
    assert fit.flags[0] & DonutFlag.NO_DONUT
    assert not fit.usable[0]
    assert np.isnan(fit.zernikes).all()
