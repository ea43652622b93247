"""Eigen-PSFs: principal components of the stars of a CCD (Jee & Tyson 2011, sec. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from .basis import COMPONENTS, Basis, FittedBasis, eigenvalues_of
from .clean_stars import CleanStars
from .file_parts import ModelParts


@check_arguments
@dataclass(frozen=True)
class PrincipalComponents(Basis):
    """Eigen-PSFs of the stars, those of largest variance; at most as many as stars less one."""

    name = "pca"
    words = "principal components a CCD"
    ordered = True

    n_components: int | Literal["auto"] | None = COMPONENTS

    @property
    def least_stars(self) -> int:
        """Fewest stars of a fit."""
        return 1 + (self.n_components if isinstance(self.n_components, int) else 1)

    def most_components(self, n_stars: int, n_pixels: int) -> tuple[int, str]:
        """Return the largest number of components, and what limits it."""
        return min(n_stars - 1, n_pixels), f"the stars ({n_stars}) less one"

    def fit(
        self, stars: CleanStars, shape: tuple[int, int], count: int, weights: np.ndarray | None = None
    ) -> EigenPsfs:
        """Return the `count` eigen-PSFs of largest eigenvalue, the element of largest magnitude of each positive.

        With `weights` [n_stars], of mean 1, each star counts in the covariance by its own.
        """
        deviations = stars.deviations if weights is None else stars.deviations * np.sqrt(weights)[:, None]
        _, singular, vectors = np.linalg.svd(deviations, full_matrices=False)
        vectors = vectors[:count]
        largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
        vectors = vectors * np.where(largest < 0.0, -1.0, 1.0)
        return EigenPsfs(stars.mean.reshape(shape), vectors.reshape(-1, *shape), eigenvalues_of(singular, stars))


@dataclass(frozen=True, eq=False)
class EigenPsfs(FittedBasis, kind=PrincipalComponents):
    """Mean of the stars and their eigen-PSFs."""

    def variance_along(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the variance of the stars along each component, [k]."""
        return self.eigenvalues[: len(self.components)]

    def parts(self) -> ModelParts:
        """Return what the basis has in a FITS file, where it is that of files without the card BASIS."""
        return ModelParts({}, super().parts().images)
