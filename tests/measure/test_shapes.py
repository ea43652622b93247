import numpy as np
import pytest
from astropy import units as u
from scipy import optimize

from pachon.core.errors import DomainError
from pachon.measure import shapes
from pachon.measure.shapes import ShapeFlag, fwhm, measure_shapes

ARCSEC = np.pi / 180.0 / 3600.0
PIXEL = 0.2 * ARCSEC
WEIGHT = 0.7 * ARCSEC
WEIGHT_SIGMA = 0.7 / 0.2 / np.sqrt(8 * np.log(2))  # pixels
COVARIANCE = np.array([[3.0, 0.5], [0.5, 2.2]])  # pixels^2


def gaussian(size=41, covariance=COVARIANCE, center=(0.3, -0.41)):
    """Unit-sum elliptical Gaussian, [y, x], centre counted from the centre of the stamp."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2.0
    inverse = np.linalg.inv(covariance)
    x, y = x - center[0], y - center[1]
    exponent = inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y
    return np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))


def lumpy(seed, size=31):
    """Positive images without any symmetry: a few Gaussians off centre."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size))
    for _ in range(4):
        a, b, c = [*rng.uniform(1.5, 4.0, 2), rng.uniform(-0.7, 0.7)]
        image += rng.uniform(0.5, 1.0) * gaussian(size, np.array([[a, c], [c, b]]), rng.uniform(-1.5, 1.5, 2))
    return image


def test_gaussian_under_gaussian_weight():
    # The product of two concentric Gaussians is a Gaussian of covariance (C^-1 + W^-1)^-1.
    s = measure_shapes(1000.0 * gaussian(), PIXEL, WEIGHT)
    q = np.linalg.inv(np.linalg.inv(COVARIANCE) + np.eye(2) / WEIGHT_SIGMA**2)
    root = np.sqrt(np.linalg.det(q))
    trace = np.trace(q) + 2 * root
    # What pixel sums miss of the integrals: 2 exp(-2 pi^2 q) = 1e-9 for the narrowest axis, q = 1.1.
    tolerance = {"abs": 2e-8}
    assert s.e1[0] == pytest.approx((q[0, 0] - q[1, 1]) / trace, **tolerance)
    assert s.e2[0] == pytest.approx(2 * q[0, 1] / trace, **tolerance)
    assert s.size[0] / PIXEL == pytest.approx(np.sqrt(root), **tolerance)
    assert (s.x[0], s.y[0]) == pytest.approx((0.3, -0.41), **tolerance)
    assert s.flux[0] == pytest.approx(1000.0, rel=1e-9)
    assert s.flags[0] == ShapeFlag.OK
    assert s.usable.all()


def test_unweighted_axis_ratio():
    # Under a very wide weight the ellipticity is (a - b)/(a + b) of the image's own axes.
    a, b, angle = 2.4, 1.6, 0.4
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    image = gaussian(61, rotation @ np.diag([a**2, b**2]) @ rotation.T, (0.0, 0.0))
    s = measure_shapes(image, 1.0, 2000.0)
    expected = (a - b) / (a + b) * np.exp(2j * angle)
    # Two terms of order 1e-5: the weight still narrows the image, (a/w)^2, and the stamp ends at 12 a.
    assert complex(s.e1[0], s.e2[0]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_brute_force(seed):
    image = lumpy(seed)
    half = (len(image) - 1) / 2

    def sums(center):
        out = np.zeros(6)
        for j in range(len(image)):
            for i in range(len(image)):
                x, y = i - half - center[0], j - half - center[1]
                w = image[j, i] * np.exp(-(x * x + y * y) / (2 * WEIGHT_SIGMA**2))
                out += w * np.array([1, x, y, x * x, y * y, x * y])
        return out

    center = optimize.root(lambda c: sums(c)[1:3], [0.0, 0.0], tol=1e-14).x
    s0, _, _, q11, q22, q12 = sums(center)
    q11, q22, q12 = q11 / s0, q22 / s0, q12 / s0
    e = complex(q11 - q22, 2 * q12) / (q11 + q22 + 2 * np.sqrt(q11 * q22 - q12**2))
    s = measure_shapes(image, PIXEL, WEIGHT)
    # The same sums; what is left of the centroid after a Newton step under 1e-6 pixel is about its square.
    assert (s.x[0], s.y[0]) == pytest.approx(center, abs=1e-10)
    assert complex(s.e1[0], s.e2[0]) == pytest.approx(e, abs=1e-10)
    assert s.size[0] == pytest.approx((q11 * q22 - q12**2) ** 0.25 * PIXEL, rel=1e-10)


def test_galsim_round_moments():
    # HSM with a round weight matches its width to the image; given that width as ours, the definitions are the same,
    # and HSM's g1, g2 are (a - b)/(a + b). It stops at 1e-6 in the moments.
    galsim = pytest.importorskip("galsim")
    for seed in range(4):
        image = galsim.Image(lumpy(seed), scale=1.0)
        theirs = galsim.hsm.FindAdaptiveMom(image, round_moments=True)
        ours = measure_shapes(image.array, 1.0, theirs.moments_sigma * np.sqrt(8 * np.log(2)))
        assert ours.e1[0] == pytest.approx(theirs.observed_shape.g1, abs=2e-6)
        assert ours.e2[0] == pytest.approx(theirs.observed_shape.g2, abs=2e-6)
        # GalSim counts pixels from 1.
        assert ours.x[0] + 16 == pytest.approx(theirs.moments_centroid.x, abs=2e-6)
        assert ours.y[0] + 16 == pytest.approx(theirs.moments_centroid.y, abs=2e-6)


def test_symmetries():
    image = lumpy(7)
    s = measure_shapes(image, PIXEL, WEIGHT)
    turned = measure_shapes(np.rot90(image), PIXEL, WEIGHT)
    flipped = measure_shapes(image[::-1], PIXEL, WEIGHT)
    transposed = measure_shapes(image.T, PIXEL, WEIGHT)
    assert abs(s.e1[0]) > 0.01
    assert abs(s.e2[0]) > 0.01
    # The same numbers summed in another order: rounding, and the rest of the centroid.
    np.testing.assert_allclose([turned.e1, turned.e2], [-s.e1, -s.e2], atol=1e-11)
    np.testing.assert_allclose([flipped.e1, flipped.e2, flipped.x, flipped.y], [s.e1, -s.e2, s.x, -s.y], atol=1e-11)
    np.testing.assert_allclose([transposed.e1, transposed.e2], [-s.e1, s.e2], atol=1e-11)


def test_units_background_and_types():
    images = np.stack([lumpy(1), lumpy(2)])
    s = measure_shapes(images, PIXEL, WEIGHT)
    same = measure_shapes(
        images + np.array([3.0, -2.0])[:, None, None], 0.2 * u.arcsec, 0.7 * u.arcsec, background=[3.0, -2.0]
    )
    # A background of 3 costs four of the sixteen digits of pixels of 0.05.
    np.testing.assert_allclose(same.e1, s.e1, atol=1e-11)
    np.testing.assert_allclose(same.size, s.size, rtol=1e-11)
    single = measure_shapes(images.astype(np.float32), PIXEL, WEIGHT)
    np.testing.assert_allclose(single.e2, s.e2, atol=1e-6)  # float32 pixels


def test_splitting_a_batch_changes_no_byte():
    rng = np.random.default_rng(0)
    images = np.stack([lumpy(i) for i in range(23)]) + rng.normal(0.0, 0.002, (23, 31, 31))
    images[5] = 0.0
    whole = measure_shapes(images, PIXEL, WEIGHT)
    # More pixels than are measured at once: batches begin within a copy.
    copies = 60
    many = measure_shapes(np.tile(images, (copies, 1, 1)), PIXEL, WEIGHT)
    for name in ("e1", "e2", "size", "flux", "x", "y", "flags"):
        assert getattr(many, name).tobytes() == np.tile(getattr(whole, name), copies).tobytes(), name
    alone = measure_shapes(images[17], PIXEL, WEIGHT)
    assert alone.e1.tobytes() == whole.e1[17:18].tobytes()
    wide = fwhm(images[:3], PIXEL)
    assert wide[2:].tobytes() == fwhm(images[2], PIXEL).tobytes()


def test_flags():
    y, x = np.mgrid[:31, :31] - 15.0
    dark = np.zeros((31, 31))
    broken = np.full((31, 31), np.nan)
    coreless = np.where(np.hypot(x, y) < 4.0, np.inf, gaussian(31))
    slope = np.exp(x)  # brightest at the edge of the stamp
    ring = np.where(np.hypot(x, y) == 0, 10.0, np.where(np.hypot(x, y) == 2, -0.6, 0.0))
    s = measure_shapes(np.stack([dark, broken, coreless, slope, ring, gaussian(31)]), PIXEL, WEIGHT)
    lost = ShapeFlag.NO_FLUX | ShapeFlag.MASKED
    others = [ShapeFlag.CENTROID_LEFT_STAMP, ShapeFlag.NEGATIVE_MOMENTS, ShapeFlag.OK]
    expected = [ShapeFlag.NO_FLUX, lost, ShapeFlag.MASKED, *others]
    assert s.flags.tolist() == expected
    assert np.isnan(s.e1).tolist() == np.isnan(s.e2).tolist() == np.isnan(s.size).tolist() == [True] * 5 + [False]
    assert np.isnan(s.x).tolist() == [True] * 4 + [False] * 2
    hurried = measure_shapes(lumpy(3), PIXEL, WEIGHT, max_iterations=1)
    assert hurried.flags[0] == ShapeFlag.NOT_CONVERGED
    assert np.isnan(hurried.e1[0])


def test_noisy_stars_converge():
    # S/N about 10: three flagged in a hundred would be bad luck for Newton's steps; none is expected.
    rng = np.random.default_rng(5)
    images = gaussian(31)[None] + rng.normal(0.0, 0.02, (200, 31, 31))
    s = measure_shapes(images, PIXEL, WEIGHT)
    assert (s.flags == 0).sum() > 195
    assert np.hypot(s.x - 0.3, s.y + 0.41)[s.usable].max() < 1.5


def test_no_images():
    assert len(measure_shapes(np.empty((0, 31, 31)), PIXEL, WEIGHT)) == 0


@pytest.mark.parametrize("size", [30, 31])
@pytest.mark.parametrize("center", [(0.0, 0.0), (0.3, -0.41)])
def test_fwhm_of_a_gaussian(size, center):
    # The half-maximum ellipse has the area of a circle of diameter sqrt(8 ln 2) sqrt(ab).
    expected = np.sqrt(8 * np.log(2)) * np.linalg.det(COVARIANCE) ** 0.25
    # Area counted on eighths of a pixel with borders as planes: (1/8 pixel / FWHM)^2 = 1e-3, half of it in the
    # diameter.
    assert fwhm(gaussian(size, COVARIANCE, center), 1.0)[0] == pytest.approx(expected, rel=5e-4)


def test_fwhm_of_a_moffat_profile():
    # I = (1 + (r/a)^2)^-2 falls to half at a sqrt(sqrt 2 - 1).
    y, x = np.mgrid[:61, :61] - 30.0
    image = (1 + ((x - 0.2) ** 2 + (y + 0.3) ** 2) / 4.0**2) ** -2
    # Wide enough (a = 4 pixels) to be band-limited to exp(-2 pi a / 2) = 3e-6; the area counts as for the Gaussian.
    assert fwhm(image, PIXEL)[0] == pytest.approx(2 * 4.0 * np.sqrt(np.sqrt(2) - 1) * PIXEL, rel=5e-4)


def test_fwhm_without_a_maximum():
    images = np.stack([np.full((31, 31), -1.0), np.full((31, 31), np.nan), gaussian(31)])
    assert np.isnan(fwhm(images, PIXEL)).tolist() == [True, True, False]


def test_fwhm_of_masked_pixels():
    images = np.repeat(gaussian(21, COVARIANCE, (0.0, 0.0)).reshape(1, 21, 21), 3, axis=0)
    images[1, 2, 3], images[2, 2, 3] = -1e30, np.nan
    assert np.isnan(fwhm(images, 1.0)).tolist() == [False, True, True]


def test_bad_arguments():
    image = gaussian(31)
    for scale in (0.0, -1.0, np.nan, np.array([1.0, 2.0])):
        with pytest.raises(DomainError, match="pixel_scale"):
            measure_shapes(image, scale, WEIGHT)
        with pytest.raises(DomainError, match="weight_fwhm"):
            measure_shapes(image, PIXEL, scale)
        with pytest.raises(DomainError, match="pixel_scale"):
            fwhm(image, scale)
    with pytest.raises(DomainError, match="images"):
        measure_shapes(np.zeros(5), PIXEL, WEIGHT)
    with pytest.raises(DomainError, match="images"):
        measure_shapes(np.full((5, 5), "a"), PIXEL, WEIGHT)
    with pytest.raises(DomainError, match="background"):
        measure_shapes(image, PIXEL, WEIGHT, background=[1.0, 2.0])
    with pytest.raises(DomainError, match="max_iterations"):
        measure_shapes(image, PIXEL, WEIGHT, max_iterations=0)
    with pytest.raises(DomainError, match="tolerance"):
        measure_shapes(image, PIXEL, WEIGHT, tolerance=0.0)
    with pytest.raises(DomainError, match="upsampling"):
        fwhm(image, PIXEL, upsampling=1)


def test_area_above_a_level_takes_the_slope_of_every_pixel():
    rng = np.random.default_rng(8)
    y, x = np.indices((40, 33))
    noise = np.array([0.0, 0.02, 0.5])[:, None, None] * rng.normal(size=(3, *x.shape))
    images = np.exp(-0.5 * ((x - 15.0) ** 2 + (y - 21.0) ** 2) / 36.0) + noise
    areas = []
    for image in images:
        slope = np.hypot(*np.gradient(image)[::-1])
        border = np.abs(image - 0.5) < 0.5 * slope
        covered = (image > 0.5).astype(float)
        covered[border] = 0.5 + (image[border] - 0.5) / slope[border]
        areas.append(covered.sum())
    assert shapes._areas_above(images, np.full(3, 0.5)) == pytest.approx(areas, rel=1e-14)


def test_steps_from_near_the_centroid_end_where_others_do():
    rng = np.random.default_rng(2)
    y, x = np.indices((25, 25)) - 12.0
    offsets = rng.uniform(-2.0, 2.0, (6, 2))
    images = np.exp(-0.5 * ((x - offsets[:, :1, None]) ** 2 + 1.2 * (y - offsets[:, 1:, None]) ** 2) / 2.0**2)
    one = measure_shapes(images, PIXEL, WEIGHT)
    starts = np.where(np.arange(6)[:, None] == 3, np.nan, offsets + 0.01)
    other = measure_shapes(images, PIXEL, WEIGHT, centers=starts, max_iterations=6)
    for name in ("x", "y", "e1", "size"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), abs=1e-10)
    with pytest.raises(DomainError, match=r"centers have shape \(2,\): expected \(6, 2\)"):
        measure_shapes(images, PIXEL, WEIGHT, centers=np.zeros(2))


def test_a_masked_image_beside_others_moves_none_of_their_starts():
    """Two stars on a stamp: which of them is measured depends on the start, and on no other image of the batch."""
    stamp = gaussian(41, np.eye(2) * 3.0, (-9.0, 0.0)) + gaussian(41, np.eye(2) * 3.0, (9.0, 0.0))
    masked = gaussian()
    masked[20, 20] = np.nan
    starts = np.array([[8.0, 0.0], [3.0, 3.0]])
    alone, whole = (
        measure_shapes(i, PIXEL, WEIGHT, centers=s) for i, s in ((stamp, starts[:1]), ([stamp, masked], starts))
    )
    assert alone.x[0] == pytest.approx(9.0, abs=0.01)
    for name in ("x", "y", "e1", "e2", "size"):
        assert getattr(whole, name)[:1].tobytes() == getattr(alone, name).tobytes(), name
    assert whole.e1[1:].tobytes() == measure_shapes(masked, PIXEL, WEIGHT).e1.tobytes()
