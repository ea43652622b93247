"""Weightless pixels of stars filled by the elliptical Gaussian of the star's own moments."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .pixel_masks import fill_symmetric

#: A star is lost where bad pixels hold more than this fraction of its light above half of its peak, or of its light
#: under the weight of the moments: what is measured would be the model rather than the star.
MOST_MASKED = 0.5
# Passes end when no centroid or size [pixel] changes by more than this: a hundredth of the error of a star of S/N 200.
_CONVERGED = 1e-4
# Most passes: what changes falls by the masked fraction of the light, a half or less, each time.
_MOST_PASSES = 20
# Least inverse variance of a Gaussian over that of the weight: a star ten times as wide as the weight is sky.
_WIDEST = 0.01


class MaskedMoments(NamedTuple):
    """Centroids from the centre of the stamps [pixel] and weighted shapes of stars, [n] each; NaN where they fail."""

    x: np.ndarray
    y: np.ndarray
    e1: np.ndarray  #: (a - b)/(a + b) along x
    e2: np.ndarray  #: along the diagonal x = y
    size: np.ndarray  #: fourth root of the determinant of the moments [pixel]


def fill_by_moments(
    images: np.ndarray, bad: np.ndarray, measure: Callable[[np.ndarray], MaskedMoments], sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fill bad pixels by the Gaussian of the moments of the filled star, and by what the opposite pixel exceeds it.

    The first guess is the mean of good neighbours. The amplitude is that of least squares in the good pixels under the
    weight. A PSF is nearly even, so its deviation from a Gaussian opposite the centroid is a good guess of that in the
    pixel, the mean of the deviations in good neighbours where both are bad.

    Parameters
    ----------
    images, bad : array
        Background-subtracted stars, each with a bad pixel, and these pixels, [n, ny, nx].
    measure : callable
        From complete images [m, ny, nx] to their moments under a round Gaussian weight about the centroid.
    sigma : float
        rms width of that weight [pixel].

    Returns
    -------
    tuple of array
        Filled stars [n, ny, nx], and those that are lost (:data:`MOST_MASKED`), [n] bool.
    """
    # No pixel stands opposite a centre out there: bad ones hold the mean of good neighbours, sky where there are none.
    outside = float(max(images.shape))
    filled = fill_symmetric(images, bad, outside, outside)
    lost = np.zeros(len(images), dtype=bool)
    active = np.arange(len(images))
    previous = np.full((len(images), 3), np.inf)
    for _ in range(_MOST_PASSES):
        moments = measure(filled[active])
        measured = np.isfinite(np.stack(moments)).all(axis=0)
        lost[active[~measured]] = _mostly_bad(bad[active[~measured]])
        active = active[measured]
        moments = MaskedMoments(*(values[measured] for values in moments))
        models = np.empty((len(active), *images.shape[1:]))
        for k, (i, star) in enumerate(zip(active, zip(*moments, strict=True), strict=True)):
            models[k], lost[i] = _gaussian_of(images[i], bad[i], MaskedMoments(*star), sigma)
        residuals = fill_symmetric(images[active] - models, bad[active], moments.x, moments.y)
        filled[active] = np.where(bad[active], models + residuals, images[active])
        state = np.stack([moments.x, moments.y, moments.size], axis=1)
        changed = (np.abs(state - previous[active]) > _CONVERGED).any(axis=1)
        previous[active] = state
        active = active[changed & ~lost[active]]
        if not len(active):
            break
    return filled, lost


def _mostly_bad(bad: np.ndarray) -> np.ndarray:
    """Return the stamps [n, ny, nx] without a good pixel in half of those near the centre, [n] bool."""
    rows, columns = (slice(n // 3, n - n // 3) for n in bad.shape[1:])
    return np.asarray(bad[:, rows, columns].mean(axis=(1, 2)) > MOST_MASKED)


def _gaussian_of(image: np.ndarray, bad: np.ndarray, star: MaskedMoments, sigma: float) -> tuple[np.ndarray, bool]:
    """Return the Gaussian of the moments of a star [ny, nx], and whether the star is lost."""
    ny, nx = image.shape
    x = np.arange(nx) - 0.5 * (nx - 1) - star.x
    y = (np.arange(ny) - 0.5 * (ny - 1) - star.y)[:, None]
    # e = (Q11 - Q22 + 2i Q12)/(Q11 + Q22 + 2 det^(1/2))
    root, square = star.size**2, star.e1**2 + star.e2**2
    trace = 2.0 * root * (1.0 + square) / (1.0 - square)
    difference, twice_cross = star.e1 * (trace + 2.0 * root), star.e2 * (trace + 2.0 * root)
    weighted = 0.5 * np.array([[trace + difference, twice_cross], [twice_cross, trace - difference]])
    # Under the weight the inverse covariances of star and weight add up.
    values, axes = np.linalg.eigh(np.linalg.inv(weighted) - np.eye(2) / sigma**2)
    values = np.maximum(values, _WIDEST / sigma**2)
    inverse = (axes * values) @ axes.T
    gaussian = np.exp(-0.5 * (inverse[0, 0] * x**2 + 2.0 * inverse[0, 1] * x * y + inverse[1, 1] * y**2))
    light = np.exp(-0.5 * (x**2 + y**2) / sigma**2) * gaussian
    good = ~bad
    norm = (light * gaussian)[good].sum()
    flux = (light * np.where(bad, 0.0, image)).sum() / norm if norm > 0.0 else 0.0
    model = flux * gaussian
    core = np.where(gaussian > 0.5, gaussian, 0.0)
    lost = any(part[bad].sum() > MOST_MASKED * part.sum() for part in (core, light))
    return model, lost
