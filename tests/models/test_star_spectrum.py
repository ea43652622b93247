"""Blackbodies: photons against Planck's law by astropy, colours against integrals over bands."""

import numpy as np
import pytest
from astropy import constants
from astropy import units as u
from astropy.modeling.physical_models import BlackBody

import pachon
from pachon.models.star_spectrum import COLORS, COOLEST, HOTTEST

WAVES = np.linspace(400e-9, 1000e-9, 13)


@pytest.mark.parametrize("kelvin", [2500.0, 5772.0, 20000.0])
def test_photons_are_those_of_plancks_law(kelvin):
    found = pachon.blackbody_photons(kelvin, WAVES)[0]
    radiance = BlackBody(kelvin * u.K, scale=1.0 * u.W / (u.m**2 * u.m * u.sr))(WAVES * u.m).value
    expected = radiance * WAVES / (constants.h * constants.c).value
    np.testing.assert_allclose(found, expected / expected.mean(), rtol=1e-7)


def test_spectra_without_a_temperature_are_flat():
    found = pachon.blackbody_photons([np.nan, 3000.0], WAVES)
    np.testing.assert_array_equal(found[0], 1.0)
    assert found[1, -1] > 5 * found[1, 0]
    # Colder than any star: all photons are in the reddest wavelength, and none overflows.
    assert pachon.blackbody_photons(10.0, WAVES)[0, -1] == pytest.approx(len(WAVES))
    np.testing.assert_allclose(pachon.blackbody_photons(5000.0, [620] * u.nm), 1.0)


def ab_magnitude(kelvin, pivot, width):
    """AB magnitude of a blackbody through a top hat, of photons; an offset is common to all bands."""
    waves = np.linspace(pivot - 0.5 * width, pivot + 0.5 * width, 2001)
    flux = BlackBody(kelvin * u.K)(waves * u.m)
    return -2.5 * np.log10(np.sum(flux.value / waves) / np.sum(1.0 / waves))


@pytest.mark.parametrize(("bands", "widths"), [("g_r", (139e-9, 137e-9)), ("r_i", (137e-9, 153e-9))])
@pytest.mark.parametrize("kelvin", [3000.0, 5772.0, 12000.0])
def test_temperatures_of_colors_of_broad_bands(bands, widths, kelvin):
    first, second, _ = COLORS[bands]
    color = ab_magnitude(kelvin, first, widths[0]) - ab_magnitude(kelvin, second, widths[1])
    # Bands have a width: 3 % of the temperature.
    assert pachon.models.color_temperature(color, bands) == pytest.approx(kelvin, rel=0.03)


def test_the_sun_and_extremes():
    # g - r 0.44 (Willmer 2018) and BP - RP 0.818 (Casagrande & VandenBerg 2018); its colour temperature is near 5900 K.
    assert pachon.models.color_temperature(0.44, "g_r") == pytest.approx(5772.0, rel=0.08)
    assert pachon.models.color_temperature(0.818, "bp_rp") == pytest.approx(5772.0, rel=0.03)
    np.testing.assert_allclose(pachon.models.color_temperature([-3.0, 9.0, np.nan]), [HOTTEST, COOLEST, np.nan])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pachon.blackbody_photons([5000.0, -1.0], WAVES), "temperature: expected .* above 0"),
        (lambda: pachon.blackbody_photons(5000.0, [0.0]), "wavelengths: expected one or more positive"),
        (lambda: pachon.models.color_temperature(0.4, "u_g"), "bands = 'u_g'|bands"),
    ],
)
def test_bad_input_is_one_line(call, words):
    with pytest.raises(pachon.PachonError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_effective_colours_are_mean_wavelengths_and_those_of_blackbodies():
    waves = np.linspace(552e-9, 691e-9, 200)
    kelvin = np.array([2500.0, 4500.0, 9000.0])
    photons = pachon.blackbody_photons(kelvin, waves)
    mean = [np.average(waves, weights=spectrum) for spectrum in photons]
    np.testing.assert_allclose(pachon.effective_colour(waves, 3.0 * photons), mean, rtol=1e-12)
    np.testing.assert_allclose(pachon.effective_colour(waves * u.m, photons[0]), mean[:1], rtol=1e-12)
    for kind in COLORS:
        colours = pachon.effective_colour(waves, photons, kind)
        # The table of temperatures has steps of 0.8 %.
        np.testing.assert_allclose(pachon.models.color_temperature(colours, kind), kelvin, rtol=2e-4)


def test_spectra_without_light_have_no_colour():
    waves = [600e-9, 650e-9]
    for photons, match in (
        ([1.0, 2.0, 3.0], r"photons have shape \(3,\): expected \[2\] or \[n, 2\]"),
        ([[1.0, 1.0], [0.0, 0.0]], "photons: expected numbers from 0, in each spectrum some above 0"),
        ([2.0, -1.0], "photons: expected numbers from 0"),
        ([2.0, np.nan], "photons: expected numbers from 0"),
    ):
        with pytest.raises(pachon.errors.DomainError, match=match):
            pachon.effective_colour(waves, photons)
    with pytest.raises(pachon.PachonError, match="kind = 'z_y'"):
        pachon.effective_colour(waves, [1.0, 1.0], "z_y")
