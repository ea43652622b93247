"""Pixels as the basis of the stars of a CCD: every pixel is its own component."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from .basis import Basis, FittedBasis, eigenvalues_of
from .clean_stars import CleanStars
from .file_parts import ModelParts


@check_arguments
@dataclass(frozen=True)
class Pixels(Basis):
    """Every pixel on its own: the same as all eigen-PSFs together."""

    name = "pixels"
    words = "each pixel on its own"
    has_components = False

    def __post_init__(self) -> None:
        if self.n_components is not None:
            raise ConfigError(
                f"n_components = {self.n_components}: expected None with basis = 'pixels', which has them all"
            )

    def most_components(self, n_stars: int, n_pixels: int) -> tuple[int, str]:
        """Return the number of pixels."""
        return n_pixels, f"the pixels ({n_pixels})"

    def component_count(self, n_stars: int, n_pixels: int) -> int:
        """Return the number of pixels."""
        return n_pixels

    def fit(
        self, stars: CleanStars, shape: tuple[int, int], count: int, weights: np.ndarray | None = None
    ) -> PixelGrid:
        """Return the mean of stars of a shape (ny, nx), and unit vectors."""
        # By products of the stars, in a fraction of the time of a singular value decomposition.
        rows = stars.deviations if len(stars.deviations) < stars.mean.size else stars.deviations.T
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(rows @ rows.T)[::-1], 0.0))
        return PixelGrid(stars.mean.reshape(shape), unit_images(shape), eigenvalues_of(singular, stars))


@dataclass(frozen=True, eq=False)
class PixelGrid(FittedBasis, kind=Pixels):
    """Mean of the stars and unit vectors."""

    def project(self, stars: CleanStars) -> tuple[np.ndarray, np.ndarray]:
        """Return the deviations of the pixels, which leave nothing."""
        return stars.deviations, np.zeros(len(stars.deviations))

    def at(self, coefficients: np.ndarray) -> np.ndarray:
        """Return mean plus deviations [n, n_pixels], [n, ny, nx]."""
        return np.asarray(self.mean + coefficients.reshape(-1, *self.mean.shape))

    def deviations(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the deviations, which the coefficients are."""
        return coefficients

    def parts(self) -> ModelParts:
        """Return what the basis has in a FITS file: unit vectors would be thirty times the size of all else."""
        parts = super().parts()
        return ModelParts(parts.cards, {"MEAN": self.mean})

    @classmethod
    def of_parts(cls, parts: ModelParts) -> PixelGrid:
        """Return the basis in a FITS file; KeyError where something is missing."""
        mean = parts.image("MEAN")
        return cls(mean, unit_images(mean.shape), parts.eigenvalues)


def unit_images(shape: tuple[int, ...]) -> np.ndarray:
    """Return the unit matrix [n_pixels, ny, nx], read-only, in the memory of two of its rows.

    Every model of pixels has one: thousands of pixels would need a hundred megabytes each.
    """
    count = int(np.prod(shape))
    unit = np.zeros(2 * count - 1)
    unit[count - 1] = 1.0
    return np.lib.stride_tricks.sliding_window_view(unit, count)[::-1].reshape(count, *shape)
