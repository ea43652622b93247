"""Fits of donuts: accuracy without noise, honest errors with it, joint fits, and other images than donuts."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, SIZE, WAVELENGTH, blurred, donut, fine_bins, noisy
from scipy.ndimage import gaussian_filter

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.core.plotting import picture_bytes
from pachon.wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance

FIELD = np.deg2rad([0.6, 0.9])
OPTIONS = {"pixel_size": PIXEL, "threads": 1}
#: Images without air, blurred by a pixel as :func:`donut` does by default.
KNOWN_BLUR = pachon.DonutModel(
    air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
)


@pytest.fixture(scope="module")
def wave():
    """Coefficients from j = 1 within the span of Z4 to Z22 [m], 100 nm rms."""
    values = np.zeros(22)
    values[3:] = np.random.default_rng(8).normal(size=19)
    return 100e-9 * values / np.linalg.norm(values)


@pytest.fixture(scope="module")
def clean(behind_focus, wave):
    return donut(behind_focus, FIELD, zernikes=wave, blur=1.0, shift=(0.7, -1.2))


def rss(values):
    return float(np.sqrt((values**2).sum()))


@pytest.mark.long
def test_wavefront_without_noise(behind_focus, wave):
    """The small form of the next test: a few rays, and a blur that hides their lattice."""
    image = donut(behind_focus, FIELD, zernikes=wave, blur=1.0, shift=(0.7, -1.2), rays=1200)
    fit = pachon.fit_donuts(
        behind_focus, image[None], [FIELD], WAVELENGTH, sky_variance=1000.0, model=KNOWN_BLUR, **OPTIONS
    )
    assert fit.reasons == [""]
    # 1.5 nm of 100: rims of 1200 rays across; 1.0 with 1500 of them, 0.5 with 3000, 0.04 with 12 000.
    assert rss(fit.zernikes[0] - wave[3:]) < 3e-9
    np.testing.assert_allclose(fit.center[0], [0.7, -1.2], atol=4e-3)
    assert fit.flux[0] == pytest.approx(5e6, rel=1e-3)


@pytest.fixture(scope="module")
def finely_binned(behind_focus, wave):
    """1e8 rays in twelfths of pixels of 10 um: with a quarter of them their lattice alone leaves 0.5 nm."""
    return fine_bins(behind_focus, FIELD, wave, (0.7, -1.2), 12_000, 2 * SIZE, 0.5 * PIXEL, fine=12)


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0.0, 0.2, 0.5, 1.5, 2.5])
def test_wavefront_without_noise_or_air(behind_focus, wave, finely_binned, blur):
    pixel = 0.5 * PIXEL
    image = blurred(finely_binned, blur, 5e6, fine=12)
    fit = pachon.fit_donuts(
        behind_focus,
        image[None],
        [FIELD],
        WAVELENGTH,
        sky_variance=1000.0,
        model=replace(KNOWN_BLUR, detector=pachon.DonutDetector(pixel_size=pixel, diffusion=blur * pixel)),
        threads=1,
    )
    assert fit.reasons == [""]
    assert rss(fit.zernikes[0] - wave[3:]) < 0.5e-9
    np.testing.assert_allclose(fit.center[0], [0.7, -1.2], atol=4e-3)
    assert fit.flux[0] == pytest.approx(5e6, rel=1e-3)


@pytest.mark.long
def test_sign_and_size_are_those_of_the_opd(behind_focus):
    """A moved camera and a bent mirror: the difference of the coefficients of two telescopes."""
    # Less than 2 nm of it is beyond Z22.
    true = behind_focus.perturbed("Camera", shift=(0.0, 0.0, 10e-6), tilt=(3e-6, 0.0, 0.0))
    before, after = (
        pachon.wavefront_zernikes(t, [FIELD], WAVELENGTH, jmax=22).coefficients[0, 3:] for t in (behind_focus, true)
    )
    image = donut(true, FIELD, blur=1.0, rays=900)
    fit = pachon.fit_donuts(
        behind_focus, image[None], [FIELD], WAVELENGTH, sky_variance=1000.0, model=KNOWN_BLUR, **OPTIONS
    )
    assert after[0] - before[0] > 50e-9
    # Rims of 900 rays across: a quarter of a standard deviation of the noise that is not there.
    np.testing.assert_allclose(fit.zernikes[0], after - before, atol=5e-9)


# Of 19 squares a donut: 228 scatter by 9 %, 608 by 6 %; a chi-square of n pixels, 8281 of them, by 1.6 %.
@pytest.mark.parametrize(
    ("count", "scatter"),
    [pytest.param(12, 0.27, marks=pytest.mark.long), pytest.param(32, 0.15, marks=pytest.mark.slow)],
)
def test_errors_are_those_claimed(behind_focus, clean, count, scatter):
    options = {"sky_variance": 500.0, "model": KNOWN_BLUR, **OPTIONS}
    first = pachon.fit_donuts(behind_focus, clean[None], [FIELD], WAVELENGTH, **options)
    # The model itself is drawn: brute force has noise of its own.
    draws = np.stack([noisy(first.model[0], 500.0, seed) for seed in range(count)])
    fit = pachon.fit_donuts(behind_focus, draws, [FIELD] * count, WAVELENGTH, **options)
    assert fit.usable.all()
    error = fit.zernikes - first.zernikes
    # Draws of one light have in common what lies beyond the fitted terms.
    chi2 = np.einsum("ni,nij,nj->", error, np.linalg.inv(fit.covariance - fit.error_parts.floor), error) / error.size
    assert chi2 == pytest.approx(1.0, abs=scatter)
    np.testing.assert_allclose(fit.chi2 / fit.n_pixels, 1.0, atol=0.05)


@pytest.mark.long
def test_large_aberrations_are_found(behind_focus):
    wave = np.zeros(11)
    wave[[3, 4, 6, 7, 10]] = 800e-9, -900e-9, 700e-9, 500e-9, -200e-9
    image = noisy(donut(behind_focus, FIELD, zernikes=wave, blur=1.0, shift=(2.0, -3.0), size=111), 500.0, 1)
    fit = pachon.fit_donuts(
        behind_focus, image[None], [FIELD], WAVELENGTH, sky_variance=500.0, noll=range(4, 12), **OPTIONS
    )
    assert fit.usable.all()
    assert rss(fit.zernikes[0] - wave[3:]) < 60e-9


@pytest.mark.long
def test_errors_have_the_terms_that_are_left_out(behind_focus, wave, clean):
    """Light with Z4 to Z22 of which Z4 to Z8 are asked for; without noise, so that the error is what is left out."""
    options = {"sky_variance": 500.0, "model": KNOWN_BLUR, **OPTIONS}
    honest, bare = (
        pachon.fit_donuts(behind_focus, clean[None], [FIELD], WAVELENGTH, fit=fit, **options)
        for fit in (pachon.sensing.SingleDonuts(range(4, 9), left_out=rms) for rms in (200e-9, 0.0))
    )

    def chi2(fit, covariance):
        error = fit.zernikes[0] - wave[3:8]
        return float(error @ np.linalg.solve(covariance[0], error))

    assert honest.zernikes.shape == (1, 5)
    # Without noise, a part of the five that noise would make; 1500 by photons where the rest is taken to be zero, which
    # the residuals show.
    assert chi2(honest, honest.covariance) < 5.0
    assert chi2(bare, bare.error_parts.photons) > 100.0
    assert chi2(bare, bare.covariance) < 10.0


@pytest.mark.slow
def test_missing_terms_do_no_harm_where_they_are_expected(behind_focus):
    wave = np.zeros(23)
    wave[22] = 60e-9
    image = donut(behind_focus, FIELD, zernikes=wave)
    plain, guarded = (
        pachon.fit_donuts(
            behind_focus,
            image[None],
            [FIELD],
            WAVELENGTH,
            sky_variance=500.0,
            model=KNOWN_BLUR,
            fit=pachon.sensing.SingleDonuts(higher_order=rms),
            **OPTIONS,
        )
        for rms in (0.0, 50e-9)
    )
    assert rss(plain.zernikes[0]) > 100e-9
    assert rss(guarded.zernikes[0]) < 15e-9


@pytest.mark.slow
def test_higher_terms_of_the_air_are_fitted_and_its_own_are_an_error(behind_focus):
    air = pachon.Atmosphere.from_site("cerro_pachon", 3, exposure=15.0)
    pupil = behind_focus.pupil_diameter, behind_focus.pupil_obscuration
    closed = mean_wavefront_covariance(air, [(0.0, 0.0)], np.arange(4, 56), *pupil)[0, :, 0]
    wave = np.zeros(55)
    # What an exposure has beyond Z22, twice over.
    wave[22:] = 2.0 * np.sqrt(np.diag(closed)[19:]) * np.random.default_rng(4).standard_normal(33)
    image = donut(behind_focus, FIELD, zernikes=wave, rays=800)
    options = {"sky_variance": 500.0, **OPTIONS}
    plain, aware = (
        pachon.fit_donuts(
            behind_focus,
            image[None],
            [FIELD],
            WAVELENGTH,
            # Without the terms, free rims would take up a part of what they make.
            model=replace(
                KNOWN_BLUR,
                air=pachon.DonutAir(fwhm=0.0, atmosphere=turbulence),
                rims=pachon.sensing.DonutRims(search=False),
            ),
            **options,
        )
        for turbulence in (None, air)
    )
    assert aware.zernikes.shape == (1, 19)
    assert rss(aware.zernikes[0]) < 0.5 * rss(plain.zernikes[0])
    # The air's covariance and, beside it, the photons' with free higher terms.
    np.testing.assert_allclose(aware.error_parts.air[0], closed[:19, :19], rtol=1e-12)
    beside = aware.covariance[0] - closed[:19, :19]
    assert np.linalg.eigvalsh(beside).min() > 0.0
    assert 1.0 < np.sqrt(np.trace(beside) / np.trace(plain.error_parts.photons[0])) < 3.0


@pytest.mark.parametrize(
    ("ratio", "offset"),
    [
        pytest.param(0.14, (14.0, 9.0), marks=pytest.mark.long),
        pytest.param(1.0, (-20.0, 12.0), marks=pytest.mark.slow),
        pytest.param(0.3, (35.0, -20.0), marks=pytest.mark.slow),
        # Most of the two overlap.
        pytest.param(0.8, (0.7, -6.4), marks=pytest.mark.slow),
    ],
)
def test_second_stars_are_survived(behind_focus, wave, ratio, offset):
    both = donut(behind_focus, FIELD, zernikes=wave) + ratio * donut(behind_focus, FIELD, zernikes=wave, shift=offset)
    fit = pachon.fit_donuts(
        behind_focus, noisy(both, 500.0, 2)[None], [FIELD], WAVELENGTH, sky_variance=500.0, **OPTIONS
    )
    # Brute force has noise of its own, which for two bright stars is enough for a remark on chi-square.
    assert fit.reasons[0] in ("blended", "blended, poor fit")
    assert fit.companions[0, 0, 0] == pytest.approx(ratio, abs=0.02)
    error = fit.zernikes[0] - wave[3:]
    assert rss(error) < 4.0 * rss(fit.errors[0])


@pytest.mark.slow
def test_second_stars_are_not_searched_for_where_there_are_none(behind_focus, wave):
    both = donut(behind_focus, FIELD, zernikes=wave)
    both = both + 0.3 * donut(behind_focus, FIELD, zernikes=wave, shift=(14.0, 9.0))
    fits = [
        pachon.fit_donuts(
            behind_focus,
            noisy(both, 500.0, 2)[None],
            [FIELD],
            WAVELENGTH,
            sky_variance=500.0,
            model=pachon.DonutModel(neighbours=neighbours, rims=pachon.sensing.DonutRims(search=False)),
            noll=range(4, 12),
            **OPTIONS,
        )
        for neighbours in (True, False)
    ]
    assert fits[0].companions[0, 0, 0] == pytest.approx(0.3, abs=0.03)
    assert np.isnan(fits[1].companions).all()
    # What one star does not explain: a second of 30 % of the light, a hundred times the noise.
    assert not fits[1].flags[0] & pachon.sensing.DonutFlag.BLENDED


@pytest.mark.long
def test_cosmic_rays_are_left_out(behind_focus, wave, clean):
    image = noisy(clean, 500.0, 3)
    image[20:50, 40] += 4000.0
    image[60, 10:30] += 20000.0
    fit = pachon.fit_donuts(behind_focus, image[None], [FIELD], WAVELENGTH, sky_variance=500.0, **OPTIONS)
    assert fit.reasons == ["clipped"]
    assert not fit.used[0, 60, 12:28].any()
    assert rss(fit.zernikes[0] - wave[3:]) < 2.0 * rss(fit.errors[0])


@pytest.mark.long
def test_fits_with_more_than_the_noise_that_is_claimed_are_flagged(behind_focus, clean):
    images = np.array([noisy(clean, 500.0, 7), noisy(clean, 2500.0, 7)])
    fit = pachon.fit_donuts(behind_focus, images, [FIELD] * 2, WAVELENGTH, sky_variance=500.0, **OPTIONS)
    assert fit.reasons == ["", "poor fit"]
    assert fit.usable.all()
    assert fit.chi2[1] > 1.5 * fit.n_pixels[1]


@pytest.mark.long
def test_bad_donuts_are_flagged_and_others_go_on(focused, behind_focus, clean):
    sky = noisy(np.zeros_like(clean), 500.0, 5)
    not_finite = np.where(np.arange(SIZE) < 55, np.nan, clean)
    saturated = np.minimum(4.0 * clean, 2.0 * clean.max())
    wrong_side = donut(focused.perturbed("Detector", shift=(0.0, 0.0, -1.5e-3)), np.deg2rad([0.9, 1.3]))
    mostly_lost = np.zeros_like(clean)
    mostly_lost[:, :-50] = clean[:, 50:]
    images = [clean, not_finite, sky, saturated, mostly_lost, clean, wrong_side, clean * 1e-6]
    fields = np.array([FIELD] * 8)
    fields[5] = np.deg2rad([3.0, 1.0])
    fields[6] = np.deg2rad([0.9, 1.3])
    fit = pachon.fit_donuts(
        behind_focus,
        images,
        fields,
        WAVELENGTH,
        sky_variance=np.array([500.0] * 7 + [1e-4]),
        model=pachon.DonutModel(detector=pachon.DonutDetector(saturation=2.0 * clean.max())),
        **OPTIONS,
    )
    flag = pachon.sensing.DonutFlag
    assert fit.flags[1:7].tolist() == [
        flag.NOT_FINITE,
        flag.NO_DONUT,
        flag.SATURATED,
        flag.MOSTLY_LOST,
        flag.OUTSIDE_FIELD,
        flag.DEFOCUS_SIGN,
    ]
    assert flag.TOO_FEW_PHOTONS & fit.flags[7]
    bad = ~fit.usable
    assert np.isnan(fit.zernikes[bad]).all()
    assert np.isnan(fit.fwhm[bad]).all()
    assert np.isnan(fit.flux[bad]).all()


def empty_stamp(seed):
    """A stamp without a donut, and the variance that is claimed for it: noise, sky left in or taken off."""
    level = (0, 1, 30, 100, 300, 1000, 3000, 10_000, 100_000, 1_000_000)[seed % 10]
    rng = np.random.default_rng(seed)
    sky = rng.poisson(level, (SIZE, SIZE)).astype(float)
    noise = rng.normal(0.0, 1.0 + level, sky.shape)
    return ((sky, 0.0), (sky, level), (sky - level, level), (noise, 0.0))[seed % 4]


@pytest.mark.parametrize(
    "every", [pytest.param(4, marks=pytest.mark.long, id="quarter"), pytest.param(1, marks=pytest.mark.slow, id="all")]
)
def test_empty_stamps_are_flagged_and_the_others_go_on(behind_focus, clean, every):
    flat, rng = np.zeros((SIZE, SIZE)), np.random.default_rng(3)
    hot = flat.copy()
    hot[45, 40] = 1e6
    cloud = gaussian_filter(rng.normal(size=flat.shape), 4.0)
    stamps = [
        *(empty_stamp(seed) for seed in (0, 1, 6, 7)),
        *((flat + level, 0.0) for level in (0.0, 50.0, 1e19, -1e19)),
        (-np.abs(rng.normal(0.0, 10.0, flat.shape)), 0.0),
        *((image, 100.0) for image in (hot, hot + rng.normal(0.0, 10.0, flat.shape))),
        (np.full_like(flat, np.nan), 0.0),
        *((np.full_like(flat, sign * np.inf), 0.0) for sign in (1.0, -1.0)),
        (rng.poisson(1e3 * np.exp(cloud / cloud.std())).astype(float), 1000.0),
    ]
    noise_stamps = 4 // every
    stamps = stamps[::every]
    images = [noisy(clean, 500.0, 3), *(image for image, _ in stamps)]
    variance = np.array([500.0, *(claimed for _, claimed in stamps)])
    options = {"fit": pachon.sensing.SingleDonuts(range(4, 12), left_out=0.0), **OPTIONS}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = pachon.fit_donuts(
            behind_focus, images, [FIELD] * len(images), WAVELENGTH, sky_variance=variance, **options
        )
        # A donut, zeros, and of all stamps the most negative and NaN, or negative ones and infinity.
        assert picture_bytes(fit.plot([0, 5, 8, 12] if every == 1 else [0, 2, 3, 4]), "png")
    assert fit.usable.tolist() == [True] + [False] * len(stamps)
    assert all(fit.reasons[1:])
    of_noise, expected = set(fit.reasons[1 : noise_stamps + 1]), {"no donut", "no donut, too few photons"}
    assert of_noise == expected if every == 1 else of_noise <= expected
    alone = pachon.fit_donuts(behind_focus, images[:1], [FIELD], WAVELENGTH, sky_variance=500.0, **options)
    assert fit.zernikes[0].tobytes() == alone.zernikes[0].tobytes()


@pytest.mark.long
def test_faint_donuts_are_found_whether_the_sky_is_left_in_or_not(behind_focus, clean):
    # Of 5e4 electrons on some 1800 pixels: a signal of 50 times the noise of the sky there.
    images = [noisy(0.01 * clean, 500.0, seed) + left for seed in range(2) for left in (0.0, 500.0)]
    options = {"sky_variance": 500.0, "fit": pachon.sensing.SingleDonuts(range(4, 9), left_out=0.0), **OPTIONS}
    fit = pachon.fit_donuts(behind_focus, images, [FIELD] * 4, WAVELENGTH, **options)
    assert fit.usable.all()
    np.testing.assert_allclose(fit.flux, 5e4, atol=5.0 * fit.flux_error.max())
    np.testing.assert_allclose(fit.background, [0.0, 500.0] * 2, atol=5.0 * 500**0.5 / 40)


@pytest.mark.long
def test_masks_of_booleans_or_of_ones_leave_pixels_out(behind_focus, clean):
    image = noisy(clean, 500.0, 3)
    mask = np.zeros((1, SIZE, SIZE), dtype=bool)
    mask[0, 40:43, 20:70] = True
    spoilt = np.where(mask[0], np.nan, image)
    fits = [
        pachon.fit_donuts(behind_focus, [spoilt], [FIELD], WAVELENGTH, mask=m, sky_variance=500.0, **OPTIONS)
        for m in (mask, mask.astype(int), list(mask))
    ]
    assert fits[0].usable.all()
    assert not fits[0].used[mask].any()
    assert {fit.zernikes.tobytes() for fit in fits} == {fits[0].zernikes.tobytes()}


@pytest.mark.long
def test_a_wavefront_that_explains_the_wrong_side_of_focus_is_not_believed(focused):
    """1.4 um of coma and trefoil make a noisy donut in the corner look like one of the other side."""
    field = np.deg2rad([-1.19, -1.125])
    true = focused.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3)).perturbed("M2", shift=(1e-4, 0.0, 0.0))
    image = noisy(donut(true, field, flux=2e6), 1200.0, 3)
    behind, front = (
        pachon.fit_donuts(
            focused,
            image[None],
            [field],
            WAVELENGTH,
            model=pachon.DonutModel(detector=pachon.DonutDetector(defocus=height)),
            sky_variance=1200.0,
            fit=pachon.sensing.SingleDonuts(higher_order=10e-9),
            **OPTIONS,
        )
        for height in (1.5e-3, -1.5e-3)
    )
    assert behind.usable.all()
    assert front.flags.tolist() == [pachon.sensing.DonutFlag.DEFOCUS_SIGN]


@pytest.mark.long
def test_a_flat_top_is_saturated_without_a_level(behind_focus, clean):
    image = np.minimum(noisy(clean, 500.0, 4), 0.5 * clean.max())
    fit = pachon.fit_donuts(behind_focus, image[None], [FIELD], WAVELENGTH, sky_variance=500.0, **OPTIONS)
    assert fit.flags.tolist() == [pachon.sensing.DonutFlag.SATURATED]


def test_no_light_passes_a_closed_telescope(behind_focus, clean):
    closed = replace(
        behind_focus,
        surfaces=tuple(
            replace(s, aperture=pachon.models.Annulus(1.0, 1.0001)) if s.name == "M1" else s
            for s in behind_focus.surfaces
        ),
    )
    fit = pachon.fit_donuts(closed, clean[None], [FIELD], WAVELENGTH, **OPTIONS)
    assert fit.flags.tolist() == [pachon.sensing.DonutFlag.NO_LIGHT]


@pytest.mark.slow
def test_degrees_of_freedom_of_all_donuts_together(focused):
    freedoms = pachon.load_degrees_of_freedom("lsst").select(
        ["M2_dz", "M2_dx", "M2_ry", "Camera_dz", "Camera_dy", "M1M3_B2", "M1M3_B6"]
    )
    values = np.array([10.0, 150.0, 3.0, -8.0, 400.0, 0.1, -0.05])
    prior = np.array([40.0, 400.0, 10.0, 30.0, 1000.0, 0.3, 0.3])
    true = freedoms.apply(focused, values)
    fields = np.deg2rad([[1.15, 1.15], [-1.15, 1.15], [1.15, -1.15], [-1.15, -1.15]])
    defocus = np.array([1.5e-3, -1.5e-3, -1.5e-3, 1.5e-3])
    images = np.stack(
        [
            noisy(donut(true.perturbed("Detector", shift=(0.0, 0.0, d)), f), 500.0, i)
            for i, (f, d) in enumerate(zip(fields, defocus, strict=True))
        ]
    )
    fit = pachon.fit_donuts(
        focused,
        images,
        fields,
        WAVELENGTH,
        sky_variance=500.0,
        model=pachon.DonutModel(detector=pachon.DonutDetector(defocus=defocus)),
        fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=prior),
        **OPTIONS,
    )
    estimate = fit.degrees_of_freedom
    error = estimate.values - values
    assert error @ np.linalg.solve(estimate.covariance, error) < 20.0  # 7 degrees of freedom; 1 in 200 beyond
    ratio, _ = estimate.combinations()
    assert ratio[0] < 0.01
    assert (np.diff(ratio) >= 0.0).all()
    assert ratio[-1] < 1.0
    expected = [pachon.wavefront_zernikes(t, fields, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (focused, true)]
    assert rss(fit.zernikes - expected[1] + expected[0]) < 4.0 * rss(fit.errors)
    json.dumps(fit.summary())
    assert estimate.plot().axes


@pytest.mark.slow
def test_double_zernikes_and_stars_in_focus(focused):
    """A wavefront that is linear over the field: donuts on both sides of focus, and a star in focus."""
    fields = np.deg2rad([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.3, 0.3]])
    defocus = np.array([1.5e-3, -1.5e-3, 1.5e-3, 0.0])
    double = np.zeros((3, 11))
    double[0, [4, 7]], double[1, 3] = (60e-9, -50e-9), 40e-9
    radius = focused.field_radius
    over_field = np.stack([np.ones(4), 2.0 * fields[:, 0] / radius, 2.0 * fields[:, 1] / radius])
    waves = over_field.T @ double
    images = [
        noisy(donut(focused.perturbed("Detector", shift=(0.0, 0.0, d)), f, zernikes=w), 500.0, i)
        for i, (f, d, w) in enumerate(zip(fields, defocus, waves, strict=True))
    ]
    # A small stamp does for a star in focus.
    images[3] = images[3][25:-25, 25:-25]
    fit = pachon.fit_donuts(
        focused,
        images,
        fields,
        WAVELENGTH,
        sky_variance=500.0,
        model=replace(KNOWN_BLUR, detector=pachon.DonutDetector(diffusion=PIXEL, defocus=defocus)),
        fit=pachon.sensing.FieldTerms([1, 2, 3], noll=range(4, 12)),
        **OPTIONS,
    )
    assert fit.double_zernikes.shape == (3, 8)
    error = (fit.double_zernikes - double[:, 3:]).ravel()
    assert error @ np.linalg.solve(fit.double_zernike_covariance, error) / error.size < 2.5
    assert fit.images.shape == (4, SIZE, SIZE)
    assert np.isnan(fit.images[3, -1, -1])


@pytest.mark.long
def test_results_do_not_depend_on_threads_or_on_other_donuts(behind_focus, clean):
    images = np.stack([noisy(clean, 500.0, seed) for seed in range(3)])
    options = {"pixel_size": PIXEL, "sky_variance": 500.0, "noll": range(4, 12)}
    many = pachon.fit_donuts(behind_focus, images, [FIELD] * 3, WAVELENGTH, threads=2, **options)
    one = pachon.fit_donuts(behind_focus, images[1:2], [FIELD], WAVELENGTH, threads=1, **options)
    np.testing.assert_array_equal(many.zernikes[1], one.zernikes[0])
    np.testing.assert_array_equal(many.model[1], one.model[0])


@pytest.mark.long
def test_stamps_without_the_light_of_their_donuts_are_lost(behind_focus, clean):
    """All pixels masked, and a stamp that lies within its donut: these were said to be no donuts."""
    middle = slice(len(clean) // 2 - 10, len(clean) // 2 + 10)
    images = [noisy(clean, 500.0, 3), noisy(clean, 500.0, 4)[middle, middle]]
    masks = [np.ones_like(image, dtype=bool) * (k == 0) for k, image in enumerate(images)]
    fit = pachon.fit_donuts(behind_focus, images, [FIELD] * 2, WAVELENGTH, mask=masks, **OPTIONS)
    assert fit.reasons == ["mostly lost", "mostly lost"]


@pytest.mark.long
def test_tables_summaries_and_pictures(behind_focus, clean):
    images = np.stack([clean, np.full_like(clean, np.nan)])
    fit = pachon.fit_donuts(
        behind_focus, images, [FIELD] * 2, WAVELENGTH, sky_variance=500.0, noll=range(4, 12), **OPTIONS
    )
    table = fit.to_table()
    assert len(table) == 2
    assert table["Z4"].unit == "nm"
    assert table["reasons"].tolist() == ["ok", "not finite"]
    text = json.loads(json.dumps(fit.summary(), allow_nan=False))
    assert text["zernike_nm"][1] == [None] * 8
    np.testing.assert_allclose(fit.residuals[0], fit.images[0] - fit.model[0])
    figure = fit.plot()
    assert len(figure.axes) >= 7
    assert ": donuts at" in figure.get_suptitle()
    assert ": 1 of 2 donuts at" in fit.plot([0]).get_suptitle()
    # The legend hides no bar, and what was not fitted of a large stamp is cut off.
    figure.canvas.draw()
    (bars,) = (axes for axes in figure.axes if axes.get_legend())
    assert bars.get_legend().get_window_extent().y0 >= bars.get_window_extent().y1
    columns = np.flatnonzero(np.isfinite(fit.model[0]).any(axis=0))
    assert figure.axes[0].get_xlim() == (columns[0] - 8, columns[-1] + 8)


@pytest.mark.long
def test_pictures_of_counts_have_the_noise_of_the_fit(behind_focus, clean):
    """Each star has its own scale from its background on, whatever the unit; the level of a bias was light before."""
    image = noisy(clean, 500.0, 3)
    images = [image, 0.4 * image + 1000.0]
    fit = pachon.fit_donuts(behind_focus, images, [FIELD] * 2, WAVELENGTH, noll=range(4, 12), **OPTIONS)
    drawn = [np.asarray(axes.images[0].get_array()) for axes in fit.plot().axes if axes.images]
    for k in (0, 1):
        assert np.median(drawn[k][:8]) == pytest.approx(0.0, abs=0.05)
        assert np.percentile(drawn[k], 99.5) == pytest.approx(1.0, abs=0.01)
        assert np.nanstd(drawn[4 + k]) == pytest.approx(np.sqrt(fit.chi2[k] / fit.n_pixels[k]), abs=0.1)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"images": np.zeros((3, 4))}, "images of shape"),
        ({"fields": [[0.0, 0.0], [0.0, 0.0]]}, "fields of shape"),
        ({"wavelength": 3e-6}, "wavelength"),
        ({"noll": [3, 4]}, "noll = "),
        ({"sky_variance": -1.0}, "sky_variance"),
        ({"sky_variance": np.ones(5)}, "sky_variance of shape"),
        ({"pixel_size": 0.0}, "pixel_size"),
        ({"model": pachon.DonutModel(air=pachon.DonutAir(fwhm=[1e-6, 1e-6]))}, "fwhm of shape"),
        ({"model": pachon.DonutModel(detector=pachon.DonutDetector(defocus=[1e-3, 1e-3]))}, "defocus of shape"),
        ({"noll": None, "fit": pachon.sensing.FieldTerms([1, 2, 3])}, "field_noll: 3 terms for 1"),
        (
            {
                "noll": None,
                "fit": pachon.sensing.FieldTerms([1]),
                "model": pachon.DonutModel(
                    air=pachon.DonutAir(atmosphere=pachon.Atmosphere.from_site("cerro_pachon", 3))
                ),
            },
            "atmosphere: expected fits",
        ),
        ({"fit": pachon.sensing.SingleDonuts()}, "noll and fit are both given"),
        ({"model": pachon.DonutModel(light=pachon.Light(WAVELENGTH))}, "wavelength and the light of the model"),
        (
            {"wavelength": pachon.Light([WAVELENGTH], dispersion=[(0.0, 1e-6)])},
            "dispersion of the light: expected none",
        ),
        ({"wavelength": pachon.Light(WAVELENGTH, weights=[1.0, 2.0])}, "weights = .*: expected 1 numbers"),
        ({"prior": 1.0}, r"prior: no argument of fit_donuts; expected fit=TelescopeFreedoms\(freedoms, prior="),
        ({"defocus": 1e-3}, r"defocus: .*; expected model=DonutModel\(detector=DonutDetector\(defocus="),
        ({"mask": np.zeros((1, 9, 9), dtype=bool)}, "mask of shape"),
        ({"mask": [np.zeros((9, 9), dtype=bool)]}, "mask of shape"),
        ({"mask": np.full((1, SIZE, SIZE), 0.5)}, r"mask.* = .*: expected an array of True and False"),
    ],
)
def test_bad_arguments(behind_focus, clean, changes, text):
    arguments = {
        "images": clean[None],
        "fields": [FIELD],
        "wavelength": WAVELENGTH,
        "noll": [4],
        "sky_variance": 500.0,
        **OPTIONS,
    }
    with pytest.raises((DomainError, ConfigError), match=text) as error:
        pachon.fit_donuts(behind_focus, **{**arguments, **changes})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        (pachon.DonutAir, {"fwhm": -1.0}, "fwhm = -1"),
        (pachon.DonutAir, {"fwhm": [1e-6, np.nan]}, "fwhm = "),
        (pachon.DonutAir, {"outer_scale": 0.0}, "outer_scale"),
        (pachon.DonutDetector, {"pixel_size": 0.0}, "pixel_size"),
        (pachon.DonutDetector, {"diffusion": -1e-6}, "diffusion"),
        (pachon.DonutDetector, {"defocus": 1.0}, "defocus: expected at most"),
        (pachon.DonutDetector, {"saturation": -1.0}, "saturation"),
        (pachon.DonutModel, {"n_pupil": 3}, "n_pupil"),
        (pachon.sensing.SingleDonuts, {"higher_order": -1.0}, "higher_order"),
        (pachon.sensing.SingleDonuts, {"left_out": 1.0}, "left_out"),
        (pachon.sensing.SingleDonuts, {"noll": [4, 4]}, "noll = "),
        (pachon.sensing.FieldTerms, {"field_noll": [0, 1]}, "field_noll = "),
    ],
)
def test_bad_options(kind, changes, text):
    with pytest.raises(DomainError, match=text):
        kind(**changes)


@pytest.mark.slow
def test_heights_of_ccds_and_several_wavelengths(behind_focus, clean):
    """A CCD that stands 30 um too high is a detector 30 um farther, whichever argument says so."""
    options = {"sky_variance": 500.0, "noll": range(4, 9), **OPTIONS}
    plane = pachon.FocalPlane.flat("lsst").with_moved("R32", dz=30e-6).with_moved("R33", dz=30e-6)
    on_plane = replace(KNOWN_BLUR, detector=pachon.DonutDetector(diffusion=PIXEL, focal_plane=plane))
    defocused = replace(KNOWN_BLUR, detector=pachon.DonutDetector(diffusion=PIXEL, defocus=30e-6))
    higher, moved, colours = (
        pachon.fit_donuts(behind_focus, clean[None], [FIELD], w, model=model, **options)
        for w, model in (
            (WAVELENGTH, on_plane),
            (WAVELENGTH, defocused),
            ([560e-9, WAVELENGTH, 680e-9], KNOWN_BLUR),
        )
    )
    np.testing.assert_allclose(higher.zernikes, moved.zernikes, atol=1e-10)
    # 158 nm of Z4 for 10 um, as batoid has it.
    nominal = pachon.fit_donuts(behind_focus, clean[None], [FIELD], WAVELENGTH, model=KNOWN_BLUR, **options)
    assert nominal.zernikes[0, 0] - higher.zernikes[0, 0] == pytest.approx(3 * 158e-9, rel=0.02)
    # The LSST's focus differs by some micrometres over the r band.
    assert rss(colours.zernikes - nominal.zernikes) < 60e-9
    between = pachon.fields_at(behind_focus, [(0.0635, 0.0)], WAVELENGTH)  # two rafts
    gap = pachon.fit_donuts(behind_focus, clean[None], between, WAVELENGTH, model=on_plane, **options)
    assert gap.reasons == ["no light"]
