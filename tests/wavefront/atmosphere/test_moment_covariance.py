"""Covariances of the moments of images by turbulence, against sums restated here and Monte Carlo of a small pupil."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.special import j0, j1

from pachon.core.units import ARCMIN, ARCSEC
from pachon.wavefront.atmosphere.layer_screens import SLOPE_LAG
from pachon.wavefront.atmosphere.moment_covariance import ExposedAir, MomentResponse, as_matrices, moment_covariance
from pachon.wavefront.atmosphere.slope_covariance import slope_covariance
from pachon.wavefront.atmosphere.turbulence import diffraction_otf, path_spectrum, slope_variance

R0, L0, CUTOFF = 0.16, 25.0, 8.75
#: A small pupil under two layers: few points sample it densely.
AIR = ExposedAir(
    altitudes=(0.0, 8000.0),
    weights=(0.6, 0.4),
    velocities=((2.4, 0.9), (-1.5, 3.3)),
    exposure=5.0,
    r0=R0,
    outer_scale=L0,
    cutoff=CUTOFF,
    diameter=1.6,
    obscuration=0.3,
)


@cache
def plain_sums():
    """Distances [m], and A and B of the slopes there by a plain sum over frequencies."""
    nu = np.linspace(1e-4, CUTOFF / (2 * math.pi), 2000)
    k = 2 * math.pi * nu
    power = path_spectrum(nu, R0, L0) * (k * np.sinc(nu * SLOPE_LAG)) ** 2 * 2 * math.pi * nu * (nu[1] - nu[0])
    distance = np.concatenate([np.linspace(1e-6, 2.0, 81), np.linspace(2.1, 16.0, 140)])
    x = k * distance[:, None]
    return distance, 0.5 * j0(x) @ power, -0.5 * (2.0 * j1(x) / x - j0(x)) @ power


def slope_matrices(apart):
    """Covariances of slopes of points `apart` [..., 2] [m], [..., 2, 2]."""
    distance, a, b = plain_sums()
    rho, phi = np.hypot(apart[..., 0], apart[..., 1]), np.arctan2(apart[..., 1], apart[..., 0])
    same, other = np.interp(rho, distance, a), np.interp(rho, distance, b)
    out = np.empty((*rho.shape, 2, 2))
    out[..., 0, 0], out[..., 1, 1] = same + other * np.cos(2 * phi), same - other * np.cos(2 * phi)
    out[..., 0, 1] = out[..., 1, 0] = other * np.sin(2 * phi)
    return out


def pupil_points(spacing):
    line = spacing * (np.arange(40) - 19.5)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    radius = np.hypot(*grid.T)
    return grid[(radius < 0.5 * AIR.diameter) & (radius > 0.5 * AIR.obscuration * AIR.diameter)]


def between_stars(lag, points, times):
    """Covariance of the slopes of two stars at every point and time, [n, n, 2, 2]."""
    place, time = np.tile(points, (len(times), 1)), np.repeat(times, len(points))
    total = np.zeros((len(place), len(place), 2, 2))
    for altitude, weight, velocity in zip(AIR.altitudes, AIR.weights, AIR.velocities, strict=True):
        apart = place[:, None] - place - altitude * np.array(lag) - np.multiply.outer(time[:, None] - time, velocity)
        total += weight * slope_matrices(apart)
    return total


def moments_of(samples):
    """p, q, s of slopes [draw, n, 2] about their means."""
    centred = samples - samples.mean(axis=1, keepdims=True)
    xx, yy, xy = ((centred[..., i] * centred[..., j]).mean(axis=1) for i, j in ((0, 0), (1, 1), (0, 1)))
    return np.stack([xx - yy, 2 * xy, xx + yy])


def wick(covariance):
    """Covariance of p, q, s of two stars: traces of products of the centred covariances of their slopes."""
    centred = covariance - covariance.mean(axis=0, keepdims=True)
    centred = centred - centred.mean(axis=1, keepdims=True)
    n = len(covariance)
    m = np.einsum("abij,abkl->ikjl", centred, centred) / n**2
    # m[i, k, j, l]: mean of S_ij S_kl; cov(M_ik, M'_jl) adds the exchange of j and l.
    pair = m + m.swapaxes(2, 3)
    weights = np.array([[[1, 0], [0, -1]], [[0, 1], [1, 0]], [[1, 0], [0, 1]]], dtype=float)
    return np.einsum("cik,ikjl,djl->cd", weights, pair, weights)


@pytest.mark.parametrize("cutoff", [4.0, CUTOFF])
def test_variance_of_slopes_is_the_closed_form(cutoff):
    """At no distance, the variance of a slope by another quadrature."""
    table = slope_covariance(R0, L0, cutoff)
    assert table.isotropic[0] == pytest.approx(slope_variance(R0, L0, cutoff, SLOPE_LAG), rel=1e-6, abs=0.0)


def test_slopes_at_a_distance():
    """Bessel integrals by a plain sum; below a thousandth of the variance the tables end."""
    table = slope_covariance(R0, L0, CUTOFF)
    for distance in (0.3, 1.0, 4.0, 12.0):
        k = round(distance / table.step)
        expected = slope_matrices(np.array([distance, 0.0]))
        got = table.isotropic[k] + np.array([1.0, -1.0]) * table.directed[k] * distance**2
        # A plain sum of 6000 steps is good to 1e-4 of the variance, its table to 2e-3.
        assert got == pytest.approx(np.diag(expected), abs=2e-3 * table.isotropic[0])


@pytest.mark.long
def test_wick_against_monte_carlo():
    """The traces restated here are those of drawn Gaussian slopes of two stars: 10 000 draws, five standard errors."""
    points, times = pupil_points(0.5), np.array([0.0, 0.9, 2.0])
    lag = (20 * ARCSEC, -10 * ARCSEC)
    blocks = [[between_stars(d, points, times) for d in row] for row in (((0, 0), lag), ((-lag[0], -lag[1]), (0, 0)))]
    n = len(points) * len(times)
    joint = np.block([[b.transpose(0, 2, 1, 3).reshape(2 * n, 2 * n) for b in row] for row in blocks]) / ARCSEC**2
    root = np.linalg.cholesky(joint + 1e-9 * np.eye(len(joint)))
    drawn = (root @ np.random.default_rng(1).standard_normal((len(joint), 10_000))).T.reshape(-1, 2, n, 2)
    first, second = moments_of(drawn[:, 0]), moments_of(drawn[:, 1])
    products = (first - first.mean(axis=1, keepdims=True))[:, None] * (second - second.mean(axis=1, keepdims=True))
    error = products.std(axis=2) / math.sqrt(10_000)
    expected = wick(blocks[0][1] / ARCSEC**2)
    assert np.all(np.abs(products.mean(axis=2) - expected) < 5 * error)


@pytest.mark.long
@pytest.mark.parametrize(
    "lag", [(0.0, 0.0), pytest.param((30 * ARCSEC, 0.0), marks=pytest.mark.slow), (-20 * ARCSEC, 40 * ARCSEC)]
)
def test_against_sums_over_a_small_pupil(lag):
    """The mean over pupil and delays is a double sum over all points and moments of the exposure.

    Points 0.25 m apart and 40 moments are finer than the slopes change: 2 % of the largest covariance for both
    samplings.
    """
    points = pupil_points(0.25)
    times = AIR.exposure * (np.arange(40) + 0.5) / 40
    expected = wick(between_stars(lag, points, times))
    got = as_matrices(moment_covariance(AIR, np.array([lag])).second)[0]
    assert got == pytest.approx(expected, abs=0.02 * expected[2, 2])


@pytest.mark.long
@pytest.mark.parametrize("lag", [(0.0, 0.0), (-20 * ARCSEC, 40 * ARCSEC)])
def test_higher_orders_against_sums_over_a_small_pupil(lag):
    """Parts of (n.S n')^N/N! that go as cos 2phi, sin 2phi and no angle, by sums over six directions each.

    At N = 2 these are the moments of the second order, p and q by a factor of 64, s of 16. A slope of the optics in any
    direction, of covariance C, takes the place of one of four: (n.S n')^3/3! n.n' C/2.
    """
    line = 0.1 * (np.arange(32) - 15.5)
    baseline = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    distance = np.hypot(*baseline.T)
    delay = AIR.exposure * ((np.arange(160) + 0.5) / 80 - 1.0)
    weight = np.outer(AIR.exposure - np.abs(delay), diffraction_otf(distance, AIR.diameter, AIR.obscuration))
    weight /= weight.sum()
    aberration = np.array([3.0, 1.0, -1.0, -2.0]) * ARCSEC**2
    of_optics = np.interp(distance, AIR.diameter * np.arange(4) / 3, aberration)
    slopes = np.zeros((*weight.shape, 2, 2))
    for altitude, share, velocity in zip(AIR.altitudes, AIR.weights, AIR.velocities, strict=True):
        drift = np.multiply.outer(delay, velocity)[:, None]
        slopes += share * slope_matrices(baseline - altitude * np.array(lag) - drift)
    angles = np.pi * np.arange(6) / 6
    means = np.zeros((4, 3))
    for phi in angles:
        along = slopes @ [np.cos(phi), np.sin(phi)]
        for psi in angles:
            projected = along @ [np.cos(psi), np.sin(psi)]
            factors = np.array([np.cos(2 * phi) * np.cos(2 * psi), np.sin(2 * phi) * np.sin(2 * psi), 0.25]) * 64 / 36
            for row, order in enumerate((2, 4, 6)):
                means[row] += factors * np.sum(weight * projected**order) / math.factorial(order)
            means[3] += factors * np.sum(weight * projected**3 * of_optics) * np.cos(phi - psi) / 12
    covariance = moment_covariance(AIR, np.array([lag]), tuple(aberration))
    got = np.array([covariance.second[0, :3], *covariance.higher[:, 0]])
    # By default pytest takes numbers below 1e-12 for equal. The mean slope, which takes a part of the second order, is
    # left in these sums.
    assert got[1:] == pytest.approx(means[1:], rel=0.03, abs=0.0)
    assert np.all(got[0] < means[0])


def test_lit_pairs_make_a_smaller_pupil():
    """Baselines of a pupil three quarters as wide, which dark rims leave of the whole one."""
    small = AIR._replace(diameter=1.2, obscuration=0.4)
    distance = np.linspace(0.0, AIR.diameter, 161)
    pairs = diffraction_otf(distance, 1.2, 0.4) / np.maximum(diffraction_otf(distance, 1.6, 0.3), 1e-9)
    lags = np.array([[0.0, 0.0], [30.0, -20.0]]) * ARCSEC
    expected = moment_covariance(small, lags).second
    got = moment_covariance(AIR, lags, lit=tuple(0.5 * pairs)).second
    whole = moment_covariance(AIR, lags).second
    # The lattice of baselines is finer for the smaller pupil.
    assert got == pytest.approx(expected, abs=0.02 * expected[0, 2])
    assert whole[0, 2] < 0.9 * got[0, 2]


def test_covariances_are_even_and_of_one_process():
    """A lag and its opposite have the same covariances, and stars far apart share what the ground layer does alone."""
    lags = np.array([[0.0, 0.0], [1.0, 0.5], [-1.0, -0.5], [300.0, 0.0]]) * ARCMIN
    second = moment_covariance(AIR, lags).second
    # The lattices of baselines differ from one delay to its opposite.
    assert second[1] == pytest.approx(second[2], abs=0.01 * second[0, 2])
    ground = moment_covariance(AIR.on_ground(), lags[:1]).second[0]
    # 300 arcmin are 700 m at 8 km: nothing of the upper layer is shared. Without it the delays are others.
    assert second[3] == pytest.approx(ground, abs=5e-3 * second[0, 2])
    assert np.all(np.abs(second[1:, :3]) < second[0, :3])


def test_bytes_do_not_depend_on_threads():
    lags = np.random.default_rng(0).uniform(-1e-3, 1e-3, (6, 2))
    one, two = (moment_covariance(AIR, lags, threads=n) for n in (1, 2))
    assert one.second.tobytes() == two.second.tobytes()
    assert one.higher.tobytes() == two.higher.tobytes()


def test_response_of_a_gaussian():
    """Of a Gaussian image of variance s2 under a Gaussian weight w2: e and ln size in closed form.

    Q = s2 w2 / (s2 + w2) along each axis, e = (Qx - Qy) / (2 (Qx + Qy)).
    """
    sigma, weight = 0.35, 0.3
    k = np.linspace(0.0, 6.0 / weight, 4000)
    response = MomentResponse.of(k, np.exp(-0.5 * sigma**2 * k**2), weight)

    def narrowed(variance):
        return variance * weight**2 / (variance + weight**2)

    step = 1e-5
    qx, qy = narrowed(sigma**2 + 0.5 * step), narrowed(sigma**2 - 0.5 * step)
    assert response.ellipticity == pytest.approx(0.5 * (qx - qy) / (qx + qy) / step, rel=1e-4)
    q1, q2 = narrowed(sigma**2 + 0.5 * step), narrowed(sigma**2)
    assert response.ln_size == pytest.approx(0.5 * math.log(q1 / q2) / step, rel=1e-4)
    # The weighted transfer function is a Gaussian of variance s2 + w2: J6 / J4 = 6 / (s2 + w2), J8 / J6 a third more.
    total = sigma**2 + weight**2
    assert response.higher_ellipticity == pytest.approx((6.0 / total, 48.0 / total**2), rel=1e-4)
    # A round change of the image that goes as k^4 or k^6 of the weighted transfer function.
    step, power = 1e-7, np.exp(-0.5 * total * k**2)
    for order, expected in ((4, response.higher_size[0]), (6, response.higher_size[1])):
        sizes = []
        for change in (0.0 * k, step * k**order, step * k**2):
            j0, j2 = (np.sum(power * (1.0 + change) * k**n) for n in (1, 3))
            sizes.append(math.log(weight**2 - 0.5 * weight**4 * j2 / j0))
        assert (sizes[1] - sizes[0]) / (sizes[2] - sizes[0]) == pytest.approx(expected, rel=1e-3)
