"""Donuts with neighbours, cut by edges, on planes of background, with bad pixels, and stamps of other things."""

import warnings

import numpy as np
import pytest
from donut_images import PIXEL, SIZE, WAVELENGTH, blurred, donut, fine_bins, noisy

import pachon

FIELD = np.deg2rad([0.6, 0.9])
OPTIONS = {"sky_variance": 500.0, "pixel_size": PIXEL, "threads": 1}
SKY = 500.0
#: Pixels of 20 um from the middle of a stamp.
Y, X = np.mgrid[:SIZE, :SIZE] - 0.5 * (SIZE - 1)


def wave_of(seed, rms):
    """Coefficients from j = 1 in the span of Z4 to Z22 [m]."""
    values = np.zeros(22)
    values[3:] = np.random.default_rng(seed).normal(size=19)
    return rms * values / np.linalg.norm(values)


def rss(values):
    return float(np.sqrt((values**2).sum()))


def fitted(tel, images, **changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return pachon.fit_donuts(tel, images, [FIELD] * len(images), WAVELENGTH, **{**OPTIONS, **changes})


@pytest.fixture(scope="module")
def wave():
    return wave_of(8, 100e-9)


@pytest.fixture(scope="module")
def clean(behind_focus, wave):
    return donut(behind_focus, FIELD, zernikes=wave, blur=1.0, shift=(0.7, -1.2), rays=600)


def test_what_remains_of_a_donut_on_a_slope_is_fitted(behind_focus, wave, clean):
    """A sky of 2 electrons a pixel more each pixel, and a third of the stamp beside the CCD, as NaN or as zero."""
    image = np.random.default_rng(3).poisson(clean + SKY + 200.0 + 2.0 * X).astype(float)
    images = [np.where(X < -17.0, fill, image) for fill in (np.nan, 0.0)]
    fit = fitted(behind_focus, images, noll=range(4, 12))
    assert fit.reasons == ["clipped, cut off"] * 2
    assert fit.zernikes[0].tobytes() == fit.zernikes[1].tobytes()
    error = fit.zernikes[0] - wave[3:11]
    assert error @ np.linalg.solve(fit.covariance[0], error) < 25.0  # 8 numbers; 1 in 600 beyond
    np.testing.assert_allclose(fit.background_slope[0], [2.0, 0.0], atol=0.2)
    assert fit.background[0] == pytest.approx(700.0, abs=20.0)


class Canvas:
    """A donut in the middle of a wide image, which stands anywhere on a stamp or beside it by whole pixels."""

    def __init__(self, tel, wave, rays=1000):
        self.image = blurred(fine_bins(tel, FIELD, wave, (0.0, 0.0), rays, 3 * SIZE, PIXEL), 1.5, 5e6)

    def at(self, x, y, size=(SIZE, SIZE)):
        """Return the stamp of a star at a place from its middle [pixels]."""
        first = [(n - m) // 2 - round(step) for n, m, step in zip(self.image.shape, size, (y, x), strict=True)]
        return self.image[first[0] : first[0] + size[0], first[1] : first[1] + size[1]]

    def crowd(self, count, rng):
        """Return neighbours anywhere with a tenth of their light on the stamp: ratios from 0.03 to 1, and places."""
        neighbours = []
        while len(neighbours) < count:
            place = np.rint(rng.uniform(-0.75, 0.75, 2) * SIZE)
            if np.hypot(*place) > 6.0 and self.at(*place).sum() > 0.1 * 5e6:
                neighbours.append((np.exp(rng.uniform(np.log(0.03), 0.0)), *place))
        return np.array(neighbours)


@pytest.mark.slow
def test_three_neighbours_are_fitted_too(behind_focus):
    """One beside the stamp, one that overlaps the star, and a faint one."""
    wave = wave_of(1, 260e-9)
    canvas = Canvas(behind_focus, wave, rays=300)
    neighbours = np.array([(0.9, 52.0, -8.0), (0.5, -15.0, 12.0), (0.1, -20.0, -40.0)])
    image = canvas.at(0.0, 0.0) + sum(ratio * canvas.at(x, y) for ratio, x, y in neighbours)
    fit = fitted(behind_focus, [noisy(image, SKY, 2)])
    assert fit.reasons[0] in ("blended", "blended, poor fit")
    np.testing.assert_allclose(fit.companions[0, :3, 0], neighbours[:, 0], atol=0.02)
    np.testing.assert_allclose(fit.companions[0, :3, 1:], neighbours[:, 1:], atol=0.5)
    assert np.isnan(fit.companions[0, 3:]).all()
    assert fit.to_table()["n_companions"].tolist() == [3]
    assert rss(fit.zernikes[0] - wave[3:]) < 80e-9


@pytest.mark.slow
def test_crowded_stars_are_as_good_as_alone(behind_focus):
    """Twenty stamps with one to five neighbours, and the same stars alone."""
    crowded, alone, waves, bright = [], [], [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        waves.append(wave_of(100 + seed, 260e-9))
        canvas = Canvas(behind_focus, waves[-1])
        star = canvas.at(0.0, 0.0)
        neighbours = [ratio * canvas.at(x, y) for ratio, x, y in canvas.crowd(1 + seed % 5, rng)]
        bright.append(sum(image.sum() > 0.1 * 5e6 for image in neighbours))
        crowded.append(noisy(star + sum(neighbours), SKY, seed))
        alone.append(noisy(star, SKY, seed))
    errors = []
    for images in (crowded, alone):
        fit = fitted(behind_focus, images)
        assert fit.usable.all()
        errors.append(1e9 * np.array([rss(z - w[3:]) for z, w in zip(fit.zernikes, waves, strict=True)]))
        if images is crowded:
            companions = np.isfinite(fit.companions[:, :, 0]).sum(axis=1)
            # Of five some that hardly reach the stamp may be missed, which the fit says.
            missed = np.array([bool(flags & pachon.sensing.DonutFlag.POOR_FIT) for flags in fit.flags])
            assert ((companions >= bright) | missed).all(), (companions, bright)
    print("crowded, alone: median, worst [nm]", *[(np.median(e).round(1), e.max().round(1)) for e in errors])
    assert np.median(errors[0]) < 1.5 * np.median(errors[1])
    assert errors[0][~missed].max() < 2.0 * errors[1].max()


@pytest.mark.long
def test_stars_closer_than_the_seeing_are_told_apart(behind_focus):
    """Two stars 1.2 arcsec apart, which one star with another wavefront fits nearly as well: it was 480 nm off."""
    wave = wave_of(533, 260e-9)
    canvas = Canvas(behind_focus, wave, rays=300)
    image = canvas.at(0.0, 0.0) + 0.34 * canvas.at(0.0, -3.0)
    fit = fitted(behind_focus, [noisy(image, SKY, 33)])
    assert fit.reasons[0].startswith("blended")
    # Flux and distance of the second make up for each other.
    np.testing.assert_allclose(fit.companions[0, 0], [0.34, 0.0, -3.0], atol=0.3)
    assert rss(fit.zernikes[0] - wave[3:]) < 100e-9


def bad_stamps(clean, canvas):
    """Stamps by name, with the flags that they have for sure, and whether there are results."""
    rng, flag = np.random.default_rng(5), pachon.sensing.DonutFlag
    base = noisy(clean, SKY, 3)
    scattered = rng.random((4, *base.shape)) < np.array([0.01, 0.05, 0.1, 0.2])[:, None, None]
    trail = 2000.0 * np.exp(-0.5 * ((0.6 * X + 0.8 * Y) / 1.5) ** 2)
    band = 300.0 * (np.abs(0.6 * X + 0.8 * Y) < 30.0)
    blobs = {rms: np.exp(-0.5 * (X**2 + Y**2) / rms**2) / (2.0 * np.pi * rms**2) for rms in (2.0, 8.0, 20.0)}
    column, rows = np.abs(X + 15.0) < 1.1, Y > -5.0
    cuts = {
        f"{name} beside {x}": np.where(x > X, v, base) for name, v in (("NaN", np.nan), ("0", 0.0)) for x in (-15, -3)
    }
    return {
        "plain": (base, flag.OK, True),
        **{name: (image, flag.CUT_OFF, True) for name, image in cuts.items()},
        "corner": (np.where(X + Y < -30.0, np.nan, base), flag.CUT_OFF, True),
        "NaN over the middle": (np.where(X < 15.0, np.nan, base), flag.NOT_FINITE, False),
        "zeros over the middle": (np.where(X < 15.0, 0.0, base), flag.MOSTLY_LOST, False),
        **{
            f"{name} {bad.mean():.2f}": (np.where(bad, value, base), flag.CLIPPED, True)
            for bad in scattered
            for name, value in (
                ("hot", 2e4),
                ("dead", -SKY),
                ("NaN", np.nan),
                ("any", rng.uniform(-500.0, 5e4, X.shape)),
            )
        },
        "dead column": (np.where(column, -SKY, base), flag.CLIPPED, True),
        "hot column": (np.where(column, 3e4, base), flag.CLIPPED, True),
        "noisy column": (np.where(column, rng.normal(500.0, 800.0, X.shape), base), flag.CLIPPED, True),
        "half a column": (np.where(column & rows, rng.normal(9e3, 90.0, X.shape), base), flag.CLIPPED, True),
        "bleeding": (np.where((column & rows) | (np.hypot(X + 15.0, Y) < 4.0), 9e4, base), flag.CLIPPED, True),
        "flat top": (np.minimum(base, 0.5 * clean.max()), flag.SATURATED, False),
        "all NaN": (np.nan * X, flag.NOT_FINITE, False),
        "all 1e30": (0.0 * X + 1e30, flag.NOT_FINITE, False),
        "all zero": (0.0 * X, flag.NO_DONUT, False),
        "all 1e4": (0.0 * X + 1e4, flag.SATURATED, False),
        "negative": (-np.abs(rng.normal(0.0, 30.0, X.shape)), flag.NO_DONUT, False),
        "ramp": (50.0 * X, flag.OK, False),
        "noisy ramp": (noisy(50.0 * (X + 46.0), SKY, 4), flag.NO_DONUT, False),
        "bowl": (noisy(0.5 * (X**2 + Y**2), SKY, 4), flag.NO_DONUT, False),
        "trail": (noisy(trail, SKY, 4), flag.NO_DONUT, False),
        "wide trail": (noisy(band, SKY, 4), flag.NO_DONUT, False),
        **{f"blob {rms}": (noisy(2e6 * blob, SKY, 4), flag.NO_DONUT, False) for rms, blob in blobs.items()},
        "donut and star": (noisy(clean + np.roll(3e5 * blobs[2.0], (10, -12), (0, 1)), SKY, 4), flag.CLIPPED, True),
        "off by 30": (noisy(canvas.at(15.0, 0.0), SKY, 6), flag.OK, True),
        "cut by the stamp": (noisy(canvas.at(30.0, 0.0), SKY, 6), flag.CUT_OFF, True),
        "wide": (noisy(canvas.at(0.0, 0.0, (71, 110)), SKY, 6), flag.OK, True),
        "even": (noisy(canvas.at(0.0, 0.0, (90, 90)), SKY, 6), flag.OK, True),
        "gain of 1000": (1e3 * base, flag.POOR_FIT, True),
        "gain of 0.001": (1e-3 * base, flag.NO_DONUT, False),
        "gain of 0.1": (0.1 * base, flag.OK, True),
        "sky of 1e5": (np.random.default_rng(3).poisson(clean + 1e5) * 1.0, flag.OK, True),
        "sky of 10 a pixel": (np.random.default_rng(3).poisson(clean + 1500.0 + 10.0 * X) * 1.0, flag.OK, True),
    }


@pytest.mark.slow
def test_bad_stamps_are_flagged_with_their_reason_and_the_others_go_on(behind_focus, wave, clean):
    stamps = bad_stamps(clean, Canvas(behind_focus, wave))
    images = [image for image, _, _ in stamps.values()]
    fit = fitted(behind_focus, images)
    report = dict(zip(stamps, fit.reasons, strict=True))
    assert {name: bool(usable) for name, usable in zip(stamps, fit.usable, strict=True)} == {
        name: usable for name, (_, _, usable) in stamps.items()
    }, report
    lacking = {n: report[n] for (n, (_, f, _)), g in zip(stamps.items(), fit.flags, strict=True) if int(f) & ~int(g)}
    assert lacking == {}
    errors = {n: rss(z - wave[3:]) / rss(e) for n, z, e in zip(stamps, fit.zernikes, fit.errors, strict=True)}
    # Of 19 numbers, whose errors the largest dominate; rays of the image have noise of their own. A gain of 1000 is
    # noise that is 1000 times the claimed variance.
    held = {n: e for n, e in errors.items() if np.isfinite(e) and n != "gain of 1000"}
    assert max(held.values()) < 2.5, held
    assert errors["gain of 1000"] < 2.5 * 1000**0.5 * 10.0
    alone = fitted(behind_focus, images[:1])
    assert alone.zernikes[0].tobytes() == fit.zernikes[0].tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("pixel", [5, 8, 12, 15, 18, 22, 25, 30, 40, 80])
def test_pixels_of_another_size_are_said(behind_focus, clean, pixel):
    fit = fitted(behind_focus, [noisy(clean, SKY, 3)], pixel_size=pixel * 1e-6)
    assert fit.reasons[0]
    assert not fit.usable[0] or pachon.sensing.DonutFlag.OTHER_SIZE & int(fit.flags[0])


@pytest.mark.slow
def test_two_hundred_empty_stamps_of_any_size_have_no_donut(behind_focus):
    lost, sizes = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        level = float(rng.choice([0.0, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6]))
        sky = rng.poisson(level, tuple(rng.integers(24, 130, 2))).astype(float)
        slope = rng.normal(0.0, 0.01 * (1.0 + level)) * np.arange(sky.shape[1])
        gap = np.where(np.arange(sky.shape[1]) < rng.integers(1, 20), np.nan, sky)
        noise = rng.normal(0.0, 1.0 + level, sky.shape)
        image, claimed = (
            (sky, 0.0), (sky, level), (sky - level, level), (noise, 0.0), (sky + slope, level), (gap, level)
        )[seed % 6]  # fmt: skip
        lost.append(fitted(behind_focus, [image], sky_variance=claimed).reasons[0])
        sizes.append(image.size)
    # On a stamp that has less pixels than the ring of a donut nothing could stand out.
    others = [reasons for reasons, n in zip(lost, sizes, strict=True) if "mostly lost" not in reasons or n >= 7000]
    assert all("no donut" in reasons or "not finite" in reasons for reasons in others), others
