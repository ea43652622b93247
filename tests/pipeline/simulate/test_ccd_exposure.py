"""Exposures of several CCDs by one call of the engine."""

import dataclasses
import math

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate import ccd_loop
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_ccd, expose_ccds
from pachon.pipeline.simulate.ccd_model import model_ccds
from pachon.pipeline.simulate.photometry import PROVISIONAL_FWHM
from pachon.wavefront.chief_rays import fields_at, fields_of_groups

NAMES = ("R22_S11", "R41_S21")


@pytest.fixture(scope="module")
def experiment(tiny):
    return Experiment.from_config(tiny(ccds=NAMES))


@pytest.fixture(scope="module")
def stars(experiment):
    return {name: ccd_stars(experiment, name, PROVISIONAL_FWHM) for name in NAMES}


@pytest.mark.long
def test_ccds_exposed_together_have_the_bytes_of_each_alone(experiment, stars):
    together = expose_ccds(experiment, stars, centered=True, threads=2)
    assert [exposure.name for exposure in together] == list(NAMES)
    for exposure in together:
        alone = expose_ccd(experiment, exposure.name, centered=True, threads=1)
        for kind in ("holdout", "observed", "centered"):
            for name, values in vars(getattr(alone, kind)).items():
                assert np.array_equal(getattr(getattr(exposure, kind), name), values), (kind, name)


@pytest.mark.parametrize("engine", ["long_exposure", pytest.param("statistical", marks=pytest.mark.long)])
def test_stars_that_an_engine_draws_in_an_order_of_its_own_are_drawn_twice(tiny, engine):
    """Of stars drawn at their places and on the centre of a pixel each image is that of its star."""
    experiment = Experiment.from_config(tiny(ccds=NAMES, psf__engine=engine, atmosphere__exposure_s=5.0))
    stars = {name: ccd_stars(experiment, name, PROVISIONAL_FWHM) for name in NAMES}
    twice, once = (expose_ccds(experiment, stars, centered=centered, threads=1) for centered in (True, False))
    for both, alone in zip(twice, once, strict=True):
        np.testing.assert_array_equal(both.observed.image, alone.observed.image)
        np.testing.assert_array_equal(both.observed.fields, alone.observed.fields)


@pytest.mark.parametrize("names", [NAMES, NAMES[:1]])
def test_a_ccd_on_which_a_catalogue_has_no_star_cannot_be_modelled(tiny, tmp_path, names):
    """As one of a night, each of whose visits has other stars on its CCDs."""
    camera = pachon.lsst_camera()
    x, y = (camera.centers[camera.ccd_index(NAMES[1])] + np.random.default_rng(1).uniform(-0.015, 0.015, (12, 2))).T
    rows = [f"{a},{b},20.0" for a, b in zip(x, y, strict=True)]
    (tmp_path / "stars.csv").write_text("\n".join(["x_m,y_m,mag", *rows]) + "\n")
    catalogue = str(tmp_path / "stars.csv")
    experiment = Experiment.from_config(tiny(ccds=NAMES, psf__engine="long_exposure", stars__catalogue=catalogue))
    stars = {name: ccd_stars(experiment, name, PROVISIONAL_FWHM) for name in names}
    simulated = ccd_loop.simulate_ccds(
        experiment, lambda exposures: model_ccds(experiment, exposures), names, fields=stars, strict=False
    )
    assert simulated.not_modelled[NAMES[0]].startswith("0 of 0 stars left: expected at least ")
    assert tuple(simulated.results) == names[1:]


def test_fields_of_groups_have_the_bytes_of_each_alone(experiment, stars):
    groups = [stars[name].observed for name in NAMES] + [np.empty((0, 2)), stars[NAMES[0]].holdout[:1]]
    wavelength = 620e-9
    together = fields_of_groups(
        experiment.telescope, np.concatenate(groups), [len(group) for group in groups], wavelength
    )
    alone = [fields_at(experiment.telescope, group, wavelength) for group in groups if len(group)]
    assert np.array_equal(together, np.concatenate(alone))


@pytest.mark.parametrize("angle", [0.7, math.pi / 2])
def test_fields_of_a_turned_camera_are_those_of_turned_positions(experiment, stars, angle):
    # At a right angle x of the detector depends on y of the sky alone.
    c, s = math.cos(angle), math.sin(angle)
    xy = stars[NAMES[1]].observed
    turned = fields_at(experiment.telescope.with_rotator(angle), xy @ np.array([[c, -s], [s, c]]), 620e-9)
    # The search ends within 1e-12 m of a target, 1e-13 of the focal length.
    np.testing.assert_allclose(turned, fields_at(experiment.telescope, xy, 620e-9), rtol=0.0, atol=1e-13)


@pytest.mark.long
def test_an_error_names_its_ccd_after_the_ccds_before_it(experiment, stars):
    # Far outside the field no light arrives.
    dark = dataclasses.replace(stars[NAMES[1]], observed=np.full((3, 2), 0.8), magnitude=np.full(3, 18.0))
    modelled = []
    with pytest.raises(DomainError, match=f"CCD {NAMES[1]}"):
        ccd_loop.simulate_ccds(
            experiment,
            lambda exposures: [modelled.append(exposure.name) for exposure in exposures],
            NAMES,
            fields={NAMES[0]: stars[NAMES[0]], NAMES[1]: dark},
            threads=1,
        )
    assert modelled == [NAMES[0]]


def test_a_signal_to_noise_ratio_of_saturated_stars_is_refused_by_its_key(tiny):
    bright = Experiment.from_config(tiny(ccds=NAMES[:1], stars__snr_min=1e6))
    with pytest.raises(ConfigError, match=r"^stars\.snr_min = 1e\+06: expected less: stars of magnitude .* saturate$"):
        ccd_stars(bright, NAMES[0], PROVISIONAL_FWHM)
