"""Polynomials through the coefficients of the stars of a CCD, by weighted least squares (Jee & Tyson 2011, sec. 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from ...core.arguments import check_arguments
from .interpolation import FittedInterpolation, Interpolation, StarField, weighted
from .kriging import shape_numbers
from .polynomial import term_count

# Probability from which on the PSF depends on the colour.
_ASKED = 0.5
# Degrees of freedom beyond polynomials and colour terms without which they are not compared.
_LEAST_FREEDOM = 2
# Least singular value of the colour terms beyond the polynomials, for a star: else these hold all of it.
_LEAST_SINGULAR = 1e-3
# Rounding of shape numbers.
_ROUNDING = 1e-12
# Largest part of the squares that colours explain, and largest logarithm of the odds: beyond, nothing changes.
_MOST_EXPLAINED = 1.0 - 1e-12
_LARGEST_GAIN = 500.0
# Least part of a star's residual that is its own: below it the other stars do not determine the polynomials.
_LEAST_ROOM = 1e-10


@check_arguments
@dataclass(frozen=True)
class Polynomial(Interpolation):
    """Polynomials of limited total degree, as in the paper."""

    name = "polynomial"
    label = "polynomials"
    words = ""
    needs_noise = False

    order: int | Literal["auto"] = 3

    @property
    def smooth_order(self) -> int:
        """Order of the polynomials that predict outliers and masked pixels."""
        # Few stars would follow their own outliers under a high order.
        return super().smooth_order if self.fixed_order is None else self.fixed_order

    def orders(self, n_stars: int) -> list[int]:
        """Return the order, or those from which one is chosen."""
        return super().orders(n_stars) if self.fixed_order is None else [self.fixed_order]

    @property
    def least_stars(self) -> int:
        """Fewest stars of a fit."""
        return term_count(self.fixed_order or 0)

    def parameter_count(self, n_stars: int) -> int:
        """Return the number of free parameters of a component."""
        return term_count(self.fixed_order or 0)

    def fit(self, stars: StarField) -> FittedPolynomial:
        """Fit the coefficients of stars by least squares."""
        probability = _colour_probability(stars)
        if probability < _ASKED:
            stars = replace(stars, colours=None)
        q, r = np.linalg.qr(weighted(stars.with_colour_terms(), stars.weights))
        terms = scipy.linalg.solve_triangular(r, q.T @ weighted(stars.coefficients, stars.weights))
        count = stars.terms.shape[1]
        return FittedPolynomial(
            stars.positions,
            stars.extent,
            stars.order,
            terms[:count],
            stars.weights,
            colour=stars.fitted_colour(terms[count:], probability),
        )


@dataclass(frozen=True, eq=False)
class FittedPolynomial(FittedInterpolation, kind=Polynomial):
    """Polynomials alone."""

    kernel_columns = range(1)

    def leave_one_out(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients [n, k] of the stars less the polynomials of the other stars.

        That needs no new fit: the residual is that in the full fit divided by 1 - leverage. NaN where the other stars
        do not determine the polynomials.
        """
        room = 1.0 - self.leverage()
        room = np.where(room > _LEAST_ROOM, room, np.nan)
        predicted = self.at(self.positions)
        if self.colour is not None:
            predicted = predicted + self.colour.at(self.positions, self.extent)
        return np.asarray((coefficients - predicted) / room[:, None])


def _colour_probability(stars: StarField) -> float:
    """Return the probability of a dependence on the colour, by what it leaves of the stars' shapes.

    The Bayesian information criterion (Schwarz 1978) of three shape numbers, of unknown noise, beyond the polynomials.
    """
    if stars.colours is None:
        return 0.0
    numbers, _ = shape_numbers(stars.basis.mean, stars.basis.deviations(stars.coefficients))
    used = np.ones(len(numbers), dtype=bool) if stars.weights is None else stars.weights > 0.0
    weights = None if stars.weights is None else stars.weights[used] / stars.weights.mean()
    values, terms, colour_terms = (weighted(rows[used], weights) for rows in (numbers, stars.terms, stars.colour_terms))
    q, _ = np.linalg.qr(terms)
    values, colour_terms = (rows - q @ (q.T @ rows) for rows in (values, colour_terms))
    freedom, count = len(values) - terms.shape[1], colour_terms.shape[1]
    basis, singular, _ = np.linalg.svd(colour_terms, full_matrices=False)
    if freedom < count + _LEAST_FREEDOM or not singular.min() > _LEAST_SINGULAR * math.sqrt(len(values)):
        return 0.0
    squares = (values**2).sum(axis=0) + _ROUNDING**2 * len(values)
    gained = ((basis.T @ values) ** 2).sum(axis=0)
    gain = -0.5 * (freedom * np.log1p(-np.minimum(gained / squares, _MOST_EXPLAINED)) + count * math.log(freedom))
    return 1.0 / (1.0 + math.exp(-min(max(gain.sum(), -_LARGEST_GAIN), _LARGEST_GAIN)))
