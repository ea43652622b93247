"""The part of the air that donuts share: against the covariance of the mean wavefront of an exposure."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models.io.site_file import load_site
from pachon.sensing.shared_air import shared_air
from pachon.wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance


@pytest.mark.parametrize(("telescope", "site"), [("lsst_v3.3_r", "cerro_pachon"), ("hsc", "maunakea")])
def test_share_is_that_of_stars_half_a_field_apart(telescope, site):
    telescope = pachon.load_telescope(telescope)
    air = pachon.Atmosphere.from_site(site, 1, exposure=30.0)
    places = np.array([[0.0, 0.0], [0.6, 0.8]]) * telescope.field_radius
    covariance = mean_wavefront_covariance(
        air, places, range(4, 9), telescope.pupil_diameter, telescope.pupil_obscuration
    )
    variance, shared = np.trace(covariance[0, :, 0]), np.trace(covariance[0, :, 1])
    assert shared_air(telescope, load_site(site)) == pytest.approx(shared / variance, abs=0.05)


def test_donuts_of_a_narrow_field_share_the_air_of_more_layers():
    site, wide = load_site("maunakea"), pachon.load_telescope("hsc")
    narrow = replace(wide, field_radius=0.1 * wide.field_radius)
    # Those at 500 m and 1 km as well, of a tenth of the air each.
    assert 0.1 < shared_air(narrow, site) - shared_air(wide, site) < 0.3


@pytest.mark.parametrize(("altitude", "expected"), [(0.0, 0.95), (9e3, 0.05)])
def test_air_in_one_layer_is_neither_all_shared_nor_not_at_all(altitude, expected):
    site = replace(
        load_site("cerro_pachon"), altitudes=(altitude,), weights=(1.0,), wind_speeds=(0.0,), wind_directions=()
    )
    assert shared_air(pachon.load_telescope("lsst_v3.3_r"), site) == expected


def test_site_of_the_fit_is_that_of_the_telescope_unless_it_is_given():
    telescope = pachon.load_telescope("hsc")
    assert pachon.DonutAir().layers(telescope) == load_site("maunakea")
    assert pachon.DonutAir(site="cerro_pachon").layers(telescope) == load_site("cerro_pachon")
    with pytest.raises(pachon.errors.UnknownNameError, match="nowhere"):
        pachon.DonutAir(site="nowhere")


@pytest.mark.long
def test_a_part_that_is_known_is_taken():
    fields = np.deg2rad([[0.2, 0.1], [-0.4, 0.3]])
    telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 0.8e-3))
    seen = pachon.DonutModel(air=pachon.DonutAir(fwhm=np.deg2rad(0.7 / 3600)))
    drawn = pachon.draw_donuts(telescope, fields, 622e-9, electrons=1e6, sky=100.0, model=seen)
    options = {"sky_variance": drawn.sky_variance, "fit": pachon.sensing.ExposureDonuts(), "threads": 1}
    model = pachon.DonutModel(air=pachon.DonutAir(shared=0.3), diffraction=False)
    fit = pachon.fit_donuts(telescope, drawn.images, fields, 622e-9, model=model, **options)
    assert fit.exposure.shared_air == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize("shared", [0.0, 1.0, np.nan])
def test_a_part_of_nothing_or_all_is_refused(shared):
    with pytest.raises(pachon.errors.DomainError, match="shared"):
        pachon.DonutAir(shared=shared)
