"""Sensor effects in a run: which stars have them, and that without them nothing changes."""

import dataclasses

import numpy as np
import pytest

from pachon.core.errors import ConfigError
from pachon.pipeline.config import with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.sensor.brighter_fatter import brighter_fatter
from pachon.pipeline.sensor.displacement import displace_stamps
from pachon.pipeline.simulate.ccd_exposure import expose_ccd, expose_positions
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.pipeline.simulate.ccd_observation import collected_images
from pachon.pipeline.simulate.photometry import sky_electrons_per_pixel

NAME = "R22_S11"
RINGS = {"sensor__tree_rings_um": 1.0, "sensor__tree_ring_period_um": 2000.0}
EDGE = {"sensor__edge_rolloff_um": 40.0, "sensor__edge_rolloff_length_um": 5000.0}


@pytest.fixture(scope="module")
def settings(tiny):
    """The mean over turbulence on one CCD: ``settings(sensor__brighter_fatter="itl")``."""

    def make(**options):
        mine = {"ccds": (NAME,), "psf__engine": "long_exposure", "wavelengths_nm": [620.0]}
        return Experiment.from_config(tiny(**(mine | options)))

    return make


@pytest.fixture(scope="module")
def plain(settings):
    experiment = settings()
    exposure = expose_ccd(experiment, NAME, threads=1)
    return exposure, model_ccd(experiment, exposure)


@pytest.mark.long
def test_bright_stars_are_fatter_and_the_truth_is_not(settings, plain):
    exposure, without = plain
    # The brighter-fatter effect is no part of the exposure: the same stars again.
    product = model_ccd(settings(sensor__brighter_fatter="e2v"), exposure)
    for key in ("e1", "e2", "size"):
        np.testing.assert_array_equal(getattr(product.holdout, key), getattr(without.holdout, key))
    noise_free = model_ccd(settings(sensor__brighter_fatter="e2v"), exposure, noisy=False)
    still = model_ccd(settings(), exposure, noisy=False)
    growth = noise_free.observed.size / still.observed.size - 1.0
    electrons = without.observed.electrons
    # The sky is common to all; the rest is proportional to the electrons of a star.
    slope, common = np.polyfit(electrons, growth, 1)
    assert slope * electrons.max() > 1e-4
    np.testing.assert_allclose(growth, common + slope * electrons, atol=0.03 * growth.max() + 1e-6)
    sky = sky_electrons_per_pixel("r", 2.0, exposure.observed.pixel_scale)
    brightest = int(electrons.argmax())
    one = exposure.observed.image[brightest].astype(float)[None]
    np.testing.assert_array_less(
        np.abs(noise_free.observed_images[brightest] - still.observed_images[brightest]).max(),
        2.0 * np.abs(brighter_fatter(one, electrons[[brightest]], sensor="e2v", sky=sky) - one).max(),
    )


@pytest.mark.long
@pytest.mark.parametrize("options", [RINGS, EDGE])
def test_static_displacements_act_on_all_stars(settings, plain, options):
    exposure, _ = plain
    experiment = settings(**options)
    found = expose_ccd(experiment, NAME, threads=1)
    effects = experiment.displacements(NAME)
    center = experiment.camera.centers[experiment.camera.ccd_index(NAME)]
    for kind in ("holdout", "observed"):
        before, after = (getattr(e, kind).image for e in (exposure, found))
        places = getattr(exposure.positions, kind) - center
        if kind == "observed":
            # Stars lie off the centre of their middle pixel, at most by half of it.
            pixel = exposure.positions.observed_pixel
            places = places - (pixel - np.rint(pixel)) * experiment.pixel_size
        expected = displace_stamps(before.astype(float), effects, places, experiment.pixel_size)
        # Holdout stars are centred on their light, a fraction of a pixel from their place.
        np.testing.assert_allclose(after, expected, atol=2e-4 * before.max())
        np.testing.assert_allclose(after.sum(axis=(1, 2)), 1.0, atol=1e-6)
        assert np.abs(after - before).max() > 2e-3 * before.max()
    np.testing.assert_array_equal(found.holdout.fields, exposure.holdout.fields)


def test_each_ccd_has_rings_of_its_own(settings):
    experiment = settings(**RINGS)
    (one,), (again,), (other,) = (experiment.displacements(n) for n in (NAME, NAME, "R24_S12"))
    assert one == again
    assert one != other
    assert dataclasses.replace(one, phase=other.phase) == other
    assert one.amplitude == 1e-6
    # Each star has those of its own CCD, whatever the others of the call.
    camera = experiment.camera
    places = camera.centers[[camera.ccd_index(n) for n in ("R24_S12", NAME)]] + 1e-3
    together = expose_positions(experiment, places, 1).image
    np.testing.assert_array_equal(together[1:], expose_positions(experiment, places[1:], 1).image)
    assert np.abs(together - expose_positions(settings(), places, 1).image).max() > 1e-6


def test_off_changes_no_bit(settings, plain):
    exposure, without = plain
    # Periods and lengths of effects that are off.
    experiment = settings(sensor__tree_ring_period_um=50.0, sensor__edge_rolloff_length_um=1e6)
    assert experiment.displacements(NAME) == ()
    again = expose_ccd(experiment, NAME, threads=2)
    np.testing.assert_array_equal(again.observed.image, exposure.observed.image)
    np.testing.assert_array_equal(again.holdout.image, exposure.holdout.image)
    np.testing.assert_array_equal(model_ccd(experiment, again).observed_images, without.observed_images)


def test_boundaries_of_other_pixels_are_refused(tiny):
    with pytest.raises(ConfigError, match=r"^psf.pixel_um = 5: expected 10, .*sensor.brighter_fatter = itl"):
        Experiment.from_config(with_options(tiny(), sensor__brighter_fatter="itl", psf__pixel_um=5.0))
    with pytest.raises(ConfigError, match=r"sensor.brighter_fatter"):
        with_options(tiny(), sensor__brighter_fatter="kodak")


def test_charge_is_transferred_along_the_columns_of_the_ccd(tiny):
    """Stamps lie along the focal plane, along whose y the rows of LSSTCam run."""
    experiment = Experiment.from_config(tiny(sensor__brighter_fatter="itl", ccds=("R22_S11",)))
    y, x = np.indices((31, 31)) - 15
    image = np.exp(-0.5 * (x**2 + y**2) / 1.7**2)[None]
    image /= image.sum()
    collected = collected_images(experiment, image, experiment.pixel_size / 10.3, np.array([1e5]))
    grown = [(collected[0] * axis**2).sum() - (image[0] * axis**2).sum() for axis in (x, y)]
    level = sky_electrons_per_pixel(experiment.band, 2.0, experiment.pixel_size / 10.3)
    along = brighter_fatter(image, np.array([1e5]), sensor="itl", sky=level)
    serial, parallel = ((along[0] * axis**2).sum() - (image[0] * axis**2).sum() for axis in (x, y))
    assert abs(serial - parallel) > 1e-3 * abs(serial)
    assert grown == pytest.approx([parallel, serial], rel=1e-2)
