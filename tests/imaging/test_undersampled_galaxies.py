"""Galaxies on pixels that do not sample the PSF or are finer than most, and wide ones: closed forms, stars."""

import numpy as np
import pytest
from scipy.special import erf

from pachon.core.errors import ConfigError, DomainError
from pachon.imaging.config import GalaxySourceConfig, ImagesConfig
from pachon.imaging.draw import Window, draw_galaxies
from pachon.imaging.exposure import Exposure
from pachon.imaging.galaxies import GalaxySource
from pachon.imaging.psf_field import PsfField
from pachon.imaging.scene import galaxies_near
from pachon.pipeline.config import Configuration, PsfConfig
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_positions
from pachon.sky.galaxies import Galaxies
from pachon.sky.mosaic import GalaxyStamps, PlantedGalaxies

SIDE = 31
#: Half-light radius of a Gaussian of unit rms width.
HALF_LIGHT = np.sqrt(2.0 * np.log(2.0))


class SquarePixels:
    """World coordinates without distortion, of pixels of an angle [rad]."""

    def __init__(self, side, angle=1.0):
        self.shape, self.angle = (side, side), angle

    def to_pixel(self, sky):
        return np.atleast_2d(sky) / self.angle

    def to_sky(self, pixels):
        return np.atleast_2d(pixels) * self.angle

    def jacobians(self, pixels):
        return np.tile(np.eye(2) / self.angle, (len(pixels), 1, 1))


def on_cells(width, center, count, cells):
    """Light of a round Gaussian of an rms width [pixel], about a place from the middle pixel, in each of its cells."""
    edges = (np.arange(count * cells + 1) - 0.5 * count * cells) / cells
    along = [np.diff(0.5 * erf((edges - c) / (np.sqrt(2.0) * width))) for c in center]
    return np.outer(along[1], along[0])


def field_of(stamp, side, cells):
    places = np.random.default_rng(1).uniform(0, side, (20, 2))
    return PsfField.fit(np.repeat(stamp[None], 20, axis=0), places, side, n_components=1, order=1, cells=cells)


@pytest.mark.parametrize("fwhm", [0.8, 1.2, 2.0])
def test_galaxies_under_a_psf_that_pixels_do_not_sample(fwhm):
    """By the transform of the PSF in pixels 0.16, 0.05 and 0.004 of the peak were too much or too little."""
    place, width = np.array([0.4, -0.3]), fwhm / 2.3548
    galaxy = Galaxies.single(20.0 + place[0], 20.0 + place[1], 20.0, 0.3 * HALF_LIGHT, sersic=0.5)
    field = field_of(on_cells(width, (0.0, 0.0), SIDE, 3), 41, 3)
    image = draw_galaxies(galaxy, np.array([1e4]), field, SquarePixels(41))
    expected = 1e4 * on_cells(np.hypot(width, 0.3), place, 41, 1)
    assert field.stamp == SIDE
    assert field.mean == pytest.approx(on_cells(width, (0.0, 0.0), SIDE, 1), abs=1e-6)
    assert np.abs(image - expected).max() < 1e-4 * expected.max()


def test_stamps_of_a_mosaic_under_a_psf_that_pixels_do_not_sample():
    """Their tables are made for the pixels of the image, and were refused on finer cells."""
    wide, place = 0.5, np.array([20.4, 19.7])
    light = on_cells(wide, (0.0, 0.0), 5, 11)
    stamps = GalaxyStamps(
        magnitude=np.array([20.0]),
        radius=np.array([wide * HALF_LIGHT]),
        images=(light,),
        center=np.zeros((1, 2)),
        scale=np.eye(2) / 11,
        psf_radius=0.01,
        surface_density=1.0,
        finest_pixel=1.0,
    )
    galaxy = PlantedGalaxies(stamps, np.array([0]), place[:1], place[1:], np.eye(2)[None])
    field = field_of(on_cells(0.5, (0.0, 0.0), SIDE, 3), 41, 3)
    image = draw_galaxies(galaxy, np.array([1e4]), field, SquarePixels(41))
    # The light of the stamp's pixels stands in their centres, their squares have widened it.
    expected = 1e4 * on_cells(np.sqrt(0.5**2 + wide**2 + 1.0 / (12 * 11**2)), place - 20.0, 41, 1)
    assert np.abs(image - expected).max() < 2e-3 * expected.max()


def test_a_run_of_coarse_pixels_draws_point_like_galaxies_as_its_stars(tmp_path, tiny):
    """Pixels of 0.6 arcsec: 0.065 of the peak was missing or too much."""
    (tmp_path / "own.yaml").write_text(
        "name: own\nsource: a test\npixel_um: 30\npixels: [400, 400]\nphotometry: lsst\n"
        "ccds: [{name: A, x_mm: 0, y_mm: 0}]\n"
    )
    experiment = Experiment.from_config(
        tiny(
            camera=str(tmp_path / "own.yaml"),
            ccds=("A",),
            wavelengths_nm=[620.0],
            psf__engine="long_exposure",
            psf__n_pupil=300,
            psf__stamp=SIDE,
            stars__truth=12,
        )
    )
    field = PsfField.of_run(experiment, "A")
    pixels = np.array([[101.3, 98.8], [150.0, 160.5], [70.5, 60.5]])
    nearest = np.rint(pixels)
    positions = experiment.camera.from_pixel(0, pixels)
    stars = expose_positions(experiment, positions, offsets=pixels - nearest, along="A").image
    galaxies = Galaxies.single(*pixels.T, 20.0, 1e-4)
    image = draw_galaxies(galaxies, np.ones(3), field, SquarePixels(400), window=Window(0, 0, 200, 200), noise=1e-6)
    assert field.cells == 3
    for star, (x, y) in zip(stars, nearest.astype(int), strict=True):
        part = image[y - 15 : y + 16, x - 15 : x + 16]
        assert np.abs(part - star).max() < 1e-3 * star.max()
    with pytest.raises(ConfigError, match=r"^way = eigen: expected direct, for a PSF that pixels do not sample"):
        draw_galaxies(galaxies, np.ones(3), field, SquarePixels(400), way="eigen")


@pytest.mark.parametrize(("telescope", "side"), [("decam", 63), ("lsst_v3.3_r", 63), ("hsc", 75), ("auxtel", 133)])
def test_stamps_of_fine_pixels_are_as_wide_in_arcseconds(telescope, side):
    """On 63 pixels of 0.05 arcsec wings wrapped round: galaxies had 2.1 % more light within 1 arcsec than stars."""
    assert ImagesConfig(run=Configuration(telescope=telescope)).experiment().stamp_size == side
    given = Configuration(telescope=telescope, psf=PsfConfig(stamp=41))
    assert ImagesConfig(run=given).experiment().stamp_size == 41


@pytest.mark.parametrize("cells", [2, 0, 7])
def test_cells_are_odd_and_fill_the_stamps(cells):
    with pytest.raises(DomainError, match=rf"^cells = {cells}: expected an odd number that divides the sides"):
        field_of(on_cells(1.0, (0.0, 0.0), SIDE, 3), 41, cells)


def test_wide_galaxies_keep_their_light_where_it_is():
    """A disc of 100 pixels: a grid of 512 ended it, and its wings came in at the other side, as bright as its rim."""
    radius, place, side = 100.0, 600.0, 1200
    length = radius / 1.67835
    galaxy = Galaxies.single(place, place, 20.0, radius)
    field = field_of(on_cells(1.5, (0.0, 0.0), SIDE, 1), side, 1)
    image = draw_galaxies(galaxy, np.array([1e7]), field, SquarePixels(side), window=Window(0, 600, side, 1), noise=1.0)
    distance = np.abs(np.arange(side) - place)
    expected = 1e7 / (2.0 * np.pi * length**2) * np.exp(-distance / length)
    outside = distance > 20.0
    # To a hundredth of the noise of a pixel, where two images of the galaxy meet.
    assert image[0, outside] == pytest.approx(expected[outside], rel=2e-3, abs=0.04)


def test_wide_galaxies_of_a_catalogue_reach_a_window_from_afar():
    """Those more than 256 pixels from it were left out."""
    angle = 1e-6
    xi, radius = np.array([-700.0, -1500.0, 50.0]) * angle, np.array([200.0, 200.0, 1.0]) * angle
    galaxies = Galaxies.single(xi, 50.0 * angle, 20.0, radius)
    listed = GalaxySource(GalaxySourceConfig(), Exposure(), 1, galaxies).down_to(25.0)
    for source in (galaxies, listed):
        near = galaxies_near(source, SquarePixels(100, angle), Window(0, 0, 100, 100))
        assert near.xi.tolist() == xi[[0, 2]].tolist()
