"""Stamps in a basis: outliers rejected, masked pixels filled, stars projected on components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .basis import Basis, pixel_grid, principal_components, shapelets
from .masked_pixels import fill_masked, mean_and_flux
from .outliers import find_outliers, restore_predicted


@dataclass(frozen=True, eq=False)
class Description:
    """Stars in a basis."""

    basis: Basis
    coefficients: np.ndarray  #: projections of the stars, [n_stars, k]
    unexplained: np.ndarray  #: squares of the residual summed over pixels, [n_stars]
    rejected: np.ndarray  #: outliers, [n_stars, n_pixels] bool


def describe(
    images: np.ndarray,
    masked: np.ndarray,
    terms: np.ndarray,
    *,
    basis: str,
    count: int,
    scale: float | None,
    clip_sigma: float | None,
    max_iterations: int,
    replacement: str,
) -> Description:
    """Describe the stars of a CCD in a basis; options as in :meth:`~.PsfModel.fit`.

    `images` [n_stars, ny, nx] are finite and of any flux; pixels in `masked` are not used. The polynomial terms at the
    stars [n_stars, n_terms] keep stars whose deviation the others predict, and fill masked pixels.
    """
    shape = images.shape[1:]
    pixels, missing = images.reshape(len(images), -1), masked.reshape(len(images), -1)
    if missing.any():
        guess, flux = mean_and_flux(pixels, missing)
        pixels = np.where(missing, flux[:, None] * guess, pixels)
    rejected = np.zeros(pixels.shape, dtype=bool)
    if clip_sigma is not None:
        rejected = find_outliers(pixels, clip_sigma, max_iterations) & ~missing
    mean, flux = mean_and_flux(pixels, rejected)
    if rejected.any():
        rejected = restore_predicted(pixels / pixels.sum(axis=1)[:, None], mean, rejected, terms)
        mean, flux = mean_and_flux(pixels, rejected)
    deviations = np.where(rejected, 0.0, pixels / flux[:, None] - mean)

    by_mean = rejected & (replacement == "mean")
    missing = missing | (rejected & ~by_mean)
    if missing.any():
        stars = fill_masked(mean + deviations, missing, by_mean, terms)
        mean = stars.mean(axis=0)
        deviations = np.where(by_mean, 0.0, stars - mean)
    if basis == "pixels":
        return Description(pixel_grid(mean, deviations), deviations, np.zeros(len(deviations)), rejected)
    if basis == "pca":
        found = principal_components(mean, deviations, count)
    else:
        found = shapelets(mean, deviations, count, shape, scale)
        deviations = deviations + (mean - found.mean)  # its mean is not that of the stars
    coefficients = deviations @ found.vectors.T
    unexplained = ((deviations - coefficients @ found.vectors) ** 2).sum(axis=1)
    return Description(found, coefficients, unexplained, rejected)
