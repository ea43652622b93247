"""Zernikes of the mean wavefront of an exposure: Noll's closed forms, the law of long exposures, frozen flow."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.core.errors import DomainError
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.mean_wavefront import covariance_by_wavefront, mean_wavefront_covariance
from pachon.wavefront.atmosphere.moment_covariance import ExposedAir
from pachon.wavefront.atmosphere.turbulence import path_spectrum

NOLL = np.arange(4, 23)
DIAMETER, OBSCURATION = 8.36, 0.61


def air(**options):
    return Atmosphere.from_site("cerro_pachon", 3, r0=0.16, **options)


def test_short_exposures_have_the_variances_of_noll():
    # Noll 1976, Table IV: residuals after j terms; Kolmogorov turbulence, full aperture, in rad^2 of (D/r0)^(5/3).
    residual = {3: 0.134, 4: 0.111, 5: 0.0880, 6: 0.0648, 7: 0.0587, 8: 0.0525, 9: 0.0463, 10: 0.0401, 11: 0.0377}
    instant = replace(air(outer_scale=1e7), exposure=0.0)
    found = mean_wavefront_covariance(instant, [(0.0, 0.0)], np.arange(4, 12), DIAMETER, 0.0)[0, :, 0]
    radians = np.diag(found) * (2.0 * np.pi / 500e-9) ** 2 / (DIAMETER / 0.16) ** (5.0 / 3.0)
    expected = -np.diff(list(residual.values()))
    # The table has three digits of each residual.
    assert radians == pytest.approx(expected, abs=1.1e-3)
    assert radians[0] == pytest.approx(0.0232, rel=0.01)
    # Noll's Table: Z5 goes with Z13 of the same order, none with another.
    both = mean_wavefront_covariance(instant, [(0.0, 0.0)], [5, 6, 7, 13], DIAMETER, 0.0)[0, :, 0]
    assert both[0, 3] < -0.1 * np.sqrt(both[0, 0] * both[3, 3])
    assert abs(both[0, 1]) < 1e-3 * both[0, 0]
    assert abs(both[0, 2]) < 1e-3 * both[0, 0]


def test_variances_fall_as_one_over_long_times():
    times = np.array([15.0, 60.0])
    long = [
        mean_wavefront_covariance(replace(air(), exposure=t), [(0, 0)], NOLL[:3], DIAMETER, OBSCURATION) for t in times
    ]
    variance = np.array([np.trace(c[0, :, 0]) for c in long])
    # The pupil is crossed in 0.4 to 1.7 s.
    assert times * variance / (times * variance)[-1] == pytest.approx(1.0, abs=0.05)
    instant = mean_wavefront_covariance(replace(air(), exposure=0.0), [(0, 0)], NOLL[:3], DIAMETER, OBSCURATION)
    assert np.trace(instant[0, :, 0]) > 8.0 * variance[0]


@pytest.mark.parametrize(
    ("diameter", "speed", "time"),
    [(1.2, 20.0, 30.0), (4.0, 15.0, 90.0), (8.4, 20.0, 600.0)],
    ids=["1.2 m", "4 m", "8.4 m"],
)
def test_long_exposures_do_not_depend_on_the_direction_of_the_wind(diameter, speed, time):
    """Radial terms, and pairs of cosine and sine, have one variance whatever the direction; it falls as 1/time."""
    terms = [4, 5, 6, 11, 14, 15]

    def variances(angle, exposure):
        wind = (speed * np.cos(angle), speed * np.sin(angle))
        layer = ExposedAir((5000.0,), (1.0,), (wind,), exposure, 0.16, 25.0, 8.75, diameter, 0.4)
        z4, z5, z6, z11, z14, z15 = np.diag(mean_wavefront_covariance(layer, (0, 0), terms, diameter, 0.4)[0, :, 0])
        return np.array([z4, z5 + z6, z11, z14 + z15])

    # The wind crosses 60 pupils.
    crossed = 60.0 * diameter / speed
    expected = variances(0.0, crossed) * crossed / time
    for angle in (0.0, 1.1):
        assert variances(angle, time) / expected == pytest.approx(np.ones(4), rel=2e-3)


def test_stars_share_the_ground_layer_and_nothing_far_apart():
    apart = [(0.0, 0.0), (0.0, 0.0), (np.deg2rad(3.4), 0.0)]
    covariance = mean_wavefront_covariance(air(), apart, [4, 5, 11], DIAMETER, OBSCURATION)
    assert covariance[0, :, 1] == pytest.approx(covariance[0, :, 0], rel=1e-12, abs=0.0)
    ground = replace(air(), weights=np.array([air().weights[0], 0.0, 0.0, 0.0, 0.0, 0.0]))
    alone = mean_wavefront_covariance(ground, apart, [4, 5, 11], DIAMETER, OBSCURATION)
    assert covariance[0, :, 2] == pytest.approx(alone[0, :, 0], rel=1e-12, abs=0.0)
    assert np.trace(covariance[0, :, 2]) < 0.9 * np.trace(covariance[0, :, 0])
    whole = covariance.reshape(9, 9)
    assert whole == pytest.approx(whole.T, rel=1e-9, abs=1e-9 * whole.max())
    assert np.linalg.eigvalsh(whole).min() > -1e-6 * np.linalg.eigvalsh(whole).max()


@pytest.mark.slow
def test_frozen_screens_drawn_and_averaged_have_these_variances():
    # Screens of one layer by brute force: random modes of the spectrum on a periodic grid, moved along x.
    pixel, size, wind, exposure, n_screen = 0.2, 512, 8.0, 2.0, 80
    nu = np.fft.fftfreq(size, pixel)
    amplitude = np.sqrt(path_spectrum(np.hypot(nu, nu[:, None]), 0.16, 10.0)) / (size * pixel)
    # The mean over a move of length L along x multiplies each mode by sinc(nu_x L).
    amplitude = amplitude * np.sinc(nu * wind * exposure)
    axis = (np.arange(44) - 21.5) * pixel / (0.5 * DIAMETER)
    x, y = np.meshgrid(axis, axis)
    inside = (np.hypot(x, y) <= 1.0) & (np.hypot(x, y) >= OBSCURATION)
    basis = annular_zernikes(22, x[inside], y[inside], OBSCURATION)
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(n_screen):
        modes = rng.normal(size=(size, size)) + 1j * rng.normal(size=(size, size))
        for screen in (np.fft.fft2(modes * amplitude).real, np.fft.fft2(modes * amplitude).imag):
            for corner in (0, 128, 256, 384):
                piece = screen[corner : corner + 44, corner : corner + 44][inside]
                squares.append(np.linalg.lstsq(basis.T, piece, rcond=None)[0][3:] ** 2)
    single = replace(
        air(outer_scale=10.0),
        altitudes=np.zeros(1),
        weights=np.ones(1),
        velocities=np.array([[wind, 0.0]]),
        exposure=exposure,
    )
    expected = np.diag(mean_wavefront_covariance(single, [(0.0, 0.0)], NOLL, DIAMETER, OBSCURATION)[0, :, 0])
    # 640 pieces, neighbours of which have modes in common: each mean square is good to 6 %, their sum to 4.
    assert np.mean(squares, axis=0).sum() == pytest.approx(expected.sum(), rel=0.12, abs=0.0)
    assert np.mean(squares, axis=0) == pytest.approx(expected, rel=0.4, abs=0.0)


def test_tilts_are_refused():
    with pytest.raises(DomainError, match=r"noll = \[3\]: expected Noll indices from 4"):
        mean_wavefront_covariance(air(), [(0.0, 0.0)], [3], DIAMETER, OBSCURATION)


def test_what_is_linear_in_the_wavefront_covaries_as_its_zernikes():
    exposed = ExposedAir.of(air(), DIAMETER, OBSCURATION)
    above = exposed._replace(**{key: getattr(exposed, key)[1:] for key in ("altitudes", "weights", "velocities")})
    rng = np.random.default_rng(0)
    products, lags = rng.standard_normal((2, 8, 8)), rng.uniform(-3e-3, 3e-3, (3, 2))
    found = covariance_by_wavefront(exposed, lags, range(4, 12), products)
    variance = np.abs(covariance_by_wavefront(exposed, np.zeros((1, 2)), range(4, 12), products)).max()
    for lag, values in zip(lags, found, strict=True):
        pair = mean_wavefront_covariance(above, [lag, (0.0, 0.0)], range(4, 12), DIAMETER, OBSCURATION)[0, :, 1]
        expected = np.einsum("pab,ab->p", products, 0.5 * (pair + pair.T))
        # Single precision of phases.
        np.testing.assert_allclose(values, expected, atol=1e-5 * variance)
    # All stars share the layer on the ground; beyond five outer scales nothing else.
    assert not covariance_by_wavefront(exposed, np.array([[0.2, 0.0]]), [4], np.ones((1, 1, 1))).any()


def test_stars_far_apart_across_the_wind_share_nothing():
    """Frequencies so far apart that the waves of two stars alias made correlations of up to 0.3 at 80 m."""
    single = replace(
        air(), altitudes=np.array([1e4]), weights=np.ones(1), velocities=np.array([[10.0, 0.0]]), exposure=15.0
    )
    noll, distances = [4, 5, 6], np.array([[0.0, 0.0], [0.0, 20.0], [0.0, 80.0], [20.0, 0.0], [7.0, 7.0]])
    covariance = mean_wavefront_covariance(single, distances / 1e4, noll, DIAMETER, OBSCURATION)
    # Modes of a periodic plane of 400 m, by brute force; the pupil a lattice.
    step, reach = 1.0 / 400.0, 200
    along = step * np.arange(-reach, reach + 1)
    axis = (np.arange(40) - 19.5) * DIAMETER / 40
    x, y = np.meshgrid(axis, axis)
    inside = (np.hypot(x, y) <= 0.5 * DIAMETER) & (np.hypot(x, y) >= 0.5 * OBSCURATION * DIAMETER)
    zernikes = np.zeros((len(noll), *inside.shape))
    values = annular_zernikes(6, x[inside] / (0.5 * DIAMETER), y[inside] / (0.5 * DIAMETER), OBSCURATION)
    values = values[np.array(noll) - 1]
    # Without the piston that a lattice leaves in them, of which turbulence has a thousand times as much.
    values -= values.mean(axis=1, keepdims=True)
    zernikes[:, inside] = values / np.sqrt((values**2).mean(axis=1, keepdims=True))
    waves = np.exp(2j * np.pi * np.outer(along, axis))
    transforms = np.einsum("vy,jyx,ux->jvu", waves, zernikes, waves, optimize=True) / inside.sum()
    nu_x, nu_y = np.meshgrid(along, along)
    power = path_spectrum(np.hypot(nu_x, nu_y), 0.16, 25.0) * np.sinc(nu_x * 150.0) ** 2 * step**2
    for k in range(1, len(distances)):
        turn = np.cos(2.0 * np.pi * (nu_x * distances[k, 0] + nu_y * distances[k, 1]))
        expected = (np.abs(transforms) ** 2 * power * turn).sum(axis=(1, 2))
        found = np.diag(covariance[0, :, k])
        # The lattice of the pupil is good to 2 % of the variance.
        np.testing.assert_array_less(np.abs(found - expected), 0.02 * np.diag(covariance[0, :, 0]))
