"""Noise, saturation and levels of exposures against their statistics, and the formulas of SMTN-002."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError
from pachon.imaging.exposure import SATURATED, Exposure, expose
from pachon.imaging.lit_fraction import LitFraction
from pachon.pipeline.config import Configuration, ListedVisitConfig
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.sensor.brighter_fatter import brighter_fatter
from pachon.pipeline.simulate.ccd_observation import collected_images
from pachon.pipeline.simulate.photometry import sky_electrons_per_pixel

SCENE = np.full((300, 400), 250.0, dtype=np.float32)
#: Background of 15 s in r: dark sky of 21.2 mag over 0.04 arcsec^2, zero point 28.36 + 0.13, and 0.2 e-/s dark current.
BACKGROUND = 15.0 * (0.04 * 10.0 ** (0.4 * (28.36 + 0.13 - 21.2)) + 0.2)


@pytest.mark.parametrize(("exposures", "gain"), [(1, 1.0), (400, 1.0), (4, 2.5)])
def test_mean_and_variance_are_those_of_the_electrons(exposures, gain):
    settings = Exposure("r", 15.0, exposures, gain=gain)
    found = expose(SCENE * exposures, settings, 1, "A")
    mean, variance = 250.0 * exposures / gain, exposures * (250.0 + BACKGROUND + 8.8**2) / gain**2
    pixels = SCENE.size
    assert found.variance == pytest.approx(variance, rel=1e-6)
    # Five standard deviations of the mean of all pixels, and of their variance.
    assert found.image.mean(dtype=np.float64) == pytest.approx(mean, abs=5.0 * np.sqrt(variance / pixels))
    assert found.image.var(dtype=np.float64) == pytest.approx(variance, rel=5.0 * np.sqrt(2.0 / pixels))
    assert settings.background == pytest.approx(exposures * BACKGROUND, rel=1e-12)
    assert settings.noise_rms == pytest.approx(np.sqrt(exposures * (BACKGROUND + 8.8**2)), rel=1e-12)


def test_the_zero_point_is_the_magnitude_of_one_adu():
    settings = Exposure("i", 30.0, 10, gain=1.7)
    assert settings.electrons(settings.zero_point) == pytest.approx(1.7, rel=1e-12)
    # SMTN-002: 28.17 gives one electron a second in i.
    assert settings.zero_point == pytest.approx(28.17 + 2.5 * np.log10(300.0 / 1.7), abs=1e-12)


def test_without_noise_an_image_is_the_expected_one():
    kept = expose(SCENE, Exposure(noise=False, subtract_background=False), 1, "A")
    assert kept.image == pytest.approx(250.0 + BACKGROUND, rel=1e-6)
    subtracted = expose(SCENE, Exposure(noise=False), 1, "A")
    assert subtracted.image == pytest.approx(250.0, rel=1e-6)
    assert (subtracted.variance == kept.variance).all()


def test_vignetting_dims_the_sky_and_not_the_dark_current():
    positions = np.random.default_rng(1).uniform(0.0, 400.0, (60, 2))
    expected = np.clip(0.7 - 1e-3 * positions[:, 0] + 2e-6 * positions[:, 0] * positions[:, 1], 0.0, 1.0)
    light = LitFraction.fit(positions, expected, (-0.5, 399.5, -0.5, 399.5), 2)
    np.testing.assert_allclose(light.at(positions), expected, atol=1e-12)
    # A part of the CCD from the pixel (40, 90).
    on_rows = partial(light.on_rows, (40, 90), SCENE.shape)
    settings = Exposure(noise=False, subtract_background=False)
    found = expose(SCENE, settings, 1, "A", lit_fraction=on_rows)
    dark = 15.0 * 0.2
    y, x = np.indices(SCENE.shape)
    lit = light.at(np.stack([x.ravel() + 40, y.ravel() + 90], axis=1)).reshape(SCENE.shape)
    assert np.ptp(lit) > 0.3
    np.testing.assert_allclose(found.image, 250.0 + dark + lit * (BACKGROUND - dark), rtol=1e-6)
    np.testing.assert_allclose(found.variance, found.image + 8.8**2, rtol=1e-6)
    subtracted = expose(SCENE, Exposure(noise=False), 1, "A", lit_fraction=on_rows)
    assert subtracted.image == pytest.approx(250.0, rel=1e-6)
    one, four = (expose(SCENE, settings, 1, "A", lit_fraction=on_rows, threads=n).image for n in (1, 4))
    assert (one == four).all()


def test_the_sky_of_the_configuration_sets_the_background():
    # A magnitude brighter: 10^0.4 times the electrons of the sky.
    dark, bright = Exposure(dark_current=0.0), Exposure(dark_current=0.0, sky=20.2)
    assert bright.background / dark.background == pytest.approx(10.0**0.4, rel=1e-12)


def test_pixels_at_the_full_well_are_clipped_and_marked():
    scene = SCENE.copy()
    scene[10, 20], scene[200, 30] = 99_000.0, 250_000.0
    found = expose(scene, Exposure(subtract_background=False, noise=False), 1, "A")
    assert np.argwhere(found.mask).tolist() == [[200, 30]]
    assert found.mask[200, 30] == SATURATED
    assert found.image[200, 30] == 1e5
    assert found.mask.dtype == np.int16
    # Two exposures hold twice as much.
    assert not expose(scene, Exposure(exposures=3, noise=False), 1, "A").mask.any()


@pytest.mark.parametrize("subtract_background", [True, False])
def test_the_level_of_saturation_is_that_of_the_clipped_pixels_in_adu(subtract_background):
    """As SExtractor and others compare it with the image, where its header has it as SATURATE."""
    scene = SCENE.copy()
    scene[10, 20], scene[200, 30] = 390_000.0, 450_000.0
    settings = Exposure(exposures=4, gain=1.7, subtract_background=subtract_background)
    found = expose(scene, settings, 1, "A")
    assert ((found.image >= settings.saturation_level) == (found.mask == SATURATED)).all()
    assert found.mask.sum() == 1
    taken = 4 * BACKGROUND if subtract_background else 0.0
    assert settings.saturation_level == pytest.approx((4e5 - taken) / 1.7, rel=1e-6)


def test_random_numbers_belong_to_their_key_and_to_no_thread():
    one, four = (expose(SCENE, Exposure(), 1, "A", 0, threads=n).image for n in (1, 4))
    assert one.tobytes() == four.tobytes()
    for seed, key in ((2, ("A", 0)), (1, ("B", 0)), (1, ("A", 1))):
        other = expose(SCENE, Exposure(), seed, *key).image
        correlation = np.corrcoef(one.ravel(), other.ravel())[0, 1]
        assert abs(correlation) < 5.0 / np.sqrt(SCENE.size)
    rows = np.corrcoef(one[:128].ravel(), one[128:256].ravel())[0, 1]
    assert abs(rows) < 5.0 / np.sqrt(SCENE.size / 2)


def test_light_below_zero_is_none():
    found = expose(np.full((64, 64), -1e4, dtype=np.float32), Exposure(), 1, "A")
    assert found.variance == pytest.approx(8.8**2, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"time": 0.0}, "time = 0.0"),
        ({"exposures": 0}, "exposures = 0"),
        ({"gain": -1.0}, "gain = -1.0"),
        ({"read_noise": -1.0}, "read_noise = -1.0"),
        ({"sky": np.nan}, "sky = nan"),
        ({"sky": 10.0}, "sky = 10.00: .* full well"),
        ({"time": 1e5}, "full well"),
    ],
)
def test_bad_settings_are_named(options, text):
    with pytest.raises(DomainError, match=text):
        Exposure(**options)


def test_an_unknown_band_is_named():
    with pytest.raises(ConfigError, match="band = 'v': expected one of u, g, r, i, z, y"):
        Exposure(band="v")


def gaussians(shape, places, electrons, sigma=1.5):
    """Sampled Gaussians [electron] at whole pixels (y, x)."""
    y, x = np.indices(shape)
    light = (
        e * np.exp(-((x - i) ** 2 + (y - j) ** 2) / (2 * sigma**2)) for (j, i), e in zip(places, electrons, strict=True)
    )
    return sum(light) / (2.0 * np.pi * sigma**2)


def test_bright_stars_on_an_image_are_broader():
    """As the same stars on stamps are, each by itself, wherever a band of rows ends; HSM of GalSim sees them grow."""
    galsim = pytest.importorskip("galsim")
    places, electrons = [(60, 60), (127, 150), (250, 240), (150, 340)], np.array([1e3, 1e5, 4e5, 8e5])
    scene = gaussians((300, 400), places, electrons).astype(np.float32)
    settings = Exposure(noise=False, brighter_fatter="e2v", full_well=1e6)
    image = expose(scene, settings, 1, "A").image.astype(np.float64)
    plain = expose(scene, replace(settings, brighter_fatter=None), 1, "A").image.astype(np.float64)
    assert image.sum() == pytest.approx(plain.sum(), rel=1e-7)  # single precision
    growth = []
    for (j, i), count in zip(places, electrons, strict=True):
        stamp = np.s_[j - 20 : j + 21, i - 20 : i + 21]
        light = plain[stamp] / count
        expected = brighter_fatter(light[None], np.array([count]), sensor="e2v", sky=settings.background)[0]
        # A hundred-thousandth of the peak: single precision of the image.
        np.testing.assert_allclose(image[stamp] / count, expected, rtol=0.0, atol=1e-6)
        sizes = [galsim.hsm.FindAdaptiveMom(galsim.Image(v[stamp].copy())).moments_sigma for v in (image, plain)]
        growth.append(sizes[0] / sizes[1] - 1.0)
    # In proportion to the electrons, 1.2 % at 8e5; HSM ends its iterations at about 1e-4.
    np.testing.assert_allclose(growth, growth[3] * electrons / electrons[3], rtol=0.0, atol=1.5e-4)
    assert 0.01 < growth[3] < 0.03


def test_boundaries_of_pixels_move_anew_in_each_exposure():
    scene = gaussians((100, 90), [(50, 40)], [3e5]).astype(np.float32)
    one = Exposure(noise=False, brighter_fatter="itl", full_well=1e6)
    found = [expose(n * scene, replace(one, exposures=n), 1, "A").image / n for n in (1, 3)]
    np.testing.assert_allclose(found[1], found[0], rtol=2e-6, atol=1e-2)  # single precision of 2e4 electrons
    # A pixel that is full repels no more.
    full = expose(1e4 * scene, replace(one, full_well=1e5), 1, "A").image
    assert np.isfinite(full).all()


def test_the_charge_of_one_snap_moves_boundaries():
    """A visit of two snaps has half of the effect of one exposure of the same light, to first order."""
    scene = gaussians((60, 60), [(30, 30)], [4e5]).astype(np.float32)
    plain, whole, halves = (
        expose(scene, Exposure(noise=False, full_well=1e6, **more), 1, "A").image.astype(np.float64)
        for more in ({}, {"brighter_fatter": "itl"}, {"brighter_fatter": "itl", "snaps": 2})
    )
    changes = halves[30, 30] - plain[30, 30], whole[30, 30] - plain[30, 30]
    assert changes[0] == pytest.approx(0.5 * changes[1], rel=0.02)
    visit = ListedVisitConfig(number=1, mid_mjd=61000.0, snaps=2)
    experiment = Experiment.from_config(Configuration(ccds=["R22_S11"], visit=visit, sensor={"brighter_fatter": "itl"}))
    assert Exposure.of_run(experiment).snaps == 2
    star = scene[None].astype(np.float64) / 4e5
    collected = collected_images(experiment, star, 1e-6, np.array([4e5]))[0]
    sky = sky_electrons_per_pixel(experiment.band, 15.0, 1e-6)
    # The camera's pixels exchange x and y.
    expected = brighter_fatter(star.swapaxes(1, 2), np.array([2e5]), sensor="itl", sky=0.5 * sky).swapaxes(1, 2)[0]
    np.testing.assert_array_equal(collected, expected)


def test_the_sensor_of_a_run_is_that_of_its_images():
    settings = {"sensor": {"brighter_fatter": "itl"}, "ccds": ["R22_S11"]}
    assert Exposure.of_run(Experiment.from_config(Configuration(**settings))).brighter_fatter == "itl"
