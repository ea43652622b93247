"""Configuration: every problem is one line with file, key, value and what was expected; resolving fills in all else."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, PachonError
from pachon.core.long_work import differences
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.silicon import Silicon
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.io.site_file import DATA as SITES
from pachon.pipeline.config import Configuration, digest, load_configuration, to_yaml, with_options
from pachon.pipeline.config_hash import hashed_heights, hashed_stars
from pachon.pipeline.experiment import Experiment
from pachon.wavefront.aberration import LARGEST_RMS, ResidualWavefront

# Screens are not made by what is tested here, so their size costs nothing.
SMALL = {"stars__truth": 30, "stars__observed": 25}


def written(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("sed: 3", ["unknown key sed = 3", "did you mean seed?"]),
        ("focal_plane: {bugdet: flat}", ["unknown key focal_plane.bugdet", "did you mean budget?"]),
        ("focal_plane: {zzz: flat}", ["unknown key focal_plane.zzz", "expected one of budget, global, raft"]),
        ("seed: -1", ["seed = -1", "from 0"]),
        ("seed: 1.5", ["seed = 1.5", "a whole number"]),
        ("seed: true", ["seed = true", "a whole number"]),
        ("atmosphere: {r0_m: 0}", ["atmosphere.r0_m = 0", "above 0"]),
        ("atmosphere: {r0_m: thick}", ['atmosphere.r0_m = "thick"', "a number"]),
        ("atmosphere: {exposure_s: .nan}", ["atmosphere.exposure_s = NaN"]),
        ("atmosphere: 5", ["atmosphere = 5", "a mapping"]),
        ("stars: {truth: 0}", ["stars.truth = 0", "from 1"]),
        ("atmosphere: {epoch: -1}", ["atmosphere.epoch = -1", "from 0"]),
        ("active_optics: {residual_um: -0.1}", ["active_optics.residual_um = -0.1", "from 0"]),
        ("active_optics: {residual_um: 200}", ["active_optics.residual_um = 200", "up to 2"]),
        ("psf: {jitter_arcsec: -1}", ["psf.jitter_arcsec = -1", "from 0"]),
        ("detector: {silicon: 1}", ["detector.silicon = 1", "true or false"]),
        ("detector: {silikon: true}", ["unknown key detector.silikon", "did you mean silicon?"]),
        ("detector: {thickness_um: 0.1}", ["detector.thickness_um = 0.1", "from 1"]),
        ("detector: {temperature_k: -100}", ["detector.temperature_k = -100", "from 100"]),
        ("psf: {engine: fats}", ['psf.engine = "fats"', "one of fast, wave"]),
        ("band: q", ['band = "q"', "u, g, r, i, z, y"]),
        ("wavelengths_nm: [600, red]", ['wavelengths_nm[1] = "red"', "a number"]),
        ("focal_plane: {tilt: 1}", ["focal_plane.tilt = 1", "true or false"]),
        ("seed: [1", ["line", "not valid YAML"]),
        ("seed: 1\nseed: 2", ["line 2", "'seed' occurs twice"]),
        ("3", ["expected a mapping"]),
    ],
)
def test_a_wrong_file_says_where_and_what(tmp_path, text, parts):
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_configuration(path)
    message = str(caught.value)
    assert "\n" not in message
    for part in [str(path), *parts]:
        assert part in message


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load_configuration(tmp_path / "none.yaml")


def test_numbers_without_a_point_are_numbers(tmp_path):
    # YAML 1.1 reads 16e-2 as text.
    assert load_configuration(written(tmp_path, "atmosphere: {r0_m: 16e-2}")).atmosphere.r0_m == 0.16


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"reconstruction__components": 40}, ["reconstruction.components = 40", "at most 39", "stars.observed = 40"]),
        (
            {"stars__truth": 15, "reconstruction__basis": "pca"},
            ["reconstruction.components = 20", "at most 14", "stars.truth = 15"],
        ),
        (
            {"reconstruction__interpolation": "polynomial", "reconstruction__order": 8},
            ["reconstruction.order = 8", "45 terms", "stars.observed = 40"],
        ),
        ({"psf__stamp": 30}, ["psf.stamp = 30", "odd"]),
        ({"wavelengths_nm": (2000.0,)}, ["wavelengths_nm[0] = 2000", "300 to 1200"]),
        ({"wavelengths_nm": ()}, ["wavelengths_nm = []"]),
        ({"ccds": ("R22_S1",)}, ["unknown CCD", "'R22_S1'", "R22_S1"]),
        ({"ccds": ("R2",)}, ["unknown raft", "'R2'"]),
        ({"ccds": ()}, ["ccds = []"]),
        ({"telescope": "lsst_v3.3_q"}, ["unknown telescope", "did you mean"]),
        ({"telescope": "paul_baker"}, ["telescope = paul_baker", "a camera"]),
        ({"atmosphere__site": "cerro_pachn"}, ["unknown site", "did you mean cerro_pachon or cerro_tololo?"]),
        (
            {"psf__engine": "statistical", "atmosphere__exposure_s": 4.0},
            ["atmosphere.exposure_s = 4", "at least 5 s", "'statistical'"],
        ),
        ({"psf__engine": "statistical", "atmosphere__enabled": False}, ["psf.engine = statistical", "enabled = true"]),
        ({"atmosphere__time_step_s": 20.0}, ["atmosphere.time_step_s = 20", "atmosphere.exposure_s = 15"]),
    ],
)
def test_what_does_not_fit_together_is_said_in_one_line(options, parts):
    with pytest.raises(PachonError) as caught:
        Experiment.from_config(with_options(Configuration(), **options))
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_screens_that_are_too_coarse_name_key_and_remedy():
    """Before the cut-off that they cannot hold, which no key sets."""
    with pytest.raises(ConfigError, match=r"^atmosphere\.screen_size = 64: expected at least 623, "):
        Experiment.from_config(with_options(Configuration(), atmosphere__screen_size=64))


@pytest.mark.parametrize(
    ("telescope", "band", "ends"),
    [
        # The telescope's own band, to the edges of its prescription.
        ("decam", "r", (570, 715)),
        # DECam's filters by their curves: 400 to 548 nm, 848 to 1002 nm; HSC's y: 934 to 1070 nm.
        ("decam", "g", (401, 549)),
        ("decam", "z", (866, 976)),
        ("hsc", "y", (928, 1019)),
        # Filters of the LSST where a camera has none of its own.
        ("auxtel", "g", (403, 551)),
    ],
)
def test_light_and_zero_point_are_those_of_the_band(telescope, band, ends):
    config = Experiment.from_config(Configuration(telescope=telescope, band=band)).config
    # The middles of five equal parts of the band.
    first, second, *_, last = config.wavelengths_nm
    half = 0.5 * (second - first)
    assert [first - half, last + half] == pytest.approx(ends, abs=1.0)
    if telescope == "auxtel":
        # One square metre, a throughput of a half, and flat light between the ends.
        assert config.photometry.zero_point == pytest.approx(
            2.5 * np.log10(5.48e10 * 0.5 * 1.00 * np.log(ends[1] / ends[0])), abs=0.02
        )


def test_the_default_goes_from_the_centre_to_the_edge_of_the_field():
    experiment = Experiment.from_config(Configuration())
    config = experiment.config
    assert config.telescope == "lsst_v3.3_r"
    assert config.band == "r"
    assert config.ccds == tuple(f"R2{raft}_S1{column}" for raft in "234" for column in "012")
    assert len(config.ccds) == 9
    # Five equally spaced wavelengths over 545 to 703 nm, as in the paper.
    assert config.wavelengths_nm == (545.0, 584.5, 624.0, 663.5, 703.0)
    assert (config.stars.truth, config.stars.observed) == (100, 40)
    radius = experiment.field_radius_on_detector
    x, y = experiment.camera.centers[[experiment.camera.ccd_index(n) for n in config.ccds]].T
    nearest, farthest = abs(x[0] + 1j * y[0]), (x**2 + y**2).max() ** 0.5
    assert nearest <= experiment.camera.shortest_side * 1.1
    assert farthest + (0.5 * experiment.camera.shortest_side) > radius > farthest


def test_band_and_telescope_follow_each_other():
    assert Experiment.from_config(with_options(Configuration(), band="i")).config.telescope == "lsst_v3.3_i"
    assert Experiment.from_config(with_options(Configuration(), telescope="lsst_v3.3_z")).config.band == "z"
    # Its filter is of another thickness, so that light of g would be out of focus.
    with pytest.raises(ConfigError, match=r"band = g: telescope lsst_v3\.3_r has filter r; expected lsst_v3\.3_g"):
        Experiment.from_config(with_options(Configuration(), telescope="lsst_v3.3_r", band="g"))


def test_stamps_are_as_wide_as_the_seeing_needs():
    # Light beyond the rim wraps around: 31 pixels made the rms width of a PSF of 2.5 arcsec 1 % too large.
    for air, stamp in (({}, 31), ({"r0_m": 0.035}, 63), ({"r0_m": 0.05, "zenith_angle_deg": 60.0}, 67)):
        options = {"psf__engine": "long_exposure"} | {f"atmosphere__{key}": value for key, value in air.items()}
        assert Experiment.from_config(with_options(Configuration(), **options)).config.psf.stamp == stamp
    given = with_options(Configuration(), atmosphere__r0_m=0.035, psf__stamp=41)
    assert Experiment.from_config(given).config.psf.stamp == 41


def test_without_an_atmosphere_pixels_and_weight_are_finer():
    experiment = Experiment.from_config(with_options(Configuration(), atmosphere__enabled=False))
    config = experiment.config
    assert config.reconstruction.weight_fwhm_arcsec == 0.3
    assert (config.psf.pixel_um, config.psf.stamp, config.psf.diffusion_pixels) == (2.5, 61, 0.0)
    assert experiment.atmosphere is None


def test_charge_diffusion_is_a_fraction_of_the_pixel_of_the_camera():
    experiment = Experiment.from_config(with_options(Configuration(), psf__diffusion_pixels=0.3, **SMALL))
    assert experiment.diffusion == pytest.approx(0.3 * 10e-6)
    fine = replace(experiment.camera, pixel_size=9e-6)
    other = replace(experiment, focal_plane=FocalPlane.flat(fine))
    assert other.diffusion == pytest.approx(0.3 * 9e-6)


def test_ccds_are_put_in_the_order_of_the_camera_each_once():
    names = ("R24_S12", "R22", "R22_S11")
    chosen = Experiment.from_config(with_options(Configuration(), ccds=names)).config.ccds
    assert chosen == (*(f"R22_S{row}{column}" for row in "012" for column in "012"), "R24_S12")
    assert len(Experiment.from_config(with_options(Configuration(), ccds=("all",))).config.ccds) == 189


def test_a_resolved_configuration_is_read_back_as_it_was(tmp_path):
    config = Experiment.from_config(with_options(Configuration(), seed=7, focal_plane__tilt=False, **SMALL)).config
    path = written(tmp_path, to_yaml(config, ["heading"]))
    again = Experiment.from_config(load_configuration(path), tmp_path).config
    assert again == config
    assert to_yaml(again, ["heading"]) == path.read_text()


def test_the_hash_tells_settings_apart_but_not_sets_of_ccds():
    def hash_of(**options):
        return Experiment.from_config(with_options(Configuration(), **SMALL, **options)).config_hash

    base = hash_of()
    assert hash_of(ccds=("R22_S11",)) == base
    assert hash_of(seed=2) != base
    assert hash_of(focal_plane__raft=False) != base
    assert hash_of(atmosphere__r0_m=0.15) != base


def test_a_prescription_counts_by_its_content_wherever_it_lies(tmp_path):
    hashes = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        save_telescope(load_telescope("lsst_v3.3_r"), tmp_path / folder / "mine.yaml")
        path = tmp_path / folder / "run.yaml"
        path.write_text("telescope: mine.yaml\n")
        experiment = Experiment.from_config(load_configuration(path), path.parent)
        assert experiment.config.telescope == str((tmp_path / folder / "mine.yaml").resolve())
        hashes.append(experiment.config_hash)
    assert hashes[0] == hashes[1]


def test_a_site_lies_beside_the_configuration_and_counts_by_its_content(tmp_path):
    text = (SITES / "cerro_pachon.yaml").read_text()
    hashes = []
    for folder, r0 in (("a", "0.16 "), ("b", "0.16 "), ("c", "0.12 ")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "my_site.yaml").write_text(text.replace("r0: 0.16 ", f"r0: {r0}"))
        path = tmp_path / folder / "run.yaml"
        path.write_text("atmosphere: {site: my_site.yaml, outer_scale_m: 20}\n")
        experiment = Experiment.from_config(load_configuration(path), path.parent)
        config = experiment.config
        assert config.atmosphere.site == str((tmp_path / folder / "my_site.yaml").resolve())
        # The site gives what the configuration leaves open.
        assert (config.atmosphere.r0_m, config.atmosphere.outer_scale_m) == (float(r0), 20.0)
        assert experiment.atmosphere.r0 == float(r0)
        hashes.append(experiment.config_hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_visits_differ_in_air_and_aberration_and_not_in_the_telescope():
    options = {"active_optics__residual_um": 0.2, "psf__jitter_arcsec": 0.05, **SMALL}
    first, second = (
        Experiment.from_config(with_options(Configuration(), atmosphere__epoch=epoch, **options)) for epoch in (0, 1)
    )
    assert not np.allclose(first.atmosphere.velocities, second.atmosphere.velocities)
    assert np.all(first.aberration.coefficients != second.aberration.coefficients)
    np.testing.assert_array_equal(first.focal_plane.to_table(2)["z"], second.focal_plane.to_table(2)["z"])
    assert first.config_hash != second.config_hash
    expected = ResidualWavefront.draw(first.telescope, 0.2e-6, seed=1, epoch=1)
    np.testing.assert_array_equal(second.aberration.coefficients, expected.coefficients)
    assert first.jitter == pytest.approx(0.05 * np.pi / 648000)
    # Off by default.
    plain = Experiment.from_config(with_options(Configuration(), **SMALL))
    assert plain.aberration is None
    assert plain.jitter == 0.0
    # The largest value that the file may have is the largest that can be drawn.
    largest = Experiment.from_config(with_options(Configuration(), **(options | {"active_optics__residual_um": 2.0})))
    assert largest.aberration is not None
    assert LARGEST_RMS == 2e-6


def test_silicon_is_off_by_default_and_then_no_part_of_the_hash():
    plain = Experiment.from_config(with_options(Configuration(), **SMALL))
    assert plain.silicon is None
    thin = Experiment.from_config(with_options(Configuration(), detector__thickness_um=20.0, **SMALL))
    assert thin.silicon is None
    # Runs of before silicon go on.
    content = plain.config.as_dict()
    del content["ccds"], content["detector"], content["camera"], content["pointing"], content["photometry"]
    content["stars"] = hashed_stars(content["stars"])
    assert list(content["stars"]) == ["truth", "observed", "snr_min", "neighbours", "cosmic_rays", "saturated"]
    content["focal_plane"] = hashed_heights(content["focal_plane"])
    del content["active_optics"]["states"], content["reconstruction"]["turbulence"]
    assert thin.config_hash == plain.config_hash == digest(content)
    options = {"detector__silicon": True, "detector__thickness_um": 80.0, "detector__temperature_k": 180.0, **SMALL}
    silicon = Experiment.from_config(with_options(Configuration(), **options))
    assert silicon.silicon == Silicon(80.0 * 1e-6, 180.0)
    assert silicon.config_hash != plain.config_hash


def test_wavelengths_to_which_silicon_is_transparent_are_refused(tmp_path):
    path = tmp_path / "clear.yaml"
    telescope = replace(load_telescope("lsst_v3.3_y"), wavelength_range=(0.9e-6, 1.2e-6))
    save_telescope(telescope, path)
    options = {"telescope": str(path), "wavelengths_nm": (970.0, 1120.0), **SMALL}
    assert Experiment.from_config(with_options(Configuration(), **options)).silicon is None
    with pytest.raises(
        ConfigError, match=r"^wavelengths_nm\[1\] = 1120: expected 300 to 1100 with detector.silicon = t"
    ):
        Experiment.from_config(with_options(Configuration(), detector__silicon=True, **options))


def test_differences_name_key_old_and_new():
    old = Experiment.from_config(Configuration()).config.as_dict()
    new = Experiment.from_config(with_options(Configuration(), seed=2, stars__truth=50)).config.as_dict()
    assert differences(old, new) == ["seed: 1 -> 2", "stars.truth: 100 -> 50"]
    assert differences(old, old) == []


def test_the_digest_does_not_depend_on_the_order_of_keys():
    assert digest({"a": 1, "b": 2.5}) == digest({"b": 2.5, "a": 1})
    # sha256sum of the canonical text, by coreutils: printf '{"a":1}' | sha256sum
    assert digest({"a": 1}) == "015abd7f5cc57a2dd94b7590f04ad8084273905ee33ec5cebeae62276a97f862"


@pytest.mark.parametrize("format", ["pachon", "batoid"])
def test_a_prescription_in_place_of_a_configuration_is_told_where_it_goes(tmp_path, format):
    path = tmp_path / "mine.yaml"
    pachon.save_telescope(pachon.load_telescope("hsc"), path, format=format)
    with pytest.raises(ConfigError, match=r"mine.yaml: a prescription; expected .* the line telescope: mine.yaml"):
        load_configuration(path)
