"""Photometry of cameras: published numbers, estimates from area and throughput, own files, and the runs that use it."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import PachonError
from pachon.imaging.exposure import Exposure
from pachon.models.camera.photometry import BANDS, estimated_band
from pachon.pipeline.config import Configuration, configuration_of, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import ccd_stars
from pachon.pipeline.simulate.photometry import limiting_magnitude, saturation_magnitude, sky_electrons_per_pixel

ARCSEC = np.pi / 648000
#: Runs whose screens are small, which are not made here.
SMALL = {
    "wavelengths_nm": [700.0], "psf": {"engine": "fast"},
    "atmosphere": {"exposure_s": 1.0, "screen_size": 1024, "screen_length_m": 800.0},
}  # fmt: skip


def run(**changes):
    return Experiment.from_config(configuration_of({**SMALL, **changes}, "test"))


def test_zero_points_are_electrons_of_the_ab_system():
    # Photons of AB magnitude 0: 3631 Jy / h = 5.48e10 a second, square metre and unit of ln(wavelength).
    band = estimated_band("r", 10.0, (550e-9, 690e-9), 0.4)
    rate = 0.4 * 10.0 * 3631e-26 / 6.62607015e-34 * np.log(690.0 / 550.0)
    assert band.zero_point == pytest.approx(2.5 * np.log10(rate), abs=1e-3)
    # The LSST by its own area and the mean throughput of its r band is right to a few hundredths.
    lsst = estimated_band("r", 0.25 * np.pi * 6.423**2, (550e-9, 690e-9), 0.548)
    assert lsst.zero_point == pytest.approx(BANDS["r"].zero_point, abs=0.03)


@pytest.mark.parametrize(
    ("telescope", "band", "zero_point", "read_noise", "full_well", "gain", "pixel"),
    [
        # obs_subaru: 26.94 in ADU, a gain of 3.0; Subaru: 4.5 e-, 150 000 e-, 0.17 arcsec.
        ("hsc", "i", 26.94 + 2.5 * np.log10(3.0), 4.5, 150e3, 3.0, 0.17),
        # obsbot: 26.818; NOIRLab: 7 e-, 100 000 e-, 4 e-/ADU, 0.2637 arcsec in the middle.
        ("decam", "r", 26.818, 7.0, 100e3, 4.0, 0.2637),
        # SMTN-002.
        ("comcam_r", "r", 28.36, 8.8, 100e3, 1.0, 0.2),
    ],
)
def test_runs_take_the_photometry_of_their_camera(telescope, band, zero_point, read_noise, full_well, gain, pixel):
    experiment = run(telescope=telescope)
    found = experiment.band
    assert found.name == experiment.config.band == band
    assert found.zero_point == pytest.approx(zero_point, abs=0.006)
    assert (found.read_noise, found.full_well, found.gain) == (read_noise, full_well, gain)
    assert found.pixel_scale == pytest.approx(pixel * ARCSEC, rel=0.01)
    # Throughputs of what is built lie between a fifth and 0.7.
    area = 0.25 * np.pi * experiment.telescope.pupil_diameter**2 * (1.0 - experiment.telescope.pupil_obscuration**2)
    perfect = estimated_band(band, area, experiment.telescope.band, 1.0).zero_point
    assert 0.2 < 10.0 ** (0.4 * (found.zero_point - perfect)) < 0.7
    # Limits by hand: the star of S/N 30, and the brightest one, with these pixels and this noise.
    stars = ccd_stars(experiment, experiment.config.ccds[0], 0.7 * ARCSEC)
    assert stars.faint == limiting_magnitude(30.0, found, 1.0, 0.7 * ARCSEC)
    counts = 10.0 ** (0.4 * (found.zero_point - stars.faint))
    sky = 10.0 ** (0.4 * (found.zero_point + found.extinction - found.dark_sky)) * (found.pixel_scale / ARCSEC) ** 2
    pixels = 2.266 * (0.7 * ARCSEC / found.pixel_scale) ** 2
    assert counts / np.sqrt(counts + pixels * (sky + read_noise**2 + found.dark_current)) == pytest.approx(30.0)
    assert sky == pytest.approx(sky_electrons_per_pixel(found, 1.0))
    assert stars.bright == saturation_magnitude(found, 1.0, 0.7 * ARCSEC)


def test_stars_are_dimmed_by_their_airmass_and_the_sky_is_not():
    air = SMALL["atmosphere"] | {"screen_length_m": 1600.0}
    zenith, low = (run(atmosphere=air | {"zenith_angle_deg": angle}) for angle in (0.0, 60.0))
    assert zenith.band.zero_point - low.band.zero_point == pytest.approx(0.13)  # SMTN-002, airmass 2
    electrons = [Exposure.of_run(experiment).electrons(20.0) for experiment in (zenith, low)]
    assert electrons[0] / electrons[1] == pytest.approx(10.0 ** (0.4 * 0.13))
    assert sky_electrons_per_pixel(low.band, 1.0) == pytest.approx(sky_electrons_per_pixel(zenith.band, 1.0))
    limits = [ccd_stars(experiment, experiment.config.ccds[0], 0.7 * ARCSEC).faint for experiment in (zenith, low)]
    assert limits[0] - limits[1] == pytest.approx(0.13, abs=1e-9)


def test_the_budget_of_the_lsst_is_drawn_for_the_lsst_alone():
    assert run(telescope="lsst_v3.3_r", wavelengths_nm=[620.0]).config.focal_plane.budget == "simulated"
    flat = run(telescope="decam", wavelengths_nm=[640.0])
    assert flat.config.focal_plane.budget == "flat"
    assert not flat.focal_plane.polynomial.any()
    drawn = run(telescope="decam", wavelengths_nm=[640.0], focal_plane={"budget": "specification"})
    assert drawn.focal_plane.polynomial.any()


OWN = """
name: own
source: test
pixel_um: 15
pixels: [1000, 800]
{photometry}
ccds: [{{name: A, x_mm: 0, y_mm: 0}}]
"""


def own(tmp_path, section, **changes):
    (tmp_path / "own.yaml").write_text(OWN.format(photometry=section))
    return run(telescope="decam", camera=str(tmp_path / "own.yaml"), wavelengths_nm=[640.0], **changes)


def test_a_camera_without_photometry_is_estimated_and_says_so(tmp_path):
    experiment = own(tmp_path, "")
    area = 0.25 * np.pi * 3.942**2 * (1.0 - 0.33**2)
    low, high = experiment.telescope.band
    rate = 0.5 * area * 3631e-26 / 6.62607015e-34 * np.log(high / low)
    assert experiment.band.zero_point == pytest.approx(2.5 * np.log10(rate), abs=1e-3)
    assert experiment.config.photometry.source.startswith("estimated: 10.9 m2, throughput 0.5, 570 to 715 nm")
    # Written out, read and resolved again it is the same.
    again = Experiment.from_config(configuration_of(experiment.config.as_dict(), "test"))
    assert again.band == experiment.band
    assert again.config_hash == experiment.config_hash


def test_own_bands_noise_and_throughput(tmp_path):
    dimmer = own(tmp_path, "photometry: {source: test, throughput: 0.25, read_noise_e: 3, gain: 2}")
    assert dimmer.band.zero_point == pytest.approx(own(tmp_path, "").band.zero_point - 2.5 * np.log10(2.0), abs=2e-3)
    assert (dimmer.band.read_noise, dimmer.band.gain) == (3.0, 2.0)
    bands = "bands: {r: {zero_point: 25, dark_sky: 21, extinction: 0.1, effective_nm: 640}}"
    measured = own(tmp_path, f"photometry: {{source: test, area_m2: 10.9, {bands}}}")
    assert measured.band.zero_point == 25.0
    # The zero points of a telescope of half the area.
    scaled = own(tmp_path, f"photometry: {{source: test, area_m2: 5.45, {bands}}}")
    area = 0.25 * np.pi * 3.942**2 * (1.0 - 0.33**2)
    assert scaled.band.zero_point == pytest.approx(25.0 + 2.5 * np.log10(area / 5.45), abs=2e-3)
    assert scaled.config_hash != measured.config_hash
    given = own(tmp_path, "", photometry={"zero_point": 24.0, "dark_sky": 20.0})
    assert (given.band.zero_point, given.band.dark_sky) == (24.0, 20.0)
    image = pachon.Exposure.of_run(dimmer, 3)
    assert (image.gain, image.read_noise, image.time) == (2.0, 3.0, 1.0)
    assert image.zero_point == pytest.approx(dimmer.band.zero_point + 2.5 * np.log10(1.5))


@pytest.mark.parametrize(
    ("photometry", "changes", "words"),
    [
        ("photometry: hsc", {}, r"photometry.*expected.*lsst"),
        ("photometry: {source: a, bands: {w: {}}}", {}, "photometry.*bands.*w"),
        ("photometry: {source: a, throughput: 0}", {}, "photometry.throughput = 0: expected more than 0"),
        ("photometry: {source: a, bands: {r: {zero_point: 25, dark_sky: 21, extinction: 0.1, effective_nm: 640}}}", {},
         "photometry.area_m2: expected the collecting area"),
        ("photometry: {source: a, area_m2: 10, bands: {g: {zero_point: 25, dark_sky: 21, extinction: 0, "
         "effective_nm: 480}}}", {}, "unknown band of own 'r': expected one of g"),
        ("", {"photometry": {"gain": -1}}, "photometry.gain = -1: expected"),
        ("height_budget: bumpy", {}, "height_budget = .*bumpy"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(tmp_path, photometry, changes, words):
    with pytest.raises(PachonError, match=words) as caught:
        own(tmp_path, photometry, **changes)
    assert "\n" not in str(caught.value)


def test_the_lsst_is_as_it_was():
    experiment = Experiment.from_config(with_options(Configuration(), ccds=("R22_S11",)))
    assert experiment.band == BANDS["r"]


def test_an_exposure_has_one_band():
    exposure = pachon.Exposure("r", photometry=BANDS["r"])
    assert exposure.zero_point == pachon.Exposure("r").zero_point
    with pytest.raises(PachonError, match="band = i: expected r, the band of photometry"):
        pachon.Exposure("i", photometry=BANDS["r"])
