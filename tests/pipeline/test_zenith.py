"""Position angle of the zenith: from north through east, whatever the roll; correctors of the air's dispersion."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, PrescriptionError
from pachon.pipeline.config import configuration_of, load_configuration
from pachon.pipeline.dispersion import with_dispersion_corrected
from pachon.pipeline.experiment import Experiment
from pachon.raytrace.rays import field_direction
from pachon.studies.visits.plan import Visit
from pachon.studies.visits.psf_visit import visit_experiment
from pachon.wavefront.chief_rays import chief_rays


def blue_towards(experiment, roll):
    """Return the position angle [deg] on the sky of blue light from red, at a roll [rad]."""
    # Slopes are those of light; where it comes from is the pointing's business.
    (xi, eta), *_ = pachon.Pointing(0.3, -0.4, roll).to_sky(np.tan(experiment.dispersion[:1]))
    return np.rad2deg(np.arctan2(xi, eta)) % 360.0


@pytest.fixture
def low(tiny):
    """Experiments at 50 degrees from the zenith: ``low(zenith=70.0, roll=30.0)``."""

    def make(zenith, roll=None):
        air = {"atmosphere__zenith_angle_deg": 50.0, "atmosphere__zenith_position_angle_deg": zenith}
        air["atmosphere__screen_length_m"] = 1300.0
        aim = {} if roll is None else {"pointing": {"ra_deg": 20.0, "dec_deg": -25.0, "position_angle_deg": roll}}
        return Experiment.from_config(tiny(**air, **aim, wavelengths_nm=[560.0, 620.0, 680.0]))

    return make


@pytest.mark.parametrize("roll", [0.0, 30.0, 200.0])
@pytest.mark.parametrize("zenith", [0.0, 70.0, -110.0])
def test_blue_light_stands_nearer_to_the_zenith(low, zenith, roll):
    assert blue_towards(low(zenith, roll), np.deg2rad(roll)) == pytest.approx(zenith % 360.0, abs=1e-6)


def test_without_a_pointing_there_is_no_roll(low):
    assert blue_towards(low(70.0), 0.0) == pytest.approx(70.0, abs=1e-6)


def test_by_default_the_zenith_lies_towards_x_of_the_telescope(low):
    # +x points to the position angle roll + 90.
    assert blue_towards(low(None, 30.0), np.deg2rad(30.0)) == pytest.approx(120.0, abs=1e-6)


def test_the_zenith_stands_still_while_visits_roll(low):
    roll = np.deg2rad(130.0)
    assert blue_towards(visit_experiment(low(70.0), Visit(1, 1, roll)), roll) == pytest.approx(70.0, abs=1e-6)


@pytest.mark.parametrize(
    ("angle", "roll", "value"), [("0.0", "", "90"), ("20", "{position_angle_deg: 30}", "100"), ("-90", "", "180")]
)
def test_the_old_key_is_refused_with_the_value_to_write(tmp_path, angle, roll, value):
    path = tmp_path / "run.yaml"
    pointing = f"pointing: {roll}" if roll else ""
    path.write_text(f"atmosphere: {{parallactic_angle_deg: {angle}}}\n{pointing}\n")
    with pytest.raises(ConfigError, match=r"atmosphere\.parallactic_angle_deg = ") as caught:
        load_configuration(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert f"expected zenith_position_angle_deg: {value} (from north through east)" in text
    assert "\n" not in text


def test_the_value_means_what_the_old_one_did(low):
    # The zenith 20 degrees from +x towards +y: of the telescope's axes on the sky, x at roll + 90, y at roll.
    shift = low(100.0, 30.0).dispersion[0]
    # Blue light comes from nearer to the zenith, and its slopes point away from there.
    assert np.rad2deg(np.arctan2(-shift[1], -shift[0])) == pytest.approx(20.0, abs=1e-9)


@pytest.mark.parametrize(("telescope", "band"), [("lsst_v3.3_g", "g"), ("lsst_v3.3_r", "r"), ("decam", "u")])
def test_the_air_disperses_five_wavelengths_as_an_even_band(telescope, band):
    # With wavelengths from end to end the variance was half as large again, and e of dispersion 1.4 times too large.
    content = {"telescope": telescope, "band": band, "atmosphere": {"zenith_angle_deg": 45.0}}
    five = Experiment.from_config(configuration_of(content, "run"))
    step = five.wavelengths[1] - five.wavelengths[0]
    ends = five.wavelengths[0] - 0.5 * step, five.wavelengths[-1] + 0.5 * step
    even = (np.linspace(*ends, 401)[1::2] * 1e9).tolist()
    many = Experiment.from_config(configuration_of(content | {"wavelengths_nm": even}, "run"))
    variance, even_variance = (np.var(e.dispersion, axis=0).sum() for e in (five, many))
    assert variance == pytest.approx(even_variance, rel=0.06)


@pytest.mark.parametrize(("band", "blue"), [("g", 0.45), ("r", 0.15)])
@pytest.mark.parametrize("zenith", [None, 40.0])
def test_a_dispersion_corrector_brings_the_colours_together(band, blue, zenith):
    air = {"zenith_angle_deg": 45.0, "zenith_position_angle_deg": zenith}
    content = {"telescope": "hsc", "band": band, "ccds": ["hsc050"], "atmosphere": air}
    experiment = Experiment.from_config(configuration_of(content, "run"))
    arcsec = np.deg2rad(1.0 / 3600.0)
    assert np.hypot(*np.ptp(experiment.dispersion, axis=0)) > blue * arcsec
    landed = [
        chief_rays(experiment.telescope, field_direction(*shift[:, None]), wavelength).position[0, :2]
        for shift, wavelength in zip(experiment.dispersion, experiment.wavelengths, strict=True)
    ]
    # The secondary spectrum of the lenses is left, over 18 m of focal length.
    assert np.hypot(*np.ptp(landed, axis=0)) < 0.02 * arcsec * 18.3
    # An ideal telescope in its place has none.
    assert replace(experiment, atmosphere_only=True).dispersion is None


def test_a_corrector_that_disperses_too_little_is_told():
    telescope = replace(pachon.load_telescope("hsc"), dispersion_corrector="W_entrance")
    content = {"telescope": "hsc", "ccds": ["hsc050"], "atmosphere": {"zenith_angle_deg": 45.0}}
    experiment = Experiment.from_config(configuration_of(content, "run"))
    with pytest.raises(PrescriptionError, match=r"dispersion_corrector = W_entrance: .*expected lenses that disperse"):
        with_dispersion_corrected(telescope, experiment.config, experiment.site)
