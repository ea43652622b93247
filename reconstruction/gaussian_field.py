"""Algebra of Gaussian random fields that the models of one CCD and of the focal plane share."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.linalg


def inverse_from_cholesky(root: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric matrix of given lower Cholesky factor."""
    lower = scipy.linalg.lapack.dpotri(root, lower=1)[0]
    return np.ascontiguousarray(np.where(_lower_triangle(len(root)), lower, lower.T))


@lru_cache(maxsize=4)
def _lower_triangle(n: int) -> np.ndarray:
    """Return the places of the lower triangle with the diagonal, bool [n, n]."""
    return np.tri(n, dtype=bool)


def leave_one_out_residuals(alpha: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return values [n] or [n, k] less their predictions by the others (Dubrule 1983).

    `inverse` [n, n] is that of their covariance, noise included, and `alpha` is the inverse times the values.
    """
    precision = np.diagonal(inverse)
    return alpha / (precision if alpha.ndim == 1 else precision[:, None])
