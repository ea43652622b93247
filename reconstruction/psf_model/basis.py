"""Bases in which the stars of a CCD are described: eigen-PSFs, the pixels themselves, and shapelets.

A basis is a mean PSF of unit sum and orthonormal components that sum to zero, so that every combination has unit sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import ConfigError

#: Names of the bases.
BASES = ("pca", "pixels", "shapelets")
# Scales of shapelets tried first, over the rms width of the mean star, before the best is refined.
_SCALES = np.geomspace(0.4, 1.6, 13)
# Most components for the choice of the scale: with many, the residual hardly depends on it.
_FOR_SCALE = 20
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class Basis:
    """A mean and components."""

    mean: np.ndarray  #: [n_pixels], unit sum
    vectors: np.ndarray  #: [k, n_pixels], orthonormal, each of sum zero; of pixels the unit vectors
    spectrum: np.ndarray  #: singular values of the stars' deviations from their mean, falling
    scale: float = np.nan  #: of shapelets [pixel]


def principal_components(
    mean: np.ndarray, deviations: np.ndarray, count: int, weights: np.ndarray | None = None
) -> Basis:
    """Return the `count` eigen-PSFs of largest eigenvalue, the element of largest magnitude of each positive.

    `deviations` [n_stars, n_pixels] are the stars less their mean [n_pixels]. With `weights` [n_stars], of mean 1, each
    star counts in the covariance by its own.
    """
    if weights is not None:
        deviations = deviations * np.sqrt(weights)[:, None]
    _, singular, vectors = np.linalg.svd(deviations, full_matrices=False)
    vectors = vectors[:count]
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
    return Basis(mean, vectors * np.where(largest < 0.0, -1.0, 1.0), singular)


def pixel_grid(mean: np.ndarray, deviations: np.ndarray) -> Basis:
    """Return the basis in which every pixel is its own component."""
    return Basis(mean, identity(len(mean)), np.linalg.svd(deviations, compute_uv=False))


def identity(count: int) -> np.ndarray:
    """Return the unit matrix [count, count], read-only, in the memory of two of its rows.

    Every model of pixels has one: thousands of pixels would need a hundred megabytes each.
    """
    unit = np.zeros(2 * count - 1)
    unit[count - 1] = 1.0
    return np.lib.stride_tricks.sliding_window_view(unit, count)[::-1]


def shapelets(
    mean: np.ndarray, deviations: np.ndarray, count: int, shape: tuple[int, int], scale: float | None
) -> Basis:
    """Return Gauss-Hermite functions (Refregier 2003) of the scale with the least residual of the stars.

    The first `count` + 1 shapelets by total order, sampled at the centres of the pixels about the centre of the stamp,
    and restricted to unit sum, make a mean and `count` components. The mean is the projection of the mean star: what
    the shapelets truncate is left out, as in the shapelet method that Jee & Tyson 2011, sec. 3, compare with. `mean`
    and `deviations` are as in :func:`principal_components`, `shape` is (ny, nx). `scale` is the rms width of the
    Gaussian [pixel]; None chooses the one with the least squares of the residuals of all stars. ConfigError if the
    stamps have too few pixels for independent shapelets.
    """
    if scale is None:
        scale = _best_scale(mean + deviations, min(count, _FOR_SCALE), shape)
    base, vectors = _unit_sum_shapelets(count, shape, scale)
    held = base + (vectors @ (mean - base)) @ vectors
    return Basis(held, vectors, np.linalg.svd(deviations, compute_uv=False), float(scale))


def shapelet_images(count: int, shape: tuple[int, int], scale: float) -> np.ndarray:
    """Return the first shapelets by total order, [count, ny, nx], sampled at the centres of the pixels.

    Within an order the one along x comes first. Each has unit square integral over the plane [pixel^-1]. `scale` is the
    rms width of the Gaussian of order zero [pixel].
    """
    # An order's amplitude is exp(-r^2 / 2 beta^2): the Gaussian of order zero has rms width beta.
    order = 0
    while (order + 1) * (order + 2) // 2 < count:
        order += 1
    along_y, along_x = (_hermite_functions(order, (np.arange(n) - (n - 1) / 2.0) / scale) for n in shape)
    pairs = [(total - m, m) for total in range(order + 1) for m in range(total + 1)][:count]
    return np.stack([along_y[m][:, None] * along_x[n] for n, m in pairs]) / scale


def _hermite_functions(order: int, x: np.ndarray) -> np.ndarray:
    """Return H_n(x) exp(-x^2/2) / sqrt(2^n n! sqrt(pi)) for n = 0 to `order`, by their recurrence."""
    rows = [np.pi**-0.25 * np.exp(-0.5 * x**2)]
    rows.append(np.sqrt(2.0) * x * rows[0])
    for n in range(1, order):
        rows.append(np.sqrt(2.0 / (n + 1)) * x * rows[n] - np.sqrt(n / (n + 1)) * rows[n - 1])
    return np.stack(rows[: order + 1])


def _unit_sum_shapelets(count: int, shape: tuple[int, int], scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussian of unit sum [n_pixels] and orthonormal combinations of sum zero [count, n_pixels].

    The first m components span the same combinations of sum zero as the first m + 1 shapelets.
    """
    images = shapelet_images(count + 1, shape, scale).reshape(count + 1, -1)
    base = images[0] / images[0].sum()
    changes = images[1:] - images[1:].sum(axis=1)[:, None] * base
    q, r = np.linalg.qr(changes.T)
    size = np.abs(np.diagonal(r))
    if count > len(base) - 1 or size.min() < 1e-8 * size.max():
        raise ConfigError(
            f"n_components = {count}: stamps of {shape[1]} x {shape[0]} pixels do not resolve that many shapelets "
            f"of scale {scale:.3g} pixels"
        )
    return base, (q * np.where(np.diagonal(r) < 0.0, -1.0, 1.0)).T


def _best_scale(stars: np.ndarray, count: int, shape: tuple[int, int]) -> float:
    """Return the scale with the least residual of the stars [n, n_pixels], by golden section."""
    width = _rms_width(stars.mean(axis=0).reshape(shape))

    def left(log_scale: float) -> float:
        try:
            base, vectors = _unit_sum_shapelets(count, shape, float(np.exp(log_scale)))
        except ConfigError:
            return np.inf
        rest = stars - base
        return float(((rest - (rest @ vectors.T) @ vectors) ** 2).sum())

    tried = np.log(_SCALES * width)
    values = [left(t) for t in tried]
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        _unit_sum_shapelets(count, shape, width)  # raises the error
    low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = left(a), left(b)
    while high - low > 1e-9:
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = left(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = left(b)
    return float(np.exp(0.5 * (low + high)))


def _rms_width(image: np.ndarray) -> float:
    """Return the rms width [pixel] of the part of a star above a tenth of its peak, without the wings."""
    y, x = np.indices(image.shape)
    light = np.where(image > 0.1 * image.max(), image, 0.0).ravel()
    light /= light.sum()
    x0, y0 = (light * x.ravel()).sum(), (light * y.ravel()).sum()
    return float(np.sqrt(0.5 * (light * ((x.ravel() - x0) ** 2 + (y.ravel() - y0) ** 2)).sum() + 0.25))


def elbow_of(eigenvalues: np.ndarray) -> int:
    """Return the number of falling eigenvalues before they flatten out.

    The index, counted from 0, at which their logarithm lies farthest below the straight line from the first to the
    middle one (Jee & Tyson 2011, sec. 3, find it by eye). Beyond the middle even pure noise falls steeply, for want of
    stars. Eigenvalues under 1e-14 of the first are rounding and do not count.
    """
    values = eigenvalues[: (len(eigenvalues) + 1) // 2]
    values = values[values > 1e-14 * values[0]]
    if len(values) < 3:
        return len(values)
    curve = np.log(values)
    return int(np.argmin(curve - np.linspace(curve[0], curve[-1], len(curve))))
