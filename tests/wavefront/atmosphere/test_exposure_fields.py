"""Fields of an exposure: their spectra have the covariances of the theory, and bytes that the seed alone fixes."""

import math

import numpy as np
import pytest

from pachon.core.units import ARCMIN, ARCSEC
from pachon.wavefront.atmosphere import exposure_fields
from pachon.wavefront.atmosphere.exposure_fields import NOLL, ExposureFields, FieldGrid, SplineFields, moment_spectrum
from pachon.wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance
from pachon.wavefront.atmosphere.moment_covariance import ExposedAir, MomentResponse, as_matrices, moment_covariance
from pachon.wavefront.atmosphere.spline import stencil_gain

AIR = ExposedAir((0.0, 5000.0), (0.6, 0.4), ((3.0, 2.0), (-4.0, 9.0)), 5.0, 0.16, 25.0, 8.75, 4.0, 0.4)
#: That of an ideal 8.4 m telescope at 620 nm, r0 = 0.16 m, under a weight of 0.7 arcsec [1/rad^2].
RESPONSE = MomentResponse(
    2.72 / ARCSEC**2, 2.85 / ARCSEC**2, (44.3 / ARCSEC**2, 2600.0 / ARCSEC**4), (58.6 / ARCSEC**2, 3400.0 / ARCSEC**4)
)
FIELD_RADIUS = math.radians(0.3)


@pytest.mark.long
def test_spectra_of_moments_have_the_covariances():
    """The transform of the squared Cholesky factors, plus what all stars share, at some lags of the grid.

    Negative remainders that count as zero, and the interpolation between lags: 1.5 % of the variance that changes over
    the field, the most at no lag.
    """
    grid = FieldGrid.of(AIR, FIELD_RADIUS)
    factors, shared, _ = moment_spectrum(AIR, RESPONSE, grid)
    gain = exposure_fields._spline_gain(grid.size)
    gain = gain[:, None] * gain[: grid.size // 2 + 1]
    plain = [[f / gain for f in row] for row in factors]
    steps = np.array([(0, 0), (1, 0), (3, 2), (-2, 7), (12, 0), (0, 25)])
    theory = as_matrices(moment_covariance(AIR, steps * grid.side / grid.size).total(RESPONSE))
    changing = np.diag(theory[0] - shared @ shared.T)
    for i in range(3):
        for j in range(i + 1):
            spectrum = sum(plain[i][m] * plain[j][m] for m in range(j + 1))
            covariance = np.fft.irfft2(spectrum, s=(grid.size, grid.size)) + (shared @ shared.T)[i, j]
            got = covariance[steps[:, 1] % grid.size, steps[:, 0] % grid.size]
            assert got == pytest.approx(theory[:, i, j], abs=0.016 * math.sqrt(changing[i] * changing[j]))


@pytest.mark.long
def test_low_layers_are_longer_than_the_period_of_a_narrow_field():
    """Cut off half a period away, covariances gave half-variograms that were 1.2 to 1.7 times too large.

    They are means over directions, of the variance that the factors have at the samples.
    """
    air = AIR._replace(
        altitudes=(0.0, 1000.0, 8000.0), weights=(0.5, 0.3, 0.2), velocities=((0.0, 0.0), (-4.0, 3.0), (8.0, -6.0))
    )
    grid = FieldGrid.of(air, FIELD_RADIUS)
    factors, _, _ = moment_spectrum(air, RESPONSE, grid)
    gain = exposure_fields._spline_gain(grid.size)
    gain = gain[:, None] * gain[: grid.size // 2 + 1]
    squares = [sum((f / gain) ** 2 for f in row) for row in factors]
    covariance = np.fft.irfft2(squares, s=(grid.size, grid.size))
    angle = math.pi * np.arange(12) / 12
    for pupils in (0.7, 1.5, 4.0):
        radius = 4.5 * pupils
        steps = np.rint(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(int)
        lags = np.concatenate([np.zeros((1, 2)), steps]) * grid.side / grid.size
        theory = moment_covariance(air, lags).total(RESPONSE)[:, :3]
        drawn = covariance[:, :1, 0] - covariance[:, steps[:, 1] % grid.size, steps[:, 0] % grid.size]
        assert drawn.mean(axis=1) == pytest.approx((theory[0] - theory[1:]).mean(axis=0), rel=0.04, abs=0.0)


@pytest.mark.long
def test_half_variograms_between_samples():
    """Differences of drawn moments at places between samples, at a third of the pupil's angle and more.

    64 exposures have a standard error of 1 %; the first lag, of one and a half samples, has 3 to 5 % too much. With
    amplitudes that are right at the samples 5 % are missing there and 4 % beyond.
    """
    grid = FieldGrid.of(AIR, FIELD_RADIUS)
    factors, _, _ = moment_spectrum(AIR, RESPONSE, grid)
    angle = AIR.diameter / max(AIR.altitudes)
    lags = angle * np.array([[0.33, 0.0], [0.0, 0.33], [0.66, 0.0], [0.0, 0.66], [1.5, 0.0], [0.0, 1.5]])
    covariance = moment_covariance(AIR, np.concatenate([np.zeros((1, 2)), lags])).total(RESPONSE)[:, :3]
    random = np.random.default_rng(2)
    places = random.uniform(0.0, grid.side, (4000, 2))
    squares = np.zeros((6, 3))
    for _ in range(64):
        modes = [exposure_fields._white_modes(random, grid.size, grid.size // 2 + 1, grid.size) for _ in range(3)]
        spectra = [sum(f * m for f, m in zip(row, modes, strict=False)) for row in factors]
        fields = SplineFields(grid.side, exposure_fields._fields(spectra, 3, grid.size))
        values = fields.at(places)
        squares += [((fields.at(places + lag) - values) ** 2).mean(axis=0) for lag in lags]
    ratio = (squares / 128 / (covariance[0] - covariance[1:])).reshape(3, 2, 3).mean(axis=1)
    assert ratio[0] == pytest.approx(np.ones(3), abs=0.06)
    assert ratio[1:] == pytest.approx(np.ones((2, 3)), abs=0.03)


def test_stars_with_less_light_have_larger_moments():
    """Where far pairs of points are dark moments differ more from star to star; not where pairs of all lengths are.

    They are those of the theory for pupils of that light alone.
    """
    grid = FieldGrid.of(AIR, FIELD_RADIUS)
    alike, far = (0.5, 0.5, 0.5), (0.7, 0.3, 0.05)
    gain = moment_spectrum(AIR, RESPONSE._replace(lit_levels=(alike, far, (1.0,))), grid)[2]
    assert gain.lit.tolist() == [0.5, 0.7, 1.0]
    assert gain.amplitudes[[0, 2]] == pytest.approx(np.ones((2, 3)), abs=1e-6)
    apart = 2.0 * AIR.diameter / max(AIR.altitudes)
    angle = np.linspace(0.0, np.pi, 17)[:-1]
    lags = np.concatenate([[[0.0, 0.0]], apart * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    of_far, usual = (moment_covariance(AIR, lags, lit=lit).total(RESPONSE)[:, :3] for lit in (far, (1.0,)))
    ratio = (of_far[0] - of_far[1:].mean(axis=0)) / (usual[0] - usual[1:].mean(axis=0))
    assert gain.amplitudes[1] ** 2 == pytest.approx(ratio, rel=0.03)
    assert (ratio > 1.2).all()
    factors = gain.factors(np.ones(3), np.array([0.7, 0.85, 0.2]))
    assert factors[[0, 2]] == pytest.approx(gain.amplitudes[[1, 0]])
    assert factors[1] == pytest.approx(0.5 * (gain.amplitudes[1] + 1.0))


@pytest.mark.filterwarnings("error")
def test_a_layer_at_the_pupil_alone_makes_no_differences():
    """All stars have the same moments, whatever light they have: rounding is no amplitude."""
    response = RESPONSE._replace(lit_levels=((0.5, 0.5, 0.5), (0.7, 0.3, 0.05), (1.0,)))
    for velocity in ((3.0, 2.0), (8.0, 0.0), (-4.0, 1.5), (2.0, 7.0)):
        air = AIR._replace(altitudes=(0.0,), weights=(1.0,), velocities=(velocity,))
        fractions, amplitudes = exposure_fields.amplitudes_by_light(air, response, FIELD_RADIUS)
        assert fractions.tolist() == [0.5, 0.7, 1.0]
        assert (amplitudes == 1.0).all()


def test_modes_are_those_of_white_noise():
    """600 grids of 8 x 8: unit variance, and one power at all frequencies, also those whose opposite is themselves.

    Five standard errors of a mean of squares: 0.29 of two that are real, 0.2 of others.
    """
    random = np.random.default_rng(5)
    noise = np.array([np.fft.irfft2(exposure_fields._white_modes(random, 8, 5, 8), s=(8, 8)) for _ in range(600)])
    power = (np.abs(np.fft.fft2(noise)) ** 2).mean(axis=0) / 64
    assert power == pytest.approx(np.ones((8, 8)), abs=0.3)
    assert (noise**2).mean() == pytest.approx(1.0, abs=5 * math.sqrt(2.0 / noise.size))
    # No mode is another one's copy, but for the conjugate of its opposite.
    spectra = np.fft.rfft2(noise).reshape(600, -1)[:, 1:]
    correlation = np.abs(spectra.T @ spectra.conj()) / 600 / 64
    opposite = [(8 - row) % 8 * 5 + column - 1 for row in range(8) for column in range(5)][1:]
    for k, other in enumerate(opposite):
        column = (k + 1) % 5
        correlation[k, [k, other] if column in (0, 4) else [k]] = 0.0
    assert correlation.max() < 0.25


@pytest.mark.long
@pytest.mark.parametrize(
    ("altitudes", "side"), [((15_000.0,), 0.05), pytest.param((12_000.0, 4000.0), 0.1, id="low layer, few modes")]
)
def test_mean_wavefronts_have_their_covariances(altitudes, side):
    """Of one layer, whose field holds many independent pupils, against the quadrature of another module."""
    altitude = min(altitudes)
    weights = tuple(float(a == altitude) for a in altitudes)
    air = AIR._replace(altitudes=altitudes, weights=weights, velocities=((-4.0, 9.0),) * len(altitudes))
    grid = FieldGrid(512, side)
    stars = np.random.default_rng(1).uniform(0, side, (20_000, 2))
    lag = np.array([3.0, 1.0]) / altitude
    theory = mean_wavefront_covariance(air, [(0.0, 0.0), lag], NOLL, air.diameter, air.obscuration)
    sigma = np.sqrt(np.diag(theory[0, :, 0]))
    scale = np.outer(sigma, sigma)
    covariance = np.zeros((2, len(NOLL), len(NOLL)))
    for seed in range(3):
        ground, fields = exposure_fields._draw_wavefronts(air, grid, seed, 0)
        assert not ground.any()
        drawn = ExposureFields(np.zeros(3), fields[0], None, ground, fields)
        here, there = drawn.wavefronts_at(stars), drawn.wavefronts_at(stars + lag)
        covariance += np.array([here.T @ here, here.T @ there]) / (3 * len(stars) * scale)
    # 750 m of a layer, 8 m across and 50 m along the wind for each independent patch: some 4200, two standard errors,
    # beside 0.09 by modes that are left out and made up for by longer ones; of the low one 400 m.
    bound = 0.12 * 750.0 / (side * altitude)
    assert covariance[0] == pytest.approx(theory[0, :, 0] / scale, abs=bound)
    assert covariance[1] == pytest.approx(theory[0, :, 1] / scale, abs=bound)
    # The variances themselves are closer.
    assert np.diag(covariance[0]) == pytest.approx(np.ones(len(NOLL)), abs=0.5 * bound)


@pytest.mark.parametrize("outer_scale", [25.0, 1000.0])
def test_mean_wavefronts_have_their_variances_whatever_the_drift_and_the_outer_scale(outer_scale):
    """In 600 s the wind blows over ten periods of the grid; a thousand metres are more than the largest grid has."""
    air = AIR._replace(altitudes=(5000.0,), weights=(1.0,), velocities=((-4.0, 9.0),), outer_scale=outer_scale)
    air = air._replace(exposure=600.0 if outer_scale == 25.0 else 15.0)
    theory = np.diag(mean_wavefront_covariance(air, (0.0, 0.0), NOLL, air.diameter, air.obscuration)[0, :, 0])
    stars = np.random.default_rng(1).uniform(0, 0.1, (5000, 2))
    square = np.zeros(len(NOLL))
    for seed in range(2):
        ground, fields = exposure_fields._draw_wavefronts(air, FieldGrid(512, 0.1), seed, 0)
        square += 0.5 * (ExposureFields(np.zeros(3), fields[0], None, ground, fields).wavefronts_at(stars) ** 2).mean(0)
    # Some 60 independent pupils along the side, across the wind, in each of two draws: a tenth.
    assert square / theory == pytest.approx(np.ones(len(NOLL)), abs=0.35)
    assert (square / theory).mean() == pytest.approx(1.0, abs=0.15)


def test_longer_modes_make_up_for_those_left_out():
    """Of one power at all frequencies up to 1, drawn to 1/8: areas of discs, and lengths of a lobe across the wind."""
    frequency = np.linspace(0.0, 1.0, 8193)
    factors = exposure_fields._compensation(frequency, np.ones((8193, 1)), np.array([0.0, 1e9]))
    assert factors[:, 0] == pytest.approx([8.0, math.sqrt(8.0)], rel=1e-3)


def test_ground_layer_is_the_same_for_all_stars():
    air = AIR.on_ground()
    ground, fields = exposure_fields._draw_wavefronts(air, FieldGrid(16, 0.01), 3, 0)
    assert fields == ()
    draws = np.array([exposure_fields._draw_wavefronts(air, FieldGrid(16, 0.01), s, 0)[0] for s in range(60)])
    theory = mean_wavefront_covariance(air, (0.0, 0.0), NOLL, air.diameter, air.obscuration)[0, :, 0]
    # 60 draws: four standard errors of a variance, of eight.
    assert (draws**2).mean(axis=0) == pytest.approx(np.diag(theory), rel=0.73, abs=0.0)
    assert ground.tobytes() == exposure_fields._draw_wavefronts(air, FieldGrid(16, 0.01), 3, 0)[0].tobytes()


def test_splines_pass_through_a_wave():
    """A wave of 8 samples, with the gain of splines, is met between its samples to the error of cubic splines."""
    size, side = 64, 1.0
    x = 2 * np.pi * 8 * np.arange(size) / size
    gain = stencil_gain(np.array([2 * np.pi * 8 / size]), np.array([[0.0]]), "spline")[0, 0]
    fields = SplineFields(side, (gain * np.cos(x) * np.ones((1, size, 1))).astype(np.float32))
    place = np.random.default_rng(0).uniform(-2, 2, (50, 2))
    assert fields.at(place)[:, 0] == pytest.approx(np.cos(2 * np.pi * 8 * place[:, 0]), abs=5e-3)
    assert fields.at(place[7:8]).tobytes() == fields.at(place)[7:8].tobytes()


def test_one_arcminute_of_lag_is_one_arcminute_of_grid():
    """The grid is wider than the field, and finer than the pupil at the highest layer."""
    grid = FieldGrid.of(AIR, FIELD_RADIUS)
    assert grid.side > 2 * FIELD_RADIUS
    assert grid.side / grid.size < 0.25 * AIR.diameter / max(AIR.altitudes)
    assert grid.side / ARCMIN == pytest.approx(54.0)
