"""Light of stacked images: photometry of stars at the edge of the field, and the mean of traced vignetting."""

import numpy as np
import pytest

import pachon
from pachon.pipeline.run_folder import CONFIG_NAME
from pachon.studies.visits.config import VisitsConfig, VisitsSection
from pachon.studies.visits.image_stack.config import ImageStackConfig
from pachon.studies.visits.image_stack.image_stack import ImageStack
from pachon.studies.visits.image_stack.stack_images import stack_images
from pachon.studies.visits.image_stack.tile_light import TileLight
from pachon.studies.visits.psf_visit import StackFrame


def edge_visits(tiny, **visits):
    """Visits of a CCD at the edge of the field."""
    run = tiny(ccds=("R01_S02",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=49)
    return VisitsConfig(run=run, visits=VisitsSection(stars=300, places=30, snapshots=(1,), **visits))


@pytest.mark.long
def test_stars_at_the_edge_have_their_magnitudes(tiny, tmp_path):
    visits = edge_visits(tiny, count=2, roll_deg=(0.0, 0.0))
    (tmp_path / CONFIG_NAME).write_text(visits.resolved(visits.experiment()).to_yaml())
    stack = stack_images(tmp_path, ImageStackConfig(faintest=20.5, side=1536, noise=False))
    image = stack.image(2, stack.tiles[0])
    stars = {key: values[image.objects["STAR"]] for key, values in image.objects.items()}
    at = np.stack([stars["X"], stars["Y"]], axis=1)
    apart = np.hypot(*(at[:, None] - at).transpose(2, 0, 1)) + 1e9 * np.eye(len(at))
    alone = np.flatnonzero((apart.min(axis=1) > 40.0) & (np.abs(at - 767.5) < 740.0).all(axis=1))
    windows = {star: tuple(slice(v - 22, v + 23) for v in np.rint(at[star, ::-1]).astype(int)) for star in alone}
    windows = {star: window for star, window in windows.items() if not image.mask[window].any()}
    alone, flux = np.array(list(windows)), np.array([image.image[window].sum() for window in windows.values()])
    assert len(alone) >= 4
    # An aperture of 9 arcsec has 99.6 % of the light.
    np.testing.assert_allclose(image.header["ZEROPNT"] - 2.5 * np.log10(flux), stars["MAG"][alone], atol=0.015)
    np.testing.assert_allclose(flux, stars["FLUX"][alone], rtol=0.01)
    assert stack.exposure(2).zero_point - image.header["ZEROPNT"] == pytest.approx(0.067, abs=0.005)


@pytest.mark.long
def test_light_is_the_mean_vignetting_of_the_visits_that_cover_a_place(tiny, tmp_path):
    visits = edge_visits(tiny, count=3, roll_deg=(0.0, 2.0, 180.0), dither_deg=0.05)
    experiment = visits.experiment()
    (tmp_path / CONFIG_NAME).write_text(visits.resolved(experiment).to_yaml())
    stack = ImageStack.of(tmp_path, ImageStackConfig(faintest=20.5, side=1024))
    frame, tile = StackFrame.of(experiment, 49), stack.tiles[0]
    light = TileLight.of(experiment, frame, tile, stack.plan)
    x, y = 0.25 * 1023.0, 0.75 * 1023.0
    sky = (np.array([[x, y]]) + tile.first) @ np.linalg.inv(frame.matrix).T
    # On the other side of the field the CCD is elsewhere.
    directions = np.concatenate([visit.directions(sky) for visit in stack.plan[:2]])
    fields = np.arctan(directions[:, :2] / np.abs(directions[:, 2:]))
    traced = pachon.vignetting(experiment.telescope, fields, 620e-9)
    assert light.at(np.array([[x, y]]))[0] == pytest.approx(traced.relative.mean(), abs=2e-3)
    assert traced.relative.max() < 0.94
