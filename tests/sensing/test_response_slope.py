"""Slope of the detector's response: a parameter of fits of several donuts."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, SIZE, WAVELENGTH, donut, noisy

import pachon
from pachon.core.errors import DomainError
from pachon.raytrace.rays import field_direction
from pachon.sensing.pupil_cells import pupil_cells
from pachon.sensing.response_slope import cells_with_response

FIELDS = np.deg2rad([(0.3, 0.2), (-1.1, 0.6), (0.9, 1.0)])
#: Relative slope of the response [1/pixel]: 1 % across the stamp along x, minus half of it along y.
SLOPE = np.array([1.0, -0.5]) * 0.01 / SIZE
DETECTOR = pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL, response_slope=2e-4)
MODEL = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.0), detector=DETECTOR, diffraction=False, neighbours=False)
NOISE = 1000.0


def test_rates_of_the_light_are_those_of_a_response_at_its_landing_points(behind_focus):
    """Centroid of the image: a slope g moves it by g times its variance."""
    direction = field_direction(*FIELDS[1])
    cells = pupil_cells(behind_focus, direction, WAVELENGTH, 64)
    rates = cells_with_response(behind_focus, direction, WAVELENGTH, cells, PIXEL, 0).rates
    rays = pachon.launch_rays(behind_focus, FIELDS[1], WAVELENGTH, cells.points.T)
    places = behind_focus.surfaces[-1].to_local(pachon.trace(behind_focus, rays).position)[:, :2] / PIXEL
    centred = places - np.average(places, axis=0, weights=cells.weights)
    variance = (cells.weights[:, None, None] * centred[:, :, None] * centred[:, None, :]).sum(axis=0)
    np.testing.assert_allclose(rates.sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(centred.T @ rates, variance, rtol=1e-6, atol=1e-6 * variance.max())


@pytest.mark.long
def test_several_donuts_tell_a_slope_from_coma(behind_focus):
    wave = np.zeros(22)
    wave[3:] = np.random.default_rng(8).normal(size=19)
    wave *= 100e-9 / np.linalg.norm(wave)
    x = np.arange(SIZE) - 0.5 * (SIZE - 1)
    response = 1.0 + SLOPE[0] * x + SLOPE[1] * x[:, None]
    clean = [donut(behind_focus, field, zernikes=wave, rays=700, flux=2e7) for field in FIELDS]
    images = np.array([noisy(response * image, NOISE, i) for i, image in enumerate(clean)])

    def fitted(model):
        fit = pachon.sensing.FieldTerms([1])
        return pachon.fit_donuts(behind_focus, images, FIELDS, WAVELENGTH, sky_variance=NOISE, model=model, fit=fit)

    with_slope, without = fitted(MODEL), fitted(replace(MODEL, detector=replace(DETECTOR, response_slope=0.0)))
    # Coma of the flat response is 16 nm off, twice what is claimed.
    assert np.hypot(*(without.zernikes[0] - wave[3:])[3:5]) > 10e-9
    error = with_slope.zernikes[0] - wave[3:]
    assert np.hypot(*error[3:5]) < 5e-9
    # Of 19 degrees of freedom: 2.6 is five standard deviations.
    assert error @ np.linalg.solve(with_slope.covariance[0], error) / 19 < 2.6
    found, spread = with_slope.response_slope[0], with_slope.response_slope_error[0]
    assert (spread < 0.15 * np.hypot(*SLOPE)).all()
    assert (np.abs(found - SLOPE) < 3.0 * spread).all()
    assert np.isnan(without.response_slope).all()


def test_slopes_of_the_response_are_checked():
    with pytest.raises(DomainError, match=r"response_slope = -1e-05: expected 0 to 0\.01 a pixel"):
        pachon.DonutDetector(response_slope=-1e-5)
