"""PSFs of spectra that no star has, predicted from stars of other spectra, against those made of their wavelengths."""

from functools import partial

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.measure.rho_statistics import trace_of_moments
from pachon.models.io.site_file import load_site
from pachon.wavefront.atmosphere.refraction import dispersion_shift

#: Middles of 24 equal parts of r [m].
WAVES = 552e-9 + (np.arange(24) + 0.5) / 24 * 139e-9
PIXEL = 0.2 * np.pi / 648000


def galaxy(redshift, depth=1.8):
    """Photons of a blackbody of 4800 K with a break at 4000 Angstrom, redshifted."""
    at_rest = WAVES / (1.0 + redshift)
    return pachon.blackbody_photons(4800.0, at_rest)[0] * np.where(at_rest < 400e-9, 1.0 / depth, 1.0)


def light_of(photons, zenith_angle, position_angle=0.4):
    """Light of spectra that the air spreads along a direction."""
    spread = dispersion_shift(WAVES, 620e-9, zenith_angle, position_angle, load_site("cerro_pachon").weather)
    return pachon.Light(WAVES, photons, spread)


def centroids(images, pixel_scale):
    found = pachon.measure_shapes(images, pixel_scale, 0.7 * np.pi / 648000)
    return np.stack([found.x, found.y], axis=1)


def made(telescope, fields, photons, zenith_angle):
    """Centred PSFs of spectra at fields, averaged over all turbulence, in silicon."""
    psfs = pachon.make_psfs(
        telescope,
        fields,
        light_of(photons, zenith_angle),
        atmosphere=pachon.Atmosphere.from_site("cerro_pachon", seed=1, zenith_angle=zenith_angle),
        engine="long_exposure",
        stamps=pachon.Stamps(31, silicon=pachon.models.Silicon(), recenter=centroids),
        threads=1,
    )
    images = np.asarray(psfs.image, dtype=float)
    return images / images.sum(axis=(1, 2), keepdims=True)


def shapes(images):
    moments = pachon.adaptive_moments(images, PIXEL, threads=1)
    return np.stack([trace_of_moments(moments.sigma, moments.g1, moments.g2), moments.g1, moments.g2])


def rms(values):
    return np.sqrt((values**2).mean())


@pytest.fixture(scope="module")
def field():
    """Places of stars and their spectra, and spectra of galaxies and others at the middle of the places."""
    rng = np.random.default_rng(2)
    middle = np.deg2rad([0.5, 0.3])
    fields = middle + np.deg2rad(rng.uniform(-0.1, 0.1, (30, 2)))
    photons = pachon.blackbody_photons(np.exp(rng.uniform(np.log(3500.0), np.log(10000.0), 30)), WAVES)
    cool = pachon.blackbody_photons(3600.0, WAVES)[0]
    spectra = np.stack([galaxy(0.0), galaxy(0.35), galaxy(0.9), np.ones(24), cool])
    return fields, photons, np.repeat(middle[None], len(spectra), axis=0), spectra


@pytest.mark.long
@pytest.mark.parametrize(
    ("zenith_angle", "kind", "fraction"),
    # g - i is linear in the mean wavelength to a few per cent; with air a second order comes in.
    [(0.0, "wavelength", 0.05), (0.0, "g_i", 0.1), (45.0, "wavelength", 0.25), (45.0, "g_i", 0.25)],
)
def test_the_psf_of_a_galaxy_is_that_of_its_effective_colour(lsst_r, field, zenith_angle, kind, fraction):
    fields, photons, places, spectra = field
    angle = np.deg2rad(zenith_angle)
    model = pachon.PsfModel.fit(
        made(lsst_r, fields, photons, angle),
        fields,
        gain=None,
        clipping=None,
        colour=pachon.effective_colour(WAVES, photons, kind),
    )
    assert model.colour.probability > 0.999
    truth = shapes(made(lsst_r, places, spectra, angle))
    colour = pachon.effective_colour(WAVES, spectra, kind)
    plain, predicted = shapes(model.at(places)), shapes(model.at(places, colour=colour))
    assert rms(plain[0] / truth[0] - 1.0) > 5e-3
    assert rms(predicted[0] / truth[0] - 1.0) < fraction * rms(plain[0] / truth[0] - 1.0)
    if zenith_angle:
        assert rms(predicted[1:] - truth[1:]) < 0.6 * rms(plain[1:] - truth[1:])
    if kind == "wavelength":
        # The light that the air spreads is known for each spectrum.
        whole = pachon.reconstruction.psf_of_spectrum(model, places, light_of(spectra, angle), PIXEL)
        np.testing.assert_allclose(whole.sum(axis=(1, 2)), 1.0, atol=1e-12)
        assert rms(shapes(whole)[0] / truth[0] - 1.0) < 0.06 * rms(plain[0] / truth[0] - 1.0)
        if zenith_angle:
            assert rms(shapes(whole)[1:] - truth[1:]) < 0.1 * rms(plain[1:] - truth[1:])


def gaussian(covariance, side=25):
    """Gaussian of unit sum of a covariance xx, yy, xy [pixel^2], the pixel's own included."""
    y, x = np.indices((side, side)) - side // 2
    xx, yy, xy = covariance
    square = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    image = np.exp(-0.5 * square)
    return image / image.sum()


def test_the_spread_of_a_spectrum_is_its_own_covariance():
    """Gaussians of stars whose covariance is that of their light, and of a spectrum of two lines."""
    rng = np.random.default_rng(3)
    shift = np.deg2rad(np.outer(WAVES - 620e-9, [0.6, -0.3]) / 139e-9 / 3600.0)

    def spread(photons):
        mean = np.average(shift, axis=0, weights=photons)
        (xx, xy), (_, yy) = (
            np.average((shift - mean)[:, :, None] * (shift - mean)[:, None], axis=0, weights=photons) / PIXEL**2
        )
        return np.array([xx, yy, xy])

    kelvin = rng.uniform(3500.0, 10000.0, 40)
    photons = pachon.blackbody_photons(kelvin, WAVES)
    stars = np.stack([gaussian(np.array([3.0, 3.0, 0.0]) + spread(p)) for p in photons])
    places = rng.uniform(-1.0, 1.0, (40, 2))
    recipe = pachon.reconstruction.Recipe(pachon.reconstruction.Pixels(), pachon.reconstruction.Polynomial(0))
    colour = pachon.effective_colour(WAVES, photons)
    model = pachon.PsfModel.fit(stars, places, recipe=recipe, gain=None, clipping=None, colour=colour)
    lines = np.where(np.isin(np.arange(24), [3, 20]), 1.0, 1e-9)
    drawn = pachon.reconstruction.psf_of_spectrum(model, [0.2, 0.1], pachon.Light(WAVES, lines, shift), PIXEL)[0]
    expected = gaussian(np.array([3.0, 3.0, 0.0]) + spread(lines))
    # The spectrum changes a star by 6 % of the peak; stars are linear in the colour to a thousandth of it.
    assert np.abs(expected - stars[0]).max() > 0.05 * expected.max()
    np.testing.assert_allclose(drawn, expected, atol=2e-3 * expected.max())
    plain = pachon.reconstruction.psf_of_spectrum(model, [0.2, 0.1], pachon.Light(WAVES, lines), PIXEL)
    np.testing.assert_array_equal(plain, model.at([0.2, 0.1], colour=pachon.effective_colour(WAVES, lines)))
    call = partial(pachon.reconstruction.psf_of_spectrum, pixel_scale=PIXEL)
    without = pachon.PsfModel.fit(stars, places, recipe=recipe, gain=None, clipping=None)
    in_magnitudes = pachon.PsfModel.fit(
        stars, places, recipe=recipe, gain=None, clipping=None, colour=pachon.effective_colour(WAVES, photons, "g_i")
    )
    for arguments, match in (
        ((without, places[0], pachon.Light(WAVES)), "model has no dependence on the colour: expected stars whose mean"),
        (
            (in_magnitudes, places[0], pachon.Light(WAVES)),
            r"expected mean wavelengths \[m\] within 5.549e-07 to 6.881e-07",
        ),
        ((model, places[:3], pachon.Light(WAVES, photons[:2])), "2 spectra, expected one, or one for each of 3 pos"),
        (
            (model, places[0], pachon.Light(WAVES, None, shift[:5])),
            r"dispersion has shape \(5, 2\): expected \[24, 2\]",
        ),
    ):
        with pytest.raises(DomainError, match=match):
            call(*arguments)
