"""Bad pixels of donuts: gaps, hot and dead pixels, lines, and strips along rims that are none."""

import numpy as np
import pytest

from pachon.sensing.bad_pixels import unused_regions, without_bad_pixels, without_outliers
from pachon.sensing.stamps import Pixels, match_template, moved

SIZE = 61
Y, X = np.mgrid[:SIZE, :SIZE] - 0.5 * (SIZE - 1)


def ring(radius=20.0):
    """A donut of 400 electrons a pixel, its rims a pixel wide."""
    distance = np.hypot(X, Y)
    return 400.0 / (1.0 + np.exp(2.0 * (distance - radius))) / (1.0 + np.exp(-2.0 * (distance - 0.6 * radius)))


def pixels_of(image, variance=300.0):
    return Pixels(image, np.full(image.shape, variance), np.ones(image.shape, dtype=bool))


@pytest.fixture
def noisy():
    return np.random.default_rng(1).poisson(ring() + 300.0) - 300.0


@pytest.mark.parametrize("fill", [0.0, -300.0, 12345.0])
def test_rows_and_columns_of_one_value_are_gaps(noisy, fill):
    image = noisy.copy()
    image[:, :13] = fill
    image[40] = fill
    used = without_bad_pixels(pixels_of(image)).used
    expected = (X[0, 12] < X) & (Y[40, 0] != Y)
    np.testing.assert_array_equal(used, expected)


def test_an_image_without_noise_has_no_gaps_where_its_light_ends():
    image = np.where(ring() < 1.0, 0.0, ring())
    assert without_bad_pixels(pixels_of(image)).used.all()


@pytest.mark.parametrize("fraction", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("value", [2e4, -300.0])
def test_scattered_bad_pixels_are_left_out_and_few_others(noisy, fraction, value):
    bad = np.random.default_rng(2).random(noisy.shape) < fraction
    pixels = without_bad_pixels(pixels_of(np.where(bad, value, noisy)))
    # Of a fifth of dead ones some have dead neighbours all around.
    assert (pixels.used & bad).sum() <= 0.1 * bad.sum()
    if fraction > 0.05:
        # Where bad pixels are many, those beside them are no worse than others.
        assert (~pixels.used & ~bad).sum() == 0


def test_noise_is_no_bad_pixel_whatever_variance_is_claimed_and_whatever_sky_was_left_in(noisy):
    for image in (noisy, noisy + 300.0, np.random.default_rng(3).poisson(ring() + 1e5).astype(float)):
        assert without_bad_pixels(pixels_of(image, 0.0)).used.all()


def test_a_rim_at_another_place_is_no_outlier():
    """Two pixels of a shifted rim along half of the circle, and a cosmic ray of as many pixels."""
    model, noise = ring(), np.random.default_rng(4).normal(0.0, 5.0, (SIZE, SIZE))
    image = np.where(X > 0.0, ring(22.0), model) + noise
    image[10, 5:25] += 600.0
    image[45, 24] = -400.0
    used = without_outliers((image - model) / 5.0, image, model, np.ones(image.shape, dtype=bool), 7.0)
    assert not used[10, 5:25].any()
    assert not used[45, 24]
    strip = (X > 1.0) & (np.abs(image - model) > 40.0) & (Y[20, 0] < Y) & (Y[40, 0] > Y)
    assert strip.sum() > 30
    assert used[strip].all()


@pytest.mark.parametrize(("bright", "outlier"), [(600.0, False), (2000.0, True)])
def test_a_fold_of_light_beside_its_place_is_no_outlier(bright, outlier):
    """Terms of higher orders move it by a pixel; clipped, wavefronts of DECam were wrong by 60 to 90 nm, not 20."""
    model, image = ring(), ring()
    model[31, 30:33] += 600.0
    image[32, 30:33] += bright
    everything = np.ones(image.shape, dtype=bool)
    used = without_outliers((image - model) / 5.0, image, model, everything, 7.0, folds=True)
    assert used[32, 30:33].all() != outlier


def test_patches_are_no_lines(noisy):
    image, model = noisy.copy(), ring()
    image[20:30, 5:15] += 2000.0
    image[5:60, 50] += 2000.0
    everything = np.ones(image.shape, dtype=bool)
    lines, outliers = (
        without_outliers((image - model) / 20.0, image, model, everything, 7.0, lines_only=only)
        for only in (True, False)
    )
    assert lines[21:29, 6:14].all()
    assert not outliers[20:30, 5:15].any()
    for used in (lines, outliers):
        assert not used[5:60, 50].any()


def test_regions_are_squares_not_lines_or_scattered_pixels():
    used = np.ones((40, 40), dtype=bool)
    used[:, :3] = False  # at the edge of the stamp, beside which there is nothing either
    used[20:28, 20:30] = False
    used[5] = False
    used[35, 35] = False
    regions = unused_regions(used)
    assert regions[:, :3].all()
    assert regions[20:28, 20:30].all()
    assert not regions[5, 10:].any()
    assert not regions[35, 35]


def test_a_template_matches_above_a_plane_as_least_squares_have_it():
    """Brute force: template and plane fitted at every place; a steep plane, and a corner that is not used."""
    rng, template = np.random.default_rng(5), ring()[10:51, 10:51] / ring().sum()
    y, x = np.mgrid[:41, :41] - 20.0
    image = 5e4 * moved(template, 3, -6) + 200.0 + 8.0 * x - 5.0 * y + rng.normal(0.0, 5.0, template.shape)
    used = x + y > -25.0
    match = match_template(np.where(used, image, 0.0), used, np.full(image.shape, 25.0), template)
    best = (np.inf,)
    for down in range(-8, 9):
        for right in range(-8, 9):
            columns = np.stack([moved(template, down, right), np.ones_like(x), x, y], axis=-1)[used]
            values, loss, *_ = np.linalg.lstsq(columns, image[used], rcond=None)
            best = min(best, (float(loss[0]), right, down, *values))
    assert (match.x, match.y) == best[1:3] == (-6.0, 3.0)
    np.testing.assert_allclose([match.flux, *match.plane], best[3:], rtol=1e-6)
