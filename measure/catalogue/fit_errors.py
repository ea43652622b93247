r"""Covariances of the errors of galaxy fits.

The gradient of chi-square at the true parameters has the covariance F of its noise, the Fisher matrix. The errors of
the parameters are it over the curvature H of chi-square, so that their covariance is :math:`H^{-1} F H^{-1}`. H is F
less the sum of residuals times second derivatives of the model, which is not zero where a galaxy is no Gaussian: by the
inverse of F alone the variance of e of exponential discs is 1.1 to 1.4 times too small, of bulges 1.3 to 1.6 times.

At a minimum second derivatives with respect to flux and centre bring nothing: the sums are those of its gradient, since
:math:`\partial^2 / \partial x^2 = 2 \partial / \partial C_{xx}` of a Gaussian. The others are differences of gradients.
"""

from __future__ import annotations

import numpy as np

from .gaussian_model import GaussianStamps, NormalEquations

#: Parameters of the covariance of a Gaussian among those of a galaxy.
_MOMENTS = (3, 4, 5)
# Steps of the differences, in standard errors.
_STEP = 1e-3
# Least curvature over that of the Fisher matrix, in any direction: noise of faint galaxies may leave none.
_LEAST_CURVATURE = 0.3


def fisher_inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverses of Fisher matrices [n, 6, 6]; NaN for a singular one."""
    scale = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    regular = (scale > 0.0).all(axis=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = matrix / (scale[:, :, None] * scale[:, None, :])
    # Six parameters of fewer pixels: the smallest eigenvalue is rounding.
    regular &= np.isfinite(scaled).all(axis=(1, 2))
    scaled[~regular] = np.eye(matrix.shape[1])
    regular &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-12
    result = np.full(matrix.shape, np.nan)
    result[regular] = np.linalg.inv(scaled[regular]) / (scale[regular, :, None] * scale[regular, None, :])
    return result


def error_covariance(stamps: GaussianStamps, minimum: np.ndarray, equations: NormalEquations) -> np.ndarray:
    """Return the covariances of the errors of fits with a minimum at parameters [n, 6], [n, 6, 6].

    NaN for a singular one.
    """
    fisher = equations.matrix
    covariance = fisher_inverse(fisher)
    regular = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    if not len(regular):
        return covariance
    scale = np.sqrt(np.diagonal(covariance[regular], axis1=1, axis2=2))
    curvature = fisher[regular]
    for k in _MOMENTS:
        params = minimum[regular]
        params[:, k] += _STEP * scale[:, k]
        change = equations.right[regular] - stamps.normal_equations(params, regular).right
        curvature[:, :, k] = change / (_STEP * scale[:, k, None])
    first = _MOMENTS[0]
    curvature[:, first:, :first] = curvature[:, :first, first:].swapaxes(1, 2)
    # Of a stamp without light a step may lead anywhere.
    finite = np.isfinite(curvature).all(axis=(1, 2))
    curvature, scale, regular = curvature[finite], scale[finite], regular[finite]
    # Whitened by the Fisher matrix: ones where the model fits, from which noise takes no more than a part.
    root = _root_of(covariance[regular] / (scale[:, :, None] * scale[:, None, :]))
    scaled = curvature * (scale[:, :, None] * scale[:, None, :])
    whitened = root.swapaxes(1, 2) @ (0.5 * (scaled + scaled.swapaxes(1, 2))) @ root
    values, directions = np.linalg.eigh(whitened)
    factors = root @ directions / np.maximum(values, _LEAST_CURVATURE)[:, None, :]
    covariance[regular] = factors @ factors.swapaxes(1, 2) * (scale[:, :, None] * scale[:, None, :])
    return covariance


def _root_of(matrix: np.ndarray) -> np.ndarray:
    """Return R with R R^T = M of positive matrices [n, k, k], whose least eigenvalues may be rounding."""
    values, directions = np.linalg.eigh(matrix)
    return np.asarray(directions * np.sqrt(np.maximum(values, 0.0))[:, None, :])
