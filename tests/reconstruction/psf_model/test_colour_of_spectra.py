"""PSFs of spectra that no star has, predicted from stars of other spectra, against those made of their wavelengths."""

import numpy as np
import pytest

import pachon
from pachon.measure.rho_statistics import trace_of_moments
from pachon.models.io.site_file import load_site
from pachon.wavefront.atmosphere.refraction import dispersion_shift

#: Middles of 24 equal parts of r [m].
WAVES = 545e-9 + (np.arange(24) + 0.5) / 24 * 158e-9


def galaxy(redshift, depth=1.8):
    """Photons of a blackbody of 4800 K with a break at 4000 Angstrom, redshifted."""
    at_rest = WAVES / (1.0 + redshift)
    return pachon.blackbody_photons(4800.0, at_rest)[0] * np.where(at_rest < 400e-9, 1.0 / depth, 1.0)


def made(telescope, fields, photons, zenith_angle):
    """PSFs of spectra at fields, averaged over all turbulence, in silicon, light spread along x by the air."""
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1, zenith_angle=zenith_angle)
    spread = dispersion_shift(WAVES, 620e-9, zenith_angle, 0.0, load_site("cerro_pachon").weather)
    stamps = pachon.Stamps(31, silicon=pachon.Silicon())
    light = pachon.Light(WAVES, photons, spread)
    psfs = pachon.make_psfs(telescope, fields, light, atmosphere=air, engine="long_exposure", stamps=stamps, threads=1)
    images = np.asarray(psfs.image, dtype=float)
    return images / images.sum(axis=(1, 2), keepdims=True)


def trace_and_g1(images):
    moments = pachon.adaptive_moments(images, 0.2 * np.pi / 648000, threads=1)
    return trace_of_moments(moments.sigma, moments.g1, moments.g2), moments.g1


@pytest.mark.long
@pytest.mark.parametrize(
    ("zenith_angle", "kind", "fraction"),
    # g - i is linear in the mean wavelength to a few per cent.
    [(0.0, "wavelength", 0.05), (0.0, "g_i", 0.1), (45.0, "wavelength", 0.35), (45.0, "g_i", 0.35)],
)
def test_the_psf_of_a_galaxy_is_that_of_its_effective_colour(lsst_r, zenith_angle, kind, fraction):
    rng = np.random.default_rng(2)
    middle, angle = np.deg2rad([0.5, 0.3]), np.deg2rad(zenith_angle)
    fields = middle + np.deg2rad(rng.uniform(-0.1, 0.1, (30, 2)))
    kelvin = np.exp(rng.uniform(np.log(3500.0), np.log(10000.0), 30))
    photons = pachon.blackbody_photons(kelvin, WAVES)
    stars = made(lsst_r, fields, photons, angle)
    model = pachon.PsfModel.fit(
        stars, fields, gain=None, clipping=None, colour=pachon.effective_colour(WAVES, photons, kind)
    )
    assert model.colour.probability > 0.999
    spectra = np.stack(
        [galaxy(0.0), galaxy(0.35), galaxy(0.9), np.ones(24), pachon.blackbody_photons(3600.0, WAVES)[0]]
    )
    places = np.repeat(middle[None], len(spectra), axis=0)
    truth = trace_and_g1(made(lsst_r, places, spectra, angle))
    colour = pachon.effective_colour(WAVES, spectra, kind)
    predicted, plain = trace_and_g1(model.at(places, colour=colour)), trace_and_g1(model.at(places))
    # What is linear in the wavelength is exact; what is left is the light that the air spreads, of second order.
    size, plain_size = predicted[0] / truth[0] - 1.0, plain[0] / truth[0] - 1.0
    assert np.sqrt((plain_size**2).mean()) > 5e-3
    assert np.sqrt((size**2).mean()) < fraction * np.sqrt((plain_size**2).mean())
    if zenith_angle:
        shape, plain_shape = predicted[1] - truth[1], plain[1] - truth[1]
        assert np.sqrt((shape**2).mean()) < 0.6 * np.sqrt((plain_shape**2).mean())
