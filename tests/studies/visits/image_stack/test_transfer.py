"""Transfer function of cubic convolution: closed forms, and an image resampled by hand."""

import numpy as np
import pytest

from pachon.studies.visits.image_stack.tiles import Tile
from pachon.studies.visits.image_stack.transfer import GRID, broadened, mean_noise_correlation, mean_transfer
from pachon.studies.visits.psf_visit import StackFrame

FRAME, TILE = StackFrame(np.eye(2), 31), Tile(0, 0, 512)


class Shifted:
    """Pixels of an image: those of the tile, stretched about its middle and shifted."""

    shape = (4000, 4000)

    def __init__(self, shift, scale=1.0):
        self.shift, self.scale = np.array(shift), scale

    def to_pixel(self, sky):
        return self.scale * sky + 2000.5 + self.shift

    def jacobians(self, pixels):
        return np.broadcast_to(self.scale * np.eye(2), (len(pixels), 2, 2))


def test_pixels_that_coincide_change_nothing():
    # The middle of a tile of even side lies between pixels, at n + 1/2 of the image as well.
    assert np.allclose(mean_transfer(TILE, FRAME, [Shifted((0.0, 0.0))]), 1.0, rtol=0, atol=1e-6)


def test_half_a_pixel_along_x_has_the_closed_form():
    transfer = mean_transfer(TILE, FRAME, [Shifted((0.5, 0.0))])
    k = np.fft.rfftfreq(GRID)
    # Weights -1/16, 9/16, 9/16, -1/16 at half a pixel.
    expected = 9.0 / 8.0 * np.cos(np.pi * k) - 1.0 / 8.0 * np.cos(3.0 * np.pi * k)
    assert np.allclose(transfer, expected, rtol=0, atol=1e-5)


def test_all_fractions_give_the_transform_of_the_kernel():
    transfer = mean_transfer(TILE, FRAME, [Shifted((0.1 * i, 0.037 * i), 1.013) for i in range(10)])
    s = (np.arange(4000) + 0.5) * 1e-3 - 2.0
    a = np.abs(s)
    kernel = np.where(a < 1.0, 1.5 * a**3 - 2.5 * a**2 + 1.0, -0.5 * a**3 + 2.5 * a**2 - 4.0 * a + 2.0)
    of_kernel = (kernel * np.cos(2.0 * np.pi * np.fft.rfftfreq(GRID)[:, None] * s)).sum(axis=1) * 1e-3
    along_y = np.concatenate([of_kernel, of_kernel[1:-1][::-1]])
    # A thousand fractions, not quite even; the pixels of the image are 1.3 % smaller than those of the tile.
    assert np.allclose(transfer, along_y[:, None] * of_kernel, rtol=0, atol=0.05)


def test_a_broadened_psf_is_the_resampled_one():
    y, x = np.indices((31, 31)) - 15
    psf = np.exp(-0.5 * (x**2 / 1.4**2 + y**2 / 1.2**2))
    psf /= psf.sum()
    found = broadened(psf[None], mean_transfer(TILE, FRAME, [Shifted((0.5, 0.0))]))[0]
    # Moved by half a pixel exactly, back by cubic convolution.
    moved = np.exp(-0.5 * ((x - 0.5) ** 2 / 1.4**2 + y**2 / 1.2**2)) / (2.0 * np.pi * 1.4 * 1.2)
    weights = {-1: 9.0 / 16.0, 0: 9.0 / 16.0, -2: -1.0 / 16.0, 1: -1.0 / 16.0}
    expected = sum(w * np.roll(moved, j, axis=1) for j, w in weights.items())
    assert np.allclose(found, expected, rtol=0, atol=1e-4 * psf.max())
    assert found.max() == pytest.approx(expected.max(), rel=1e-4)
    assert found.max() < 0.99 * psf.max()


def test_the_correlation_of_noise_has_the_closed_form():
    assert np.allclose(mean_noise_correlation(TILE, FRAME, [Shifted((0.0, 0.0))]), np.pad([[1.0]], 5), atol=1e-12)
    # Weights -1/16, 9/16, 9/16, -1/16 at half a pixel along x.
    weights = np.array([-1.0, 9.0, 9.0, -1.0]) / 16.0
    along_x = np.correlate(weights, weights, "full") / (weights**2).sum()
    correlation = mean_noise_correlation(TILE, FRAME, [Shifted((0.5, 0.0))])
    assert np.allclose(correlation[5, 2:9], along_x, rtol=0, atol=1e-12)
    assert np.allclose(np.delete(correlation, 5, axis=0), 0.0, rtol=0, atol=1e-12)


class Rotated(Shifted):
    """Pixels of an image that is rotated by 0.5 rad against the tile."""

    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])

    def to_pixel(self, sky):
        return sky @ self.turn.T + 2000.5 + self.shift

    def jacobians(self, pixels):
        return np.broadcast_to(self.turn, (len(pixels), 2, 2))


def test_the_correlation_of_noise_is_that_of_resampled_noise():
    """White noise, resampled by hand along the axes of a rotated image."""
    rng, wcs = np.random.default_rng(1), Rotated((0.2, 0.3))
    x, y = np.meshgrid(np.arange(300.0), np.arange(300.0))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2) @ Rotated.turn.T + 200.0
    noise, first = rng.standard_normal((700, 700)), np.floor(pixels).astype(int)
    resampled = np.zeros(len(pixels))
    for i in range(-1, 3):
        for j in range(-1, 3):
            a, b = np.abs(pixels - first - np.array([i, j])).T
            along_x, along_y = (
                np.where(d < 1.0, 1.5 * d**3 - 2.5 * d**2 + 1.0, -0.5 * d**3 + 2.5 * d**2 - 4.0 * d + 2.0)
                for d in (a, b)
            )
            resampled += along_x * along_y * noise[first[:, 1] + j, first[:, 0] + i]
    image = resampled.reshape(300, 300)
    correlation = mean_noise_correlation(TILE, FRAME, [wcs])
    for dx, dy in ((1, 0), (0, 1), (1, 1), (-1, 1), (2, 0), (0, 3)):
        one, two = image[: 300 - dy, max(0, -dx) : 300 - max(0, dx)], image[dy:, max(0, dx) : 300 + min(0, dx)]
        # 90 000 pixels; a hundred nodes stand for all fractions.
        assert (one * two).mean() / (image**2).mean() == pytest.approx(correlation[5 + dy, 5 + dx], abs=0.02)
