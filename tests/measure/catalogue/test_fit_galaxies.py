"""Fits of galaxies: exact recovery, the minimum of a brute-force fit, errors of the Fisher matrix, flags, bad input."""

import numpy as np
import pytest
from astropy.table import Table
from scipy.optimize import least_squares

import pachon
from pachon.core.table_files import write_table
from pachon.measure.catalogue.galaxy_fits import GalaxyFlag
from pachon.measure.catalogue.levenberg_marquardt import LevenbergMarquardt

galsim = pytest.importorskip("galsim")

TRUE = {"flux": 900.0, "x": 0.3, "y": -0.2, "size": 2.0, "e1": 0.2, "e2": -0.1}


@pytest.fixture(scope="module")
def galaxy(render):
    return render(
        galsim.Gaussian(sigma=TRUE["size"], flux=TRUE["flux"]).shear(g1=TRUE["e1"], g2=TRUE["e2"]),
        32,
        TRUE["x"],
        TRUE["y"],
    )


def with_noise(stamp, count, sigma, seed):
    return stamp + np.random.default_rng(seed).normal(0.0, sigma, (count, *stamp.shape))


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        for name in ("flux", "x", "y", "moments", "covariance", "chi2", "pixels", "evaluations", "flags")
    )


def test_gaussians_are_recovered(gaussians, psf):
    # GalSim's own accuracy, and the PSF cut off at 16 pixels, are 1e-6.
    stamps, true = gaussians
    fits = pachon.measure.fit_galaxy_stamps(stamps, 1.0, psf)
    assert fits.good.all()
    for name, values in true.items():
        scale = values if name in ("flux", "size") else 1.0
        np.testing.assert_allclose(getattr(fits, name) / scale, values / scale, rtol=0, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("side", [31, 33, 45])
def test_stamps_of_any_side(render, psf, side):
    stamp = render(galsim.Gaussian(sigma=1.5, flux=3.0).shear(g1=0.1, g2=0.3), side, 0.2, -0.1)
    fits = pachon.measure.fit_galaxy_stamps(stamp[None], 1.0, psf)
    found = [fits.flux, fits.x, fits.y, fits.size, fits.e1, fits.e2]
    np.testing.assert_allclose(np.ravel(found), [3.0, 0.2, -0.1, 1.5, 0.1, 0.3], rtol=0, atol=1e-5)


def test_without_psf_the_adaptive_moments_of_galsim():
    # Of a Gaussian, the best-fitting Gaussian and the adaptive moments (HSM) are the same.
    profile = galsim.Gaussian(sigma=2.1, flux=7.0).shear(g1=0.15, g2=-0.2).shift(0.3, 0.1)
    image = profile.drawImage(nx=32, ny=32, scale=1.0, method="no_pixel", dtype=float)
    moments = galsim.hsm.FindAdaptiveMom(image)
    fits = pachon.measure.fit_galaxy_stamps(image.array[None], 1.0, np.ones((1, 1)))
    shape = moments.observed_shape
    found = [fits.e1[0], fits.e2[0], fits.size[0], fits.flux[0]]
    expected = [shape.g1, shape.g2, moments.moments_sigma, moments.moments_amp]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)  # HSM stops at 1e-6 of its moments
    np.testing.assert_allclose(found, [0.15, -0.2, 2.1, 7.0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("profile", ["gaussian", pytest.param("exponential", marks=pytest.mark.slow)])
def test_the_minimum_is_that_of_a_brute_force_fit(profile, galaxy, render, psf):
    # Restated in flux, centre, ln size and ellipticity, with numerical derivatives, on a grid of another period.
    period, side = 81, 32
    k = 2.0 * np.pi * np.fft.fftfreq(period)
    kx, ky = np.meshgrid(k, k)
    at = np.arange(33) - 16
    transform = np.exp(-1j * np.outer(k, at)) @ psf @ np.exp(-1j * np.outer(at, k))
    to_pixels = np.exp(1j * np.outer(np.arange(side) - 15.5, k)) / period
    noise = 2.5
    variance = noise**2 * (1.0 + 0.5 * np.random.default_rng(5).uniform(size=(side, side)))
    if profile == "exponential":  # which no model fits
        galaxy = render(galsim.Exponential(half_light_radius=2.4, flux=TRUE["flux"]).shear(g1=0.2, g2=-0.1))
    stamps = with_noise(galaxy, 4, noise, 6)
    masked = np.zeros(stamps.shape, dtype=bool)
    masked[:, 3:12, 20:25] = True

    def residuals(p, stamp):
        flux, x0, y0, log_size, e1, e2 = p
        e = np.hypot(e1, e2)
        shear = np.array([[1.0 + e1, e2], [e2, 1.0 - e1]]) / np.sqrt(1.0 - e**2)
        (xx, xy), (_, yy) = np.exp(2.0 * log_size) * shear @ shear
        spectrum = transform * np.exp(-0.5 * (xx * kx**2 + 2 * xy * kx * ky + yy * ky**2) - 1j * (kx * x0 + ky * y0))
        model = flux * (to_pixels @ spectrum @ to_pixels.T).real
        return ((stamp - model) / np.sqrt(variance))[~masked[0]]

    fits = pachon.measure.fit_galaxy_stamps(stamps, np.broadcast_to(variance, stamps.shape), psf, mask=masked)
    assert fits.good.all()
    start = [*(TRUE[name] for name in ("flux", "x", "y")), np.log(TRUE["size"]), TRUE["e1"], TRUE["e2"]]
    for i, stamp in enumerate(stamps):
        best = least_squares(residuals, start, args=(stamp,), xtol=1e-12, ftol=1e-12, gtol=1e-12, x_scale="jac")
        found = [fits.flux[i], fits.x[i], fits.y[i], np.log(fits.size[i]), fits.e1[i], fits.e2[i]]
        scale = [TRUE["flux"], 1, 1, 1, 1, 1]
        np.testing.assert_allclose(np.divide(found, scale), best.x / scale, rtol=0, atol=1e-4)
        assert fits.chi2[i] == pytest.approx(2.0 * best.cost, rel=1e-8)
        assert fits.pixels[i] == (~masked[0]).sum()


def test_errors_are_the_scatter_of_noise_realisations(galaxy, psf):
    # Standard deviations of 1000 are known to 2.2 %; the Fisher matrix is that of large S/N.
    noise = 1.0
    fits = pachon.measure.fit_galaxy_stamps(with_noise(galaxy, 1000, noise, 7), noise**2, psf)
    assert fits.good.all()
    assert 60.0 < np.median(fits.snr) < 100.0
    for name in ("flux", "x", "y", "size", "e1", "e2"):
        scatter = getattr(fits, name).std(ddof=1)
        assert np.median(getattr(fits, f"{name}_error")) == pytest.approx(scatter, rel=0.07), name
    assert fits.chi2_per_pixel.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 1024 / 1000))


def test_errors_of_galaxies_that_no_model_fits(render, psf):
    # By the Fisher matrix the variance of e is 1.3 times too small, and that of the size 1.7 times.
    galaxy = render(galsim.Sersic(2.5, half_light_radius=3.0, flux=TRUE["flux"]).shear(g1=0.2, g2=-0.1))
    stamps = with_noise(galaxy, 1000, 0.6, 8)
    fisher, fits = (
        pachon.measure.fit_galaxy_stamps(stamps, 0.6**2, psf, solver=LevenbergMarquardt(whole_errors=whole))
        for whole in (False, True)
    )
    assert np.array_equal(fits.moments, fisher.moments)
    for name, least in (("flux", 1.1), ("size", 1.25), ("e1", 1.1), ("e2", 1.1)):
        scatter = getattr(fits, name).std(ddof=1)
        assert np.median(getattr(fits, f"{name}_error")) == pytest.approx(scatter, rel=0.06), name
        assert scatter > least * np.median(getattr(fisher, f"{name}_error")), name


def test_same_bytes_on_any_threads_and_in_any_part(galaxy, psf):
    stamps = with_noise(galaxy, 37, 8.0, 8)
    whole = pachon.measure.fit_galaxy_stamps(stamps, 64.0, psf, threads=1)
    assert same(whole, pachon.measure.fit_galaxy_stamps(stamps, 64.0, psf, threads=3))
    for i in (0, 17, 36):
        alone = pachon.measure.fit_galaxy_stamps(stamps[i : i + 1], 64.0, np.stack([psf]), threads=2)
        part = {name: getattr(whole, name)[i : i + 1] for name in ("flux", "moments", "covariance", "chi2")}
        for name, values in part.items():
            assert np.array_equal(getattr(alone, name), values), name


def test_unit_of_the_image_does_not_matter(galaxy, psf):
    stamps = with_noise(galaxy, 5, 5.0, 9)
    one = pachon.measure.fit_galaxy_stamps(stamps, 25.0, psf)
    other = pachon.measure.fit_galaxy_stamps(1e-3 * stamps, 25e-6, psf)
    np.testing.assert_allclose(other.flux, 1e-3 * one.flux, rtol=1e-9)
    np.testing.assert_allclose(other.e1, one.e1, rtol=0, atol=1e-9)
    assert np.array_equal(other.evaluations, one.evaluations)


def test_point_like_galaxies_have_covariances_about_zero(render, psf):
    star = render(galsim.DeltaFunction(flux=3000.0))
    fits = pachon.measure.fit_galaxy_stamps(with_noise(star, 200, 2.0, 10), 4.0, psf)
    assert not (fits.flags & GalaxyFlag.NOT_CONVERGED).any()
    error = fits.moments.std(axis=0) / np.sqrt(200)
    assert (np.abs(fits.moments.mean(axis=0)) < 3.5 * error).all()
    assert np.median(np.sqrt(fits.covariance[:, 3, 3])) == pytest.approx(fits.moments[:, 0].std(), rel=0.15)
    unresolved = (fits.flags & GalaxyFlag.UNRESOLVED) != 0
    assert 0.4 < unresolved.mean() < 0.95  # both eigenvalues must be positive
    assert np.isnan(fits.e1[unresolved]).all()
    assert np.isfinite(fits.e1[~unresolved]).all()


def blended(galaxy):
    """An image with a galaxy at (40.3, 29.8), a brighter one beside it, and the segmentation of both."""
    image = np.zeros((64, 80))
    image[14:46, 24:56] += galaxy
    image[20:52, 33:65] += 5.0 * galaxy
    segmentation = np.zeros(image.shape, dtype=np.int32)
    yy, xx = np.indices(image.shape)
    segmentation[np.hypot(xx - 39.8, yy - 29.3) < 5.0] = 1
    segmentation[(np.hypot(xx - 48.8, yy - 35.3) < 12.0) & (segmentation == 0)] = 2
    return image, segmentation


def test_positions_in_an_image(galaxy, psf):
    image = np.zeros((70, 90))
    image[20:52, 37:69] = galaxy
    fits = pachon.fit_galaxies(image, np.ones(image.shape), [52.0], [36.0], psf, half_light_radius=3.0)
    # The centre of the stamp is at (37 + 15.5, 20 + 15.5).
    np.testing.assert_allclose([fits.x[0], fits.y[0]], [52.8, 35.3], rtol=0, atol=1e-5)
    np.testing.assert_allclose(fits.flux, TRUE["flux"], rtol=1e-4)
    assert fits.flags[0] == 0


def test_neighbours_are_masked_by_the_segmentation(galaxy, psf):
    image, segmentation = blended(galaxy)
    options = {"half_light_radius": 3.0}
    arguments = image, np.ones(image.shape), [39.8], [29.3], psf
    alone = pachon.fit_galaxies(*arguments, segmentation=segmentation, **options)
    both = pachon.fit_galaxies(*arguments, **options)
    assert abs(alone.flux[0] / TRUE["flux"] - 1.0) < 0.2
    assert both.flux[0] > 2.0 * TRUE["flux"]
    assert alone.pixels[0] < both.pixels[0] == 32 * 32


def test_large_galaxies_get_large_stamps(psf):
    side = 160
    image = galsim.Convolve(galsim.Gaussian(sigma=7.0, flux=100.0), galsim.Gaussian(sigma=2.0)).drawImage(
        nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float
    )
    round_psf = galsim.Gaussian(sigma=2.0).drawImage(nx=31, ny=31, scale=1.0, method="no_pixel", dtype=float).array
    at = [79.5], [79.5]
    fits = pachon.fit_galaxies(image.array, np.ones((side, side)), *at, round_psf, half_light_radius=8.6)
    assert fits.pixels[0] == 96**2
    np.testing.assert_allclose([fits.size[0], fits.flux[0]], [7.0, 100.0], rtol=1e-4)
    unknown = pachon.fit_galaxies(image.array, np.ones((side, side)), *at, round_psf, half_light_radius=np.nan)
    assert unknown.pixels[0] == 32**2
    cut = pachon.fit_galaxies(image.array, np.ones((side, side)), *at, round_psf, half_light_radius=30.0)
    assert cut.flags[0] == GalaxyFlag.CUT_OFF
    assert cut.pixels[0] == 128**2


def test_a_psf_for_each_galaxy(render, psf):
    turned = np.rot90(psf).copy()
    profile = galsim.Gaussian(sigma=1.8, flux=5.0).shear(g1=0.2, g2=0.1)
    stamp = render(profile)
    # The whole image rotated by 90 degrees: PSF and ellipticity rotate with it.
    fits = pachon.measure.fit_galaxy_stamps([stamp, np.rot90(stamp)], 1.0, [psf, turned])
    np.testing.assert_allclose(fits.e1, [0.2, -0.2], rtol=0, atol=1e-5)
    np.testing.assert_allclose(fits.e2, [0.1, -0.1], rtol=0, atol=1e-5)
    both = pachon.measure.fit_galaxy_stamps([stamp, np.rot90(stamp)], 1.0, [turned, psf], psf_index=[1, 0])
    assert same(both, fits)


def test_faint_galaxies_converge(galaxy, psf):
    # S/N of 8: steps with the Fisher matrix alone took 13.9 models, and left half of the galaxies unfinished after 12.
    noise = 9.0
    stamps = with_noise(galaxy, 400, noise, 12)
    fits = pachon.measure.fit_galaxy_stamps(stamps, noise**2, psf)
    assert 6.0 < np.median(fits.snr) < 10.0
    assert (fits.flags & GalaxyFlag.NOT_CONVERGED == 0).all()
    assert fits.evaluations.mean() < 11.0
    short = pachon.measure.fit_galaxy_stamps(stamps, noise**2, psf, solver=LevenbergMarquardt(max_evaluations=12))
    assert (short.flags & GalaxyFlag.NOT_CONVERGED > 0).mean() < 0.1
    # The same minima as from many steps more.
    long = pachon.measure.fit_galaxy_stamps(stamps, noise**2, psf, solver=LevenbergMarquardt(300, 1e-8))
    both = fits.good & long.good
    lower = fits.chi2[both] - long.chi2[both]
    assert np.median(np.abs(lower)) < 1e-6
    assert np.percentile(np.abs(lower), 98) < 1e-4


def test_fits_begin_near_earlier_ones(galaxy, psf):
    stamps = with_noise(galaxy, 50, 4.0, 13)
    other = np.rot90(psf).copy()
    first = pachon.measure.fit_galaxy_stamps(stamps, 16.0, other)
    cold, warm = (pachon.measure.fit_galaxy_stamps(stamps, 16.0, psf, start=start) for start in (None, first))
    assert warm.evaluations.sum() < 0.9 * cold.evaluations.sum()
    both = cold.good & warm.good
    assert both.mean() > 0.9
    np.testing.assert_allclose(warm.e1[both], cold.e1[both], rtol=0, atol=1e-4)
    with pytest.raises(pachon.errors.DomainError, match="start: 50 fits of 3 galaxies"):
        pachon.measure.fit_galaxy_stamps(stamps[:3], 16.0, psf, start=first)


def test_flags(galaxy, psf):
    image = np.zeros((64, 64))
    image[16:48, 16:48] = galaxy
    variance = np.ones(image.shape)
    at, options = ([31.8], [31.3]), {"half_light_radius": 3.0}

    def flags(**more):
        return pachon.fit_galaxies(image, variance, *at, psf, **(options | more)).flags[0]

    assert flags() == 0
    assert flags(solver=LevenbergMarquardt(max_evaluations=2)) & GalaxyFlag.NOT_CONVERGED
    mask = np.zeros(image.shape, dtype=int)
    mask[24:40, 24:27] = 4  # 48 of the 256 pixels in the inner half
    assert flags(mask=mask) == GalaxyFlag.OK
    mask[24:40, 24:29] = 4  # 80 of them
    assert flags(mask=mask) == GalaxyFlag.MASKED
    assert flags(mask=np.ones(image.shape)) & (GalaxyFlag.MASKED | GalaxyFlag.NOT_CONVERGED)
    for part, x, y in ((np.s_[20:], 31.8, 11.3), (np.s_[:44], 31.8, 31.3), (np.s_[:, 20:], 11.8, 31.3)):
        edge = pachon.fit_galaxies(image[part], variance[part], [x], [y], psf, **options)
        assert edge.flags[0] == GalaxyFlag.EDGE
        assert edge.flux[0] == pytest.approx(TRUE["flux"], rel=1e-3)
        assert edge.pixels[0] < 32**2
    assert pachon.fit_galaxies(-image, variance, *at, psf, **options).flags[0] & GalaxyFlag.NO_FLUX
    # An image sharper than the PSF allows: the bound is reached.
    point = np.zeros((1, 32, 32))
    point[0, 15, 15] = 10.0
    assert pachon.measure.fit_galaxy_stamps(point, 1.0, psf).flags[0] & GalaxyFlag.AT_BOUNDS


def test_masked_pixels_may_hold_anything(galaxy, psf):
    stamps, mask = galaxy[None].copy(), np.zeros((1, 32, 32), dtype=bool)
    mask[0, 4, 5:8] = True
    variance = np.ones(stamps.shape)
    before = pachon.measure.fit_galaxy_stamps(stamps, variance, psf, mask=mask)
    stamps[mask], variance[mask] = [np.nan, np.inf, 1e30], [-1.0, np.nan, 0.0]
    assert same(before, pachon.measure.fit_galaxy_stamps(stamps, variance, psf, mask=mask))


def test_usable_galaxies_are_large_and_well_measured(galaxy, psf):
    stamps = np.concatenate([with_noise(galaxy, 2, 1.0, 12), with_noise(galaxy, 2, 60.0, 13)])
    fits = pachon.measure.fit_galaxy_stamps(stamps, np.repeat([1.0, 3600.0], 2)[:, None, None] * np.ones((32, 32)), psf)
    error = np.sqrt(0.5 * (fits.e1_error**2 + fits.e2_error**2))
    assert (error[:2] < 0.2).all()
    assert not (error[2:] < 0.2).any()
    usable = pachon.measure.usable_galaxies(fits, [2.5, 2.3, 2.5, 2.5], [1.9, 2.0, 2.1])  # 1.2 times 2.0 is 2.4
    assert usable.tolist() == [True, False, False, False]
    assert pachon.measure.usable_galaxies(fits, [2.5] * 4, 2.0, least_ratio=1.3).sum() == 0
    assert pachon.measure.usable_galaxies(fits, [np.nan] * 4, 2.0).sum() == 0


def test_tables_have_units_and_descriptions(galaxy, psf, tmp_path):
    fits = pachon.measure.fit_galaxy_stamps(with_noise(galaxy, 3, 1.0, 14), 1.0, psf)
    write_table(tmp_path / "fits.ecsv", fits.table())
    table = Table.read(tmp_path / "fits.ecsv", format="ascii.ecsv")
    assert table["size"].unit == "pix"
    assert all(table[name].description for name in table.colnames)
    for name in ("x", "flux_error", "size", "e1", "e2_error", "chi2_per_pixel", "flags"):
        assert np.array_equal(table[name], getattr(fits, name)), name
    assert np.array_equal(table["cxy"], fits.moments[:, 1])


def test_no_galaxies(psf):
    fits = pachon.fit_galaxies(np.zeros((9, 9)), np.ones((9, 9)), [], [], psf, half_light_radius=1.0)
    assert len(fits) == 0
    assert len(fits.table()) == 0


def test_pixels_without_weight_have_no_say(psf):
    """Masks, numbers that are none, -1e30 and infinite variance are the same: as the mask alone, tested above."""
    rng = np.random.default_rng(12)
    y, x = np.indices((40, 50))
    image = 100.0 * np.exp(-0.5 * ((x - 24.0) ** 2 + (y - 20.0) ** 2) / 3.0**2) + rng.normal(size=(40, 50))
    variance, bad = np.full(image.shape, 1.0), rng.uniform(size=image.shape) < 0.1
    options = {"x": [24.0], "y": [20.0], "psf_images": psf, "half_light_radius": 3.5}
    masked = pachon.fit_galaxies(np.where(bad, 1e6, image), variance, mask=bad, **options)
    for other_image, other_variance in (
        (np.where(bad, np.nan, image), variance),
        (np.where(bad, -1e30, image), variance),
        (np.where(bad, 1e6, image), np.where(bad, np.inf, variance)),
    ):
        fits = pachon.fit_galaxies(other_image, other_variance, **options)
        assert fits.moments.tobytes() == masked.moments.tobytes()
        assert fits.pixels == masked.pixels
        stamps = pachon.measure.fit_galaxy_stamps(other_image[None], other_variance[None], psf)
        assert stamps.pixels[0] == (~bad).sum()
    complete = pachon.fit_galaxies(image, variance, **options)
    assert abs(masked.e1[0] - complete.e1[0]) < complete.e1_error[0]


IMAGE = np.zeros((40, 50))
DOT = np.ones((1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"variance": np.ones((40, 51))}, r"variance has shape \(40, 51\): expected \(40, 50\)"),
        ({"mask": np.zeros((4, 5))}, r"mask has shape \(4, 5\): expected \(40, 50\)"),
        ({"segmentation": np.zeros((40, 50))}, "segmentation has shape .* float64: expected integers"),
        ({"image": np.zeros(9)}, r"image has shape \(9,\): expected \[ny, nx\]"),
        ({"image": "sky"}, "image = 'sky': expected real numbers"),
        ({"variance": IMAGE}, r"variance\[0, 0\] = 0: expected positive where the mask is zero"),
        ({"x": [50.0]}, r"x, y \[0\] = \(50, 8\): expected a position in the image"),
        ({"x": [np.nan]}, r"x, y \[0\] = \(nan, 8\)"),
        ({"x": [1.0, 2.0]}, "x and y have shapes"),
        ({"half_light_radius": 0.0}, "half_light_radius: expected positive"),
        ({"half_light_radius": [1.0, 2.0]}, "half_light_radius: expected one number or 1"),
        ({"psf_images": np.full((4, 4), 1 / 16)}, "odd m"),
        ({"psf_images": np.full((3, 3), 0.1)}, r"psf_images\[0\] has a sum of 0.9: expected 1"),
        ({"psf_images": np.full((3, 3), np.nan)}, "has a sum of nan"),
        ({"psf_images": np.ones((2, 1, 1))}, "psf_images: 2 for 1 galaxy"),
        ({"psf_index": [1]}, "psf_index: 1 to 1, expected 0 to 0"),
        ({"psf_index": [0.0]}, r"psf_index has shape \(1,\) and type float64: expected 1 integers"),
    ],
)
def test_bad_input_is_one_clear_line(change, message):
    good = {"image": IMAGE, "variance": np.ones((40, 50)), "x": [9.0], "y": [8.0], "psf_images": DOT}
    with pytest.raises(pachon.errors.DomainError, match=message) as caught:
        pachon.fit_galaxies(**(good | {"half_light_radius": 2.0} | change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0], 2.0), r"half_light_radius has shape \(1,\): expected \(0,\)"),
        (([], []), "at least one star"),
        (([], [0.0]), "expected positive numbers"),
    ],
)
def test_bad_limits_of_usable_galaxies(arguments, message):
    none = pachon.fit_galaxies(IMAGE, np.ones((40, 50)), [], [], DOT, half_light_radius=1.0)
    with pytest.raises(pachon.errors.DomainError, match=message):
        pachon.measure.usable_galaxies(none, *arguments)
