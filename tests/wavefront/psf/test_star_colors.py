"""PSFs of stars of any colour: all engines against direct sums over wavelengths."""

import numpy as np
import pytest

import pachon
from pachon.wavefront.atmosphere.refraction import dispersion_shift
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

ARCSEC = np.pi / 180 / 3600
WEATHER = pachon.models.load_site("cerro_pachon").weather
WAVES = np.array([560e-9, 625e-9, 690e-9])


def air():
    screens = pachon.ScreenSampling(screen_size=1024, screen_length=120.0, fine_size=512)
    return pachon.Atmosphere.from_site("cerro_pachon", 1, exposure=0.2, time_step=0.1, screens=screens)


def images(telescope, engine, waves, atmosphere, weights=None):
    fields = np.radians([(0.1, 0.2), (0.6, -0.7)])
    dispersion = dispersion_shift(waves, WAVES[1], np.radians(50.0), 0.3, WEATHER)
    light, stamps = pachon.Light(waves, weights, dispersion), Stamps(offsets=[[0.2, -0.3], [0.0, 0.1]])
    return make_psfs(telescope, fields, light, engine=engine, atmosphere=atmosphere, stamps=stamps)


@pytest.mark.parametrize("engine", ["fast", "long_exposure", pytest.param("wave", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["lsst_v3.3_r", "decam"])
def test_spectra_are_direct_sums_over_wavelengths(engine, name):
    """Each wavelength by itself beside the middle one, of which all stars have their reference points."""
    if engine == "wave" and name == "decam":
        pytest.skip("one telescope will do")
    telescope, atmosphere = pachon.load_telescope(name), air()
    photons = np.array([[0.2, 1.0, 2.3], [3.0, 0.5, 0.0]])
    engine = {
        "fast": pachon.FastEngine(),
        "long_exposure": pachon.LongExposureEngine(n_pupil=1500 if name == "decam" else 80),
        "wave": pachon.WaveEngine(pupil_spacing=0.02),
    }[engine]
    found = images(telescope, engine, WAVES, atmosphere, photons)
    total = np.zeros_like(found.image, dtype=np.float64)
    for w, wave in enumerate(WAVES):
        # A pair [wave, middle] has the middle wavelength's reference points too.
        pair = images(telescope, engine, np.array([wave, WAVES[1]]), atmosphere, [1.0, 0.0])
        light = photons[:, w, None, None] * pair.inside[:, None, None] * pair.lit_fraction[:, :1, None]
        total += light * pair.image
    total /= total.sum(axis=(1, 2), keepdims=True)
    # Single precision, and frequencies of which 1e-5 is left, which reach farther at one wavelength than at another.
    np.testing.assert_allclose(found.image, total, atol=3e-5 * total.max())


def test_equal_weights_are_none(lsst_r):
    for engine in ("fast", "long_exposure"):
        plain = images(lsst_r, engine, WAVES, air())
        for weights in ([2.0, 2.0, 2.0], np.full((2, 3), 0.7)):
            found = images(lsst_r, engine, WAVES, air(), weights)
            np.testing.assert_allclose(found.image, plain.image, atol=1e-7 * plain.image.max())


def test_five_wavelengths_make_the_colour_of_a_star(lsst_r):
    """A cool and a hot star in refracting air, against fifty wavelengths over the band: shift and size."""
    zenith, kelvin = np.radians(50.0), [3200.0, 12000.0]
    found = []
    for count in (5, 51):
        # The midpoint rule.
        waves = lsst_r.band[0] + (np.arange(count) + 0.5) / count * np.ptp(lsst_r.band)
        dispersion = dispersion_shift(waves, waves[count // 2], zenith, 0.0, WEATHER)
        light = pachon.Light(waves, pachon.blackbody_photons(kelvin, waves), dispersion)
        fields = [[0.0, 0.0]] * 2
        psfs = make_psfs(lsst_r, fields, light, atmosphere=air(), engine="long_exposure", stamps=Stamps(41))
        shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, 0.7 * ARCSEC)
        found.append(np.array([shapes.x, shapes.y, shapes.e1, shapes.e2, shapes.size / ARCSEC]))
    five, many = found
    place = five[:2] - many[:2]
    # The mean of the air's shifts, by the photons of each wavelength; the weight draws centroids to the brightest part.
    photons = pachon.blackbody_photons(kelvin, waves)
    apart = np.hypot(*((photons[1] - photons[0]) @ dispersion / count)) / ARCSEC
    assert apart > 0.03
    assert np.hypot(*(many[:2, 1] - many[:2, 0])) * psfs.pixel_scale / ARCSEC == pytest.approx(apart, rel=0.1)
    assert np.abs(place).max() * 0.2 < 4e-3
    np.testing.assert_allclose(five[4], many[4], rtol=5e-3)


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ([1.0, 2.0], r"weights of shape \[2\]: expected \[3\] or \[2, 3\]"),
        ([1.0, -2.0, 1.0], "weights: expected numbers of photons from 0"),
        (np.zeros((2, 3)), "weights: expected numbers of photons from 0"),
        (["red", "blue", "green"], "weights"),
    ],
)
def test_bad_weights_are_one_line(lsst_r, weights, words):
    with pytest.raises(pachon.PachonError, match=words) as caught:
        make_psfs(lsst_r, [[0.0, 0.0]] * 2, pachon.Light(WAVES, weights=weights))
    assert "\n" not in str(caught.value)
