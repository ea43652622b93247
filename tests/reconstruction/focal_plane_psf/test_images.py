import numpy as np
import pytest

from pachon.measure.shapes import measure_shapes
from pachon.models.camera.cameras import load_camera
from pachon.reconstruction.focal_plane_psf.images import ResidualImages, has_shape, with_shapes
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf
from pachon.reconstruction.focal_plane_psf.mosaic import Mosaic
from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars

ARCSEC = np.pi / 648000
PIXEL, WEIGHT = 0.2 * ARCSEC, 0.7 * ARCSEC
SIZE = 31


def moffat(e1, e2, scale=2.2, beta=4.0, center=(0.0, 0.0)):
    """Stars with wings, of unit sum; axis ratio and direction by a shear of their isophotes."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2.0
    x, y = x - center[0], y - center[1]
    radius = (1 - 2 * e1) * x**2 + (1 + 2 * e1) * y**2 - 4 * e2 * x * y
    image = (1 + radius / scale**2) ** -beta
    return image / image.sum()


def values(images):
    found = measure_shapes(images, PIXEL, WEIGHT)
    assert found.usable.all()
    return np.stack([found.e1, found.e2, np.log(found.size)], axis=1), np.stack([found.x, found.y], axis=1)


BASE = np.stack([moffat(0.01, -0.02), moffat(-0.03, 0.01, center=(0.3, -0.4)), moffat(0.0, 0.0, 2.6, 3.0)])


CHANGE = np.array([[0.03, -0.02, 0.04], [-0.02, 0.03, -0.03], [0.05, 0.05, 0.08]])


@pytest.mark.parametrize("factor", [0.1, 1.0])
def test_images_have_the_shapes_asked_for(factor):
    asked = values(BASE)[0] + factor * CHANGE
    found = with_shapes(BASE, asked, PIXEL, WEIGHT)
    shapes, centre = values(found)
    # 1e-5 is a hundredth of the scatter that a star of the highest signal to noise has.
    np.testing.assert_allclose(shapes, asked, atol=1e-5)
    np.testing.assert_allclose(found.sum(axis=(1, 2)), 1.0, rtol=1e-13)
    # Centred: the second star stood half a pixel off.
    np.testing.assert_allclose(centre, 0.0, atol=1e-4)


def test_shapes_that_no_image_has_are_told():
    """Noise gives faint stars shapes for which a convolution, of negative width, ends in rings or in no image."""
    asked = np.concatenate([values(BASE)[0] + CHANGE, values(BASE[:1])[0] + [[-0.2, 0.0, -0.4]]])
    drawn = with_shapes(BASE[[0, 1, 2, 0]], asked, PIXEL, WEIGHT)
    assert has_shape(drawn).tolist() == [True, True, True, False]


def test_images_of_their_own_shapes_stay_as_they_are():
    centred = BASE[[0, 2]]
    found = with_shapes(centred, values(centred)[0], PIXEL, WEIGHT)
    # Nothing to change but centroids of 1e-7 pixels and rounding of the transforms.
    np.testing.assert_allclose(found, centred, atol=1e-6 * centred.max())


def test_a_gaussian_stays_a_gaussian_of_the_other_moments():
    def gaussian(covariance):
        y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2.0
        i = np.linalg.inv(covariance)
        image = np.exp(-0.5 * (i[0, 0] * x * x + 2 * i[0, 1] * x * y + i[1, 1] * y * y))
        return image / image.sum()

    # A convolution adds moments: the image of other moments is the Gaussian of these, in every pixel.
    old, new = gaussian(np.diag([3.0, 3.0])), gaussian(np.array([[3.06, 0.04], [0.04, 3.02]]))
    found = with_shapes(old[None], values(new[None])[0], PIXEL, WEIGHT)[0]
    # What is left of the shapes after three iterations, 1e-6 for so small a change, makes as much of the peak; the ends
    # of the stamp make 1e-7.
    np.testing.assert_allclose(found, new, atol=1e-5 * new.max())


@pytest.mark.long
def test_components_that_vary_over_the_plane_are_found():
    rng = np.random.default_rng(1)
    n = 240
    xy = rng.uniform(0.0, 0.1, (n, 2))
    mosaic = Mosaic(("a",), np.array([[0.05, 0.05]]), 0.05)
    places = mosaic.at(xy, np.zeros(n, dtype=int))
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2.0
    # A trefoil, orthogonal to all moments up to the second.
    mode = (x**3 - 3 * x * y**2) * np.exp(-(x**2 + y**2) / 18.0)
    mode /= np.sqrt((mode**2).sum())

    def amount(xy):
        return 0.02 * np.sin(40.0 * xy[:, 0]) + 0.01 * np.cos(30.0 * xy[:, 1])

    sigma = 1e-3
    stamps = amount(xy)[:, None, None] * mode + rng.normal(0.0, sigma, (n, SIZE, SIZE))
    found = ResidualImages.fit(stamps, places, np.ones(n), mosaic, 3, 2)
    assert len(found.components) == 1
    # Noise of the component, sigma / sqrt(sum a^2) in each pixel: a cosine of 1 - 961 sigma^2 / (2 sum a^2).
    power = (amount(xy) ** 2).sum()
    assert abs((found.components[0] * mode).sum()) > 1.0 - 961 * sigma**2 / power
    elsewhere = mosaic.at(rng.uniform(0.01, 0.09, (50, 2)), np.zeros(50, dtype=int))
    truth = amount(elsewhere.xy)
    got = (found.at(elsewhere) * mode).sum(axis=(1, 2))
    # A coefficient has the noise of a pixel; the smooth field averages over several stars about a place.
    assert np.sqrt(np.mean((got - truth) ** 2)) < sigma
    assert found.at(elsewhere, 1).tobytes() == found.at(elsewhere, 2).tobytes()


def test_noise_has_no_components():
    n = 240
    mosaic = Mosaic(("a",), np.array([[0.05, 0.05]]), 0.05)
    places = mosaic.at(np.random.default_rng(2).uniform(0.0, 0.1, (n, 2)), np.zeros(n, dtype=int))
    stamps = np.random.default_rng(3).normal(0.0, 1e-3, (n, SIZE, SIZE))
    assert ResidualImages.fit(stamps, places, np.ones(n), mosaic, 3, 1) is None


@pytest.mark.long
@pytest.mark.parametrize("size", [31, 30])
def test_a_constant_star_is_drawn_as_it_is(size):
    """Faint stars, whose sums sky puts off by a third, and photons made components: 5e-3 rms, half a peak at worst.

    Images of an even number of pixels stood half a pixel off the stars.
    """
    rng, camera, n = np.random.default_rng(2), load_camera("lsst"), 90
    ccd = rng.choice([camera.ccd_index(f"R22_S{i}{k}") for i in range(3) for k in range(3)], n)
    x, y = camera.from_uv(ccd, rng.uniform(-0.9, 0.9, (n, 2))).T
    dy, dx = np.indices((size, size)) - size // 2
    star = (1.0 + (dx**2 + 1.1 * dy**2) / 4.8) ** -4.0
    star /= star.sum()
    electrons, sky = 10.0 ** rng.uniform(3.5, 5.0, n), 400.0
    images = rng.poisson(electrons[:, None, None] * star + sky) - sky
    table = {"ccd": np.array(camera.ccd_names)[ccd], "x": x, "y": y}
    table["snr"] = electrons / np.sqrt(electrons + sky / (star**2).sum())
    stars = FocalPlaneStars.from_table(table, stamps=images, pixel_scale=PIXEL)
    model = FocalPlanePsf.fit(stars, camera=camera, threads=1)
    # The 2.5e6 electrons of all stars leave the peak to 2e-3, and pixels on the mean to 4e-4.
    error = (model.draw(stars.ccd, x, y, threads=1) - star) / star.max()
    assert np.sqrt((error**2).mean()) < 1e-3
    assert np.abs(error).max() < 0.02


@pytest.mark.parametrize(("snr", "largest"), [(12.0, 0.25), (50.0, 0.1)])
def test_images_of_few_faint_stars_have_no_more_noise_than_their_mean(snr, largest):
    """Smaller images than the mean enlarged its noise at high frequencies: errors of 0.4 to 1 of the peak."""
    camera, n = load_camera("lsst"), 50
    for seed in range(2):
        rng = np.random.default_rng(seed)
        ccd = rng.integers(len(camera.ccd_names), size=n + 30)
        x, y = camera.from_uv(ccd, rng.uniform(-0.9, 0.9, (n + 30, 2))).T
        dy, dx = np.indices((SIZE, SIZE)) - SIZE // 2
        truth = (1.0 + (dx**2 + dy**2) / (12.0 * (1.0 + 0.5 * x)[:, None, None])) ** -4.0
        truth /= truth.sum(axis=(1, 2), keepdims=True)
        sky = np.sqrt((truth**2).sum(axis=(1, 2), keepdims=True)) / snr
        stamps = truth[:n] + sky[:n] * rng.normal(size=truth[:n].shape)
        table = {"ccd": np.array(camera.ccd_names)[ccd[:n]], "x": x[:n], "y": y[:n], "snr": np.full(n, snr)}
        model = FocalPlanePsf.fit(
            FocalPlaneStars.from_table(table, stamps=stamps, pixel_scale=PIXEL), camera=camera, threads=1
        )
        drawn = model.draw(np.array(camera.ccd_names)[ccd[n:]], x[n:], y[n:], threads=1)
        assert np.abs(drawn - truth[n:]).max() < largest * truth.max()
