"""Degrees of freedom from noise-free, diffracted donuts on both sides of focus: nothing but rounding is left."""

import numpy as np
import pytest

import pachon

WAVELENGTH, DEFOCUS, ELECTRONS = 622e-9, 1.5e-3, 5e6
FIELDS = np.deg2rad([(0.3, 0.2), (-1.1, 0.6), (0.9, 1.1), (0.4, -1.4)])


def diffracted(defocus):
    return pachon.DonutModel(detector=pachon.DonutDetector(diffusion=4e-6, defocus=defocus), diffraction=True)


@pytest.mark.slow
def test_joint_fits_find_a_misaligned_telescope(focused):
    freedoms = pachon.load_degrees_of_freedom("lsst")
    # 90 nm rms of wavefront over the field for each.
    size = 90e-9 / pachon.sensitivity(focused, freedoms, wavelength=WAVELENGTH).rms
    state = size * np.random.default_rng(1).standard_normal(len(freedoms))
    true = freedoms.apply(focused, state)
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1)
    images = [
        pachon.draw_donuts(
            true.perturbed("Detector", shift=(0.0, 0.0, side * DEFOCUS)), FIELDS, [WAVELENGTH], atmosphere=air
        ).psf.image
        for side in (1.0, -1.0)
    ]
    fit = pachon.fit_donuts(
        focused,
        ELECTRONS * np.concatenate(images),
        np.tile(FIELDS, (2, 1)),
        WAVELENGTH,
        sky_variance=400.0,
        model=diffracted(np.repeat([DEFOCUS, -DEFOCUS], len(FIELDS))),
        fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=5.0 * size),
    )
    # Rims that stand where an earlier step had them, and no derivatives of their places, left 30 to 60 nm of coma.
    before, after = (
        pachon.wavefront_zernikes(t, FIELDS, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (focused, true)
    )
    assert np.linalg.norm(after - before, axis=1).min() > 200e-9
    error = np.linalg.norm(fit.zernikes[: len(FIELDS)] - (after - before), axis=1)
    # Steps that were damped anew with every outer iteration left 4 nm.
    assert error.max() < 2e-9
    assert fit.chi2.max() < 1e-3 * fit.n_pixels.min()


@pytest.mark.slow
def test_rims_near_the_image_move_with_the_telescope(focused):
    """At 1.9 degrees decentres of M2 and camera, whose coma cancels, shift the shadows of the camera's rims."""
    fields = np.deg2rad([(1.34, 1.34), (-1.5, -1.15)])
    freedoms = pachon.load_degrees_of_freedom("lsst")
    freedoms = freedoms.select([name for name in freedoms.names if "_B" not in name])
    # 100 nm rms of wavefront over the field for each.
    size = 100e-9 / pachon.sensitivity(focused, freedoms, wavelength=WAVELENGTH).rms
    state = 2.0 * size * np.random.default_rng(2).standard_normal(len(freedoms))
    true = freedoms.apply(focused, state).perturbed("Detector", shift=(0.0, 0.0, DEFOCUS))
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1)
    images = pachon.draw_donuts(true, fields, [WAVELENGTH], atmosphere=air).psf.image
    fit = pachon.fit_donuts(
        focused,
        ELECTRONS * images,
        fields,
        WAVELENGTH,
        sky_variance=400.0,
        model=diffracted(DEFOCUS),
        fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=5.0 * size),
    )
    # Rims that follow from one outer iteration to the next, without derivatives, left 3e-2 a pixel, and M2 and camera
    # off by 370 times the claimed variance.
    error = fit.degrees_of_freedom.values - state
    assert fit.chi2.max() < 2e-3 * fit.n_pixels.min()
    assert error @ np.linalg.solve(fit.degrees_of_freedom.covariance, error) < 0.3 * len(error)
