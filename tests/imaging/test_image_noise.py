"""Noise of images whose pixels are correlated, and of those whose are not."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import convolve

from pachon.imaging.image_shear import image_noise

#: Shift by half a pixel along both axes, by linear interpolation: neighbours are correlated by a half.
HALF_PIXEL = np.full((2, 2), 0.25)


def image_of(noise):
    """Image with an object, a masked column and pixels without variance, and its objects."""
    variance, mask = np.full(noise.shape, 4.0), np.zeros(noise.shape, dtype=int)
    pixels, segmentation = noise + 100.0, np.zeros(noise.shape, dtype=int)
    pixels[20:40, 30:50] += 50.0
    segmentation[20:40, 30:50] = 1
    pixels[:, 7], mask[:, 7] = 1e6, 1
    pixels[60:64], variance[60:64] = 0.0, 0.0
    objects = SimpleNamespace(background=np.full(noise.shape, 100.0), segmentation=segmentation)
    return SimpleNamespace(image=pixels, variance=variance, mask=mask), objects


def test_resampled_noise_has_its_correlation_and_white_noise_the_variance_of_the_image():
    white = 2.0 * np.random.default_rng(1).standard_normal((200, 200))
    assert image_noise(*image_of(white)) == 2.0
    noise = image_noise(*image_of(convolve(white, HALF_PIXEL, mode="wrap")))
    assert noise.rms == pytest.approx(1.0, rel=0.03)
    middle = len(noise.correlation) // 2
    np.testing.assert_allclose(noise.correlation[middle, middle - 1 : middle + 2], [0.5, 1.0, 0.5], atol=0.03)
    assert noise.correlation[middle + 1, middle + 1] == pytest.approx(0.25, abs=0.03)


def test_an_image_without_sky_has_the_noise_of_its_variance():
    image, objects = image_of(np.random.default_rng(1).standard_normal((80, 80)))
    objects.segmentation[:] = 1
    assert image_noise(image, objects) == 2.0
