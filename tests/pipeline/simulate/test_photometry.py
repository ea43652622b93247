import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import DomainError, UnknownNameError
from pachon.pipeline.simulate import photometry

ARCSEC = np.pi / 180.0 / 3600.0

# Total r throughput of the LSST from 535 nm in steps of 5 nm: github.com/lsst/throughputs, baseline/total_r.dat,
# version 1.9, which is for airmass 1.2.
# fmt: off
R_THROUGHPUT = np.array([
    0.00524, 0.03769, 0.13215, 0.28986, 0.41015, 0.46948, 0.48362, 0.48980, 0.49606, 0.49957, 0.50191, 0.50172,
    0.50523, 0.51012, 0.51457, 0.51991, 0.52792, 0.53260, 0.53724, 0.53624, 0.54598, 0.55019, 0.55684, 0.55950,
    0.56357, 0.56795, 0.57160, 0.57460, 0.57271, 0.53939, 0.44252, 0.28851, 0.17394, 0.05222, 0.00546,
])
# fmt: on


def test_r_zero_point_follows_from_the_ab_magnitude_system():
    wavelength = 535e-9 + 5e-9 * np.arange(len(R_THROUGHPUT))
    planck = 6.62607015e-34
    area = np.pi / 4.0 * 6.423**2  # effective diameter, SMTN-002
    flux = 3631e-26  # W/m^2/Hz at AB magnitude 0
    rate = flux * area / planck * np.trapezoid(R_THROUGHPUT / wavelength, wavelength)
    at_zenith = 2.5 * np.log10(rate) + 0.2 * photometry.BANDS["r"].extinction
    # 0.005 for the published rounding, 0.001 for the rounding of the extinction, 0.003 for the 5 nm steps at the edges.
    assert photometry.BANDS["r"].zero_point == pytest.approx(at_zenith, abs=0.009)


@pytest.mark.parametrize(
    ("band", "fwhm", "depth"),
    [
        ("u", 0.92, 23.70),
        ("g", 0.87, 24.97),
        ("r", 0.83, 24.52),
        ("i", 0.80, 24.13),
        ("z", 0.78, 23.56),
        ("y", 0.76, 22.55),
    ],
)
def test_published_depths_of_a_30_s_visit(band, fwhm, depth):
    # SMTN-002 lists zero points, sky, extinction, FWHM and depth to 0.01 each: together they allow 0.012.
    assert photometry.limiting_magnitude(5.0, band, 30.0, fwhm * ARCSEC) == pytest.approx(depth, abs=0.012)


def test_instrument_noise_of_one_exposure_is_nine_electrons():
    # SMTN-002: "the total instrumental noise per exposure is 9 photo-electrons", rounded.
    assert photometry.instrument_noise("r", 15.0) == pytest.approx(9.0, abs=0.05)


def test_signal_to_noise_written_out():
    exposure, fwhm, pixel = 15.0, 0.7, 0.2
    counts = 15.0 * 10 ** (0.4 * (28.36 - 21.0))
    sky = 15.0 * 0.04 * 10 ** (0.4 * (28.36 + 0.13 - 21.2))
    noise = np.sqrt(counts + 2.266 * (fwhm / pixel) ** 2 * (sky + 8.8**2 + 0.2 * 15.0))
    ratio = photometry.signal_to_noise(21.0, "r", exposure, fwhm * ARCSEC)
    assert ratio == pytest.approx(counts / noise, rel=1e-12)  # the same formula: rounding


def test_limits_invert_and_order():
    fwhm = 0.7 * u.arcsec
    for snr in (5.0, 30.0, 1e4):
        faint = photometry.limiting_magnitude(snr, "r", 15.0, fwhm)
        assert photometry.signal_to_noise(faint, "r", 15.0, fwhm) == pytest.approx(snr, rel=1e-10)  # rounding
    bright = photometry.saturation_magnitude("r", 15.0, fwhm)
    assert 14.0 < bright < 18.0 < photometry.limiting_magnitude(30.0, "r", 15.0, fwhm) < 23.0
    counts = photometry.electrons(np.array([18.0, 20.5]), "r", 15.0)
    np.testing.assert_allclose(photometry.magnitude_of(counts, "r", 15.0), [18.0, 20.5], rtol=1e-14)


def test_brightest_pixel_at_saturation():
    sigma = 0.7 / np.sqrt(8 * np.log(2)) / 0.2
    y, x = np.mgrid[-0.5:0.5:201j, -0.5:0.5:201j]
    weights = np.full(201, 1 / 200.0)
    weights[[0, -1]] /= 2
    central = weights @ np.exp(-(x**2 + y**2) / (2 * sigma**2)) @ weights / (2 * np.pi * sigma**2)
    counts = photometry.electrons(photometry.saturation_magnitude("r", 15.0, 0.7 * ARCSEC), "r", 15.0)
    peak = counts * central + photometry.sky_electrons_per_pixel("r", 15.0)
    assert peak == pytest.approx(photometry.BANDS["r"].full_well, rel=1e-5)  # trapezoidal rule over 200 steps


@pytest.mark.parametrize("value", [0.0, -15.0, np.nan, np.inf])
def test_arguments_must_be_positive(value):
    with pytest.raises(DomainError, match="exposure"):
        photometry.electrons(20.0, "r", value)
    with pytest.raises(DomainError, match="fwhm"):
        photometry.signal_to_noise(20.0, "r", 15.0, value)
    with pytest.raises(DomainError, match="snr"):
        photometry.limiting_magnitude(value, "r", 15.0, 0.7 * ARCSEC)
    with pytest.raises(DomainError, match="pixel_scale"):
        photometry.sky_electrons_per_pixel("r", 15.0, value)


def test_bad_names_units_and_wells():
    with pytest.raises(UnknownNameError, match="unknown band 'R'"):
        photometry.electrons(20.0, "R", 15.0)
    with pytest.raises(DomainError, match="pixel_scale"):
        photometry.sky_electrons_per_pixel("r", 15.0, 0.2 * u.m)
    with pytest.raises(DomainError, match=r"full_well = 100 \(photometry.full_well_e of a configuration\): "):
        photometry.saturation_magnitude("r", 15.0, 0.7 * ARCSEC, full_well=100.0)
    with pytest.raises(DomainError, match="counts"):
        photometry.magnitude_of(0.0, "r", 15.0)
