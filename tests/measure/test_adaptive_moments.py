"""Adaptive moments: Gaussians in closed form, the definition restated, GalSim's HSM, masks, errors, failures."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError

SCALE = 1e-6  # rad
NUMBERS = ("g1", "g2", "sigma", "rho4", "flux", "x", "y")


def gaussian(side, xx, xy, yy, x0=0.0, y0=0.0):
    """Return an elliptical Gaussian of unit flux, sampled at the centres of pixels."""
    y, x = np.mgrid[:side, :side] - 0.5 * (side - 1)
    x, y = x - x0, y - y0
    det = xx * yy - xy**2
    return np.exp(-0.5 * (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / det) / (2.0 * np.pi * np.sqrt(det))


def star(side=33, x0=0.0, y0=0.0):
    """Return a star with wings, whose inner and outer parts have different ellipses."""
    return (
        0.6 * gaussian(side, 2.2, 0.3, 1.9, x0, y0)
        + 0.3 * gaussian(side, 5.0, -0.4, 6.0, x0, y0)
        + 0.1 * gaussian(side, 14.0, 1.0, 12.0, x0 + 0.4, y0)
    )


def test_of_a_gaussian_they_are_its_own():
    xx, xy, yy, x0, y0 = 6.0, -1.1, 4.0, 0.37, -0.71
    moments = pachon.adaptive_moments(1e3 * gaussian(41, xx, xy, yy, x0, y0), SCALE)
    root = np.sqrt(xx * yy - xy**2)
    norm = xx + yy + 2.0 * root
    # Sums over pixels stand for integrals to 2 exp(-2 pi^2 2), 1e-17: what remains is the edge of the weight, 2e-8.
    assert moments.g1[0] == pytest.approx((xx - yy) / norm, abs=1e-8)
    assert moments.g2[0] == pytest.approx(2.0 * xy / norm, abs=1e-8)
    assert moments.sigma[0] == pytest.approx(np.sqrt(root) * SCALE, rel=1e-7)
    assert moments.T[0] == pytest.approx((xx + yy) * SCALE**2, rel=1e-7)
    assert moments.e1[0] == pytest.approx((xx - yy) / (xx + yy), abs=1e-8)
    assert moments.e2[0] == pytest.approx(2.0 * xy / (xx + yy), abs=1e-8)
    assert moments.rho4[0] == pytest.approx(2.0, abs=1e-5)  # 36^2 exp(-36), times the step of the edge
    assert moments.flux[0] == pytest.approx(1e3, rel=1e-6)
    assert (moments.x[0], moments.y[0]) == pytest.approx((x0, y0), abs=1e-8)


@pytest.mark.parametrize("g", [0.02, 0.1])
def test_a_shear_of_a_round_image_is_its_g(g):
    # A round profile sheared along 30 degrees: x -> S^-1 x leaves circles as ellipses of (a - b)/(a + b) = g.
    angle = np.deg2rad(30.0)
    y, x = np.mgrid[:61, :61] - 30.0
    c, s = g * np.cos(2.0 * angle), g * np.sin(2.0 * angle)
    u, v = ((1.0 - c) * x - s * y, -s * x + (1.0 + c) * y)
    r2 = (u**2 + v**2) / (1.0 - g**2)
    moffat = (1.0 + r2 / 4.0**2) ** -3.0
    moments = pachon.adaptive_moments(moffat, SCALE)
    # The profile is so wide that its pixels are as good as a continuous image.
    assert (moments.g1[0], moments.g2[0]) == pytest.approx((c, s), abs=1e-6)


def test_they_solve_their_equations():
    image = star(x0=0.21, y0=-0.34)
    m = pachon.adaptive_moments(image, SCALE)
    sigma, g1, g2 = m.sigma[0] / SCALE, m.g1[0], m.g2[0]
    trace = 2.0 * sigma**2 / (1.0 - g1**2 - g2**2)
    xx, yy = (0.5 * trace * (1.0 + g1**2 + g2**2 + sign * 2.0 * g1) for sign in (1.0, -1.0))
    xy = trace * g2
    y, x = np.mgrid[:33, :33] - 16.0
    x, y = x - m.x[0], y - m.y[0]
    det = xx * yy - xy**2
    rho2 = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / det
    light = np.exp(-0.5 * rho2) * image
    total = light.sum()
    assert np.sqrt(np.sqrt(det)) == pytest.approx(sigma, rel=1e-12)  # sqrt(a b)
    for value in ((light * x).sum(), (light * y).sum()):
        assert value / total == pytest.approx(0.0, abs=1e-6)
    for product, moment in ((x * x, xx), (x * y, xy), (y * y, yy)):
        assert 2.0 * (light * product).sum() / total == pytest.approx(moment, abs=1e-6)
    assert m.rho4[0] == pytest.approx((light * rho2**2).sum() / total, abs=1e-5)
    assert m.flux[0] == pytest.approx(2.0 * total, rel=1e-6)


def test_flips_shifts_and_units():
    image = star()
    first = pachon.adaptive_moments(image, SCALE)
    variants = np.stack([image.T, image[:, ::-1], np.roll(image, (2, -1), axis=(0, 1)), 7.0 * image])
    m = pachon.adaptive_moments(variants, 3.0 * SCALE)
    np.testing.assert_allclose(m.g1, first.g1 * [-1.0, 1.0, 1.0, 1.0], atol=1e-7)
    np.testing.assert_allclose(m.g2, first.g2 * [1.0, -1.0, 1.0, 1.0], atol=1e-7)
    np.testing.assert_allclose(m.sigma, 3.0 * first.sigma[0], rtol=1e-7)
    assert m.x[2] - first.x[0] == pytest.approx(-1.0, abs=1e-6)
    assert m.y[2] - first.y[0] == pytest.approx(2.0, abs=1e-6)
    assert m.flux[3] == pytest.approx(7.0 * first.flux[0], rel=1e-9)


def test_batches_and_threads_change_no_byte():
    rng = np.random.default_rng(4)
    images = star() + 1e-4 * rng.normal(size=(7, 33, 33))
    weight = np.full((33, 33), 1e8)
    together = pachon.adaptive_moments(images, SCALE, weight=weight, threads=3).to_table()
    for i, image in enumerate(images):
        alone = pachon.adaptive_moments(image, SCALE, weight=weight, threads=1).to_table()
        assert [name for name in alone.colnames if alone[name][0] != together[name][i]] == []


def test_pixels_without_light_are_those_of_a_mask():
    image, mask = star(), np.zeros((33, 33), dtype=bool)
    mask[15, 17] = mask[3, 4] = mask[20, :] = True
    expected = pachon.adaptive_moments(image, SCALE, mask)
    for value in (np.nan, np.inf, -1e30):
        m = pachon.adaptive_moments(np.where(mask, value, image), SCALE)
        assert (m.g1, m.sigma) == (expected.g1, expected.sigma)
    weighted = pachon.adaptive_moments(np.where(mask, 1e6, image), SCALE, weight=np.where(mask, 0.0, 1e4))
    assert (weighted.g2, weighted.flux) == (expected.g2, expected.flux)


def test_a_masked_core_of_a_gaussian_costs_nothing():
    image, mask = gaussian(41, 6.0, -1.1, 4.0, 0.37, -0.71), np.zeros((41, 41), dtype=bool)
    mask[19:21, 20:22] = mask[24] = True
    whole = pachon.adaptive_moments(image, SCALE)
    filled = pachon.adaptive_moments(image, SCALE, mask)
    for name in NUMBERS:
        np.testing.assert_allclose(getattr(filled, name), getattr(whole, name), rtol=1e-5, atol=1e-6, err_msg=name)
    zeros = pachon.adaptive_moments(image, SCALE, mask, fill_masked=False)
    assert abs(zeros.g1 - whole.g1)[0] > 0.01


@pytest.mark.long
def test_errors_are_the_scatter_of_noisy_images():
    count, rng = 1500, np.random.default_rng(8)
    image, mask = 2e4 * star(), np.zeros((33, 33), dtype=bool)
    mask[14:16, 17:19] = True
    variance = 30.0 + image
    images = image + rng.normal(size=(count, 33, 33)) * np.sqrt(variance)
    for masked, fill in ((None, True), (mask, True)):
        m = pachon.adaptive_moments(images, SCALE, masked, 1.0 / variance, fill_masked=fill)
        assert m.usable.all()
        for name in ("g1", "g2", "sigma", "flux", "x", "y"):
            scatter, error = getattr(m, name).std(), np.median(getattr(m, f"error_{name}"))
            # The rms of 1500 has an error of 1.8 %, and S/N 100 makes terms of second order of 2 %.
            assert scatter == pytest.approx(error, rel=0.08), name


def test_errors_of_stars_half_as_wide_as_their_stamps():
    """The Gaussian goes on beyond the stamp, as in HSM: errors were a tenth too large, of Moffat profiles a quarter."""
    image = 1e7 * gaussian(61, 162.0, -10.0, 160.0, 0.3, -0.4)
    variance = 25.0 + image
    images = image + np.random.default_rng(3).normal(size=(400, 61, 61)) * np.sqrt(variance)
    m = pachon.adaptive_moments(images, SCALE, weight=1.0 / variance)
    assert m.usable.all()
    for name in ("g1", "g2", "sigma", "flux", "x", "y"):
        # The rms of 400 has an error of 3.5 %.
        scatter, error = getattr(m, name).std(), np.median(getattr(m, f"error_{name}"))
        assert scatter == pytest.approx(error, rel=0.1), name


def test_failures_are_flagged():
    y, x = np.mgrid[:21, :21] - 10.0
    images = np.zeros((7, 21, 21))
    images[1] = -gaussian(21, 3.0, 0.0, 3.0)
    images[2] = np.nan
    images[3] = 1.0  # no maximum
    images[4] = x**2 + y**2  # a hole
    images[5, 10, 10] = 1.0  # a hot pixel
    images[6] = 1e-320
    m = pachon.adaptive_moments(images, SCALE, weight=np.ones((21, 21)))
    assert (m.flags != 0).all()
    assert m.flags[:3].tolist() == [pachon.measure.MomentFlag.NO_FLUX] * 3
    assert np.isnan([getattr(m, name) for name in NUMBERS]).all()
    mask = np.hypot(x, y) < 3.0
    assert (
        pachon.adaptive_moments(gaussian(21, 3.0, 0.0, 3.0), SCALE, mask).flags[0] == pachon.measure.MomentFlag.MASKED
    )
    assert len(pachon.adaptive_moments(np.empty((0, 21, 21)), SCALE)) == 0
    # Five pixels of a star of one pixel's width do not determine six numbers.
    few = np.zeros((5, 5))
    few[2, 1:4] = few[1:4, 2] = 1.0
    for fill in (True, False):
        m = pachon.adaptive_moments(
            gaussian(5, 0.5, 0.0, 0.5), SCALE, weight=few, fill_masked=fill, start_sigma=0.7 * SCALE
        )
        assert np.isfinite([m.g1, m.error_g1]).all() == (m.flags[0] == 0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mask": np.zeros((5, 5), bool)}, r"mask has shape \(5, 5\): expected \(1, 33, 33\)"),
        ({"weight": np.ones((2, 33, 33))}, r"weight has shape \(2, 33, 33\): expected \(1, 33, 33\)"),
        ({"weight": -np.ones((33, 33))}, "weight: the least is -1"),
        ({"weight": np.zeros((33, 33))}, "weight is 0 in all pixels"),
        ({"weight": np.full((33, 33), np.inf)}, "weight has infinite values"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"start_sigma": -1.0}, "start_sigma"),
    ],
)
def test_bad_input(options, words):
    with pytest.raises(DomainError, match=words):
        pachon.adaptive_moments(star(), SCALE, **options)


def hsm(galsim, images, weight=None):
    """Return the numbers of GalSim's adaptive moments [7, n] in units of pixels; NaN where it fails.

    By its default threshold, 1e-6, HSM ends 1e-5 from the solution of its equations on a masked, noisy stamp of 10 000.
    """
    converged, rows = galsim.hsm.HSMParams(convergence_threshold=1e-7), []
    for i, image in enumerate(images):
        good = None if weight is None else galsim.ImageD(weight[i].astype(float))
        try:
            m = galsim.hsm.FindAdaptiveMom(
                galsim.ImageD(np.ascontiguousarray(image), scale=1.0), good, hsmparams=converged
            )
        except galsim.GalSimHSMError:
            rows.append([np.nan] * 7)
            continue
        shape, center = m.observed_shape, m.moments_centroid
        middle = 0.5 * (np.array(image.shape[::-1]) + 1.0)
        rows.append(
            [
                shape.g1,
                shape.g2,
                m.moments_sigma,
                m.moments_rho4,
                m.moments_amp,
                center.x - middle[0],
                center.y - middle[1],
            ]
        )
    return np.array(rows).T


def psfs(galsim, count, seed):
    """Return drawn stars [count, 33, 33]: airy patterns, turbulence and both, sheared, off the centre."""
    rng = np.random.default_rng(seed)
    images = []
    for i in range(count):
        air = galsim.Kolmogorov(fwhm=rng.uniform(0.45, 1.1))
        optics = galsim.Airy(lam=620.0, diam=8.36 * rng.uniform(0.4, 1.0), obscuration=0.61)
        profile = (optics, air, galsim.Convolve(air, optics))[i % 3]
        profile = profile.shear(g1=rng.normal(0.0, 0.04), g2=rng.normal(0.0, 0.04))
        offset = rng.uniform(-0.5, 0.5, 2)
        scale = 0.006 if i % 3 == 0 else 0.2
        images.append(profile.drawImage(nx=33, ny=33, scale=scale, offset=offset, dtype=float).array)
    return np.array(images)


def differences(m, theirs):
    """Return the largest differences of g, ln sigma, rho4/2, ln flux and the centroid [pixel]."""
    ours = np.array([getattr(m, name) for name in NUMBERS])
    same = np.isfinite(ours[0]) & np.isfinite(theirs[0])
    ours, theirs = ours[:, same], theirs[:, same]
    relative = np.abs(ours / theirs - 1.0)
    return {
        "g": np.abs(ours - theirs)[:2].max(),
        "sigma": relative[2].max(),
        "rho4": relative[3].max(),
        "flux": relative[4].max(),
        "centroid": np.abs(ours - theirs)[5:].max(),
    }


def test_hsm_on_stars_noise_and_masks():
    galsim = pytest.importorskip("galsim")
    images = psfs(galsim, 12, 1)
    rng = np.random.default_rng(2)
    noisy = images + rng.normal(size=images.shape) * 0.02 * images.max(axis=(1, 2), keepdims=True)
    mask = rng.random(images.shape) < 0.05
    for m, theirs in (
        (pachon.adaptive_moments(images, 1.0), hsm(galsim, images)),
        (pachon.adaptive_moments(noisy, 1.0), hsm(galsim, noisy)),
        (pachon.adaptive_moments(images, 1.0, mask, fill_masked=False), hsm(galsim, images, ~mask)),
    ):
        assert np.isfinite(theirs[0]).sum() >= 10
        np.testing.assert_array_equal(m.usable, np.isfinite(theirs[0]))
        assert max(differences(m, theirs).values()) < 1e-5


@pytest.mark.slow
def test_hsm_on_ten_thousand_stamps():
    galsim = pytest.importorskip("galsim")
    images = psfs(galsim, 5000, 11)
    rng = np.random.default_rng(12)
    noise = rng.normal(size=images.shape) * images.max(axis=(1, 2), keepdims=True)
    noise *= 10.0 ** rng.uniform(-3.0, -1.7, (len(images), 1, 1))  # S/N 1000 to 20 or so
    noisy = images + noise
    mask = rng.random(images.shape) < 0.03
    for m, theirs in (
        (pachon.adaptive_moments(images, 1.0), hsm(galsim, images)),
        (pachon.adaptive_moments(noisy, 1.0), hsm(galsim, noisy)),
        (pachon.adaptive_moments(noisy, 1.0, mask, fill_masked=False), hsm(galsim, noisy, ~mask)),
    ):
        # Where noise decides whether the iteration ends, one of them may give up.
        assert (m.usable != np.isfinite(theirs[0])).mean() < 2e-3
        assert max(differences(m, theirs).values()) < 1e-5
    # Filled pixels: nearer to the unmasked star than zeros are.
    whole = hsm(galsim, images)
    errors = {}
    for fill in (True, False):
        m = pachon.adaptive_moments(images, 1.0, mask, fill_masked=fill)
        errors[fill] = np.sqrt(np.nanmedian((np.array([m.g1, m.g2]) - whole[:2]) ** 2))
    assert errors[True] < 0.1 * errors[False]
