"""Interpolations of the stars' coefficients over a CCD: what all have in common.

A subclass of :class:`Interpolation` holds the options of a kind, one of :class:`FittedInterpolation` what it makes of
the stars, with its part of a FITS file. A new kind is one file, and an entry in :data:`~.recipe.INTERPOLATIONS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ...core.errors import ConfigError, PachonError, attempt
from ...core.row_sums import sums_of_products
from ...core.threads import one_blas_thread
from .basis import FittedBasis
from .checks import check_distinct_positions, check_terms
from .colour import FittedColour, StarColours
from .file_parts import ModelParts
from .polynomial import MOST_ORDER, Extent, automatic_orders, design_matrix

# Order of the polynomials that predict outliers and masked pixels where the interpolation has none of its own.
_SMOOTH_ORDER = 2


@dataclass(frozen=True, eq=False)
class StarField:
    """Stars in a basis, to be interpolated."""

    positions: np.ndarray  #: [n, 2]
    extent: Extent  #: of the CCD, in the unit of the positions
    order: int  #: of the polynomials
    terms: np.ndarray  #: of the polynomials at the stars, [n, n_terms]
    coefficients: np.ndarray  #: [n, k]
    weights: np.ndarray | None  #: of the stars, [n]; None for equal ones
    basis: FittedBasis
    electrons: np.ndarray | None  #: of the stars, [n]; None for no photon noise
    masked: np.ndarray | None = None  #: pixels of the stamps that are filled, [n, ny, nx]
    colours: StarColours | None = None  #: of the stars, where they differ

    @property
    def colour_terms(self) -> np.ndarray:
        """Terms of the colours at the stars, [n, n_colour_terms]; none without colours."""
        if self.colours is None:
            return np.empty((len(self.positions), 0))
        return self.colours.terms(self.positions, self.extent)

    def with_colour_terms(self) -> np.ndarray:
        """Return the terms of the polynomials and, behind them, of the colours, [n, n_terms + n_colour_terms]."""
        return self.terms if self.colours is None else np.hstack([self.terms, self.colour_terms])

    def fitted_colour(self, slope: np.ndarray, probability: float) -> FittedColour | None:
        """Return the dependence on the colour of coefficients [n_colour_terms, k]; None without colours."""
        return None if self.colours is None else FittedColour(self.colours, slope, probability)


@dataclass(frozen=True)
class Interpolation(ABC):
    """Options of an interpolation."""

    name: ClassVar[str]
    fitted: ClassVar[type[FittedInterpolation]]
    #: In titles, and in the report of a run before the polynomials.
    label: ClassVar[str]
    words: ClassVar[str]
    #: Whether it needs the noise of each star, by stamps in electrons, in place of weights.
    needs_noise: ClassVar[bool] = True

    #: Total degree of the polynomials, or of the trend under a process; ``auto`` lets held-out stars choose.
    order: int | Literal["auto"] = 0

    def __post_init__(self) -> None:
        if self.order != "auto" and not 0 <= self.order <= MOST_ORDER:
            raise ConfigError(f"order = {self.order}: expected a polynomial order from 0 to {MOST_ORDER}")
        if self.order == "auto" and self.needs_noise:
            raise ConfigError(f"order = 'auto': expected a number or None with interpolation = {self.name!r}")

    @property
    def fixed_order(self) -> int | None:
        """The order, or None where it is to be chosen."""
        return None if self.order == "auto" else int(self.order)

    @property
    def smooth_order(self) -> int:
        """Order of the polynomials that predict outliers and masked pixels."""
        return _SMOOTH_ORDER

    def orders(self, n_stars: int) -> list[int]:
        """Return the orders of polynomials that serve to choose components, and to weigh stars in eigen-PSFs."""
        return automatic_orders(n_stars)

    @property
    def least_stars(self) -> int:
        """Fewest stars of a fit."""
        return 2

    def parameter_count(self, n_stars: int) -> int:
        """Return the number of free parameters of a component."""
        return n_stars

    def check_stars(self, positions: np.ndarray, weights: Any) -> None:
        """Raise ConfigError or DomainError for stars that cannot be interpolated in this way."""
        if self.needs_noise:
            if weights is not None:
                raise ConfigError(
                    f"weights: expected none with interpolation = {self.name!r}, which fits the noise itself"
                )
            check_distinct_positions(positions, self.name)

    def check_terms(self, terms: np.ndarray, order: int, positions: np.ndarray, weights: np.ndarray | None) -> None:
        """Raise an error if the stars do not determine the polynomials of an order; a process shrinks their terms."""
        if not self.needs_noise:
            check_terms(terms, order, positions, weights)

    @abstractmethod
    def fit(self, stars: StarField) -> FittedInterpolation:
        """Fit the coefficients of stars."""

    def fit_each(self, ccds: Sequence[StarField]) -> list[FittedInterpolation | PachonError]:
        """Fit the coefficients of stars of several CCDs, with the error of a CCD in its place; as :meth:`fit`."""
        return [attempt(self.fit, stars) for stars in ccds]


@dataclass(frozen=True, eq=False)
class FittedInterpolation:
    """Coefficients between the stars: polynomials, which subclasses may add to."""

    kind: ClassVar[type[Interpolation]]
    #: Columns of the image KERNEL in files of kinds that have no card INTERP, as those before others came.
    kernel_columns: ClassVar[range | None] = None

    positions: np.ndarray  #: of the stars, [n, 2]
    extent: Extent  #: (xmin, xmax, ymin, ymax) of the CCD in the unit of the positions
    order: int  #: total degree of the polynomials
    polynomial: np.ndarray  #: coefficients of their terms, [n_terms, k]
    weights: np.ndarray | None  #: of the stars, [n]; under a process their inverse variances over the middle star's
    colour: FittedColour | None = field(default=None, kw_only=True)  #: dependence on the colour of stars that have one

    def __init_subclass__(cls, kind: type[Interpolation]) -> None:
        super().__init_subclass__()
        cls.kind, kind.fitted = kind, cls

    @property
    def name(self) -> str:
        """Name of the kind."""
        return self.kind.name

    @property
    def smoothness(self) -> dict[str, float]:
        """Probability of each form of the field over the CCD by the stars; empty where none is chosen."""
        return {}

    def terms(self) -> np.ndarray:
        """Return the terms of the polynomials at the stars and those of their colours, [n, n_terms]."""
        terms = design_matrix(self.positions, self.extent, self.order)
        if self.colour is None:
            return terms
        return np.hstack([terms, self.colour.stars.terms(self.positions, self.extent)])

    def leverage(self) -> np.ndarray:
        """Return the diagonal of the polynomials' hat matrix, [n]."""
        with one_blas_thread():
            q, _ = np.linalg.qr(weighted(self.terms(), self.weights))
        return np.asarray((q**2).sum(axis=1))

    def at(self, positions: Any) -> np.ndarray:
        """Evaluate the coefficients at positions [m, 2] for the mean colour, [m, k]; no batch size matters."""
        terms = design_matrix(positions, self.extent, self.order)
        return sums_of_products(terms, self.polynomial)

    def with_colour(self, positions: Any, colour: np.ndarray | None) -> np.ndarray:
        """Evaluate the coefficients at positions [m, 2] for colours [m] or one, [m, k]; None for the mean."""
        values = self.at(positions)
        if self.colour is None or colour is None:
            return values
        return np.asarray(values + self.colour.at(positions, self.extent, colour))

    def leave_one_out(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients [n, k] of the stars less their prediction by the other stars; NaN where there is none."""
        raise NotImplementedError

    @property
    def predicts_left_out(self) -> bool:
        """Whether :meth:`left_out` needs no other fit."""
        return False

    def left_out(self, parts: list[np.ndarray], coefficients: np.ndarray) -> np.ndarray:
        """Return predictions [n, k] of all stars, those of a part by all others, without another fit.

        `parts` are indices of the stars that are left out together, of all stars in all; `coefficients` [n, k] theirs.
        """
        raise NotImplementedError

    def truncated(self, count: int) -> Self:
        """Return the interpolation of the first components only."""
        colour = None if self.colour is None else self.colour.truncated(count)
        return replace(self, polynomial=self.polynomial[:, :count], colour=colour)

    def parts(self) -> ModelParts:
        """Return what the interpolation has in a FITS file."""
        cards: dict[str, Any] = {"ORDER": (self.order, "total degree of the polynomials")}
        if self.kernel_columns is None:
            cards["INTERP"] = (self.name, "interpolation over the CCD")
        columns = {} if self.weights is None else {"weight": self.weights}
        parts = ModelParts(cards, {"POLY": self.polynomial}, columns)
        return parts if self.colour is None else self.colour.add_to(parts)

    @classmethod
    def reads(cls, parts: ModelParts) -> bool:
        """Return whether a FITS file holds this kind."""
        if cls.kernel_columns is None or "INTERP" in parts.cards:
            return bool(parts.cards.get("INTERP") == cls.kind.name)
        return (parts.images["KERNEL"].shape[1] if "KERNEL" in parts.images else 0) in cls.kernel_columns

    @classmethod
    def of_parts(cls, parts: ModelParts) -> Self:
        """Return the interpolation in a FITS file; KeyError where something is missing."""
        return cls(
            parts.columns["position"],
            parts.extent,
            int(parts.cards["ORDER"]),
            parts.image("POLY"),
            parts.columns.get("weight"),
            **cls._fields_of(parts),
            colour=FittedColour.in_parts(parts),
        )

    @classmethod
    def _fields_of(cls, parts: ModelParts) -> dict[str, Any]:
        """Return further fields."""
        return {}


def weighted(rows: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Return rows of equations times the roots of their weights, for least squares."""
    return rows if weights is None else rows * np.sqrt(weights)[:, None]
