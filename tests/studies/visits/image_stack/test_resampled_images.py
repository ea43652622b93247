"""Images resampled onto tiles: against a brute-force cubic convolution along traced chief rays; flux; noise."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.imaging.draw import Window
from pachon.imaging.exposure import ExposedImage
from pachon.imaging.wcs import ccd_wcs
from pachon.studies.visits.image_stack.resample import add_resampled
from pachon.studies.visits.image_stack.tiles import Tile, TileSums
from pachon.studies.visits.image_stack.visit_wcs import VisitWcs
from pachon.studies.visits.plan import Visit
from pachon.studies.visits.psf_visit import StackFrame

# Variance of a resampled pixel over that of the image, mean over the places between pixels, in white noise: the
# square of the integral of the squared kernel of Keys 1981 with a = -1/2, 57/70. What is missing is in the
# correlations of neighbouring pixels: averages over several pixels are as noisy as before.
CORRELATED = (57.0 / 70.0) ** 2
WAVELENGTH = 620e-9
#: One pixel of 10 um of the frame on the axis [rad], by the focal length of 10.3 m.
FRAME = StackFrame(-1.03e6 * np.eye(2), 31)
TILE = Tile(0, 0, 256)
WINDOW = Window(1800, 1800, 500, 500)
RNG = np.random.default_rng(5)


def keys(s):
    """The cubic convolution kernel of Keys (1981), eq. 15, a = -1/2."""
    s = np.abs(s)
    inner = 1.5 * s**3 - 2.5 * s**2 + 1.0
    outer = -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0
    return np.where(s < 1.0, inner, np.where(s < 2.0, outer, 0.0))


def image_of(values, variance=1.0, mask=0):
    shape = values.shape
    return ExposedImage(
        values.astype(np.float32),
        np.broadcast_to(np.float32(variance), shape).copy(),
        np.broadcast_to(np.int16(mask), shape).copy(),
    )


@pytest.fixture(scope="module")
def wcs_of(lsst_r):
    ccd = ccd_wcs(lsst_r, pachon.lsst_camera(), "R22_S11", wavelength=WAVELENGTH)
    return lambda visit: VisitWcs(ccd, visit)


def resampled(wcs, exposed, threads=None):
    sums = TileSums.empty(TILE.side)
    add_resampled(sums, TILE, FRAME, exposed, WINDOW, wcs, threads=threads)
    return sums


@pytest.mark.parametrize("visit", [Visit(0, 0), Visit(1, 1, roll=0.7, pointing=(4e-5, -2e-5))])
def test_a_tile_is_the_cubic_convolution_along_chief_rays(lsst_r, wcs_of, visit):
    values = RNG.normal(size=WINDOW.shape)
    variance = RNG.uniform(1.0, 2.0, WINDOW.shape)
    sums = resampled(wcs_of(visit), replace(image_of(values), variance=variance.astype(np.float32)))
    rows, columns = RNG.integers(0, TILE.side, (2, 60))
    places = np.stack([columns, rows], axis=1) + TILE.first
    sky = places @ np.linalg.inv(FRAME.matrix).T
    camera = pachon.lsst_camera()
    center = camera.centers[camera.ccd_index("R22_S11")]

    def in_window(at):
        landing = visit.on_detector(lsst_r, at, WAVELENGTH)
        # The pixels' x and y run along y and x of the focal plane; the CCD has 4096 x 4004 of them.
        return (landing - center)[:, ::-1] / camera.pixel_size + [2047.5, 2001.5] - (WINDOW.x, WINDOW.y)

    u, v = in_window(sky).T
    step = 1e-6
    slopes = [(in_window(sky + s) - in_window(sky - s)) / (2.0 * step) for s in step * np.eye(2)]
    to_pixels = np.stack(slopes, axis=2) @ np.linalg.inv(FRAME.matrix)
    area = np.abs(np.linalg.det(to_pixels))
    along_x, along_y = (keys(np.arange(500) - p[:, None]) for p in (u, v))
    expected = area * np.einsum("ni,nj,ji->n", along_x, along_y, values)
    spread = area**2 * np.einsum("ni,nj,ji->n", along_x**2, along_y**2, variance)
    # White noise of rms 1 changes by about 1 from pixel to pixel: positions are good to 1e-4 pixel near the axis.
    assert np.allclose(sums.data[rows, columns], expected, rtol=0, atol=3e-4)
    assert np.allclose(sums.variance[rows, columns], spread, rtol=0, atol=6e-4)
    assert (sums.count == 1).all()


def test_the_flux_of_a_star_is_conserved(wcs_of):
    y, x = np.indices(WINDOW.shape)
    star = np.exp(-0.5 * ((x - 247.3) ** 2 + (y - 251.8) ** 2) / 1.6**2)
    for roll in (0.0, 0.4, 2.0):
        sums = resampled(wcs_of(Visit(0, 0, roll=roll)), image_of(star))
        # The sum of the cubic kernel over pixels is 1 wherever it stands; of a Gaussian of 1.6 pixels the pixels of the
        # tile sum up to 1e-4.
        assert sums.data.sum() == pytest.approx(star.sum(), rel=3e-4)


def test_masked_pixels_leave_out_all_that_need_them(wcs_of):
    exposed = image_of(np.ones(WINDOW.shape))
    exposed.mask[250, 245] = 1
    sums = resampled(wcs_of(Visit(0, 0)), exposed)
    # Along each axis four pixels are within two of the masked one; five where the grids all but coincide.
    assert 16 <= (sums.count == 0).sum() <= 25
    # A constant is reproduced, but for the ratio of the pixels' areas.
    assert np.allclose(sums.data[sums.count > 0], sums.data.max(), rtol=1e-3)


def test_noise_is_that_of_the_correlated_pixels(wcs_of):
    sums = TileSums.empty(TILE.side)
    for number, roll in enumerate((0.3, 1.2, 2.5, 4.0)):
        exposed = image_of(RNG.normal(0.0, 3.0, WINDOW.shape), 9.0)
        add_resampled(sums, TILE, FRAME, exposed, WINDOW, wcs_of(Visit(number, number, roll=roll)))
    sums.visits = 4
    image, variance, mask = sums.stacked()
    area = np.linalg.det(wcs_of(Visit(0, 0)).jacobians([[2048.0, 2048.0]])[0] @ np.linalg.inv(FRAME.matrix)) ** 2
    assert not mask.any()
    # 65536 pixels, about half of them independent: 0.8 % of the variance.
    assert image.var() == pytest.approx(variance.mean(), rel=0.03)
    assert variance.mean() == pytest.approx(4 * 9.0 * area * CORRELATED, rel=5e-3)
    # Averages over 16 x 16 pixels are as noisy as those of white noise: 256 of them, 9 % of the variance.
    blocks = image.reshape(16, 16, 16, 16).mean(axis=(1, 3))
    assert blocks.var() * 256 == pytest.approx(4 * 9.0 * area, rel=0.3)


def test_correlation_is_the_norm_of_the_kernel():
    s = (np.arange(400000) + 0.5) * 1e-5
    assert pytest.approx((2.0 * (keys(s) ** 2).sum() * 1e-5) ** 2, rel=1e-6) == CORRELATED


def test_no_byte_depends_on_threads(wcs_of):
    exposed = image_of(RNG.normal(size=WINDOW.shape))
    one, three = (resampled(wcs_of(Visit(0, 0, roll=0.7)), exposed, threads) for threads in (1, 3))
    assert one.data.tobytes() == three.data.tobytes()
    assert one.variance.tobytes() == three.variance.tobytes()


def test_the_mean_of_fewer_visits_counts_as_that_of_all():
    count = np.array([[4, 2, 0]], dtype=np.int16)
    sums = TileSums(4, np.array([[8.0, 4.0, 0.0]], np.float32), np.array([[4.0, 2.0, 0.0]], np.float32), count)
    image, variance, mask = sums.stacked()
    assert image.tolist() == [[8.0, 8.0, 0.0]]
    # Half of the visits: twice the variance.
    assert variance.tolist() == [[4.0, 8.0, 0.0]]
    assert mask.tolist() == [[0, 0, 1]]
