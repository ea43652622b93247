"""Shapes on the sky that `pachon measure` writes, of rolled images, mirrored and not, against the truth."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC
from pachon.imaging.draw import Window
from pachon.imaging.exposure import Exposure
from pachon.imaging.measure import measure_image
from pachon.imaging.scene import draw_ccd
from pachon.measure.catalogue.matching import match_positions
from pachon.pipeline.experiment import Experiment
from pachon.sky.galaxies import Galaxies

WINDOW = Window(1200, 1100, 1000, 900)


def gaussian_galaxies(xi, eta):
    """Galaxies that an elliptical Gaussian fits, on a grid 16 arcsec apart, elongated in all directions."""
    places = [np.arange(low, high, 16.0 * ARCSEC) for low, high in (xi, eta)]
    x, y = (v.ravel() for v in np.meshgrid(*places))
    rng = np.random.default_rng(5)
    e1, e2 = rng.uniform(-0.3, 0.3, (2, x.size))
    radius = rng.uniform(0.5, 1.2, x.size) * ARCSEC
    return Galaxies.single(x, y, rng.uniform(20.5, 22.0, x.size), radius, e1=e1, e2=e2, sersic=0.5)


@pytest.mark.parametrize(
    "transposed",
    [
        pytest.param(True, id="as seen", marks=pytest.mark.long),
        pytest.param(False, id="mirrored", marks=pytest.mark.slow),
    ],
)
def test_shapes_of_galaxies_on_a_rolled_image_are_the_true_ones(tiny, transposed):
    run = tiny(ccds=("R22_S11",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=63, stars__truth=24)
    run = run.model_copy(update={"stars": run.stars.model_copy(update={"observed": 2000})})
    experiment = Experiment.from_config(run)
    camera = replace(experiment.camera, transposed=transposed)
    experiment = replace(experiment, focal_plane=pachon.FocalPlane.flat(camera))
    scene = draw_ccd(
        experiment,
        "R22_S11",
        gaussian_galaxies,
        window=WINDOW,
        exposure=Exposure("r", 15.0, 100),
        pointing=pachon.Pointing(1.0, -0.5, np.deg2rad(30.0)),
    )
    image = scene.exposed()
    assert (np.linalg.det(image.wcs.wcs.cd) < 0.0) == transposed
    table, truth = measure_image(image, threads=1).table(), image.objects
    x, y = truth["X"] - WINDOW.x, truth["Y"] - WINDOW.y
    match = match_positions(np.array(table["x"]), np.array(table["y"]), x, y, 3.0)
    good = (match >= 0) & ~truth["STAR"][match] & np.array(table["usable"])
    match = match[good]
    assert good.sum() > 80
    assert np.abs(table["ra"][good] - truth["RA"][match]).max() * 3600.0 < 1.0
    # The truth is along xi and eta, towards east and north: g2 of the convention of the sky is minus that.
    for name, true in (("g1_sky", truth["E1"][match]), ("g2_sky", -truth["E2"][match])):
        slope, offset = np.polyfit(true, table[name][good], 1)
        # Blends and noise of a fit of Gaussians: 0.03; along the pixels the slopes were 0.5 and below.
        assert slope == pytest.approx(1.0, abs=0.06), name
        assert abs(offset) < 0.02
    e1 = np.array(table["e1"])[good]
    assert np.polyfit(truth["E1"][match], e1, 1)[0] == pytest.approx(-0.5 if transposed else 0.5, abs=0.1)
