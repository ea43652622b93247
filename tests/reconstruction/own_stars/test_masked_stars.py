"""Bad pixels on star stamps: what is filled in, which stars are lost, and the model that is left."""

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.measure.pixel_masks import bad_pixels, fill_symmetric
from pachon.measure.shapes import measure_shapes
from pachon.measure.stamps import center_masks, shift_masks
from pachon.measure.star_selection import StarFlag
from pachon.reconstruction.own_stars.masked_stars import (
    fill_by_profiles,
    profiles_of_psfs,
    sky_of_stamps,
)
from pachon.reconstruction.own_stars.own_stars import fit_own_stars
from pachon.reconstruction.psf_model import kriging

PIXEL = np.deg2rad(0.2 / 3600.0)
SIZE, COUNT, SKY = 33, 60, 22.0
Y, X = np.indices((SIZE, SIZE)) - SIZE // 2


def profiles(positions, dx, dy):
    """Moffat profiles of unit sum whose ellipticity and width change linearly over 4000 pixels."""
    u, v = (positions.T / 2000.0 - 1.0)[:, :, None, None]
    x, y = X - dx[:, None, None], Y - dy[:, None, None]
    square = x**2 * (1 - 0.02 * u) + y**2 * (1 + 0.02 * u) - 0.04 * v * x * y
    images = (1.0 + square / (2.8 * (1.0 + 0.01 * u)) ** 2) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


def simulated_stars(seed):
    """Stars of S/N 30 to 600 over a background of 300, anywhere in a pixel, and their places."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(1.0, 4000.0, (COUNT, 2))
    electrons = 5000.0 * 10.0 ** rng.uniform(0.3, 1.5, COUNT)
    light = electrons[:, None, None] * profiles(positions, *rng.uniform(-0.5, 0.5, (2, COUNT)))
    return light + rng.normal(size=light.shape) * np.sqrt(SKY**2 + light) + 300.0, positions


@pytest.fixture(scope="module")
def stars():
    return simulated_stars(11)


@pytest.fixture(scope="module")
def complete(stars):
    """The model of the same stars without bad pixels."""
    return fit_own_stars(*stars, PIXEL, interpolation="kriging")


def random_masks(kind, seed):
    """Bad pixels on every second star."""
    rng = np.random.default_rng(seed)
    bad = np.zeros((COUNT, SIZE, SIZE), dtype=bool)
    for star in range(0, COUNT, 2):
        angle, wing, near = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(6.0, 12.0), rng.uniform(1.5, 4.0)
        if kind == "corner":
            bad[star, 0, -1] = True
        elif kind == "wing":
            centre = wing * np.array([np.cos(angle), np.sin(angle)])
            bad[star] = np.hypot(X - centre[0], Y - centre[1]) < rng.uniform(1.0, 4.0)
        elif kind == "near the core":
            bad[star, SIZE // 2 + round(near * np.sin(angle)), SIZE // 2 + round(near * np.cos(angle))] = True
        elif kind == "column":
            bad[star, :, SIZE // 2 + rng.choice([-4, -3, -2, 2, 3, 4])] = True
        elif kind == "peak":
            bad[star, SIZE // 2, SIZE // 2] = True
        elif kind == "twentieth":
            bad[star] = rng.uniform(size=(SIZE, SIZE)) < 0.05
    return bad


def model_errors(model, weight_fwhm):
    """Rms errors of a component of e, and of the size, at places without a star."""
    places = np.random.default_rng(5).uniform(200.0, 3800.0, (80, 2))
    truth = profiles(places, *np.zeros((2, 80)))
    rim = (SIZE - model.mean.shape[0]) // 2
    drawn, true = (
        measure_shapes(images, PIXEL, weight_fwhm) for images in (model.at(places), truth[:, rim:-rim, rim:-rim])
    )
    e = np.concatenate([drawn.e1 - true.e1, drawn.e2 - true.e2])
    return np.sqrt(np.mean(e**2)), np.sqrt(np.mean((drawn.size / true.size - 1.0) ** 2))


@pytest.mark.long
@pytest.mark.parametrize("value", [np.nan, -1e30, np.inf])
def test_a_bad_pixel_in_the_corner_of_all_stamps_changes_nothing(stars, complete, value):
    stamps = stars[0].copy()
    stamps[:, 0, 0] = value
    own = fit_own_stars(stamps, stars[1], PIXEL, interpolation="kriging")
    assert own.used.all()
    # One of 560 pixels of sky is missing: its median changes by a hundredth of its error.
    assert np.abs(own.shapes.e1 - complete.shapes.e1).max() < 0.01 * complete.sigma_e.min()
    assert np.abs(own.model.mean - complete.model.mean).max() < 2e-4 * complete.model.mean.max()


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "fraction"),
    # Most change of e1, e2 and size over their noise (rms): the part of the noise that was in the bad pixels. Where
    # half of the peaks are filled, noise raises the maxima less: the FWHM, and so the weight, is 0.2 % larger.
    [("corner", 0.02), ("wing", 0.02), ("near the core", 0.3), ("column", 0.4), ("peak", 0.8), ("twentieth", 0.4)],
)
def test_stars_with_bad_pixels_keep_their_shapes(stars, complete, kind, fraction):
    bad = random_masks(kind, 3)
    own = fit_own_stars(np.where(bad, np.nan, stars[0]), stars[1], PIXEL, interpolation="kriging")
    assert own.used.all()
    hit = bad.any(axis=(1, 2))
    changes = np.stack(
        [
            (own.shapes.e1 - complete.shapes.e1) / complete.sigma_e,
            (own.shapes.e2 - complete.shapes.e2) / complete.sigma_e,
            (own.shapes.size / complete.shapes.size - 1.0) / complete.sigma_size,
        ]
    )[:, hit]
    assert np.sqrt(np.mean(changes**2)) < fraction
    assert abs(own.weight_fwhm / complete.weight_fwhm - 1.0) < 0.003
    # Thirty good stars alone would have an error of e of sqrt(2) times that of sixty.
    errors, best = (model_errors(each.model, complete.weight_fwhm) for each in (own, complete))
    assert errors[0] < 1.2 * best[0]
    assert errors[1] < 0.001


@pytest.mark.long
def test_a_model_with_masked_stars_is_better_than_without_these_stars():
    ratios = []
    for seed in range(3):
        stamps, positions = simulated_stars(100 + seed)
        bad = random_masks("column", seed)
        good = ~bad.any(axis=(1, 2))
        options = {"interpolation": "kriging", "extent": (0.0, 4000.0, 0.0, 4000.0)}
        masked = fit_own_stars(stamps, positions, PIXEL, masks=bad, **options)
        fewer = fit_own_stars(stamps[good], positions[good], PIXEL, **options)
        ratios.append([model_errors(each.model, fewer.weight_fwhm)[0] for each in (masked, fewer)])
    masked, fewer = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert masked < 0.9 * fewer


@pytest.mark.long
def test_stars_with_neighbours_stay_and_keep_their_shapes():
    options = {"recipe": "paper", "basis": "pixels", "order": 1}
    stamps, positions = simulated_stars(100)
    complete = fit_own_stars(stamps, positions, PIXEL, **options)
    rng = np.random.default_rng(50)
    radius, angle = rng.uniform(5.0, 13.0, COUNT), rng.uniform(0.0, 2.0 * np.pi, COUNT)
    flux = rng.uniform(0.1, 0.6, COUNT)
    flux *= (stamps - 300.0).sum(axis=(1, 2)) * (np.arange(COUNT) % 2 == 0)
    stamps = stamps + flux[:, None, None] * profiles(positions, radius * np.cos(angle), radius * np.sin(angle))
    own = fit_own_stars(stamps, positions, PIXEL, **options)
    flagged = (own.flags & StarFlag.NEIGHBOUR) > 0
    assert (flagged | ~own.used)[flux > 3e3].all()  # 20 standard deviations of the sky under a star
    kept = flagged & own.used
    assert kept.sum() >= 0.8 * flagged.sum() >= 20
    # What a mask leaves of a neighbour and what it takes from the star are less than the star's own noise.
    for change, sigma in (
        (own.shapes.e1 - complete.shapes.e1, complete.sigma_e),
        (own.shapes.size / complete.shapes.size - 1.0, complete.sigma_size),
    ):
        assert np.sqrt(np.mean((change[kept] / sigma[kept[complete.used]]) ** 2)) < 0.8


@pytest.mark.long
def test_masks_are_the_same_as_pixels_that_are_not_finite(stars):
    bad = random_masks("wing", 7)
    own, same = (
        fit_own_stars(stamps, stars[1], PIXEL, masks=masks, interpolation="polynomial", order=1)
        for stamps, masks in ((np.where(bad, np.nan, stars[0]), None), (np.where(bad, 7.0, stars[0]), bad))
    )
    assert own.model.mean.tobytes() == same.model.mean.tobytes()
    assert own.shapes.e1.tobytes() == same.shapes.e1.tobytes()


def test_masks_without_a_pixel_change_no_byte(stars):
    options = {"interpolation": "polynomial", "order": 0}
    own, same = (
        fit_own_stars(*stars, PIXEL, masks=masks, **options) for masks in (None, np.zeros(stars[0].shape, dtype=bool))
    )
    assert own.model.mean.tobytes() == same.model.mean.tobytes()
    assert own.held_out.e1.tobytes() == same.held_out.e1.tobytes()


@pytest.mark.long
def test_stars_without_a_core_are_lost_with_their_reason(stars):
    bad = np.zeros(stars[0].shape, dtype=bool)
    bad[3] = np.hypot(X, Y) < 2.5
    bad[4] = True
    bad[5] = X < 0  # half of a star is enough
    own = fit_own_stars(*stars, PIXEL, masks=bad, interpolation="polynomial", order=0)
    assert list(own.flags[[3, 4, 5]]) == [StarFlag.MASKED, StarFlag.MASKED, StarFlag.GOOD]
    assert own.summary()["flagged"]["masked"] == 2
    assert set(np.flatnonzero(~own.used)) == {3, 4}
    with pytest.raises(DomainError, match=r"0 of 60 stars left \(60 masked\): expected at least 5"):
        fit_own_stars(*stars, PIXEL, masks=np.broadcast_to(np.hypot(X, Y) < 3.0, bad.shape).copy())


@pytest.mark.long
def test_round_stamps_are_no_loss(stars):
    stamps = np.where(np.hypot(X, Y) < 12.0, stars[0], np.nan)
    # The noise of a hundred pixels in place of five hundred is good to a tenth, and so is the S/N.
    own = fit_own_stars(stamps, stars[1], PIXEL, min_snr=10.0, interpolation="polynomial", order=1)
    assert own.used.all()
    assert np.isfinite(own.model.mean).all()


def test_masks_of_another_shape_are_named(stars):
    with pytest.raises(DomainError, match=r"masks have shape \(33, 33\) and type bool: expected bool \[60, 33, 33\]"):
        fit_own_stars(*stars, PIXEL, masks=np.zeros((SIZE, SIZE), dtype=bool))


def test_stamps_without_any_weight_are_named(stars):
    for stamps, masks in ((stars[0], np.ones(stars[0].shape, dtype=bool)), (np.full(stars[0].shape, -1e30), None)):
        with pytest.raises(DomainError, match="no pixel of 60 stamps has weight: all are masked, or no numbers"):
            fit_own_stars(stamps, stars[1], PIXEL, masks=masks)


def test_what_counts_as_a_bad_pixel():
    values = np.array([0.0, -500.0, -9e28, -1e29, -1e30, np.nan, np.inf, -np.inf])
    assert list(bad_pixels(values)) == [False] * 3 + [True] * 5


def test_sky_is_that_of_the_good_pixels():
    rng = np.random.default_rng(2)
    images = 50.0 + 3.0 * rng.normal(size=(3, SIZE, SIZE))
    bad = rng.uniform(size=images.shape) < 0.2
    bad[1] = np.hypot(X, Y) > 10.0
    bad[2] = True
    level, rms = sky_of_stamps(np.where(bad, 1e9, images), bad, 13.0)
    outer = images[0][(np.hypot(X, Y) > 13.0) & ~bad[0]]
    assert level[0] == np.median(outer)
    assert rms[0] == 1.4826 * np.median(np.abs(outer - np.median(outer)))
    # Of 317 pixels 79 are taken: their median is good to 0.4, their scatter to 0.35.
    assert level[1] == pytest.approx(50.0, abs=1.2)
    assert rms[1] == pytest.approx(3.0, abs=1.0)
    assert np.isnan([level[2], rms[2]]).all()


def test_the_first_guess_is_the_pixel_opposite_or_the_mean_of_neighbours():
    image = 5.0 + np.random.default_rng(3).normal(size=(1, 9, 9))
    bad = np.zeros(image.shape, dtype=bool)
    bad[0, 2, 3] = bad[0, 4, 4] = True
    filled = fill_symmetric(image, bad)[0]
    assert filled[2, 3] == image[0, 6, 5]
    y, x = np.indices((9, 9)) - 4
    weight = np.exp(-0.5 * (x**2 + y**2) / 1.5**2) * ~bad[0]
    assert filled[4, 4] == pytest.approx((weight * image[0]).sum() / weight.sum(), abs=1e-3)
    assert np.array_equal(filled[~bad[0]], image[0][~bad[0]])


def test_stars_without_noise_are_filled_exactly():
    """A star of its profile's shape at any place and flux: the fill is the truth to the aliasing of the pixels."""
    shift = np.array([[0.0, 0.4, -1.3], [0.0, -0.3, 0.8]])
    wide = np.exp(-0.5 * ((X - shift[0][:, None, None]) ** 2 + (Y - shift[1][:, None, None]) ** 2) / 1.7**2)
    flux = np.array([1.0, 30.0, 5.0])[:, None, None]
    truth = flux * wide
    bad = np.random.default_rng(1).uniform(size=truth.shape) < 0.1
    profile = np.broadcast_to(wide[0], truth.shape)
    filled, lost = fill_by_profiles(np.where(bad, 0.0, truth), bad, profile, *shift, 1.7)
    assert not lost.any()
    assert np.abs(filled / flux - wide).max() < 1e-5
    inner = wide[:1, 6:-6, 6:-6]
    joined = profiles_of_psfs(inner / inner.sum(), wide[0], 1.7)
    assert np.abs(joined - wide[0]).max() < 1e-12


def test_masks_move_with_their_stars():
    mask = np.zeros((SIZE, SIZE), dtype=bool)
    mask[10, 12] = True
    # A shift by a quarter of a pixel leaves three quarters on one pixel; by a twentieth it is no overlap to speak of.
    moved = shift_masks(np.stack([mask, mask]), np.array([2.0, 0.25]), np.array([-3.0, 0.05]))
    assert np.array_equal(np.argwhere(moved), [[0, 7, 14], [1, 10, 12], [1, 10, 13]])
    centred = center_masks(mask[None], np.array([-2.0]), np.array([np.nan]), 11)
    assert np.array_equal(
        np.argwhere(centred[0]), np.argwhere(mask[11:22, 11:22]) if mask[11:22, 11:22].any() else np.empty((0, 2))
    )
    centred = center_masks(mask[None], np.array([-2.0]), np.array([-3.0]), 15)
    assert np.array_equal(np.argwhere(centred[0]), [[10 + 3 - 9, 12 + 2 - 9]])


def test_filled_pixels_are_not_taken_for_quiet_sky():
    rng = np.random.default_rng(4)
    mean = profiles(np.full((1, 2), 2000.0), *np.zeros((2, 1)))[0]
    deviations = 1e-3 * rng.normal(size=(30, SIZE * SIZE))
    masked = rng.uniform(size=deviations.shape) < 0.5
    filters = kriging.shape_numbers(mean, deviations)[1]
    filled = np.where(masked, 0.0, deviations)
    truth, noise, quiet = (
        np.mean(kriging.star_noise(None, *each))
        for each in (
            (deviations, mean, filters),
            (filled, mean, filters, masked.reshape(-1, *mean.shape)),
            (filled, mean, filters),
        )
    )
    # Medians of 400 and of 200 pixels in 30 stars: good to 2 %.
    assert noise == pytest.approx(truth, rel=0.06)
    assert quiet < 0.5 * truth
