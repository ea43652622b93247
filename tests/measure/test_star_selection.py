import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.measure.stamps import observe_stamps
from pachon.measure.star_selection import MatchedFilter, StarFlag, flag_stars
from pachon.pipeline.simulate.star_defects import add_defects
from pachon.reconstruction.psf_model.model import PsfModel

SIZE, GRID = 31, 128
SKY, READ = 400.0, 9.0
NOISE = np.sqrt(SKY + READ**2)
EXTENT = (0.0, 4000.0, 0.0, 4000.0)


def psf(places):
    """Kolmogorov stars whose width changes by 5 % and whose shear by 3 % over the CCD."""
    frequency = np.fft.fftfreq(GRID)
    kx, ky = frequency[None, :], frequency[:, None]
    middle = GRID // 2
    pixel = np.sinc(kx) * np.sinc(ky) * np.exp(-2j * np.pi * (kx + ky) * middle)
    part = slice(middle - SIZE // 2, middle + SIZE // 2 + 1)
    images = []
    for u, v in places / 4000.0 - 0.5:
        shear, cross, width = 0.02 * u + 0.01, 0.03 * v, 5.67 * (1.0 + 0.05 * u)
        radius = np.hypot((1 + shear) * kx + cross * ky, (1 - shear) * ky + cross * kx)
        images.append(np.fft.ifft2(np.exp(-((width * radius) ** (5.0 / 3.0))) * pixel).real[part, part])
    return np.stack(images)


def observed(seed=0, count=40):
    """Stars from S/N of about 30 to a thousand."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 4000.0, (count, 2))
    shapes = psf(places)
    electrons = 10.0 ** rng.uniform(np.log10(5e3), np.log10(3e5), count)
    return observe_stamps(shapes, electrons, SKY, READ, rng), shapes, places


@pytest.mark.long
def test_good_stars_stay():
    # Noise reaches six standard deviations once in 1e9, and 120 000 pixels are looked at twice.
    found = [flag_stars(observed(seed)[0], NOISE).flags for seed in (1, 2, 3)]
    assert np.count_nonzero(found) <= 1  # the star that differs most from the median, at S/N 1000, may go


@pytest.mark.long
@pytest.mark.parametrize("kind", ["neighbours", "cosmic_rays"])
def test_defects_are_found_and_named(kind):
    for seed in (0, 1, 2):
        stamps, shapes, _ = observed(seed)
        spoiled, flags = add_defects(stamps, shapes, np.random.default_rng(100 + seed), **{kind: 0.2})
        assert 2 <= np.count_nonzero(flags) <= 16
        found = flag_stars(spoiled, NOISE)
        hit = flags > 0
        np.testing.assert_array_equal(found.flags[hit], flags[hit])
        assert np.count_nonzero(found.flags[~hit]) <= 1
        assert found.masks[hit].any(axis=(1, 2)).all()


@pytest.mark.long
def test_masks_hold_the_cosmic_ray():
    stamps, _, _ = observed(4)
    stamps[7, 3:9, 20] += 3000.0
    selection = flag_stars(stamps, NOISE)
    assert selection.flags[7] == StarFlag.COSMIC_RAY
    assert selection.masks[7, 3:9, 20].all()
    assert selection.masks[7].sum() <= 8
    assert selection.masks.sum() == selection.masks[7].sum()


@pytest.mark.long
def test_saturated_cores():
    stamps, shapes, _ = observed(5)
    full = 0.4 * stamps.max()
    clipped, flags = add_defects(stamps, shapes, np.random.default_rng(0), full_well=full)
    assert np.count_nonzero(flags) >= 2
    np.testing.assert_array_equal(flag_stars(clipped, NOISE, saturation=full).flags, flags)
    # Without the level, from the shape: a fifth, and 0.08 for what width alone does, and noise.
    without = flag_stars(clipped, NOISE).flags
    core = shapes > 0.6 * shapes.max(axis=(1, 2), keepdims=True)
    lost = 1.0 - (clipped * core).sum(axis=(1, 2)) / (stamps * core).sum(axis=(1, 2))
    assert (without[lost > 0.32] == StarFlag.SATURATED).all()
    assert (lost > 0.32).any()
    assert not without[lost == 0.0].any()


def test_unusable_stars_and_none_left():
    stamps, shapes, _ = observed(6, count=12)
    stamps[2] = np.nan
    stamps[5] *= -1.0
    middle = np.unravel_index(stamps[4].argmax(), stamps[4].shape)
    stamps[4, middle[0] - 2 : middle[0] + 3, middle[1] - 2 : middle[1] + 3] = np.nan
    stamps[6, 3, 3] = -1e30  # one pixel is no loss
    selection = flag_stars(stamps, NOISE)
    assert selection.flags[[2, 4, 5, 6]].tolist() == [StarFlag.UNUSABLE, StarFlag.MASKED, StarFlag.UNUSABLE, 0]
    assert selection.keep(9).sum() == 9
    with pytest.raises(DomainError, match=r"^9 of 12 stars left \(2 unusable, 1 masked\): expected at least 11$"):
        selection.keep(11)
    hit, _ = add_defects(stamps[6:], shapes[6:], np.random.default_rng(0), cosmic_rays=1.0)
    with pytest.raises(DomainError, match=r"^0 of 6 stars left \(.*6 cosmic ray\): expected at least 1$"):
        flag_stars(hit, NOISE).keep()


@pytest.mark.slow
def test_model_without_the_flagged_stars():
    # One star in ten with a neighbour: left in, it bends the model; found and left out, only its light is missed.
    ratios = []
    for seed in range(4):
        stamps, shapes, places = observed(seed)
        spoiled, flags = add_defects(stamps, shapes, np.random.default_rng(50 + seed), neighbours=0.1)
        elsewhere = np.random.default_rng(9).uniform(200.0, 3800.0, (50, 2))
        truth = psf(elsewhere)

        def error(images, keep, elsewhere=elsewhere, truth=truth, places=places):
            model = PsfModel.fit(images[keep], places[keep], order=1, n_components=5, extent=EXTENT)
            return np.sqrt(((model.at(elsewhere) - truth) ** 2).mean())

        everything = np.ones(40, dtype=bool)
        selected = flag_stars(spoiled, NOISE).keep(20)
        assert selected.sum() >= 40 - np.count_nonzero(flags) - 1
        ratios.append(error(spoiled, selected) / error(stamps, everything))
    assert np.exp(np.mean(np.log(ratios))) < 1.1


def test_more_defects_leave_the_earlier_ones():
    stamps, shapes, _ = observed(7)
    few, some = add_defects(stamps, shapes, np.random.default_rng(1), neighbours=0.1, cosmic_rays=0.1)
    more, many = add_defects(stamps, shapes, np.random.default_rng(1), neighbours=0.1, cosmic_rays=0.5)
    assert not (some & ~many).any()
    same = some == many
    np.testing.assert_array_equal(few[same], more[same])
    nothing, none = add_defects(stamps, shapes, np.random.default_rng(1))
    assert nothing.tobytes() == stamps.tobytes()
    assert not none.any()


def test_bad_arguments():
    stamps, shapes, _ = observed(8, count=4)
    with pytest.raises(DomainError, match="stamps have shape"):
        flag_stars(stamps[0], NOISE)
    with pytest.raises(DomainError, match="stamps = 'stars': expected"):
        flag_stars("stars", NOISE)
    with pytest.raises(DomainError, match="noise ="):
        flag_stars(stamps, [1.0, 2.0])
    for name in ("gain", "threshold", "saturation"):
        with pytest.raises(DomainError, match=f"{name} = 0"):
            flag_stars(stamps, NOISE, **{name: 0.0})
    with pytest.raises(DomainError, match="the median star has no wings"):
        flag_stars(np.ones_like(stamps), NOISE)
    with pytest.raises(DomainError, match="2 of 2 stars are usable: expected at least 3"):
        flag_stars(stamps[:2], NOISE)
    rng = np.random.default_rng(0)
    with pytest.raises(DomainError, match="have shapes"):
        add_defects(stamps, shapes[:2], rng)
    with pytest.raises(DomainError, match=r"neighbours = 1\.5"):
        add_defects(stamps, shapes, rng, neighbours=1.5)
    with pytest.raises(DomainError, match="full_well = -1"):
        add_defects(stamps, shapes, rng, full_well=-1.0)


def test_the_matched_filter_is_the_sum_over_pixels():
    rng = np.random.default_rng(6)
    for shape in ((9, 9), (12, 15)):
        image, star = rng.normal(size=(2, *shape))
        peak = np.unravel_index(star.argmax(), shape)
        expected = np.zeros(shape)
        for at in np.ndindex(shape):  # the star's peak stands on this pixel
            for pixel in np.ndindex(shape):
                place = tuple(a + p - q for a, p, q in zip(at, pixel, peak, strict=True))
                if all(0 <= i < n for i, n in zip(place, shape, strict=True)):
                    expected[at] += star[pixel] * image[place]
        np.testing.assert_allclose(MatchedFilter.of(star).light(image), expected, rtol=0, atol=1e-12)
