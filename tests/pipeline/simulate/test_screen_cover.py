"""Length of a periodic screen that a run crosses, against the positions that its light crosses, one by one."""

import math
import re

import numpy as np
import pytest

from pachon.core.errors import ConfigError
from pachon.models.camera.cameras import load_camera
from pachon.models.io.prescription import load_telescope
from pachon.models.io.site_file import load_site
from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.defaults import resolve
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.screen_cover import swept_lengths
from pachon.raytrace.rays import field_direction
from pachon.wavefront.chief_rays import fields_at


def swept(config):
    telescope = load_telescope(config.telescope)
    return swept_lengths(config, telescope, load_camera(telescope.camera), load_site(config.atmosphere.site))


def test_the_default_and_all_ccds_fit():
    lengths = swept(Experiment.from_config(Configuration()).config)
    assert lengths.max() < 1300.0
    everything = swept(Experiment.from_config(with_options(Configuration(), ccds=("all",))).config)
    # The top layer: 20 m/s for 15 s, 15.46 km under +-0.3167 m of focal plane at 10.31 m, and the pupil.
    assert everything[5] == pytest.approx(300.0 + 2 * 15460.0 * 0.3167 / 10.31 + 8.36, rel=2e-3)
    # The ground layer is the same for all fields.
    assert everything[0] == pytest.approx(75.0 + 8.36)
    assert everything.max() < 1300.0


@pytest.mark.parametrize("zenith", [0.0, 40.0])
def test_no_light_leaves_the_swept_length(zenith):
    """Stars in the corners of the CCDs, rim of the pupil, begin and end of the exposure."""
    names = ("R22_S11", "R31_S02", "R24_S21")
    options = {"ccds": names, "atmosphere__zenith_angle_deg": zenith, "atmosphere__ground_lift_m": 300.0}
    config = Experiment.from_config(with_options(Configuration(), seed=3, **options)).config
    experiment = Experiment.from_config(config)
    camera = experiment.camera
    # 4004 and 4096 pixels of 10 um along x and y.
    half = np.array([20.02e-3, 20.48e-3]) * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    corners = np.concatenate([camera.centers[camera.ccd_index(n)] + half for n in names])
    direction = field_direction(*fields_at(experiment.telescope, corners).T)
    atmosphere = experiment.atmosphere
    crossed = np.concatenate([atmosphere.pupil_centers(direction, time) for time in (0.0, atmosphere.exposure)])
    extents = np.ptp(crossed, axis=0).max(axis=1) + experiment.telescope.pupil_diameter
    lengths = swept(config)
    assert np.all(extents <= lengths)
    # With the wind along the longer side it is just as much.
    view = np.ptp(atmosphere.pupil_centers(direction), axis=0).max(axis=1)
    drift = np.hypot(*atmosphere.velocities.T) * atmosphere.exposure
    np.testing.assert_allclose(lengths, view + drift + experiment.telescope.pupil_diameter, rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"atmosphere__exposure_s": 60.0}, "atmosphere.exposure_s = 60: "),
        # From here on one layer alone comes round: the same message, not that of the atmosphere.
        ({"atmosphere__exposure_s": 600.0}, "atmosphere.exposure_s = 600: "),
        ({"atmosphere__zenith_angle_deg": 60.0}, "atmosphere.exposure_s = 15: "),
        ({"atmosphere__screen_length_m": 300.0}, "atmosphere.exposure_s = 15: "),
        ({"psf__engine": "wave", "atmosphere__exposure_s": 60.0}, "atmosphere.exposure_s = 60: "),
    ],
)
def test_screens_that_come_round_are_refused_and_what_is_asked_for_is_enough(options, named):
    with pytest.raises(ConfigError) as caught:
        resolve(with_options(Configuration(), **options))
    message = str(caught.value)
    assert message.startswith(named)
    assert "of the layer at 15460 m" in message
    assert "\n" not in message
    length, size = re.search(
        r"screen_length_m of at least (\d+) \(and atmosphere.screen_size = (\d+) ", message
    ).groups()
    enough = {**options, "atmosphere__screen_length_m": float(length), "atmosphere__screen_size": int(size)}
    config = resolve(with_options(Configuration(), **enough)).config
    before = with_options(Configuration(), **options).atmosphere
    pixel, old = (a.screen_length_m / a.screen_size for a in (config.atmosphere, before))
    # A fast size for the Fourier transform may be some per cent larger than need be.
    assert 0.9 * old < pixel <= old
    less = {**enough, "atmosphere__screen_length_m": float(length) - 1.0}
    with pytest.raises(ConfigError):
        resolve(with_options(Configuration(), **less))


def test_what_reads_no_screens_needs_none():
    config = with_options(Configuration(), atmosphere__enabled=False, atmosphere__exposure_s=600.0)
    assert Experiment.from_config(config).config.atmosphere.exposure_s == 600.0


def test_one_ccd_may_be_exposed_longer():
    config = Experiment.from_config(
        with_options(Configuration(), ccds=("R22_S11",), atmosphere__exposure_s=60.0)
    ).config
    # A CCD covers 0.041 m / 10.31 m of angle.
    assert swept(config)[5] == pytest.approx(1200.0 + 15460.0 * 0.04096 / 10.31 + 8.36, rel=1e-3)
    assert math.isclose(config.atmosphere.exposure_s, 60.0)
