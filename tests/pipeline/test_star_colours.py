"""Runs whose stars have spectra: models for the colour of each star, and for other spectra, in products and summary."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.core.products import Stamp
from pachon.core.statistics import FWHM_PER_RMS
from pachon.measure.adaptive_moments import adaptive_moments
from pachon.pipeline.config import Configuration
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_ccd, expose_positions
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.pipeline.summary import ccd_metrics
from pachon.reconstruction.ccd_product import product_path, read_product, write_product

CCD = "R22_S11"


def experiment_of(folder, kelvin):
    """Sixty bright stars on a CCD under all turbulence."""
    camera = pachon.lsst_camera()
    rng = np.random.default_rng(5)
    x, y = camera.centers[camera.ccd_index(CCD)][:, None] + rng.uniform(-0.018, 0.018, (2, 60))
    Table({"x_m": x, "y_m": y, "mag": rng.uniform(17.0, 18.5, 60)} | kelvin).write(folder / "s.ecsv")
    given = {
        "ccds": [CCD],
        "stars": {"catalogue": "s.ecsv", "truth": 30, "brightest": 10, "faintest": 25},
        "psf": {"engine": "long_exposure"},
        "detector": {"silicon": True},
    }
    return Experiment.from_config(Configuration.model_validate(given), folder)


@pytest.fixture(scope="module")
def coloured(tmp_path_factory):
    kelvin = np.exp(np.random.default_rng(6).uniform(np.log(3500.0), np.log(10000.0), 60))
    kelvin[:3] = np.nan
    experiment = experiment_of(tmp_path_factory.mktemp("stars"), {"teff": kelvin})
    return experiment, model_ccd(experiment, expose_ccd(experiment, CCD, threads=1))


@pytest.mark.long
def test_the_model_is_that_of_the_colour_of_each_star(coloured):
    experiment, product = coloured
    model, colours = product.model, product.observed.colour
    assert model.colour.probability > 0.99
    assert np.isnan(colours).sum() == 3
    metrics = ccd_metrics(product)
    assert metrics["psf_colour_probability"] == model.colour.probability
    assert metrics["stars_without_colour"] == 3
    # Mean wavelengths of blackbodies of 3500 and 10 000 K at five wavelengths of r, both edges among them.
    assert 616e-9 < np.nanmin(colours) < np.nanmax(colours) < 638e-9
    stars = np.stack([product.observed.x, product.observed.y], axis=1)
    # The iteration begins where that of the product does.
    start = experiment.weight_fwhm / FWHM_PER_RMS
    drawn = adaptive_moments(model.at(stars, colour=colours), product.pixel_scale, start_sigma=start)
    np.testing.assert_array_equal(product.observed.model_g1, drawn.g1)


@pytest.mark.long
def test_psfs_of_other_spectra_are_those_made_of_their_wavelengths(coloured):
    """Cool, hot and flat spectra at holdout positions, made wavelength by wavelength by the engine."""
    experiment, product = coloured
    places = np.stack([product.holdout.x, product.holdout.y], axis=1)
    waves = experiment.wavelengths
    for kelvin in (3300.0, 9000.0, np.nan):
        photons = pachon.blackbody_photons([kelvin], waves)
        colour = pachon.effective_colour(waves, photons)[0]
        exposed = expose_positions(experiment, places, 1, offsets=np.zeros((30, 2)), temperatures=np.full(30, kelvin))
        true = adaptive_moments(exposed.image, exposed.pixel_scale)
        made, plain = (
            adaptive_moments(product.model.at(places, colour=c), exposed.pixel_scale) for c in (colour, None)
        )
        with_colour, without = ((m.sigma / true.sigma - 1.0).mean() for m in (made, plain))
        # A star of S/N 500 has a size good to 2e-3; mean and slope of a line through 57 of them, three errors.
        deviation = (colour - np.nanmean(product.observed.colour)) / np.nanstd(product.observed.colour)
        assert abs(with_colour) < 3.0 * 2e-3 * np.sqrt((1.0 + deviation**2) / 57.0)
        # Seeing falls with the wavelength to the power of 0.3 (von Karman), by 2 % of it and more.
        if kelvin == 3300.0:
            assert without > 3e-3
        if kelvin == 9000.0:
            assert without < -1e-3


@pytest.mark.long
def test_products_keep_the_colours(coloured, tmp_path):
    _, product = coloured
    write_product(tmp_path, product, Stamp("0" * 64, 1), [])
    again = read_product(product_path(tmp_path, CCD))
    np.testing.assert_allclose(again.observed.colour, product.observed.colour, rtol=1e-15)
    assert again.model.colour.probability == product.model.colour.probability
    asked = np.full(1, 640e-9)
    place = again.model.positions[:1]
    assert again.model.at(place, colour=asked).tobytes() == product.model.at(place, colour=asked).tobytes()


@pytest.mark.long
def test_stars_of_one_spectrum_and_without_any_have_the_model_that_they_had(tmp_path):
    folders = [tmp_path / name for name in ("same", "none")]
    products = []
    for folder, kelvin in zip(folders, ({"teff": np.full(60, np.nan)}, {}), strict=True):
        folder.mkdir()
        experiment = experiment_of(folder, kelvin)
        products.append(model_ccd(experiment, expose_ccd(experiment, CCD, threads=1)))
    same, none = products
    assert (same.model.colour, none.model.colour, none.observed.colour) == (None, None, None)
    assert np.isnan(same.observed.colour).all()
    np.testing.assert_array_equal(same.observed.model_g1, none.observed.model_g1)
    assert "psf_colour_probability" not in ccd_metrics(none)
    written = []
    without_column = replace(same, observed=replace(same.observed, colour=None))
    for folder, product in zip(folders, (without_column, none), strict=True):
        write_product(folder, product, Stamp("0" * 64, 1), [])
        written.append(product_path(folder, CCD).read_bytes())
    assert written[0] == written[1]
