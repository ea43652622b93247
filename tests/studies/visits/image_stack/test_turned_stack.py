"""Stacks of images of CCDs of different sizes that are turned: stars where the sky is, with all their light."""

import numpy as np
import pytest

from pachon.imaging.draw import Window
from pachon.imaging.exposure import ExposedImage
from pachon.measure.shapes import measure_shapes
from pachon.pipeline.run_folder import CONFIG_NAME
from pachon.studies.visits.config import VisitsConfig, VisitsSection
from pachon.studies.visits.image_stack.config import ImageStackConfig
from pachon.studies.visits.image_stack.resample import add_resampled
from pachon.studies.visits.image_stack.stack_images import stack_images
from pachon.studies.visits.image_stack.tiles import TileSums

#: Two CCDs beside each other, turned by 30 and 210 degrees.
CAMERA = """
name: pair
source: made up
pixel_um: 10
ccds:
  - {name: A, x_mm: 2.3, y_mm: -3.9837, rotation_deg: 30, pixels: [1500, 900]}
  - {name: B, x_mm: -2.1, y_mm: 3.6373, rotation_deg: 210, pixels: [1400, 800]}
"""


@pytest.fixture(scope="module")
def stack(tiny, round_galaxies, tmp_path_factory):
    folder = tmp_path_factory.mktemp("turned")
    (folder / "pair.yaml").write_text(CAMERA)
    run = tiny(
        ccds=("A", "B"),
        camera=str(folder / "pair.yaml"),
        psf__engine="long_exposure",
        psf__n_pupil=200,
        psf__stamp=49,
        focal_plane__budget="flat",
    )
    section = VisitsSection(count=2, stars=25, places=40, snapshots=(1,))
    visits = VisitsConfig(run=run, visits=section, galaxies=round_galaxies)
    (folder / CONFIG_NAME).write_text(visits.resolved(visits.experiment()).to_yaml())
    return stack_images(folder, ImageStackConfig(faintest=25.0, side=900, noise=False))


@pytest.mark.long
@pytest.mark.parametrize("visits", [1, 2])
def test_stars_and_galaxies_are_where_the_header_says_with_their_light(stack, visits):
    image = stack.image(visits, stack.tiles[0])
    seen = image.mask == 0
    # The gap between the CCDs in the first visit, and the corners that they leave.
    assert 0.3 < seen.mean() < 1.0
    objects = image.objects
    at = np.stack([objects["X"], objects["Y"]], axis=1)
    assert np.allclose(image.wcs.all_world2pix(np.stack([objects["RA"], objects["DEC"]], axis=1), 0), at, atol=1e-6)
    apart = np.hypot(*(at[:, None] - at).transpose(2, 0, 1)) + 1e9 * np.eye(len(at))
    checked = {True: 0, False: 0}
    for i, (x, y) in enumerate(np.rint(at).astype(int)):
        half = 20
        if min(x, y) < half or max(x, y) >= 900 - half or apart[i].min() < 40.0:
            continue
        rows, columns = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
        if not seen[rows, columns].all():
            continue
        stamp = image.image[rows, columns].astype(float)
        shapes = measure_shapes(stamp[None], stack.exposure().pixel_scale, stack.experiment.weight_fwhm)
        miss = np.hypot(x + shapes.x[0] - at[i, 0], y + shapes.y[0] - at[i, 1])
        # Neighbours 40 pixels away tilt the background; the light beyond 4 arcsec of a star is 2 %.
        assert miss < 0.05, (i, objects["STAR"][i])
        assert 0.95 < stamp.sum() / objects["FLUX"][i] < 1.01
        checked[bool(objects["STAR"][i])] += 1
    assert checked[True] > 2
    assert checked[False] > 2


def test_the_flux_of_a_star_on_a_turned_ccd_is_conserved(stack):
    tile = stack.tiles[0]
    for name, wcs in next(stack.wcs(stack.plan[1:]))[1].items():
        height, width = wcs.shape
        x0, y0 = wcs.to_pixel([[0.0, 0.0]])[0].clip([80, 80], [width - 80, height - 80])
        y, x = np.indices(wcs.shape)
        # 3 pixels wide: sums over pixels are those over the area to 1e-7, wherever its centre is.
        star = np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / 3.0**2).astype(np.float32)
        exposed = ExposedImage(star, np.ones_like(star), np.zeros(star.shape, np.int16))
        sums = TileSums.empty(tile.side)
        add_resampled(sums, tile, stack.frame, exposed, Window(0, 0, width, height), wcs)
        assert sums.data.sum(dtype=np.float64) == pytest.approx(star.sum(dtype=np.float64), rel=1e-4), name
