"""Pixels of star stamps that do not belong to the star: cosmic rays, neighbours, bad pixels."""

from __future__ import annotations

import numpy as np

# A pixel that differs by less than five times this fraction of the PSF's peak is no cosmic ray, however quiet the stamps.
_FLOOR = 1e-4


def find_outliers(images: np.ndarray, terms: np.ndarray, clip_sigma: float, max_iterations: int) -> np.ndarray:
    """Find pixels that stand out from the smooth change of the PSF across the CCD.

    Each pixel of the normalised stamps is fitted, across the stars, by a polynomial in position: deviations from the mean
    PSF alone would single out the stars in the corners, where the PSF differs most. What is left over is compared with
    its robust scatter (1.48 times the median absolute deviation), that of the pixel over the stars and that of the star
    over its pixels in quadrature. For the comparison a star is scaled to the surface by least squares over its good
    pixels: its sum, over a thousand pixels of sky noise, would be off by far more than the star's own noise.

    One bright pixel spoils its star's flux and its neighbours' fit, so each pass rejects only what is at least half as
    bad as the worst pixel of its star and as the worst star in its pixel; then everything is fitted again.

    Parameters
    ----------
    images : array
        [n_stars, n_pixels], not normalised.
    terms : array
        [n_stars, n_terms] of the polynomial, linearly independent, the constant among them.
    clip_sigma : float
        Deviations beyond this many standard deviations are rejected.
    max_iterations : int
        Most passes.

    Returns
    -------
    array of bool
        [n_stars, n_pixels] True where rejected.
    """
    rejected = np.zeros(images.shape, dtype=bool)
    q, _ = np.linalg.qr(terms)
    hat = q @ q.T
    spread = np.sqrt(np.maximum(1.0 - np.diag(hat), 1e-3))  # a residual is smaller than its error by this factor
    flux = _scale(images, hat @ (images / images.sum(axis=1)[:, None]), rejected)
    for _ in range(max_iterations):
        surface = _fit_good(images / flux[:, None], rejected, hat)
        flux = _scale(images, surface, rejected)
        deviation = np.abs(images / flux[:, None] - surface) / spread[:, None]
        deviation[rejected] = np.nan
        with np.errstate(invalid="ignore"):
            scale = np.hypot(
                1.4826 * _median(deviation, axis=0)[None, :], 1.4826 * _median(deviation, axis=1)[:, None]
            )
            scale = np.maximum(scale, _FLOOR * surface.max())
            suspect = np.where(deviation > clip_sigma * scale, deviation, 0.0)
        worst = np.maximum(suspect.max(axis=0)[None, :], suspect.max(axis=1)[:, None])
        new = (suspect > 0.0) & (suspect >= 0.5 * worst)
        if not new.any():
            break
        rejected |= new
    return rejected


def _fit_good(values: np.ndarray, rejected: np.ndarray, hat: np.ndarray) -> np.ndarray:
    """Return the least-squares surface of every pixel, fitted to the stars that are not rejected there.

    Leaving stars out of a fit is the same as giving them the values at which their residuals vanish.
    """
    filled = np.where(rejected, 0.0, values)
    for pixel in np.flatnonzero(rejected.any(axis=0)):
        bad = np.flatnonzero(rejected[:, pixel])
        known = hat[bad] @ filled[:, pixel]
        filled[bad, pixel] = np.linalg.lstsq(np.eye(len(bad)) - hat[np.ix_(bad, bad)], known, rcond=1e-10)[0]
    return hat @ filled


def _scale(images: np.ndarray, surface: np.ndarray, rejected: np.ndarray) -> np.ndarray:
    """Return the factor of each star that brings the surface closest to it over its good pixels, [n_stars]."""
    good = np.where(rejected, 0.0, surface)
    return (images * good).sum(axis=1) / (good**2).sum(axis=1)


def _median(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the median of the numbers that are not NaN along an axis, zero where there is none."""
    count = np.isfinite(values).sum(axis=axis)
    ordered = np.sort(values, axis=axis)  # NaN last
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2 * (count > 0)])
    middle = np.minimum(middle, values.shape[axis] - 1)
    if axis == 0:
        median = 0.5 * np.take_along_axis(ordered, middle, axis=0).sum(axis=0)
    else:
        median = 0.5 * np.take_along_axis(ordered, middle.T, axis=1).sum(axis=1)
    return np.where(count > 0, median, 0.0)
