"""Polynomials through the coefficients of the stars of a CCD, by weighted least squares (Jee & Tyson 2011, sec. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from ...core.arguments import check_arguments
from .interpolation import FittedInterpolation, Interpolation, StarField, weighted
from .polynomial import term_count

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
        q, r = np.linalg.qr(weighted(stars.terms, stars.weights))
        polynomial = scipy.linalg.solve_triangular(r, q.T @ weighted(stars.coefficients, stars.weights))
        return FittedPolynomial(stars.positions, stars.extent, stars.order, polynomial, stars.weights)


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
        return np.asarray((coefficients - self.at(self.positions)) / room[:, None])
