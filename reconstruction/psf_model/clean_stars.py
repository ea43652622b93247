"""Stars of a CCD to be modelled: outliers rejected, masked pixels filled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...measure.star_flux import star_fluxes
from .masked_pixels import fill_masked, mean_and_flux
from .outliers import SigmaClipping, find_outliers, restore_predicted


@dataclass(frozen=True, eq=False)
class CleanStars:
    """Stars of unit sum without outliers and masked pixels."""

    mean: np.ndarray  #: mean of the stars, [n_pixels], unit sum
    deviations: np.ndarray  #: of the stars from it, [n_stars, n_pixels]
    rejected: np.ndarray  #: outliers, [n_stars, n_pixels] bool
    flux: np.ndarray  #: of the stars, [n_stars], in the unit of their stamps

    def of_stars(self, chosen: np.ndarray) -> CleanStars:
        """Return some of the stars, about the same mean."""
        return CleanStars(self.mean, self.deviations[chosen], self.rejected[chosen], self.flux[chosen])

    def about_weighted_mean(self, weights: np.ndarray) -> CleanStars:
        """Return the stars about their mean with weights [n_stars]."""
        shift = weights @ self.deviations / weights.sum()
        return CleanStars(self.mean + shift, self.deviations - shift, self.rejected, self.flux)


def cleaned_stars(
    images: np.ndarray,
    masked: np.ndarray,
    terms: np.ndarray,
    clipping: SigmaClipping | None,
) -> CleanStars:
    """Return the stars of a CCD without outliers; `clipping` as in :meth:`~.PsfModel.fit`.

    `images` [n_stars, ny, nx] are finite and of any flux; pixels in `masked` are not used. The polynomial terms at the
    stars [n_stars, n_terms] keep stars whose deviation the others predict, and fill masked pixels.
    """
    pixels, filled_pixels = images.reshape(len(images), -1), masked.reshape(len(images), -1)
    if filled_pixels.any():
        guess, flux = mean_and_flux(pixels, filled_pixels)
        pixels = np.where(filled_pixels, flux[:, None] * guess, pixels)
    rejected = np.zeros(pixels.shape, dtype=bool)
    if clipping is not None:
        rejected = find_outliers(pixels, clipping.sigma, clipping.max_iterations) & ~filled_pixels
    mean, flux = mean_and_flux(pixels, rejected)
    if rejected.any():
        rejected = restore_predicted(pixels / star_fluxes(pixels, profile=mean)[:, None], mean, rejected, terms)
        mean, flux = mean_and_flux(pixels, rejected)
    deviations = np.where(rejected, 0.0, pixels / flux[:, None] - mean)
    # What the sum of a star of this flux still differs from one by is noise of all pixels.
    excess = deviations.sum(axis=1) / np.maximum((~rejected).sum(axis=1), 1)
    deviations -= np.where(rejected, 0.0, excess[:, None])

    by_mean = rejected & (clipping is not None and clipping.replacement == "mean")
    filled_pixels = filled_pixels | (rejected & ~by_mean)
    if filled_pixels.any():
        stars = fill_masked(mean + deviations, filled_pixels, by_mean, terms)
        mean = stars.mean(axis=0)
        deviations = np.where(by_mean, 0.0, stars - mean)
    return CleanStars(mean, deviations, rejected, flux)
