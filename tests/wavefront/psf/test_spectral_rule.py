"""Wavelengths that stand for those of flat spectra: against sums over all of them."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models import load_site
from pachon.wavefront.atmosphere.refraction import dispersion_shift
from pachon.wavefront.psf import statistical
from pachon.wavefront.psf.psf import psf_inputs
from pachon.wavefront.psf.spectral_rule import SpectralRule, spectral_rule
from pachon.wavefront.psf.stamps import Stamps

WAVES = np.linspace(552e-9, 691e-9, 6)[:-1] + 13.9e-9
FIELDS = np.deg2rad([[0.0, 0.0], [0.5, -0.3], [-1.2, 0.8], [1.1, 1.1]])


@pytest.fixture(scope="module")
def lsst():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.fixture(scope="module")
def air():
    return pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=10.0)


def dispersion(zenith_deg):
    weather = load_site("cerro_pachon").weather
    return dispersion_shift(WAVES, WAVES[2], np.deg2rad(zenith_deg), 0.7, weather)


def inputs_of(telescope, air, zenith_deg=30.0, waves=WAVES, **options):
    light = pachon.Light(waves, dispersion=dispersion(zenith_deg)[: len(waves)], **options)
    return psf_inputs(telescope, FIELDS, light, None, air, None, Stamps(), 1)[0]


@pytest.mark.parametrize("count", [2, 3])
def test_means_of_polynomials_are_kept(count):
    shifts = np.polynomial.Polynomial([1.0, -2.0, 0.5])((WAVES - WAVES[2]) / 1e-7)
    rule = SpectralRule.of(WAVES, np.stack([shifts, -shifts], axis=1), count)
    assert rule.wavelengths[1] == pytest.approx(WAVES[2], rel=1e-12)
    assert rule.photons.mean() == pytest.approx(1.0)
    assert np.count_nonzero(rule.photons) == count
    for order in range(2 * count):
        powers = [((w - 600e-9) / 1e-7) ** order for w in (WAVES, rule.wavelengths)]
        assert rule.photons @ powers[1] / 3 == pytest.approx(powers[0].mean(), rel=1e-9)
    at_nodes = np.polynomial.Polynomial([1.0, -2.0, 0.5])((rule.wavelengths - WAVES[2]) / 1e-7)
    np.testing.assert_allclose(rule.dispersion, np.stack([at_nodes, -at_nodes], axis=1), rtol=1e-9, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("zenith_deg", "count"), [(30.0, 3), (0.0, 2)])
def test_images_are_those_of_all_wavelengths(lsst, air, monkeypatch, zenith_deg, count):
    light = pachon.Light(WAVES, dispersion=dispersion(zenith_deg))
    rule = spectral_rule(inputs_of(lsst, air, zenith_deg), 2)
    assert np.count_nonzero(rule.photons) == count
    few, all_light = [], []
    for psfs in (few, all_light):
        psfs.append(pachon.make_psfs(lsst, FIELDS, light, atmosphere=air, engine="statistical", threads=1))
        psfs.append(pachon.psf_moments(lsst, FIELDS, light, atmosphere=air, engine="statistical", threads=1))
        monkeypatch.setattr(statistical, "spectral_rule", lambda inputs, depths: None)
    # With two wavelengths 5e-5 of the peak, 1e-6 of e and 1.2e-5 of the size were found.
    assert np.abs(few[0].image - all_light[0].image).max() < 1e-4 * all_light[0].image.max()
    assert few[0].lit_fraction.tobytes() == all_light[0].lit_fraction.tobytes()
    assert few[0].reference_point == pytest.approx(all_light[0].reference_point, abs=1e-9)
    for name in ("e1", "e2"):
        assert getattr(few[1], name) == pytest.approx(getattr(all_light[1], name), abs=5e-5)
        assert np.abs(getattr(few[1], name) - getattr(all_light[1], name)).max() > 1e-9
    assert few[1].size == pytest.approx(all_light[1].size, rel=5e-5)


def test_all_wavelengths_are_taken_where_fewer_do_not_stand_for_them(lsst, air):
    assert spectral_rule(inputs_of(lsst, air, 65.0), 2) is None
    assert spectral_rule(inputs_of(lsst, air, waves=WAVES[:3]), 2) is None
    uneven = np.array([560e-9, 570e-9, 580e-9, 640e-9, 690e-9])
    assert spectral_rule(inputs_of(lsst, air, waves=uneven), 2) is None
    assert spectral_rule(replace(inputs_of(lsst, air), atmosphere=None), 2) is None
    assert inputs_of(lsst, air, weights=[1.0, 2.0, 3.0, 2.0, 1.0]).has_spectra
