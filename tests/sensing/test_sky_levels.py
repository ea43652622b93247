"""Noise of donuts whose sky is left in, was taken off twice, or does not show on a tight stamp."""

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon
from pachon.sensing import DonutFlag

FIELD = np.deg2rad([0.9, 0.6])
SKY = 400.0
#: Rays are those of no wave.
MODEL = pachon.DonutModel(diffraction=False)


@pytest.fixture(scope="module")
def near_focus(focused):
    return focused.perturbed("Detector", shift=(0.0, 0.0, 0.6e-3))


@pytest.fixture(scope="module")
def image(near_focus):
    """Donut of 24 pixels, sky taken off."""
    return noisy(donut(near_focus, FIELD, zernikes=[0.0] * 6 + [80e-9], flux=4e5, size=51), SKY, 3)


def fitted(telescope, image, **options):
    return pachon.fit_donuts(
        telescope,
        image[None],
        [FIELD],
        WAVELENGTH,
        model=MODEL,
        pixel_size=PIXEL,
        noll=range(4, 9),
        threads=1,
        **options,
    )


@pytest.fixture(scope="module")
def without_sky(near_focus, image):
    return fitted(near_focus, image, sky_variance=SKY)


@pytest.mark.parametrize("level", [SKY, -0.75 * SKY])
def test_the_sky_counts_once_whatever_its_level(near_focus, image, without_sky, level):
    """Left in, it had its own noise beside that claimed: half of chi-square; taken off twice, four times that."""
    fit = fitted(near_focus, image + level, sky_variance=SKY)
    assert fit.background[0] == pytest.approx(without_sky.background[0] + level, abs=0.5)
    np.testing.assert_allclose(fit.chi2 / fit.n_pixels, without_sky.chi2 / without_sky.n_pixels, rtol=0.02)
    photons, expected = (np.sqrt(np.trace(f.error_parts.photons[0])) for f in (fit, without_sky))
    assert photons == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(fit.zernikes, without_sky.zernikes, atol=2e-9)
    assert fit.sky_variance[0] == SKY


def test_noise_of_a_tight_stamp_is_that_of_the_sky_and_the_light(near_focus, image):
    """What was taken for the level of the sky is that of the donut: chi-square was twice too large, a poor fit."""
    middle = image[13:38, 13:38]
    fit, known = fitted(near_focus, middle), fitted(near_focus, middle, sky_variance=SKY)
    assert not fit.flags[0] & DonutFlag.POOR_FIT
    np.testing.assert_allclose(fit.chi2 / fit.n_pixels, 1.0, atol=0.15)
    np.testing.assert_allclose(fit.errors, known.errors, rtol=0.3)
    assert SKY / 2.0 < fit.sky_variance[0] < 2.0 * SKY


def test_stamps_that_cannot_hold_half_of_a_donut_have_lost_it(near_focus, image):
    """They had too few photons."""
    fit = fitted(near_focus, image[18:33, 18:33])
    assert fit.flags[0] == DonutFlag.MOSTLY_LOST
