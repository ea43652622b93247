"""Order of the polynomials and number of components, by the shapes of stars that were held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .basis import FittedBasis
from .clean_stars import CleanStars
from .polynomial import FOLDS, term_count
from .shape_noise import ShapeNoise


def choose_by_cross_validation(
    stars: CleanStars,
    terms: np.ndarray,
    shapes: ShapeNoise,
    orders: Sequence[int],
    counts: np.ndarray,
    basis_of: Callable[[CleanStars, np.ndarray | None, int], FittedBasis],
    given: np.ndarray | None,
) -> tuple[int, int]:
    """Return the order and the number of components whose models predict the shapes of held-out stars best.

    Parameters
    ----------
    stars : CleanStars
        The stars.
    terms : array
        Of polynomials of the highest order at the stars, [n, n_terms].
    shapes : ShapeNoise
        Of the stars.
    orders : sequence of int
        To choose from, ascending.
    counts : array of int
        Numbers of components to choose from, ascending.
    basis_of : callable
        From some stars, their weights (None for equal ones) and a number of components to a basis.
    given : array or None
        Weights of the stars in the polynomials, [n], with equal ones in the basis; None for those of their noise.
    """
    fold = np.arange(len(terms)) % FOLDS
    residuals = np.full((len(terms), len(orders), len(counts), 3), np.nan)
    for index in range(fold.max() + 1):
        held_out = fold == index
        fitted_shapes, fitted_stars = shapes.of_stars(~held_out), stars.of_stars(~held_out)
        for i, order in enumerate(orders):
            order_terms = terms[:, : term_count(order)]
            if given is None:
                weights = fitted_shapes.star_weights(fitted_stars.deviations, order_terms[~held_out])
                centred_stars = fitted_stars.about_weighted_mean(weights)
            else:
                weights = given[~held_out]
                centred_stars = fitted_stars.about_weighted_mean(np.ones(len(weights)))
            basis = basis_of(centred_stars, None if given is not None else weights, int(counts[-1]))
            mean, vectors = basis.mean.ravel(), basis.vectors
            root = np.sqrt(weights)[:, None]
            rule = order_terms[held_out] @ np.linalg.pinv(order_terms[~held_out] * root) * root.T
            coefficients = (centred_stars.deviations + (centred_stars.mean - mean)) @ vectors.T
            predicted = (rule @ coefficients)[:, :, None] * (vectors @ shapes.filters.T)
            summed = np.concatenate([np.zeros_like(predicted[:, :1]), np.cumsum(predicted, axis=1)], axis=1)
            numbers = (stars.deviations[held_out] + (stars.mean - mean)) @ shapes.filters.T
            residuals[held_out, i] = numbers[:, None] - summed[:, np.minimum(counts, len(vectors))]
    # One column for each order and number of components.
    squares = (residuals**2).mean(axis=-1).reshape(len(terms), -1)
    case_residuals = residuals.reshape(len(terms), -1, 3)
    best = int(np.argmin(squares.mean(axis=0)))
    for _ in range(2):
        weight = (shapes.model_variance(case_residuals[:, best]) + shapes.noise) ** -2
        best = int(np.argmin(weight @ squares))
    order, count = divmod(best, len(counts))
    return orders[order], int(counts[count])
