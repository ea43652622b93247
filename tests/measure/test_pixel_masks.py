"""Pixels without weight in moments, shifts and copies of dead columns."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.measure.pixel_masks import clipped_level, copied_pixels, empty_pixels, fill_symmetric, weightless_pixels
from pachon.measure.shapes import ShapeFlag, measure_shapes
from pachon.measure.stamps import center_masks, center_stamps, decenter_masks
from pachon.measure.star_selection import StarFlag, flag_stars

PIXEL, WEIGHT, SIZE, COUNT = 0.2, 0.7, 31, 24
Y, X = np.indices((SIZE, SIZE)) - SIZE // 2


def moffats(e1, e2, x, y):
    """Moffat stars of beta 3, FWHM about 3.5 pixels, of unit peak."""
    x, y = X - x[:, None, None], Y - y[:, None, None]
    e1, e2 = e1[:, None, None], e2[:, None, None]
    square = (x * x + y * y) - 2.0 * e1 * (x * x - y * y) - 4.0 * e2 * x * y
    return (1.0 + square / 3.5**2) ** -3


@pytest.fixture(scope="module")
def stars():
    rng = np.random.default_rng(1)
    return moffats(*rng.normal(scale=0.03, size=(2, COUNT)), *rng.uniform(-0.5, 0.5, (2, COUNT)))


def masks_of(kind, seed=2):
    rng = np.random.default_rng(seed)
    bad = np.zeros((COUNT, SIZE, SIZE), dtype=bool)
    middle = SIZE // 2
    for star in bad:
        if kind == "corner":
            star[0, 0] = True
        elif kind == "peak":
            star[middle, middle] = True
        elif kind == "near":
            star[middle + rng.integers(-3, 4), middle + rng.integers(-3, 4)] = True
        elif kind == "column":
            star[:, middle + rng.integers(-3, 4)] = True
    return bad


# Errors of e and of size, rms: of the Gaussian and the opposite pixel; leaving the pixels out costs 20 times as much.
LIMITS = [("corner", 1e-6, 1e-6), ("peak", 2e-4, 5e-3), ("near", 5e-4, 1e-3), ("column", 3e-3, 5e-3)]


@pytest.mark.parametrize(("kind", "of_e", "of_size"), LIMITS)
def test_moments_of_stars_with_masked_pixels_are_those_of_the_complete_stars(stars, kind, of_e, of_size):
    bad = masks_of(kind)
    complete = measure_shapes(stars, PIXEL, WEIGHT)

    def errors(shapes):
        assert not shapes.flags.any()
        return np.sqrt(np.mean((shapes.e1 - complete.e1) ** 2)), np.sqrt(
            np.mean((shapes.size / complete.size - 1) ** 2)
        )

    masked = measure_shapes(np.where(bad, np.nan, stars), PIXEL, WEIGHT)
    e, size = errors(masked)
    assert e < of_e
    assert size < of_size
    if kind != "corner":
        e_left_out, size_left_out = errors(measure_shapes(np.where(bad, 0.0, stars), PIXEL, WEIGHT))
        assert e < 0.2 * e_left_out
        assert size < 0.2 * size_left_out
    if kind != "near":
        return
    # All ways to say so are the same, under any junk.
    for images, weights in (
        (np.where(bad, -1e30, stars), None),
        (np.where(bad, 1e6, stars), ~bad),
        (np.where(bad, -7.0, stars), np.where(bad, 0.0, 3.0)),
        (np.where(bad, np.inf, stars), np.where(bad, np.nan, 1e-3)),
    ):
        same = measure_shapes(images, PIXEL, WEIGHT, weights=weights)
        assert same.e1.tobytes() == masked.e1.tobytes()
        assert same.size.tobytes() == masked.size.tobytes()


@pytest.mark.long
def test_moments_with_masks_have_smaller_errors_than_those_of_hsm(stars):
    galsim = pytest.importorskip("galsim")
    bad = masks_of("column")
    e = {}
    for name, masks in (("complete", np.zeros_like(bad)), ("masked", bad)):
        weights = [galsim.ImageI((~mask).astype(np.int32)) for mask in masks]
        moments = [
            galsim.hsm.FindAdaptiveMom(galsim.ImageD(star.copy()), weight=weight, strict=False)
            for star, weight in zip(stars, weights, strict=True)
        ]
        e[name] = np.array([m.observed_shape.e1 if m.error_message == "" else np.nan for m in moments])
    theirs = np.sqrt(np.nanmean((e["masked"] - e["complete"]) ** 2)) / np.nanstd(e["complete"])
    complete, masked = (measure_shapes(i, PIXEL, WEIGHT) for i in (stars, np.where(bad, np.nan, stars)))
    ours = np.sqrt(np.mean((masked.e1 - complete.e1) ** 2)) / complete.e1.std()
    assert ours < 0.2 * theirs


def test_a_star_is_lost_where_half_of_its_core_is_masked(stars):
    for radius, flag in ((1.0, 0), (3.0, ShapeFlag.MASKED)):
        shapes = measure_shapes(np.where(np.hypot(X, Y) < radius, np.nan, stars[:3]), PIXEL, WEIGHT)
        assert (shapes.flags == flag).all()
        assert np.isnan(shapes.e1).all() == bool(flag)


def test_each_star_is_measured_alone(stars):
    images = np.where(masks_of("near"), np.nan, stars)
    whole = measure_shapes(images, PIXEL, WEIGHT)
    one = measure_shapes(images[17], PIXEL, WEIGHT)
    assert one.e1.tobytes() == whole.e1[17:18].tobytes()


def test_bad_weights_are_named(stars):
    for weights, message in (
        (np.zeros((COUNT, SIZE, SIZE)), "weights are zero in every pixel: expected positive ones where the stars are"),
        (np.ones((SIZE, SIZE + 1)), r"weights have shape \(31, 32\): expected \[24, 31, 31\] as the images"),
        (np.full((SIZE, SIZE), -2.0), "weights hold -2: expected zero or more, as inverse variances are"),
    ):
        with pytest.raises(DomainError, match=message):
            measure_shapes(stars, PIXEL, WEIGHT, weights=weights)
        with pytest.raises(DomainError, match=message):
            center_stamps(stars, 0.0, 0.0, weights=weights)
    assert weightless_pixels(stars, np.ones((SIZE, SIZE))).sum() == 0


def test_centred_stamps_have_no_number_where_there_is_no_weight(stars):
    bad = masks_of("near")
    shapes = measure_shapes(stars, PIXEL, WEIGHT)
    centred = center_stamps(np.where(bad, np.nan, stars), shapes.x, shapes.y, 25)
    expected = center_stamps(stars, shapes.x, shapes.y, 25)
    assert np.array_equal(np.isnan(centred), center_masks(bad, shapes.x, shapes.y, 25))
    # What is wrong of the stand-in leaks by the shift into good pixels: a peak has no opposite but its neighbours.
    assert np.nanmax(np.abs(centred - expected)) < 0.02 * expected.max()
    weights = center_stamps(stars, shapes.x, shapes.y, 25, weights=~bad)
    np.testing.assert_array_equal(weights, centred)
    assert not flag_stars(centred, 1e-3 * expected.max()).flags.any()


def test_masks_go_back_to_where_they_came_from():
    mask = np.zeros((1, 12, 13), dtype=bool)
    mask[0, 6, 4] = True
    x, y = np.array([1.0]), np.array([-1.5])
    centred = center_masks(mask, x, y, 9)
    assert np.array_equal(decenter_masks(centred, x, y, (12, 13)), mask)
    # What is masked at the edge of a stamp goes on beyond it, to the edge of the image.
    at_edge = np.zeros((1, 9, 9), dtype=bool)
    at_edge[0, 3:6, 7:] = True
    moved = decenter_masks(at_edge, np.array([0.4]), np.array([-0.3]), (12, 13))[0]
    assert moved[5:7, 10:].all()
    assert moved.any(axis=1).sum() == 4
    assert not moved[:, :9].any()


def test_neighbours_are_masked_to_below_the_noise():
    rng = np.random.default_rng(5)
    stars = moffats(*rng.normal(scale=0.02, size=(2, 30)), *np.zeros((2, 30))) * 2000.0
    neighbour = 600.0 * moffats(*np.zeros((2, 1)), np.array([8.0]), np.array([-3.0]))[0]
    stamps = stars + rng.normal(scale=20.0, size=stars.shape)
    stamps[4] += neighbour
    selection = flag_stars(stamps, 20.0, gain=1e6)
    assert selection.flags[4] == StarFlag.NEIGHBOUR
    assert (np.delete(selection.flags, 4) == 0).all()
    # The matched filter has the neighbour's flux to a twentieth, and its place to a pixel.
    assert neighbour[~selection.masks[4]].max() < 0.35 * 20.0
    assert not selection.masks[4][np.hypot(X, Y) < 2.0].any()
    assert selection.masks[4].sum() < 200


def test_copies_of_dead_columns():
    images = np.random.default_rng(6).normal(size=(3, 21, 20))
    images[:, :, 6] += np.arange(21.0)
    images[0, 4:18, 7:10] = images[0, 4:18, 6:7]  # columns 7 to 9 are copies of column 6
    images[1, 4:18, 5] = images[1, 4:18, 6]  # two of them may be alike by chance
    images[2, :, 2:9] = 5.0  # a constant is no copy
    assert np.array_equal(np.argwhere(copied_pixels(images[0:1])[0].any(axis=0)).ravel(), [7, 8, 9]) or np.array_equal(
        np.argwhere(copied_pixels(images[0:1])[0].any(axis=0)).ravel(), [6, 7, 8]
    )
    assert copied_pixels(images[0:1])[0].sum() == 3 * 14
    assert not copied_pixels(images[1:]).any()
    assert np.array_equal(copied_pixels(images.transpose(0, 2, 1)), copied_pixels(images).transpose(0, 2, 1))
    ramp = np.zeros((1, 15, 15)) + np.exp(-0.5 * (np.arange(15.0) - 7.0) ** 2 / 3.0**2) * np.arange(15.0)[:, None]
    ramp[0, :, 8:11] = ramp[0, :, 7:8]  # of the columns 7 to 10 the first continues its neighbour
    assert np.array_equal(np.argwhere(copied_pixels(ramp)[0].any(axis=0)).ravel(), [8, 9, 10])


def test_stand_ins_are_opposite_the_centroid():
    image = np.arange(49.0).reshape(1, 7, 7)
    bad = np.zeros(image.shape, dtype=bool)
    bad[0, 1, 2] = True
    assert fill_symmetric(image, bad)[0, 1, 2] == image[0, 5, 4]
    assert fill_symmetric(image, bad, 0.5, -0.5)[0, 1, 2] == image[0, 4, 5]
    # A plane is interpolated exactly, but for the pixel that is missing from it; its values are 7 y + x.
    assert fill_symmetric(image, bad, 0.3, -0.2)[0, 1, 2] == pytest.approx(7.0 * (5 - 0.4) + 4.6, abs=0.2)


def test_models_take_stamps_with_pixels_that_are_not_finite(stars):
    rng = np.random.default_rng(7)
    places = rng.uniform(0.0, 1.0, (COUNT, 2))
    bad = masks_of("near")
    noisy = 1e4 * stars + rng.normal(scale=20.0, size=stars.shape)
    options = {"recipe": "paper", "n_components": 3, "order": 1}
    named = pachon.PsfModel.fit(noisy, places, masks=bad, **options)
    for value in (np.nan, -1e30):
        model = pachon.PsfModel.fit(np.where(bad, value, noisy), places, **options)
        assert model.mean.tobytes() == named.mean.tobytes()
    with pytest.raises(DomainError, match=r"stamps\[3\] has pixels that are not finite, and no others"):
        pachon.PsfModel.fit(np.where(np.arange(COUNT)[:, None, None] == 3, np.nan, noisy), places, **options)


def test_the_level_of_clipped_pixels():
    rng = np.random.default_rng(3)
    image = np.rint(rng.normal(100.0, 5.0, (60, 60)))
    image[14:45, 14:45] += 3000.0 / (1.0 + (X**2 + Y**2) / 16.0) ** 3
    good = np.ones(image.shape, dtype=bool)
    assert clipped_level(image, good) is None
    clipped = np.minimum(image, 1000.0)
    assert clipped_level(clipped, good) == 1000.0
    assert clipped_level(clipped, good & (clipped < 1000.0)) is None
    symmetric = np.zeros((60, 60))
    symmetric[29:31, 29:31] = 1.0
    for even in (symmetric, np.ones((60, 60)), np.full((60, 60), np.nan)):
        assert clipped_level(even, np.isfinite(even)) is None


def test_areas_of_zeros_are_no_measurements():
    rng = np.random.default_rng(4)
    y, x = np.indices((200, 240))
    outside = (x + y < 90) | (x > 215)
    noise = rng.normal(0.0, 3.0, x.shape)
    assert np.array_equal(empty_pixels(np.where(outside, 0.0, noise)), outside)
    # Zeros of whole numbers, of faint sky, and between objects without noise are measurements.
    between = np.zeros(x.shape)
    between[20:60, 20:60] = between[100:150, 90:140] = 1.0
    for image in (noise, np.rint(0.3 * noise), rng.poisson(0.05, x.shape), between, np.zeros(x.shape)):
        assert not empty_pixels(image).any()
