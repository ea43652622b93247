"""Telescope and air from wavefronts of donuts: against dense algebra restated here, and against drawn truths."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.models.zernike_polynomials import annular_zernikes, noll_to_nm
from pachon.sensing.air_shape import air_shape
from pachon.sensing.contradicting_donuts import fit_consistently
from pachon.sensing.hierarchy import RMS, Basis, ExposureAir, Observations, Sizes, _Model, fit_hierarchy, star_numbers

NOLL = np.arange(4, 12)
#: Part of the air that donuts share.
GROUND = 0.66


def field_basis(places, last=3):
    over_field = annular_zernikes(last, *places.T)[:last].T
    n = len(NOLL)
    columns = np.einsum("ik,ab->iakb", over_field, np.eye(n)).reshape(len(places), n, -1)
    field, pupil = (np.array([noll_to_nm(int(j))[0] for j in js]) for js in (range(1, last + 1), NOLL))
    return Basis(columns, np.repeat(field, n), np.tile(pupil, last))


def shape():
    return air_shape(22, 0.61, np.inf)[: len(NOLL), : len(NOLL)]


def drawn(rng, places, *, star, exposure, air, noise=8e-9, scale=1.0, linear=150e-9, local=0.0):
    """Return observations, and the telescope's and the light's wavefronts."""
    n, basis = len(NOLL), field_basis(places)
    factor = np.linalg.cholesky(shape())
    falls = 4.0 ** -(0.5 * (basis.field_degree - 1 + basis.pupil_degree - 2))
    terms = np.where(basis.field_degree == 0, 200e-9, linear * falls) * rng.normal(size=basis.columns.shape[2])
    telescope = basis.columns @ terms
    telescope = telescope + local * (rng.normal(size=(star.max() + 1, n)) @ factor.T)[star]
    ground = air * GROUND**0.5 * rng.normal(size=(exposure.max() + 1, n)) @ factor.T
    total = telescope + ground[exposure] + air * (1.0 - GROUND) ** 0.5 * rng.normal(size=(len(places), n)) @ factor.T
    mixing = noise * (np.eye(n) + 0.3 * rng.normal(size=(len(places), n, n)))
    covariance = mixing @ mixing.transpose(0, 2, 1)
    observed = total + scale**0.5 * np.einsum("iab,ib->ia", mixing, rng.normal(size=total.shape))
    return Observations(observed, covariance, star, exposure), telescope, total


def places_of(rng, count):
    return np.sqrt(rng.uniform(0.0, 1.0, count))[:, None] * np.array(
        [[np.cos(a), np.sin(a)] for a in rng.uniform(0.0, 2.0 * np.pi, count)]
    )


@pytest.mark.long
def test_posterior_is_that_of_dense_algebra():
    """Conditional mean and covariance of one big Gaussian, for the variances that the fit has found."""
    rng = np.random.default_rng(3)
    places = np.repeat(places_of(rng, 4), 2, axis=0)[:7]
    star, exposure = np.array([0, 0, 1, 1, 2, 2, 3]), np.array([0, 1, 0, 1, 0, 1, 0])
    observations, _, _ = drawn(rng, places, star=star, exposure=exposure, air=60e-9, local=20e-9)
    basis = field_basis(places)
    fit = fit_hierarchy(observations, basis, ExposureAir(shape(), GROUND))
    sizes, n, count = fit.sizes, len(NOLL), len(places)
    prior = np.diag(basis.variances(sizes))
    columns = basis.columns.reshape(count * n, -1)
    telescope = columns @ prior @ columns.T + np.kron(star[:, None] == star, sizes.local**2 * shape())
    shared = GROUND * (exposure[:, None] == exposure) + (1.0 - GROUND) * np.eye(count)
    total = telescope + np.kron(shared, sizes.air**2 * shape())
    noise = np.zeros_like(total)
    for i, block in enumerate(observations.covariance):
        noise[n * i : n * (i + 1), n * i : n * (i + 1)] = sizes.noise * block
    for covariance, values, errors in (
        (telescope, fit.telescope, fit.telescope_covariance),
        (total, fit.total, fit.total_covariance),
    ):
        gain = np.linalg.solve(total + noise, covariance).T
        np.testing.assert_allclose(values.ravel(), gain @ observations.zernikes.ravel(), atol=1e-13)
        posterior = covariance - gain @ covariance.T
        blocks = np.array([posterior[n * i : n * (i + 1), n * i : n * (i + 1)] for i in range(count)])
        np.testing.assert_allclose(errors, blocks, atol=1e-4 * np.abs(blocks).max())


@pytest.mark.slow
@pytest.mark.parametrize(("air", "scale"), [(100e-9, 1.0), (5e-9, 3.0)])
def test_errors_are_those_claimed(air, scale):
    """Chi-square of the telescope's and of the light's wavefronts over exposures: nearly 1 a term."""
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places, star, exposure = places_of(rng, 12), np.arange(12), np.zeros(12, dtype=int)
        observations, telescope, total = drawn(rng, places, star=star, exposure=exposure, air=air, scale=scale)
        fit = fit_hierarchy(observations, field_basis(places), ExposureAir(shape(), GROUND))
        squares.append(
            [
                np.mean([e @ np.linalg.solve(c, e) for e, c in zip(error, covariance, strict=True)]) / len(NOLL)
                for error, covariance in (
                    (fit.telescope - telescope, fit.telescope_covariance),
                    (fit.total - total, fit.total_covariance),
                )
            ]
        )
        # What single fits leave is more.
        assert np.linalg.norm(fit.telescope - telescope) < np.linalg.norm(observations.zernikes - telescope)
    # Eight terms of twelve exposures, much the same at all donuts of one: 15 %.
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.35)


def test_a_donut_that_the_others_contradict_says_nothing_of_the_telescope():
    """One that is off by 1.5 um made the telescope's wavefront wrong by 100 nm at all others."""
    air, count = ExposureAir(shape(), GROUND), 12
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places, exposure = places_of(rng, count), np.zeros(count, dtype=int)
        # Thirty times as misaligned as the prior has it, too.
        linear = (150e-9, 1e-6, 5e-6)[seed]
        options = {"star": np.arange(count), "exposure": exposure, "air": 60e-9, "linear": linear}
        observations, telescope, _ = drawn(rng, places, **options)
        basis, one, direction = field_basis(places), int(rng.integers(count)), rng.normal(size=len(NOLL))
        without = fit_consistently(observations, basis, air)
        assert not without.left_out.any()
        wrong = observations.zernikes.copy()
        wrong[one] += 1.5e-6 * direction / np.linalg.norm(direction)
        fit = fit_consistently(replace(observations, zernikes=wrong), basis, air)
        np.testing.assert_array_equal(fit.left_out, np.arange(count) == one)
        # What the others say of the telescope there, as far as they know it.
        error, covariance = fit.hierarchy.telescope - telescope, fit.hierarchy.telescope_covariance
        assert error[one] @ np.linalg.solve(covariance[one], error[one]) < 3.0 * len(NOLL)
        before = np.linalg.norm(without.hierarchy.telescope - telescope, axis=1)
        assert np.linalg.norm(np.delete(error, one, axis=0), axis=1).max() < 1.3 * before.max()


def test_high_orders_of_bent_mirrors_keep_their_slopes_over_the_field():
    """A tilted camera, and 10 nm of Z11 that is linear over the field: it is not taken for less by Z4's fall to it."""
    rng = np.random.default_rng(2)
    places = places_of(rng, 12)
    observations, telescope, _ = drawn(
        rng, places, star=np.arange(12), exposure=np.zeros(12, dtype=int), air=0.0, noise=6e-9, linear=0.0
    )
    change = np.zeros_like(telescope)
    change[:, 0], change[:, -1] = 800e-9 * places[:, 0], 10e-9 * places[:, 1]
    fit = fit_hierarchy(
        replace(observations, zernikes=observations.zernikes + change),
        field_basis(places),
        ExposureAir(shape(), GROUND),
    )
    error = (fit.telescope - telescope - change)[:, -1]
    # The noise of three field terms by twelve donuts is 3 nm; without slopes the error would be 6 nm.
    assert np.std(error) < 3.5e-9


@pytest.mark.long
def test_sizes_are_those_drawn():
    rng = np.random.default_rng(1)
    places, star, exposure = places_of(rng, 60), np.arange(60), np.zeros(60, dtype=int)
    observations, _, _ = drawn(rng, places, star=star, exposure=exposure, air=90e-9, scale=2.0)
    sizes = fit_hierarchy(observations, field_basis(places), ExposureAir(shape(), GROUND)).sizes
    assert sizes.air == pytest.approx(90e-9, rel=0.15)
    assert sizes.noise == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("part", [0.3, 0.9])
def test_exposures_say_which_part_of_the_air_donuts_share(part):
    """Where residuals say how much air there is, scatter says what of it donuts do not share."""
    rng = np.random.default_rng(2)
    places, zeros = places_of(rng, 20), np.zeros(20, dtype=int)
    air = 120e-9 * np.sqrt((1.0 - part) / (1.0 - GROUND))
    observations, _, _ = drawn(rng, places, star=np.arange(20), exposure=zeros, air=air)
    losses = 200.0 * np.log(RMS / 120e-9) ** 2
    known, free = (ExposureAir(shape(), 0.8, spread, losses=losses) for spread in (0.0, 1.5))
    sizes = [fit_hierarchy(observations, field_basis(places), of_air).sizes for of_air in (known, free)]
    assert sizes[0].shared == pytest.approx(0.8)
    assert sizes[1].shared == pytest.approx(part, abs=0.15)
    assert sizes[1].air == pytest.approx(120e-9, rel=0.15)


def test_donuts_of_one_star_stand_within_a_distance_or_have_one_name():
    fields = np.array([[0.0, 0.0], [1e-3, 0.0], [1e-5, 0.0], [1e-3, 1e-5]])
    assert star_numbers(fields, 1e-4).tolist() == [0, 1, 0, 1]
    assert star_numbers(fields, 1e-4, [7, 7, 3, 3]).tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize("donuts_of_a_star", [1, 2])
def test_slopes_of_the_loss_are_those_of_differences(donuts_of_a_star):
    """By the logarithm of each size: a search by differences takes seven times as many evaluations."""
    rng = np.random.default_rng(5)
    places = np.repeat(places_of(rng, 4), donuts_of_a_star, axis=0)
    star = np.repeat(np.arange(4), donuts_of_a_star)
    exposure = np.arange(len(star)) % donuts_of_a_star
    observations, _, _ = drawn(rng, places, star=star, exposure=exposure, air=60e-9, local=20e-9)
    model = _Model(observations, field_basis(places), ExposureAir(shape(), GROUND))
    at, step = np.log([1.3, 90e-9, 120e-9, np.log(3.5), 6e-9, 12e-9, 1.5]), 1e-4

    def loss(logarithms):
        return model.loss(Sizes.of(logarithms))[0]

    differences = [(loss(at + unit) - loss(at - unit)) / (2.0 * step) for unit in step * np.eye(7)]
    slopes = model.loss(Sizes.of(at))[1]
    assert np.abs(slopes).min() > 0.01
    # Second-order differences at this step are off by 1e-7 of the larger slopes.
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-5)


def test_residuals_say_how_much_air_donuts_have_in_common():
    """Scatter of donuts about a smooth field says nothing of what layers near the ground have in all of them."""
    rng = np.random.default_rng(6)
    places, one = places_of(rng, 4), np.zeros(4, dtype=np.int64)
    observations, _, _ = drawn(rng, places, star=np.arange(4), exposure=one, air=60e-9)
    without, strong = (ExposureAir(shape(), 0.8, losses=losses) for losses in (None, 20.0 * np.log(RMS / 200e-9) ** 2))
    assert without.loss(0.0) == (0.0, 0.0)
    for rms in (20e-9, 200e-9, 2e-6):
        loss, slope = strong.loss(np.log(rms))
        ahead, behind = (strong.loss(np.log(rms) + step)[0] for step in (1e-5, -1e-5))
        assert slope == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-3)
        assert rms > RMS[-1] or loss == pytest.approx(20.0 * np.log(rms / 200e-9) ** 2, abs=0.2)
    scattered, told = (fit_hierarchy(observations, field_basis(places), air) for air in (without, strong))
    assert scattered.sizes.air < 130e-9
    assert told.sizes.air == pytest.approx(200e-9, rel=0.25)
    # Errors of the telescope's wavefront have it.
    assert np.trace(told.telescope_covariance[0]) > 2.0 * np.trace(scattered.telescope_covariance[0])
