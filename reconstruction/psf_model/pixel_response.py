"""How the pixels of a PSF respond to its shape, by a mean star that has noise."""

from __future__ import annotations

import numpy as np

from ...core.statistics import signal_share

# Pixels of a ring that differ by its noise alone if they are fewer.
_SEVERAL = 4


def without_noise(star: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return a star [ny, nx] as far as it is above noise of variances [ny, nx].

    Far out a mean of faint stars is noise, and its slope there, times the distance, would be the largest response of
    all. So what a pixel differs by from the mean of its ring about the centre is taken as far as the pixels of the
    ring differ by more than their noise (Wiener), and so is the mean. Stars without noise stay what they are.
    """
    y, x = np.indices(star.shape) - np.array(star.shape)[:, None, None] // 2
    radius = np.hypot(x, y)
    ring = np.rint(radius).astype(int).ravel()
    count = np.bincount(ring)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.bincount(ring, values.ravel()) / count)

    centre, variance, profile = mean(radius), mean(noise), mean(star)
    profile *= signal_share(profile**2, variance / count, np.sqrt(2.0))
    smooth = np.interp(radius, centre, profile)
    difference = star - smooth
    share = signal_share(mean(difference**2), variance, np.sqrt(2.0 / count))
    several = count >= _SEVERAL
    return np.asarray(smooth + np.interp(radius, centre[several], share[several]) * difference)


def shape_response(star: np.ndarray) -> np.ndarray:
    """Return the changes of a PSF [ny, nx] by a stretch along x, along x = y, and by magnification, [3, n_pixels].

    None of them changes the sum of the pixels.
    """
    y, x = np.indices(star.shape) - np.array(star.shape)[:, None, None] // 2
    along_y, along_x = _slope(star), _slope(star.T).T
    response = -np.stack(
        [x * along_x - y * along_y, x * along_y + y * along_x, x * along_x + y * along_y + 2.0 * star]
    ).reshape(3, -1)
    return np.asarray(response - response.sum(axis=1, keepdims=True) * star.ravel() / star.sum())


def _slope(image: np.ndarray) -> np.ndarray:
    """Return the derivative along the first axis, by differences of fourth order: stars are few pixels wide."""
    padded = np.pad(image, ((2, 2), (0, 0)), mode="edge")
    return np.asarray((8.0 * (padded[3:-1] - padded[1:-3]) - (padded[4:] - padded[:-4])) / 12.0)
