"""Differential refraction against Filippenko's own table, GalSim and ERFA."""

import math

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import DomainError
from pachon.measure.shapes import fwhm
from pachon.models.site import Weather
from pachon.wavefront.atmosphere.refraction import air_refractivity, dispersion_shift

ARCSEC = math.radians(1.0 / 3600.0)


PACHON = Weather(pressure_mmhg=520.0, temperature_c=5.0, water_vapour_mmhg=8.0)
WAVELENGTHS = np.array([300, 350, 400, 450, 500, 550, 600, 650, 700, 800, 900, 1000]) * 1e-9
# Filippenko (1982), Table 1: arcseconds relative to 500 nm, at 600 mm Hg, 7 C and 8 mm Hg of water vapour.
TABLE = {
    1.05: [0.68, 0.38, 0.20, 0.08, 0.00, -0.06, -0.11, -0.14, -0.17, -0.21, -0.24, -0.26],
    1.25: [1.59, 0.90, 0.48, 0.20, 0.00, -0.14, -0.25, -0.33, -0.40, -0.50, -0.56, -0.61],
    1.50: [2.37, 1.34, 0.71, 0.29, 0.00, -0.21, -0.37, -0.50, -0.60, -0.74, -0.84, -0.91],
}


@pytest.mark.parametrize("airmass", list(TABLE))
def test_filippenko_table(airmass):
    shift = dispersion_shift(WAVELENGTHS, 500e-9, math.acos(1.0 / airmass), 0.0, Weather(600.0, 7.0, 8.0))
    # The table has two decimals; two of its entries are rounded the other way.
    np.testing.assert_allclose(-shift[:, 0] / ARCSEC, TABLE[airmass], atol=0.0065)


def test_index_of_standard_air():
    # Ciddor (1996): n = 1.00027717 at 587.6 nm, 15 C, 760 mm Hg, dry; the older formula differs by some 1e-8.
    assert float(air_refractivity(587.6e-9, Weather(760.0, 15.0, 0.0))) == pytest.approx(2.7717e-4, abs=2e-8)


def test_shorter_wavelengths_lie_nearer_to_the_zenith_on_the_sky():
    zenith_angle, position = math.radians(45.0), math.radians(30.0)
    blue, red = dispersion_shift([450e-9, 700e-9], 550e-9, zenith_angle, position, PACHON)
    zenith_on_sky = np.array([math.cos(position), math.sin(position)])
    # The field angle is the slope of the light's travel: the source on the sky lies the opposite way.
    assert -blue @ zenith_on_sky > 0.0 > -red @ zenith_on_sky
    np.testing.assert_allclose(blue[0] * zenith_on_sky[1] - blue[1] * zenith_on_sky[0], 0.0, atol=1e-20)


def test_snell_law_through_a_flat_atmosphere():
    """Brute force: refract the direction vector of the light itself at the top of a slab of air."""
    zenith_angle, position = math.radians(45.0), 0.7
    towards_zenith = np.array([math.cos(position), math.sin(position)])

    def slopes(index):
        # In vacuum the star stands at zenith_angle; under the slab at the smaller angle that Snell's law gives.
        apparent = math.asin(math.sin(zenith_angle) / index)
        lift = zenith_angle - apparent
        return -math.tan(lift) * towards_zenith  # travel is opposite to the direction on the sky

    waves = np.array([550e-9, 690e-9])
    index = 1.0 + air_refractivity(waves, PACHON)
    expected = slopes(index[0]) - slopes(index[1])
    shift = dispersion_shift(waves, waves[1], zenith_angle, position, PACHON)[0]
    # (n - 1) tan z against Snell's law: relative error about (n - 1).
    np.testing.assert_allclose(shift, expected, rtol=1e-3)


def test_r_and_i_bands_at_45_degrees():
    for low, high in ((552e-9, 691e-9), (691e-9, 818e-9)):
        spread = dispersion_shift(low, high, math.radians(45.0), 0.0, PACHON)
        # Jee & Tyson (2011), section 2: below about 0.3" in r and i.
        assert 0.1 < np.hypot(*spread[0]) / ARCSEC < 0.3


def test_against_galsim_and_erfa():
    galsim = pytest.importorskip("galsim")
    erfa = pytest.importorskip("erfa")
    waves = np.linspace(400e-9, 1000e-9, 7)
    zenith_angle = math.radians(45.0)
    ours = -dispersion_shift(waves, 600e-9, zenith_angle, 0.0, PACHON)[:, 0]
    kilopascal = 101.325 / 760.0
    air = {"pressure": 520.0 * kilopascal, "temperature": 278.15, "H2O_pressure": 8.0 * kilopascal}
    theirs = galsim.dcr.get_refraction(np.append(waves * 1e9, 600.0), zenith_angle * galsim.radians, **air)
    # GalSim divides by n^2: a difference of (n - 1) in relative terms.
    np.testing.assert_allclose(ours, theirs[:-1] - theirs[-1], rtol=1e-3, atol=1e-11)
    # ERFA has its own formula of the air and the curvature of the layers (B tan^3 z), compared in dry air.
    ours = -dispersion_shift(waves, 600e-9, zenith_angle, 0.0, Weather(520.0, 5.0, 0.0))[:, 0]

    def bend(wave):
        a, b = erfa.refco(520.0 * kilopascal * 10.0, 5.0, 0.0, wave * 1e6)
        return a * math.tan(zenith_angle) + b * math.tan(zenith_angle) ** 3

    expected = np.array([bend(wave) - bend(600e-9) for wave in waves])
    np.testing.assert_allclose(ours, expected, rtol=0.01, atol=1e-10)


def test_bands_from_u_to_y():
    """Jee & Tyson (2011), Fig. 3 and section 2: what each filter spreads from edge to edge at 45 degrees."""
    galsim = pytest.importorskip("galsim")
    kilopascal = 101.325 / 760.0
    air = {"pressure": 520.0 * kilopascal, "temperature": 278.15, "H2O_pressure": 8.0 * kilopascal}
    zenith_angle = math.radians(45.0)
    spread = {}
    for band in "ugrizy":
        low, high = pachon.load_telescope(f"lsst_v3.3_{band}").band
        (shift,) = dispersion_shift([low], high, zenith_angle, 0.0, PACHON)
        blue, red = galsim.dcr.get_refraction(np.array([low * 1e9, high * 1e9]), zenith_angle * galsim.radians, **air)
        spread[band] = np.hypot(*shift) / ARCSEC
        assert spread[band] == pytest.approx((blue - red) / ARCSEC, rel=1e-3)
    assert list(spread.values()) == sorted(spread.values(), reverse=True)
    # "Less than ~0.3 arcsec" in r and i: the edges of our r, 545 and 703 nm, lie 0.318 apart.
    assert spread["i"] < 0.15
    assert spread["r"] < 0.32
    assert spread["u"] > 2.0 * spread["r"]


def test_dispersion_elongates_the_image_at_45_degrees():
    """Second moments of an image of 0.7 arcsec grow by about 9 % along the zenith; e stays below 0.04."""
    telescope = pachon.load_telescope("lsst_v3.3_r")
    wavelengths = np.linspace(*telescope.band, 5)
    atmosphere = pachon.Atmosphere.from_site("cerro_pachon", 1, r0=0.12)
    shift = dispersion_shift(wavelengths, wavelengths[2], math.radians(45.0), 0.5 * math.pi, PACHON)
    round_, long_ = (
        pachon.make_psfs(telescope, [[0.0, 0.0]], light, atmosphere=atmosphere, engine="long_exposure")
        for light in (wavelengths, pachon.Light(wavelengths, dispersion=shift))
    )
    assert fwhm(round_.image, round_.pixel_scale)[0] / ARCSEC == pytest.approx(0.7, abs=0.03)
    # The variance of a band spread evenly over so much, against that of a Gaussian of 0.7 arcsec.
    added = (shift[0, 1] - shift[-1, 1]) ** 2 / 12.0
    assert added / (0.7 * ARCSEC / 2.3548) ** 2 == pytest.approx(0.09, abs=0.01)
    shapes = pachon.measure_shapes(long_.image, long_.pixel_scale, 0.7 * ARCSEC)
    assert -0.04 < shapes.e1[0] < -0.005
    assert abs(shapes.e2[0]) < 1e-3


def test_no_shift_at_the_zenith_nor_at_the_reference():
    assert np.all(dispersion_shift(WAVELENGTHS, 600e-9, 0.0, 1.0, PACHON) == 0.0)
    assert np.all(dispersion_shift(600e-9, 600e-9, 0.5, 1.0, PACHON) == 0.0)


def test_quantities_are_accepted():
    plain = dispersion_shift([550e-9], 600e-9, math.radians(30.0), math.radians(90.0), PACHON)
    given = dispersion_shift([550.0] * u.nm, 600.0 * u.nm, 30.0 * u.deg, 90.0 * u.deg, PACHON)
    # The conversions round.
    np.testing.assert_allclose(given, plain, rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((100e-9, 600e-9, 0.5, 0.0, PACHON), "wavelength = 1e-07 m: expected 2e-07 to 2e-06 m"),
        ((550e-9, math.nan, 0.5, 0.0, PACHON), "wavelength = nan m"),
        ((550e-9, 600e-9, 1.5, 0.0, PACHON), "zenith_angle = 1.5: expected 0 to 1.3963 rad"),
        ((550e-9, 600e-9, -0.1, 0.0, PACHON), "zenith_angle = -0.1: expected"),
        ((550e-9, 600e-9, 0.5, math.inf, PACHON), "position_angle = inf rad"),
    ],
)
def test_bad_arguments_are_named(arguments, text):
    with pytest.raises(DomainError) as caught:
        dispersion_shift(*arguments)
    assert text in str(caught.value)
