"""Donuts a few times as wide as the seeing, of waves, fitted by default: without noise, seeing or diffraction told."""

import numpy as np
import pytest

import pachon
from pachon.wavefront.aberration import ResidualWavefront

FIELDS = np.deg2rad([(0.1, 0.05), (0.6, -0.4)])
#: Zernikes of the wavefront that is looked for, Z4 to Z11 [m].
TRUE = 1e-9 * np.array([30.0, -20.0, 60.0, -90.0, 70.0, 50.0, -150.0, -20.0])


def fitted(telescope, defocus, pixels, fields=FIELDS, diffraction=None):
    """Return the fit of donuts with the wavefront, and its errors, [n_star, n_noll]."""
    behind = telescope.perturbed("Detector", shift=(0.0, 0.0, defocus))
    model = pachon.DonutModel(detector=pachon.DonutDetector(10e-6), diffraction=diffraction)
    light = [telescope.default_wavelength]
    drawn = pachon.draw_donuts(
        behind,
        fields,
        light,
        model=model,
        atmosphere=pachon.Atmosphere.from_site("cerro_pachon", seed=1, exposure=30.0),
        stamps=pachon.Stamps(pixels),
        aberration=ResidualWavefront(TRUE, telescope.pupil_diameter, telescope.pupil_obscuration),
    )
    fit = pachon.fit_donuts(behind, drawn.images, fields, light, model=model, threads=1)
    return fit, fit.zernikes - np.pad(TRUE, (0, len(fit.noll) - len(TRUE)))


@pytest.mark.parametrize("defocus", [pytest.param(100e-6, marks=pytest.mark.long), 200e-6])
def test_small_donuts_fit_what_they_are_drawn_with(focused, defocus):
    """Of 8 and 16 pixels. By rays, with the noise of their own edges, they were off by 0.1 to 2 um, 20 nm claimed."""
    fit, error = fitted(focused, defocus, 51)
    assert fit.diffraction
    assert fit.usable.all()
    assert np.linalg.norm(error, axis=1).max() < 30e-9
    chi2 = [e @ np.linalg.solve(c, e) / len(e) for e, c in zip(error, fit.covariance, strict=True)]
    assert max(chi2) < 2.0
    # Electrons, though the edges of the stars look like 30 times their noise.
    np.testing.assert_allclose(fit.photon_variance, 1.0, rtol=0.5)


def test_donuts_of_a_short_camera_have_its_diffracted_light():
    """That of 1.2 m is wide at f/2.5: by rays 90 to 160 nm of Z4, and a seeing of 1.8 arcsec for 0.5."""
    camera = pachon.new_telescope("schmidt", diameter=1.2, f_number=2.5)
    fit, error = fitted(camera, 0.4e-3, 51, fields=np.deg2rad([(0.5, 0.2)]))
    assert fit.diffraction
    assert np.linalg.norm(error) < 25e-9
    assert fit.fwhm[0] < np.deg2rad(0.8 / 3600.0)


def test_variances_of_a_star_in_focus_are_positive(focused):
    """What its pixels do not tell has eigenvalues of the curvature that are rounding, of either sign."""
    fit, _ = fitted(focused, 20e-6, 41, FIELDS[:1], diffraction=False)
    for covariance in (fit.covariance[0], *(getattr(fit.error_parts, name)[0] for name in ("photons", "residuals"))):
        values = np.linalg.eigvalsh(covariance)
        assert values.min() > -1e-9 * values.max()
