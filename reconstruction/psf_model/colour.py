"""Colour of the stars of a CCD as one more coordinate of the PSF, in which it is linear.

A spectrum S within a band makes the PSF that is the mean of those of its wavelengths, each by its photons. As far as
these are linear in the wavelength, it is that of the mean wavelength alone: with the mean wavelength of each star as
its colour, a model of stars holds for any other spectrum, such as a galaxy's. What that leaves is of second order: the
light that air spreads has its own variance in each spectrum (docs/explanation/colour.md). Colours of two bands,
and temperatures, are as good as their relation to the mean wavelength is linear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError
from ...core.units import real_array
from .file_parts import ModelParts
from .polynomial import Extent, design_matrix

# Highest degree in position of what multiplies the colour.
_MOST_ORDER = 2
# Least scatter of colours over their largest: less is rounding, and tells nothing.
_LEAST_SCATTER = 1e-9
# Endings of the images in a file: what the PSF changes by in a standard deviation of the colours, its probability.
_SLOPE, _PROBABILITY = "COLOUR", "COLPROB"
# Column of the colours in the table of stars.
_COLUMN = "colour"
# Card of the degree in position.
_ORDER_CARD = "COLORDER"


@check_arguments
@dataclass(frozen=True)
class ColourTerm:
    """Part of a PSF model that is linear in the colours of the stars, as far as these ask for it.

    Kriging takes each of its forms with and without it, by their evidence; polynomials take it where the Bayesian
    information criterion of the stars' shapes does.

    Parameters
    ----------
    order : int
        Total degree, 0 to 2, of the polynomials of the position that multiply the colour; 0 where it does the same all
        over the CCD.

    Raises
    ------
    ConfigError
        If there is no such order.
    """

    order: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.order <= _MOST_ORDER:
            raise ConfigError(f"order = {self.order}: expected 0 to {_MOST_ORDER}, of a colour term", key="order")

    def of_stars(self, colour: Any, n_stars: int) -> StarColours | None:
        """Return the colours of stars; None where they do not differ, so that they tell nothing."""
        values = as_colours(colour, n_stars)
        colours = StarColours(np.broadcast_to(values, (n_stars,)).copy(), self.order)
        known_values = values[np.isfinite(values)]
        if not known_values.size or np.ptp(known_values) <= _LEAST_SCATTER * np.abs(known_values).max():
            return None
        return colours


@dataclass(frozen=True, eq=False)
class StarColours:
    """Colours of stars; those that are unknown count as the mean of the others."""

    values: np.ndarray  #: [n], NaN where unknown
    order: int = 0  #: total degree of the polynomials of the position that multiply them

    @cached_property
    def mean(self) -> float:
        """Mean of the colours that are known."""
        return float(np.nanmean(self.values))

    @cached_property
    def scale(self) -> float:
        """Their standard deviation."""
        return float(np.nanstd(self.values))

    @property
    def n_unknown(self) -> int:
        """Number of stars without a colour."""
        return int(np.isnan(self.values).sum())

    def terms(self, positions: Any, extent: Extent, colour: np.ndarray | None = None) -> np.ndarray:
        """Return terms [m, n_terms] at positions [m, 2] for colours [m] or one, by default those of the stars."""
        values = self.values if colour is None else colour
        deviations = np.nan_to_num((values - self.mean) / self.scale)
        return np.asarray(deviations.reshape(-1, 1) * design_matrix(positions, extent, self.order))


@dataclass(frozen=True, eq=False)
class FittedColour:
    """What the PSF changes by with the colour.

    Attributes
    ----------
    stars : StarColours
        Colours of the stars.
    slope : ndarray
        Change of the coefficients of the basis in a standard deviation of the colours, one row for each term of the
        position, [n_terms, k].
    probability : float
        That the PSF depends on the colour, by the stars.
    """

    stars: StarColours
    slope: np.ndarray
    probability: float

    @property
    def mean(self) -> float:
        """Mean colour of the stars, to which predictions without a colour refer."""
        return self.stars.mean

    def at(self, positions: Any, extent: Extent, colour: np.ndarray | None = None) -> np.ndarray:
        """Return the change of the coefficients [m, k] at positions [m, 2] for colours [m] or one, or the stars'."""
        terms = self.stars.terms(positions, extent, colour)
        values = np.zeros((len(terms), self.slope.shape[1]))
        for column, row in zip(terms.T, self.slope, strict=True):  # no BLAS: its sums depend on the batch
            values += column[:, None] * row
        return values

    def truncated(self, count: int) -> FittedColour:
        """Return that of the first components only."""
        return replace(self, slope=self.slope[:, :count])

    def add_to(self, parts: ModelParts) -> ModelParts:
        """Return parts of a FITS file with those of the colour."""
        cards = parts.cards | {_ORDER_CARD: (self.stars.order, "degree in position of the colour term")}
        images = {_SLOPE: self.slope, _PROBABILITY: np.array([self.probability])}
        return replace(parts, cards=cards).extended(images, {_COLUMN: self.stars.values})

    @classmethod
    def in_parts(cls, parts: ModelParts) -> FittedColour | None:
        """Return that in a FITS file, None where it has none; KeyError where something is missing."""
        if _SLOPE not in parts.images:
            return None
        stars = StarColours(parts.columns[_COLUMN], int(parts.cards[_ORDER_CARD]))
        return cls(stars, parts.image(_SLOPE), float(parts.image(_PROBABILITY)[0]))


def as_colours(colour: Any, count: int) -> np.ndarray:
    """Return colours as float64, one number or [count]; NaN for unknown ones."""
    values = real_array(colour, "colour: expected real numbers")
    if values.shape not in ((), (count,)):
        raise DomainError(f"colour has shape {values.shape}: expected one number, or one for each of {count}")
    if np.isinf(values).any():
        raise DomainError("colour is infinite: expected finite numbers, or NaN where it is unknown")
    return values
