"""Donuts on stamps hardly wider than they are."""

import numpy as np
import pytest

import pachon
from pachon.wavefront.aberration import ResidualWavefront


@pytest.mark.long
def test_light_beyond_the_stamp_does_not_come_back_on_the_other_side():
    """It did in pixels of the detector, of which the fit has sums: 0.6 % of the peak (rms), along two edges."""
    telescope, size, crop = pachon.load_telescope("auxtel"), 271, 186
    fields, light = 0.1 * telescope.field_radius * np.array([[2.0, 1.0]]), telescope.default_wavelength
    wavefront = np.array([0.0, 300e-9])
    aberration = ResidualWavefront(wavefront, telescope.pupil_diameter, telescope.pupil_obscuration)
    detector = pachon.DonutDetector(defocus=0.8e-3, moved="M2")
    air = pachon.DonutAir(fwhm=np.deg2rad(0.8 / 3600.0))
    drawn = pachon.draw_donuts(
        telescope,
        fields,
        light,
        model=pachon.DonutModel(air=air, detector=detector),
        stamps=pachon.Stamps(size),
        aberration=aberration,
    )
    edge = slice((size - crop) // 2, (size - crop) // 2 + crop)
    image = 3e6 * drawn.psf.image[:, edge, edge]
    model = pachon.DonutModel(detector=detector, diffraction=True)
    fit = pachon.fit_donuts(telescope, image, fields, light, sky_variance=300.0, model=model, threads=1)
    assert image.sum() < 0.98 * 3e6
    assert np.nanstd(fit.residuals) < 2e-3 * image.max()
