"""PSF models of few stars with noise, masked pixels and cosmic rays: no pixel of the model is brighter than the PSF."""

import numpy as np
import pytest

from pachon import PsfModel

SIDE = 31


def few_stars(count, snr, seed):
    """Stars [count], of a size that changes over the CCD, in noise of one; their positions, and the PSF elsewhere."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((SIDE, SIDE)) - SIDE // 2
    positions = rng.uniform(-1.0, 1.0, (count + 20, 2))
    width = 1.6 * (1.0 + 0.04 * positions[:, 0])
    images = (1.0 + (x**2 + y**2) / (3.2 * width[:, None, None] ** 2)) ** -3.0
    images /= images.sum(axis=(1, 2), keepdims=True)
    stars = snr * images[:count] / np.sqrt((images[:count] ** 2).sum(axis=(1, 2), keepdims=True))
    return stars + rng.normal(size=stars.shape), positions[:count], images[count:], positions[count:], rng


def largest_error(model, truth, elsewhere):
    return np.abs(model.at(elsewhere) - truth).max() / truth.max()


@pytest.mark.parametrize(("count", "snr", "fraction"), [(6, 40.0, 0.05), (8, 40.0, 0.03), (12, 20.0, 0.3)])
def test_masked_pixels_of_few_stars_are_not_extrapolated(count, snr, fraction):
    """Polynomials through as many good stars as terms enlarged their noise: pixels 50 to 600 000 times the peak."""
    for seed in range(4):
        stars, positions, truth, elsewhere, rng = few_stars(count, snr, seed)
        masks = rng.random(stars.shape) < fraction
        masks[:, masks.all(axis=0)] = False
        model = PsfModel.fit(np.where(masks, np.nan, stars), positions, masks=masks, gain=None)
        assert largest_error(model, truth, elsewhere) < 0.4


def test_half_of_the_pixels_of_bright_stars_may_be_masked():
    """Fluxes and filled pixels of thirty stars, each by the other, diverged: 30 times the peak."""
    for seed in range(2):
        stars, positions, truth, elsewhere, rng = few_stars(30, 1000.0, seed)
        masks = rng.random(stars.shape) < 0.5
        model = PsfModel.fit(np.where(masks, np.nan, stars), positions, masks=masks, gain=None)
        assert largest_error(model, truth, elsewhere) < 0.2


@pytest.mark.parametrize("count", [5, 6])
def test_cosmic_rays_of_few_stars_stay_rejected(count):
    """As many terms as stars predict every deviation of a star, and all came back: 300 times the peak."""
    for seed in range(4):
        stars, positions, truth, elsewhere, rng = few_stars(count, 40.0, seed)
        for _ in range(count):
            stars[rng.integers(count), rng.integers(SIDE), rng.integers(SIDE)] += rng.uniform(100.0, 2000.0)
        assert largest_error(PsfModel.fit(stars, positions, gain=None), truth, elsewhere) < 0.5
