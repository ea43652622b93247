"""Flux of faint stars on wide stamps: no star is magnified by the noise of a thousand pixels of sky."""

import numpy as np
import pytest

from pachon import PsfModel
from pachon.core.errors import DomainError
from pachon.measure.star_flux import star_fluxes, with_unit_flux
from pachon.measure.star_selection import StarFlag, flag_stars

SIDE = 49


def profiles(width):
    """Moffat stars of core widths [n] pixels."""
    y, x = np.indices((SIDE, SIDE)) - SIDE // 2
    images = (1.0 + (x**2 + y**2) / (3.2 * np.reshape(width, (-1, 1, 1)) ** 2)) ** -3.0
    return images / images.sum(axis=(1, 2), keepdims=True)


def faint_stars(count, snr, seed):
    """Stars of a S/N of PSF photometry in sky noise, in units of their flux."""
    rng = np.random.default_rng(seed)
    images = profiles(rng.uniform(1.5, 1.8, count))
    sky = np.sqrt((images**2).sum(axis=(1, 2))) / snr
    return images + sky[:, None, None] * rng.normal(size=images.shape)


def test_bright_stars_have_their_sums():
    stars = profiles(np.linspace(1.4, 2.0, 20)) * np.geomspace(1.0, 1e5, 20)[:, None, None]
    assert np.array_equal(with_unit_flux(stars)[1], stars.reshape(20, -1).sum(axis=1))


def test_faint_stars_have_their_flux():
    stars = faint_stars(1000, 30.0, 1).reshape(1000, -1)
    sums = stars.sum(axis=1)
    assert sums.min() < 0.2
    fluxes = star_fluxes(stars)
    np.testing.assert_allclose(fluxes, 1.0, atol=0.4)
    assert fluxes.std() < 0.5 * sums.std()
    assert abs(np.median(fluxes) - 1.0) < 0.02


def test_fluxes_agree_in_common_with_the_sums():
    """The median of twelve faint stars has an eighth of its light too much or too little, and fluxes had with it."""
    for seed in range(20):
        stars = faint_stars(12, 20.0, seed).reshape(12, -1)
        assert abs(star_fluxes(stars).mean() / stars.sum(axis=1).mean() - 1.0) < 0.15


def test_stars_of_negative_sum_do_not_turn_the_others():
    """Sky subtracted by 0.15 of its noise too much: more than half of the stars sum to less than nothing."""
    stars = faint_stars(60, 30.0, 6)
    stars -= 0.15 * stars[:, :8].std()
    stars[:20] += 20.0 * profiles(np.full(20, 1.65))
    assert (stars.sum(axis=(1, 2)) < 0.0).sum() == 40
    flux = with_unit_flux(stars)[1]
    assert (flux[:20] > 10.0).all()
    assert (flux[20:] > 0.0).all()
    assert not (flag_stars(stars / stars[:, :8].std(), 1.0).flags & StarFlag.UNUSABLE).any()


def test_an_empty_stamp_of_negative_sum_is_no_star():
    """By chance a fit to noise alone is positive half of the time."""
    stars = faint_stars(30, 100.0, 7)
    noise = stars[:, :8].std() * np.random.default_rng(8).normal(size=(200, SIDE, SIDE))
    dark = noise[noise.sum(axis=(1, 2)) < 0.0]
    assert np.isnan(with_unit_flux(np.concatenate([stars, dark[:20]]))[1][30:]).all()
    with pytest.raises(DomainError, match=r"stamps\[30\] has no light"):
        PsfModel.fit(np.concatenate([stars, dark[:1]]), np.zeros((31, 2)), gain=None)


def test_masked_pixels_and_cosmic_rays_do_not_move_the_flux():
    rng = np.random.default_rng(2)
    stars = faint_stars(60, 60.0, 3).reshape(60, -1)
    used = rng.uniform(size=stars.shape) > 0.2
    assert np.abs(star_fluxes(np.where(used, stars, 1e9), used) - 1.0).max() < 0.4
    hit = stars.copy()
    hit[0, 7] = 1e3
    np.testing.assert_allclose(star_fluxes(hit)[1:], star_fluxes(stars)[1:], rtol=0.01)


def test_stamps_without_light_have_no_flux():
    stars = faint_stars(10, 100.0, 4)
    stars[3] = -stars[3]
    stars[5, 0, 0] = np.nan
    unit, flux = with_unit_flux(stars)
    assert np.array_equal(np.isnan(flux), np.isin(np.arange(10), (3, 5)))
    assert np.isnan(unit[[3, 5]]).all()


@pytest.mark.parametrize(
    "options", [{}, {"interpolation": "polynomial"}, {"interpolation": "polynomial", "basis": "shapelets"}]
)
def test_a_star_of_small_sum_does_not_bend_the_model(options):
    """Sky noise of -0.95 of its light in the sum, which is 3 standard deviations at S/N 30."""
    rng = np.random.default_rng(5)
    positions = rng.uniform(-1.0, 1.0, (40, 2))
    truth = profiles(1.65 + 0.1 * positions[:, 0])
    stars = truth + np.sqrt((truth**2).sum(axis=(1, 2)).mean()) / 30.0 * rng.normal(size=truth.shape)
    unlucky = stars.copy()
    unlucky[7] -= (stars[7].sum() - 0.05) / SIDE**2
    elsewhere = rng.uniform(-0.8, 0.8, (30, 2))
    usual, bent = (PsfModel.fit(s, positions, order=2, gain=None, **options).at(elsewhere) for s in (stars, unlucky))
    assert np.abs(bent - usual).max() < 0.1 * usual.max()
