"""Silicon: measured index and absorption, their change with temperature, errors."""

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.models.media.silicon import absorption_length, silicon_index

WAVELENGTHS = np.array([620e-9, 754e-9, 870e-9, 970e-9])


def test_index_and_absorption_are_those_of_green_2008():
    # Green (2008), Sol. Energ. Mat. Sol. Cells 92, 1305, at 300 K, another combination of measurements. Its index is
    # within 0.3 % of ours; absorption is stated to a few per cent, and Schinke et al. (2015) to 4 % at 870 nm.
    index, length = [3.898, 3.713, 3.630, 3.583], [2.84e-6, 7.93e-6, 23.2e-6, 88.5e-6]
    np.testing.assert_allclose(silicon_index(WAVELENGTHS, 300.0), index, rtol=3e-3)
    np.testing.assert_allclose(absorption_length(WAVELENGTHS, 300.0), length, rtol=0.06)


def test_index_falls_with_temperature_as_measured():
    # Franta et al. (2017), Appl. Surf. Sci. 421, 405, at 150 K and 300 K. Their slope is that of ours, by a rounded
    # table.
    cold, warm = np.array([3.8565, 3.6820, 3.6037, 3.5588]), np.array([3.8997, 3.7152, 3.6335, 3.5869])
    ours = silicon_index(WAVELENGTHS, 300.0) - silicon_index(WAVELENGTHS, 150.0)
    np.testing.assert_allclose(ours, warm - cold, rtol=0.01)


def test_absorption_falls_with_temperature_as_rajkanan_and_franta_have_it():
    # Rajkanan et al. (1979), restated phonon by phonon, at the wavelength of y.
    photon, boltzmann = 1.239842e-6 / 970e-9, 8.617e-5

    def coefficient(temperature):
        gap = 1.1557 - 7.021e-4 * temperature**2 / (temperature + 1108.0)
        total = 0.0
        for phonon, coupling in ((1.827e-2, 5.5), (5.773e-2, 4.0)):
            emission = (photon - gap - phonon) ** 2 / (1.0 - np.exp(-phonon / (boltzmann * temperature)))
            absorption = (photon - gap + phonon) ** 2 / (np.exp(phonon / (boltzmann * temperature)) - 1.0)
            total += coupling * 3.231e2 * (emission + absorption)
        return total

    ratio = absorption_length(970e-9, 173.0) / absorption_length(970e-9, 295.0)
    assert ratio == pytest.approx(coefficient(295.0) / coefficient(173.0), rel=1e-12)
    # Franta et al. (2017) at 200 K and 293 K: another model of other measurements, with other ratios by up to 20 %.
    cold, warm = np.array([3.86, 10.8, 28.4, 193.0]), np.array([2.90, 8.43, 18.8, 90.5])
    ours = absorption_length(WAVELENGTHS, 200.0) / absorption_length(WAVELENGTHS, 293.0)
    np.testing.assert_allclose(ours, cold / warm, rtol=0.2)


@pytest.mark.parametrize("property_of", [silicon_index, absorption_length])
@pytest.mark.parametrize(
    ("wavelength", "temperature", "parts"),
    [
        (1.12e-6, 173.0, ["wavelength = 1120 nm", "expected 300 to 1100 nm for silicon"]),
        (250e-9, 173.0, ["wavelength = 250 nm", "300 to 1100 nm"]),
        (np.nan, 173.0, ["wavelength = nan nm"]),
        (620e-9, 77.0, ["temperature = 77.0", "expected 100 to 350 K"]),
        (620e-9, np.nan, ["temperature = nan", "expected 100 to 350 K"]),
    ],
)
def test_outside_the_measurements_is_one_clear_line(property_of, wavelength, temperature, parts):
    with pytest.raises(DomainError) as caught:
        property_of(wavelength, temperature)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message
