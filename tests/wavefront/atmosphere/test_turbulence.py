"""Von Karman theory against quadrature, published constants and GalSim."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from pachon.core.errors import DomainError
from pachon.wavefront.atmosphere.turbulence import (
    diffraction_otf,
    fried_parameter,
    long_exposure_fwhm,
    long_exposure_otf,
    path_spectrum,
    path_variance,
    slope_variance,
    structure_function,
)

R0, L0 = 0.16, 25.0
RADIANS_PER_METRE = 2.0 * math.pi / 500e-9


def spectrum(nu, r0=R0, outer_scale=L0):
    """Path spectrum restated with the published rounded constant 0.02290 (0.0229 to 5e-4)."""
    return 0.022896 * r0 ** (-5 / 3) * (nu**2 + outer_scale**-2) ** (-11 / 6) / RADIANS_PER_METRE**2


def hankel(separation, low, high):
    """Structure function of the modes between two frequencies [cycles/m], by adaptive quadrature in log frequency."""

    def integrand(log_nu):
        nu = math.exp(log_nu)
        return 4.0 * math.pi * nu**2 * spectrum(nu) * (1.0 - j0(2.0 * math.pi * nu * separation)) * 1e14

    return quad(integrand, math.log(low), math.log(high), limit=20000, epsrel=1e-9)[0] * 1e-14


def test_spectrum_follows_the_published_formula():
    nu = np.array([0.0, 0.01, 0.04, 1.0, 30.0])
    # 0.022896 is the constant rounded to five figures.
    np.testing.assert_allclose(path_spectrum(nu, R0, L0), spectrum(nu), rtol=3e-5)


@pytest.mark.parametrize("separation", [0.04, 0.32, 2.0, 25.0])
def test_structure_function_is_the_hankel_transform_of_the_spectrum(separation):
    # Frequencies beyond 1e3 / separation are left out of the integral: 1e-5 of it.
    np.testing.assert_allclose(
        structure_function(separation, R0, L0), hankel(separation, 1e-6, 1e3 / separation), rtol=1e-4
    )


def test_structure_function_tends_to_kolmogorov_and_to_twice_the_variance():
    r = np.array([0.01, 0.1, 1.0])
    kolmogorov = 6.88388 * (r / R0) ** (5 / 3)
    # With an outer scale L the relative deficit is 1.49 (r / L)^(1/3): 1.5e-3 for 1e9 times the separation.
    huge = structure_function(r, R0, 1e9) * RADIANS_PER_METRE**2
    deficit = 1.0 - huge / kolmogorov
    np.testing.assert_allclose(deficit, 1.4854 * (r / 1e9) ** (1 / 3), rtol=1e-2)
    np.testing.assert_allclose(structure_function(1e4, R0, L0), 2.0 * path_variance(R0, L0), rtol=1e-12)
    # Variance 0.0863 (L0/r0)^(5/3) rad^2 (Conan 2000), quoted to three figures.
    assert path_variance(R0, L0) * RADIANS_PER_METRE**2 == pytest.approx(0.0863 * (L0 / R0) ** (5 / 3), rel=1e-3)


def test_structure_function_is_smooth_where_its_two_forms_meet():
    meeting = L0 / (2.0 * math.pi)
    r = meeting * (1.0 + 1e-9 * np.arange(-3, 4))
    values = structure_function(r, R0, L0)
    # Seven points 1e-9 apart lie on a straight line to rounding.
    assert np.ptp(np.diff(values)) < 1e-13 * values[0]
    assert structure_function(0.0, R0, L0) == 0.0


@pytest.mark.long
def test_annular_transfer_function_is_the_overlap_of_two_pupils():
    diameter, obscuration, n = 8.36, 0.61, 2001
    axis = (np.arange(n) - n // 2) * (diameter * 1.02 / n)
    x, y = np.meshgrid(axis, axis)

    def inside(x):
        r = np.hypot(x, y)
        return (r <= diameter / 2) & (r >= obscuration * diameter / 2)

    b = np.array([0.0, 0.3, 1.0, 2.0, 4.0, 6.5, 8.0, 9.0])
    counted = [np.mean(inside(x) & inside(x + shift)) for shift in b] / np.mean(inside(x))
    # Counting cells of 4 mm along edges 8 m long: some 1e-4 of the area.
    np.testing.assert_allclose(diffraction_otf(b, diameter, obscuration), counted, atol=3e-4)


def test_fried_parameter_goes_with_the_six_fifths_of_the_wavelength():
    wavelength = np.array([500e-9, 1000e-9])
    np.testing.assert_allclose(fried_parameter(R0, wavelength), [R0, R0 * 2**1.2], rtol=1e-14)
    # The Kolmogorov phase structure function at any wavelength is 6.88 at its own Fried parameter.
    r = fried_parameter(R0, 1000e-9)
    phase = structure_function(r, R0, 1e12) * (2.0 * math.pi / 1000e-9) ** 2
    assert phase == pytest.approx(6.88388, rel=1e-3)  # deficit 1.49 (r/L0)^(1/3) of the finite outer scale


def test_kolmogorov_seeing_is_0_98_wavelengths_over_the_fried_parameter():
    # 0.9759 (Fried 1966; Tokovinin 2002 rounds to 0.98); an outer scale of 1e11 m narrows it by 1e-4.
    assert long_exposure_fwhm(500e-9, R0, 1e11) == pytest.approx(0.9759 * 500e-9 / R0, rel=1e-3)


@pytest.mark.parametrize("wavelength", [400e-9, 600e-9, 1000e-9])
@pytest.mark.parametrize("outer_scale", [15.0, 25.0, 50.0])
def test_long_exposure_width_against_tokovinin(wavelength, outer_scale):
    r0 = float(fried_parameter(R0, wavelength))
    approximation = 0.976 * wavelength / r0 * math.sqrt(1.0 - 2.183 * (r0 / outer_scale) ** 0.356)
    # Tokovinin (2002), eq. 19, states about 1 % for L0/r0 > 20, where 0.98 lambda/r0 is rounded from 0.976.
    assert long_exposure_fwhm(wavelength, R0, outer_scale) == pytest.approx(approximation, rel=0.0125)


def test_seeing_of_the_lsst_example():
    # The figure of the project's physics notes: 0.47" to 0.48" at 600 nm, r0 = 0.16 m, L0 = 25 m.
    assert math.degrees(long_exposure_fwhm(600e-9, R0, L0)) * 3600 == pytest.approx(0.477, abs=0.002)


def test_diffraction_alone_is_the_airy_width():
    # FWHM of the Airy pattern: 1.02899 lambda/D; turbulence with r0 = 100 m broadens by less than 1e-3.
    assert long_exposure_fwhm(500e-9, 100.0, L0, diameter=8.0) == pytest.approx(1.02899 * 500e-9 / 8.0, rel=1e-3)


def test_pupil_widens_the_seeing():
    free = long_exposure_fwhm(600e-9, R0, L0)
    blurred = long_exposure_fwhm(600e-9, R0, L0, diameter=8.36, obscuration=0.61)
    assert free < blurred < 1.05 * free
    otf = long_exposure_otf(np.array([0.0, 1.0]), 600e-9, R0, L0, diameter=8.36, obscuration=0.61)
    assert otf[0] == 1.0
    expected = long_exposure_otf(1.0, 600e-9, R0, L0) * diffraction_otf(1.0, 8.36, 0.61)
    assert otf[1] == pytest.approx(float(expected), rel=1e-12)


def test_against_galsim():
    galsim = pytest.importorskip("galsim")
    profile = galsim.VonKarman(lam=600.0, r0_500=R0, L0=L0)
    for separation in (0.1, 1.0, 10.0):
        ours = float(structure_function(separation, R0, L0)) * (2.0 * math.pi / 600e-9) ** 2
        # Both are the closed form; GalSim's constants have seven figures.
        assert profile._structure_function(separation) == pytest.approx(ours, rel=1e-6)
    width = math.degrees(long_exposure_fwhm(600e-9, R0, L0)) * 3600
    assert profile.calculateFWHM(scale=0.005) == pytest.approx(width, rel=1e-4)  # GalSim interpolates its radial table


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: structure_function(1.0, 0.0, L0), "r0 = 0.0: expected a positive"),
        (lambda: structure_function(1.0, R0, -25.0), "outer_scale = -25.0: expected a positive"),
        (lambda: path_spectrum(1.0, math.nan, L0), "r0 = nan"),
        (lambda: path_variance("wide", L0), "r0 = 'wide'"),
        (lambda: diffraction_otf(1.0, 0.0), "diameter = 0.0"),
        (lambda: diffraction_otf(1.0, 8.0, 1.0), "obscuration = 1.0"),
        (lambda: long_exposure_otf(1.0, -1.0, R0, L0), "wavelength = -1.0"),
        (lambda: long_exposure_fwhm(500e-9, 10.0, 25.0), "outer_scale = 25.0"),
    ],
)
def test_bad_arguments_are_named(call, text):
    with pytest.raises(DomainError) as caught:
        call()
    assert text in str(caught.value)


@pytest.mark.parametrize("lag", [0.0, 0.2])
def test_slope_variance_is_the_integral_over_the_low_modes(lag):
    def integrand(nu):
        seen = 2.0 * math.pi * nu * np.sinc(nu * lag)
        return 0.5 * seen**2 * path_spectrum(nu, 0.14, 23.0) * 2.0 * math.pi * nu

    expected = quad(integrand, 0.0, 8.0 / (2.0 * math.pi), epsabs=0.0, epsrel=1e-11, limit=300)[0]
    assert slope_variance(0.14, 23.0, 8.0, lag) == pytest.approx(expected, rel=1e-9, abs=0.0)
