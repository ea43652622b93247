"""Gaussian processes of a position on a CCD, over a polynomial trend, with the noise of each star (kriging)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.linalg

# Bounds of the correlation length, in units in which the CCD is 2 wide, and of the variance of the middle star's noise
# over that of the process. The noise keeps the covariance of near stars from being singular.
_LENGTHS, _RATIOS = (0.05, 20.0), (1e-8, 1e4)
# The likelihood is evaluated on a grid of both, and then maximised between the neighbours of the best.
_LENGTHS_TRIED, _RATIOS_TRIED = np.geomspace(*_LENGTHS, 25), np.geomspace(*_RATIOS, 49)
# Precision of the logarithms of both.
_PRECISION = {"xatol": 1e-3}


def fit_kernels(
    points: np.ndarray, values: np.ndarray, terms: np.ndarray, noise: np.ndarray, *, shared: bool
) -> np.ndarray:
    """Fit variance, correlation length and noise variance [k, 3] to each column by likelihood.

    `points` [n, 2] are mapped to [-1, 1], `values` are [n, k], and the process is the residual of a fit of the trend's
    `terms` [n, n_terms]. `noise` [n] is the variance of each star's noise over that of the middle star, whose own is
    fitted. With `shared` all columns have one kernel. Variances are zero for a column without any.
    """
    root = np.sqrt(noise)[:, None]
    q, _ = np.linalg.qr(terms / root)
    rest = values / root
    rest = rest - q @ (q.T @ rest)
    result = np.zeros((values.shape[1], 3))
    result[:, 1] = 1.0
    groups = [np.arange(values.shape[1])] if shared else [np.array([k]) for k in range(values.shape[1])]
    largest = np.abs(values / root).max(initial=0.0)
    squares = _squared_distances(points, points)

    def spectrum(length: float) -> tuple[np.ndarray, np.ndarray]:
        """Return eigenvalues and eigenvectors of the correlation of values over the roots of their noise."""
        return np.linalg.eigh(np.exp(-0.5 * squares / length**2) / (root * root.T))

    spectra = [spectrum(length) for length in _LENGTHS_TRIED]
    for group in groups:
        power = float((rest[:, group] ** 2).mean())
        if np.sqrt(power) <= 1e-15 * largest:
            continue
        own = rest[:, group] / np.sqrt(power)
        tried = [_likelihood(each, own, _RATIOS_TRIED)[0] for each in spectra]
        i, j = np.unravel_index(np.argmax(tried), np.shape(tried))
        length = _refined_maximum(partial(_best_likelihood, spectrum, own, int(j)), _LENGTHS_TRIED, int(i))
        _, ratio = _best_ratio(spectrum(length), own, int(j))
        variance = power * float(_likelihood(spectrum(length), own, np.array([ratio]))[1][0])
        result[group] = (variance, length, variance * ratio)
    return result


def _likelihood(
    spectrum: tuple[np.ndarray, np.ndarray], values: np.ndarray, ratios: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the logarithm of the likelihood, and the most likely variance of the process, for each ratio.

    With the eigenvalues l of the correlation, values y along its eigenvectors and g the ratio of the noise to the
    variance c, the logarithm for n values is, but for a constant, -(n ln c + sum ln(l + g) + sum y^2/(l + g)/c)/2, and
    largest for c = sum y^2/(l + g)/n. `values` are [n, k], of one kernel.
    """
    eigenvalues, vectors = spectrum
    power = ((vectors.T @ values) ** 2).mean(axis=1)
    total = np.maximum(eigenvalues, 0.0)[:, None] + ratios
    variances = (power[:, None] / total).mean(axis=0)
    return -0.5 * (len(values) * np.log(variances) + np.log(total).sum(axis=0)), variances


def _best_ratio(spectrum: tuple[np.ndarray, np.ndarray], values: np.ndarray, near: int) -> tuple[float, float]:
    """Return the largest likelihood near a ratio of the grid, and the ratio."""

    def likelihood(ratio: float) -> float:
        return float(_likelihood(spectrum, values, np.array([ratio]))[0][0])

    ratio = _refined_maximum(likelihood, _RATIOS_TRIED, near)
    return likelihood(ratio), ratio


def _best_likelihood(
    spectrum: Callable[[float], tuple[np.ndarray, np.ndarray]], values: np.ndarray, near: int, length: float
) -> float:
    """Return the largest likelihood of a length, near a ratio of the grid."""
    return _best_ratio(spectrum(length), values, near)[0]


def _refined_maximum(function: Callable[[float], float], grid: np.ndarray, near: int) -> float:
    """Return where a function is largest between the neighbours of a point of a grid, by Brent's method."""
    from scipy.optimize import minimize_scalar  # a fifth of a second

    low, high = np.log(grid[max(near - 1, 0)]), np.log(grid[min(near + 1, len(grid) - 1)])
    found = minimize_scalar(
        lambda t: -function(float(np.exp(t))), bounds=(low, high), method="bounded", options=_PRECISION
    )
    return float(np.exp(found.x))


def krige(
    points: np.ndarray, values: np.ndarray, terms: np.ndarray, kernels: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for the trend and the stars' weights, and predict each value from the others.

    Arguments are as in :func:`fit_kernels`, and its result. Returns the coefficients of the terms by generalised least
    squares [n_terms, k]; the inverse covariance times values less trend [n, k], the weights of :func:`predict`; and
    each value minus its prediction by the others with the same kernel [n, k] (Dubrule 1983).
    """
    trend = np.zeros((terms.shape[1], values.shape[1]))
    weights, left_out = np.zeros(values.shape), np.zeros(values.shape)
    squares = _squared_distances(points, points)
    for kernel in np.unique(kernels, axis=0):
        group = (kernels == kernel).all(axis=1)
        variance, length, of_middle = kernel
        if variance == 0.0:  # nothing but the trend
            covariance = np.diag(noise)
        else:
            covariance = variance * np.exp(-0.5 * squares / length**2) + of_middle * np.diag(noise)
        # Everything in units whitened by the root of the covariance: ordinary least squares.
        root = scipy.linalg.cholesky(covariance, lower=True)
        inverse = scipy.linalg.solve_triangular(root, np.eye(len(points)), lower=True)
        q, r = np.linalg.qr(inverse @ terms)
        whitened = inverse @ values[:, group]
        projected = q.T @ whitened
        trend[:, group] = scipy.linalg.solve_triangular(r, projected)
        rest = inverse - q @ (q.T @ inverse)
        alpha = inverse.T @ (whitened - q @ projected)
        own = (rest**2).sum(axis=0)
        own = np.where(own * np.diagonal(covariance) > 1e-10, own, np.nan)
        left_out[:, group] = alpha / own[:, None]
        weights[:, group] = alpha if variance > 0.0 else 0.0
    return trend, weights, left_out


def predict(points: np.ndarray, at: np.ndarray, kernels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the process, without its trend, at places [m, 2] mapped like the points: [m, k].

    Each place on its own, star after star: no batch size matters.
    """
    different, which = np.unique(kernels, axis=0, return_inverse=True)
    result = np.zeros((len(at), len(kernels)))
    for point, alpha in zip(points, weights, strict=True):
        squares = ((at - point) ** 2).sum(axis=1)
        near = different[:, 0] * np.exp(-0.5 * squares[:, None] / different[:, 1] ** 2)
        result += near[:, which] * alpha
    return result


def _squared_distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the squared distances, [n, m]."""
    return ((one[:, None] - other) ** 2).sum(axis=2)
