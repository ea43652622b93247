from types import SimpleNamespace

import numpy as np
import pytest

from pachon.studies.alignment import loop
from pachon.studies.alignment.scene import NOLL
from pachon.wavefront.opd import wavefront_opd
from pachon.wavefront.zernike import fit_zernikes

PHOTONS = 8e-9  # error of each Zernike [m]


def _zernikes(telescope, scene):
    """Zernikes of the traced wavefronts at the stars [m]: what a perfect fit of the donuts finds."""
    maps = [wavefront_opd(telescope, tuple(field), scene.wavelength, grid=48) for field in scene.stars.fields]
    found = [fit_zernikes(m, 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, 28) for m in maps]
    return np.array([zernikes.coefficients[NOLL - 1] for zernikes in found])


@pytest.fixture
def donut_zernikes():
    """Function of a telescope and a scene that returns the Zernikes of the donuts [m]."""
    return _zernikes


@pytest.fixture(scope="module")
def traced_donuts():
    """The loop with traced wavefronts and noise in place of images and fits, which take seconds a visit."""

    def expose(scene, telescope, visit, threads):
        return _zernikes(telescope, scene), visit

    def fit(scene, exposed, threads):
        zernikes, visit = exposed
        noise = PHOTONS * np.random.default_rng(visit).standard_normal(zernikes.shape)
        count, size = zernikes.shape
        stamps = np.random.default_rng(3).poisson(100.0, (count, 9, 9)).astype(float)
        return SimpleNamespace(
            zernikes=zernikes - _zernikes(scene.telescope, scene) + noise,
            error_parts=SimpleNamespace(photons=np.tile(PHOTONS**2 * np.eye(size), (count, 1, 1))),
            usable=np.ones(count, dtype=bool),
            images=stamps,
            model=np.full(stamps.shape, 100.0),
            residuals=stamps - 100.0,
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "expose", expose)
        patch.setattr(loop, "fit", fit)
        yield
