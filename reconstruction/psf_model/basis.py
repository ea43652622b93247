"""Bases in which the stars of a CCD are described: what all have in common, and the number of eigen-PSFs.

A basis is a mean PSF of unit sum and orthonormal components that sum to zero, so that every combination has unit sum.
A subclass of :class:`Basis` holds the options of a kind, one of :class:`FittedBasis` what it makes of stars, with its
part of a FITS file. A new kind is one file, and an entry in :data:`~.recipe.BASES`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ...core.errors import ConfigError
from .clean_stars import CleanStars
from .file_parts import ModelParts

#: Components where no number is given (Jee & Tyson 2011, sec. 3).
COMPONENTS = 20
#: Most components from which an automatic choice is made.
_MOST_COMPONENTS = 65


@dataclass(frozen=True)
class Basis(ABC):
    """Options of a basis."""

    name: ClassVar[str]
    fitted: ClassVar[type[FittedBasis]]
    #: In the report of a run, after the number of components.
    words: ClassVar[str]
    #: Whether the components are those of the stars, by falling variance: the first ones are the best so many.
    ordered: ClassVar[bool] = False
    #: Whether there are components to choose; else every pixel is one.
    has_components: ClassVar[bool] = True

    #: Components to keep; ``auto`` for as many as predict the shapes of held-out stars best.
    n_components: int | Literal["auto"] | None = None

    @property
    def automatic(self) -> bool:
        """Whether the number of components is chosen by the stars."""
        return self.n_components == "auto"

    @property
    def least_stars(self) -> int:
        """Fewest stars of a fit."""
        return 2

    @abstractmethod
    def most_components(self, n_stars: int, n_pixels: int) -> tuple[int, str]:
        """Return the largest number of components, and what limits it."""

    def component_count(self, n_stars: int, n_pixels: int) -> int:
        """Return how many components to make, of an automatic choice the largest number; ConfigError if impossible."""
        limit, reason = self.most_components(n_stars, n_pixels)
        if self.automatic:
            return min(limit, _MOST_COMPONENTS)
        count = self.n_components
        if isinstance(count, bool) or not isinstance(count, (int, np.integer)):
            raise ConfigError(f"n_components = {count!r}: expected a whole number, 'auto' or None")
        if not 1 <= count <= limit:
            raise ConfigError(f"n_components = {count}: expected 1 to {limit}, no more than {reason}")
        return int(count)

    @abstractmethod
    def fit(
        self, stars: CleanStars, shape: tuple[int, int], count: int, weights: np.ndarray | None = None
    ) -> FittedBasis:
        """Return mean and `count` components of stars of a shape (ny, nx), with `weights` [n_stars] where they matter.

        ConfigError if the stamps do not resolve that many.
        """


@dataclass(frozen=True, eq=False)
class FittedBasis:
    """A mean and components."""

    kind: ClassVar[type[Basis]]

    mean: np.ndarray  #: [ny, nx], unit sum
    components: np.ndarray  #: [k, ny, nx], orthonormal, each of sum zero; of pixels the unit vectors
    eigenvalues: np.ndarray  #: variance of the stars along their principal components, falling, [min(n - 1, ny nx)]

    def __init_subclass__(cls, kind: type[Basis]) -> None:
        super().__init_subclass__()
        cls.kind, kind.fitted = kind, cls

    @property
    def name(self) -> str:
        """Name of the kind."""
        return self.kind.name

    @property
    def vectors(self) -> np.ndarray:
        """The components, [k, n_pixels]."""
        return self.components.reshape(len(self.components), -1)

    def project(self, stars: CleanStars) -> tuple[np.ndarray, np.ndarray]:
        """Project stars: coefficients [n_stars, k], and residual sums of squares [n_stars]."""
        deviations = self._deviations_of(stars)
        coefficients = deviations @ self.vectors.T
        return coefficients, ((deviations - coefficients @ self.vectors) ** 2).sum(axis=1)

    def _deviations_of(self, stars: CleanStars) -> np.ndarray:
        """Return the deviations of stars from the mean of the basis, [n_stars, n_pixels]."""
        return stars.deviations

    def at(self, coefficients: np.ndarray) -> np.ndarray:
        """Return mean plus coefficients [n, k] times components, [n, ny, nx]; no batch size matters."""
        images = np.repeat(self.mean[None], len(coefficients), axis=0)
        for k, component in enumerate(self.components):  # no BLAS: its sums depend on the batch
            images += coefficients[:, k, None, None] * component
        return images

    def deviations(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the deviations of stars of coefficients [n, k] from the mean, [n, n_pixels]."""
        return coefficients @ self.vectors

    def variance_along(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the variance of stars of coefficients [n, k] along each component, [k]."""
        return np.asarray(coefficients.var(axis=0, ddof=1))

    def truncated(self, count: int) -> Self:
        """Return the basis with its first components only; ConfigError if there are fewer, or they have no order."""
        k = len(self.components)
        if not self.kind.has_components or not 1 <= count <= k:
            raise ConfigError(f"n_components = {count}: expected 1 to {k} of a model of pca or shapelets")
        return replace(self, components=self.components[:count])

    def parts(self) -> ModelParts:
        """Return what the basis has in a FITS file."""
        return ModelParts(
            {"BASIS": (self.name, "kind of the components")}, {"MEAN": self.mean, "EIGEN": self.components}
        )

    @classmethod
    def of_parts(cls, parts: ModelParts) -> Self:
        """Return the basis in a FITS file; KeyError where something is missing."""
        return cls(parts.image("MEAN"), parts.image("EIGEN"), parts.eigenvalues, **cls._options_of(parts))

    @classmethod
    def _options_of(cls, parts: ModelParts) -> dict[str, Any]:
        """Return further fields."""
        return {}


def eigenvalues_of(singular: np.ndarray, stars: CleanStars) -> np.ndarray:
    """Return the variances of stars along their principal components from singular values."""
    n_stars, n_pixels = stars.deviations.shape
    return np.asarray(singular[: min(n_stars - 1, n_pixels)] ** 2 / (n_stars - 1))


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
