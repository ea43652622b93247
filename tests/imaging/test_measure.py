"""From a simulated image to a catalogue: stars, the PSF from them and galaxies against the truth of the image."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.errors import PachonError
from pachon.core.units import ARCSEC
from pachon.imaging.draw import Window
from pachon.imaging.exposure import Exposure
from pachon.imaging.image_file import CcdImage
from pachon.imaging.measure import measure_image
from pachon.imaging.scene import draw_ccd
from pachon.pipeline.catalogue.matching import match_positions
from pachon.pipeline.experiment import Experiment
from pachon.sky.galaxies import Galaxies

pytestmark = pytest.mark.long


def gaussian_galaxies(xi, eta):
    """Galaxies that an elliptical Gaussian fits, on a grid 22 arcsec apart."""
    places = [np.arange(low, high, 22.0 * ARCSEC) for low, high in (xi, eta)]
    x, y = (v.ravel() for v in np.meshgrid(*places))
    rng = np.random.default_rng(5)
    e, magnitude = rng.uniform(-0.3, 0.3, x.size), rng.uniform(20.5, 22.0, x.size)
    radius = rng.uniform(0.5, 1.2, x.size)
    # Half-light radii of many values: stars alone have one.
    return Galaxies.single(x, y, magnitude, radius * ARCSEC, e1=e, e2=0.1, sersic=0.5)


@pytest.fixture(scope="module")
def image(tiny):
    run = tiny(ccds=("R22_S11",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=63, stars__truth=24)
    run = run.model_copy(update={"stars": run.stars.model_copy(update={"observed": 1500})})
    window, deep = Window(1200, 1100, 1400, 1300), Exposure("r", 15.0, 100)
    return draw_ccd(Experiment.from_config(run), "R22_S11", gaussian_galaxies, window=window, exposure=deep).exposed()


def on_image(truth):
    """Pixels of the image of the objects of its table, which counts those of the CCD."""
    return truth["X"] - 1200, truth["Y"] - 1100


@pytest.fixture(scope="module")
def catalogue(image):
    return measure_image(image, threads=1)


def test_stars_and_objects_against_the_truth(catalogue):
    metrics = catalogue.metrics()
    assert metrics["stars"] >= 15
    assert metrics["star_purity"] > 0.95
    assert metrics["purity"] > 0.95
    # The Gaussian of the long exposure is near 2 pixels of half-light radius.
    assert 1.5 < metrics["star_half_light_radius_pixel"] < 3.0


def test_gaussian_galaxies_have_their_own_ellipticity(catalogue, image):
    truth = image.objects
    rows = catalogue.galaxies
    match = match_positions(catalogue.objects.x[rows], catalogue.objects.y[rows], *on_image(truth), 1.0)
    good = (match >= 0) & catalogue.usable
    good[good] &= ~truth["STAR"][match[good]].astype(bool)
    assert good.sum() > 80
    deviation = catalogue.fits.e1[good] - truth["E1"][match[good]]
    error = catalogue.fits.e1_error[good]
    # Stars and galaxies overlap here and there: the median is robust.
    assert abs(np.median(deviation)) < 5e-3
    assert 1.4826 * np.median(np.abs(deviation / error)) == pytest.approx(1.0, abs=0.3)


def test_the_table_has_sky_positions(catalogue, image):
    table = catalogue.table()
    truth = image.objects
    match = match_positions(table["x"], table["y"], *on_image(truth), 1.0)
    own = match >= 0
    apart = 3600.0 * np.hypot(
        (table["ra"][own] - truth["RA"][match[own]] + 180.0) % 360.0 - 180.0,
        table["dec"][own] - truth["DEC"][match[own]],
    )
    assert np.median(apart) < 0.02
    assert table["ra"].unit == "deg"


def test_the_command_writes_catalogue_and_psf(image, catalogue, tmp_path, capsys):
    image.write(tmp_path / "image.fits")
    assert main(["measure", str(tmp_path / "image.fits"), "--json", "--quiet", "-o", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)["images"]["image.fits"]
    assert found["stars"] == len(catalogue.stars)
    table = Table.read(tmp_path / "out" / "image_galaxies.fits")
    np.testing.assert_array_equal(table["e1"], catalogue.fits.e1)
    assert fits.getheader(tmp_path / "out" / "image_psf.fits")["SIMPLE"]


def test_what_cannot_be_measured(image, tmp_path, capsys):
    empty = CcdImage(image.name, 0.0 * image.image, image.variance, image.mask, image.header, image.objects)
    with pytest.raises(PachonError, match="CCD R22_S11: "):
        measure_image(empty)
    (tmp_path / "text.fits").write_text("no image")
    assert main(["measure", str(tmp_path / "text.fits")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
