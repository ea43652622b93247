"""Pixels of star stamps that do not belong to the star: cosmic rays, neighbours, bad pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from ...core.statistics import RMS_PER_MAD, column_percentile, row_medians, sorted_columns
from ...measure.star_flux import fitted_fluxes, median_star

# Standard deviation of the PSF itself within a CCD: this fraction of the geometric mean of the pixel's value and the
# peak's. The wings may change by more of themselves than the core.
_PSF_CHANGE = 0.04
# ... and of the peak anywhere: what deviates less is no cosmic ray, however quiet the stamps are.
_FLOOR = 1e-4
# A star's rejected pixels come back if the other stars' polynomials predict their deviations from the mean this well.
_PREDICTED = 0.1
# One less the leverage of a star that the others predict: as many terms as stars fit everything.
_LEAST_ROOM = 1e-6


@check_arguments
@dataclass(frozen=True)
class SigmaClipping:
    """Rejection of the pixels of stars that stand out from the mean PSF.

    Parameters
    ----------
    sigma : float
        Pixels that deviate by more standard deviations are rejected (:func:`find_outliers`); none where it is infinite.
    max_iterations : int
        Most passes of the rejection.
    replacement : str
        What stands for rejected pixels: the ``mean`` of the stars, as in Jee & Tyson 2011, or as for masked ones the
        ``polynomial`` of the others.

    Raises
    ------
    ConfigError
        If an option is out of its range.
    """

    sigma: float = 5.0
    max_iterations: int = 20
    replacement: Literal["mean", "polynomial"] = "mean"

    def __post_init__(self) -> None:
        if not self.sigma > 0.0:
            raise ConfigError(f"sigma = {self.sigma}: expected a positive number of standard deviations", key="sigma")
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations = {self.max_iterations}: expected at least 1", key="max_iterations")


def find_outliers(images: np.ndarray, clip_sigma: float, max_iterations: int) -> np.ndarray:
    """Return the pixels that stand out from the mean PSF, bool; stars [n_stars, n_pixels] need not be normalised.

    A pixel's deviation is compared with `clip_sigma` times three standard deviations in quadrature: that of the pixel
    over the stars, that of the star over its pixels, and an allowance for the PSF's change within the CCD. The first is
    taken from the 80th percentile, which unlike the median includes the few stars in the corners, where the PSF differs
    most; three times the one from the median is its upper bound, should more than a fifth of the stars be bad in that
    pixel. Mean and fluxes come from the pixels not rejected, and all pixels are compared anew until nothing changes.
    Stars are scaled to the mean by least squares: the sum over a thousand pixels of sky noise would be off by far more
    than the star's own noise.
    """
    mean, flux = _first_guess(images)
    rejected = np.zeros(images.shape, dtype=bool)
    for _ in range(max_iterations):
        deviation = np.abs(images / flux[:, None] - mean)
        rising = sorted_columns(deviation)
        middle, high = (column_percentile(rising, percent) for percent in (50.0, 80.0))
        over_stars = np.minimum(high / 1.2816, 3.0 * RMS_PER_MAD * middle)
        over_pixels = RMS_PER_MAD * row_medians(deviation)
        allowance = np.maximum(_PSF_CHANGE * np.sqrt(np.maximum(mean, 0.0) * mean.max()), _FLOOR * mean.max())
        scale = np.sqrt(over_pixels[:, None] ** 2 + over_stars**2 + allowance**2)
        before, rejected = rejected, deviation > clip_sigma * scale
        if np.array_equal(before, rejected):
            break
        good = ~rejected
        good[:, rejected.all(axis=0)] = True
        mean = np.where(good, images / flux[:, None], 0.0).sum(axis=0) / good.sum(axis=0)
        mean /= mean.sum()
        flux = fitted_fluxes(images, good, mean)[0]
    return rejected


def restore_predicted(values: np.ndarray, mean: np.ndarray, rejected: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return the rejected pixels without those of stars whose deviation from the mean the other stars predict.

    Where the PSF changes by much, a star in a corner of the CCD may stand out from the mean. The polynomial in position
    through the other stars predicts a smooth change in all of the star's rejected pixels, to a tenth of the deviation,
    but no cosmic ray. `values` [n_stars, n_pixels] have unit sum; `terms` [n_stars, n_terms] are linearly independent.
    """
    q, _ = np.linalg.qr(terms)
    residual = values - q @ (q.T @ values)
    # The residual of a star in the fit is 1 - leverage times its distance from what the others predict.
    room = 1.0 - (q**2).sum(axis=1)[:, None]
    predicted = np.abs(residual) <= _PREDICTED * room * np.abs(values - mean)
    surprising = rejected & ~(predicted & (room > _LEAST_ROOM))
    return rejected & surprising.any(axis=1)[:, None]


def _first_guess(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median star [n_pixels] and fluxes [n_stars] by the median of each star's bright pixels."""
    total = images.sum(axis=1)
    median = median_star(images)
    bright = median > 0.2 * median.max()
    flux = row_medians(images[:, bright] / median[bright])
    return median, np.where(flux > 0.0, flux, total)
