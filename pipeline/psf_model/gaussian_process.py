"""Gaussian processes of a position on a CCD, over a polynomial trend (universal kriging)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import scipy.linalg

from ...core.errors import ConfigError

# Bounds of the correlation length, in units in which the CCD is 2 wide, and of the noise's variance, in units in which
# the values have variance 1. The noise keeps the covariance of near stars from being singular.
_LENGTHS = (0.05, 20.0)
_NOISES = (1e-10, 10.0)
_VARIANCES = (1e-3, 1e6)
_BOUNDS = (_VARIANCES, _LENGTHS, _NOISES)
# The likelihood is evaluated on a grid of lengths and of ratios of the noise's variance to the process's, and then
# maximised within this factor of the best of these, which is several of their steps.
_NEAR = 8.0
_LENGTHS_TRIED, _RATIOS_TRIED = np.geomspace(*_LENGTHS, 25), np.geomspace(1e-8, 1e4, 49)


def fit_kernels(points: np.ndarray, values: np.ndarray, terms: np.ndarray, *, shared: bool) -> np.ndarray:
    """Fit variance, correlation length and noise variance [k, 3] to each column by likelihood (scikit-learn).

    `points` [n, 2] are mapped to [-1, 1], `values` are [n, k], and the process is the residual of an unweighted fit of
    the trend's `terms` [n, n_terms]. With `shared` all columns have one kernel. Variances are zero for a column without
    any. ConfigError if scikit-learn is not installed.
    """
    try:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    except ImportError as error:
        raise ConfigError("interpolation = 'gp' needs scikit-learn: pip install 'pachon[gp]'") from error
    q, _ = np.linalg.qr(terms)
    rest = values - q @ (q.T @ values)
    result = np.zeros((values.shape[1], 3))
    result[:, 1] = 1.0
    groups = [np.arange(values.shape[1])] if shared else [np.array([k]) for k in range(values.shape[1])]
    largest = np.abs(values).max(initial=0.0)
    squares = _squares(points, points)
    spectra = [np.linalg.eigh(np.exp(-0.5 * squares / length**2)) for length in _LENGTHS_TRIED]
    for group in groups:
        power = float((rest[:, group] ** 2).mean())
        if np.sqrt(power) <= 1e-15 * largest:
            continue
        # From near the maximum a few steps are enough. Bounds near it exclude lower maxima and singular covariances.
        rough = _rough_kernel(spectra, rest[:, group] / np.sqrt(power))
        near = [(max(v / _NEAR, low), min(v * _NEAR, high)) for v, (low, high) in zip(rough, _BOUNDS, strict=True)]
        variance, length, noise = rough
        kernel = ConstantKernel(variance, near[0]) * RBF(length, near[1]) + WhiteKernel(noise, near[2])
        process = GaussianProcessRegressor(kernel, alpha=0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a parameter may end on its bound: no noise, or noise only
            process.fit(points, rest[:, group] / np.sqrt(power))
        found = process.kernel_
        result[group] = (power * found.k1.k1.constant_value, found.k1.k2.length_scale, power * found.k2.noise_level)
    return result


def _rough_kernel(spectra: Sequence[tuple[np.ndarray, np.ndarray]], values: np.ndarray) -> tuple[float, float, float]:
    """Return variance, length and noise of the largest likelihood on a grid of lengths and ratios.

    With the eigenvalues l of the correlation matrix, values y along its eigenvectors and g the ratio of the noise to
    the variance c, the logarithm of the likelihood of n values is, but for a constant,
    -(n ln c + sum ln(l + g) + sum y^2/(l + g)/c)/2, and largest for c = sum y^2/(l + g)/n. `spectra` holds eigenvalues
    and eigenvectors for each of the lengths; `values` [n, k] of one kernel have mean square 1.
    """
    count = values.shape[0]
    best, found = -np.inf, (1.0, 1.0, 0.1)
    for length, (eigenvalues, vectors) in zip(_LENGTHS_TRIED, spectra, strict=True):
        power = ((vectors.T @ values) ** 2).mean(axis=1)
        total = np.maximum(eigenvalues, 0.0)[:, None] + _RATIOS_TRIED
        variances = (power[:, None] / total).mean(axis=0)
        likelihood = -0.5 * (count * np.log(variances) + np.log(total).sum(axis=0))
        top = int(np.argmax(likelihood))
        if likelihood[top] > best:
            best, found = float(likelihood[top]), (variances[top], length, variances[top] * _RATIOS_TRIED[top])
    variance, length, noise = (float(np.clip(v, *b)) for v, b in zip(found, _BOUNDS, strict=True))
    return variance, length, noise


def krige(
    points: np.ndarray, values: np.ndarray, terms: np.ndarray, kernels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for the trend and the stars' weights, and predict each value from the others.

    Arguments are as in :func:`fit_kernels`, and its result. Returns the coefficients of the terms by generalised least
    squares [n_terms, k]; the inverse covariance times values less trend [n, k], the weights of :func:`predict`; and
    each value minus its prediction by the others with the same kernel [n, k] (Dubrule 1983).
    """
    trend = np.zeros((terms.shape[1], values.shape[1]))
    weights, left_out = np.zeros(values.shape), np.zeros(values.shape)
    squares = _squares(points, points)
    for kernel in np.unique(kernels, axis=0):
        group = (kernels == kernel).all(axis=1)
        variance, length, noise = kernel
        if variance == 0.0:  # nothing but the trend
            covariance = np.eye(len(points))
        else:
            covariance = variance * np.exp(-0.5 * squares / length**2) + noise * np.eye(len(points))
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


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the squared distances, [n, m]."""
    return ((one[:, None] - other) ** 2).sum(axis=2)
