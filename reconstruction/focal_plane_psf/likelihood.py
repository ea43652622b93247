r"""Hyperparameters of a covariance by maximum likelihood, with weak priors.

Where the values are residuals of fitted parameters, the covariance S that the uncertain parameters make among them is
added to the products of the values, which is the M step of expectation maximisation (Dempster, Laird & Rubin 1977).
The likelihood is that of blocks of neighbouring stars, each of all its stars at once, added up over blocks (a composite
likelihood; Varin, Reid & Firth 2011, Statistica Sinica 21, 5): pairs of stars on opposite sides of the field say
nothing about correlation lengths. Its gradient is exact,

.. math:: \frac{\partial \ln L}{\partial p} = \frac12 \mathrm{tr}\left[
          (K^{-1} (y y^T + S) K^{-1} - K^{-1}) \frac{\partial K}{\partial p}\right].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ..gaussian_field import inverse_from_cholesky
from .covariance import CCD_TERMS, COMPONENTS, Covariance, Places, ccd_terms
from .layer_covariance import LayerCovariance, in_order

#: Largest number of stars in a block.
BLOCK = 300
# Logarithmic bounds of amplitudes over the variance of the values.
_AMPLITUDES = (-14.0, 2.0)
# ... of lengths over the extent of the field.
_LENGTHS = (-6.5, 1.0)
# Bounds of the shear of a component.
_SHEAR = (-10.0, 10.0)
# Lengths from which the fit starts, over the extent of the field: 3 and 16 arcmin over 3.5 degrees.
_START = (0.014, 0.08, 0.3)
# Widths of the priors of each component about the first guess: logarithm of the amplitude, of two lengths, shear. Of
# many stars the data dominate; the likelihood of some hundred stars in a few streaks has secondary maxima far away.
_WIDTHS = (1.0, 1.0, 1.0, 1.5)
# ... of the logarithms of the variances of the terms of the CCDs and of the nugget.
_VARIANCE_WIDTH = 3.0
# Logarithm of the amplitude of a component over the variance of the values, below which it counts as absent.
_VANISHED = -6.0
# Least signal of the first guess, over the variance of the values.
_LEAST_SIGNAL = 0.1
# Rounds in which variances and the weights of their stars follow each other.
_ROUNDS = 10
#: Variance of the part common to all stars, over the mean square of the values.
_CONSTANT = 100.0


@dataclass(frozen=True)
class CovarianceFit:
    """Covariance of the largest likelihood.

    Attributes
    ----------
    covariance : Covariance
        The covariance.
    log_likelihood : float
        Composite likelihood, without the constant of 2 pi.
    at_bounds : tuple of str
        Hyperparameters that ended on a bound.
    """

    covariance: Covariance
    log_likelihood: float
    at_bounds: tuple[str, ...]


@dataclass(frozen=True)
class _Block:
    difference: np.ndarray  #: [m, m, 2], over the extent of the field
    fixed: np.ndarray  #: covariance that is not fitted, noise included, [m, m]
    products: np.ndarray  #: of the values, and their covariance due to fitted parameters, [m, m]
    amplitudes: np.ndarray | float  #: products of those of two stars, [m, m], or 1
    terms: tuple[np.ndarray, ...]  #: of the CCDs, [m, m] each


def blocks_of(xy: np.ndarray, size: int = BLOCK) -> list[np.ndarray]:
    """Cut places [n, 2] into blocks of neighbours, at most `size` each: indices, by halves along the longer side."""
    waiting, blocks = [np.arange(len(xy))], []
    while waiting:
        stars = waiting.pop()
        if len(stars) <= size:
            blocks.append(np.sort(stars))
            continue
        along = int(np.argmax(np.ptp(xy[stars], axis=0)))
        order = stars[np.argsort(xy[stars, along], kind="stable")]
        waiting += [order[len(order) // 2 :], order[: len(order) // 2]]
    return blocks


def fit_covariance(
    places: Places,
    values: np.ndarray,
    noise: np.ndarray,
    *,
    spread: Callable[[np.ndarray], np.ndarray] | None = None,
    with_ccds: bool = False,
    start: Covariance | None = None,
    constant: float | None = None,
    blocks: Sequence[np.ndarray] | None = None,
    max_iterations: int = 30,
) -> CovarianceFit:
    """Fit a covariance to values at places.

    Parameters
    ----------
    places : Places
        Of the stars.
    values : ndarray, shape [n]
        One shape parameter of each star, minus that of the optics.
    noise : ndarray, shape [n]
        Variance of the noise of each.
    spread : callable, optional
        Covariance of the values of a block due to fitted parameters, such as CCD heights: given indices [m], it returns
        [m, m].
    with_ccds : bool
        Whether there are terms of each CCD.
    start : Covariance, optional
        Covariance to start from.
    constant : float, optional
        Variance of the part common to all stars; by default so large that it is free.
    blocks : list of ndarray, optional
        Blocks of stars; by default those of :func:`blocks_of`.
    max_iterations : int
        Most steps of the search (L-BFGS).
    """
    # Of stars at one place the lengths are without effect.
    extent = float(np.ptp(places.xy, axis=0).max()) or 1.0
    centred = values - np.average(values, weights=1.0 / noise)
    weights = _weights_of_squares(centred, noise)
    mean_square = float(weights @ values**2)
    power = max(float(weights @ centred**2), 1e-12 * mean_square, 1e-30)
    if constant is None:
        constant = _CONSTANT * max(power, mean_square)
    prepared = []
    for index in blocks_of(places.xy) if blocks is None else blocks:
        block_places = places[index]
        held = np.diag(noise[index] / power) + constant / power
        scaled_values = values[index] / np.sqrt(power)
        products = np.outer(scaled_values, scaled_values)
        if spread is not None:
            products += spread(index) / power
        amplitudes = block_places.amplitudes_with(block_places)
        terms = tuple(amplitudes * t for t in ccd_terms(block_places, block_places)) if with_ccds else ()
        difference = (block_places.xy[:, None] - block_places.xy) / extent
        prepared.append(_Block(difference, held, products, amplitudes, terms))
    n_ccd = len(CCD_TERMS) if with_ccds else 0
    names = [
        f"{quantity} {j + 1}"
        for j in range(COMPONENTS)
        for quantity in ("amplitude", "length", "length across", "shear")
    ]
    names += [*CCD_TERMS[:n_ccd], "nugget"]
    bounds = [_AMPLITUDES, _LENGTHS, _LENGTHS, _SHEAR] * COMPONENTS + [_AMPLITUDES] * (n_ccd + 1)
    # Inverse lengths are fitted.
    bounds = [(-b[1], -b[0]) if "length" in n else b for n, b in zip(names, bounds, strict=True)]
    guess = _first_guess(float(weights @ noise) / power, n_ccd)
    first = guess.copy()
    if start is not None:
        packed_start = _pack_parameters(start, power, extent, n_ccd)
        for j in range(COMPONENTS):
            # A component of zero amplitude has no gradient, and would stay at zero.
            if packed_start[4 * j] > _VANISHED:
                first[4 * j : 4 * j + 4] = packed_start[4 * j : 4 * j + 4]
        first[4 * COMPONENTS :] = packed_start[4 * COMPONENTS :]
    first = np.clip(first, *np.transpose(bounds))
    width = np.array([*_WIDTHS * COMPONENTS, *[_VARIANCE_WIDTH] * (n_ccd + 1)])
    from scipy.optimize import minimize  # a fifth of a second

    optimum = minimize(
        _negative_log_posterior,
        first,
        args=(prepared, guess, width),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": max_iterations, "ftol": 1e-7},
    )
    at_bounds = tuple(
        name
        for name, value, (low, high) in zip(names, optimum.x, bounds, strict=True)
        # A variance of zero is a valid result, not a failed fit.
        if value >= high - 1e-9 or (value <= low + 1e-9 and ("length" in name or name == "shear"))
    )
    covariance = _unpack_parameters(optimum.x, power, extent, constant, n_ccd)
    count = sum(len(block.fixed) for block in prepared)
    value, _ = _negative_log_likelihood(optimum.x, prepared)
    return CovarianceFit(covariance, -value - 0.5 * count * np.log(power), at_bounds)


def log_likelihood(
    covariance: Covariance | LayerCovariance,
    places: Places,
    values: np.ndarray,
    noise: np.ndarray,
    blocks: Sequence[np.ndarray],
) -> float:
    """Return the logarithm of the likelihood in blocks of shapes [n, k] that covary, without the constant of 2 pi."""
    total = 0.0
    for index in blocks:
        root = covariance.root(places[index], in_order(noise[index]))
        white = scipy.linalg.solve_triangular(root, in_order(values[index]), lower=True, check_finite=False)
        total -= 0.5 * float(white @ white) + float(np.log(np.diagonal(root)).sum())
    return total


def _weights_of_squares(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return weights of unit sum with which squares of values of unequal noise tell their common variance best."""
    variance = float(np.mean(values**2))
    for _ in range(_ROUNDS):
        # The variance of a square is in proportion to the square of its mean.
        weights = (noise + variance) ** -2.0
        weights /= weights.sum()
        variance = max(float(weights @ (values**2 - noise)), _LEAST_SIGNAL * float(weights @ noise))
    return np.asarray(weights)


def _first_guess(noise_fraction: float, n_ccd: int) -> np.ndarray:
    signal = max(1.0 - noise_fraction, _LEAST_SIGNAL)
    guess = []
    for j in range(COMPONENTS):
        inverse = -np.log(_START[j])
        guess += [np.log(signal / COMPONENTS), inverse, inverse, 0.3 * (-1) ** j]
    return np.array(guess + [np.log(0.1 * signal)] * n_ccd + [np.log(0.01)])


def _pack_parameters(covariance: Covariance, power: float, extent: float, n_ccd: int) -> np.ndarray:
    packed = []
    with np.errstate(divide="ignore"):
        for amplitude, matrix in zip(covariance.amplitude, covariance.matrix, strict=True):
            packed += [np.log(amplitude / power), *np.log(np.diagonal(matrix) * extent), matrix[0, 1] / matrix[0, 0]]
        packed += [*np.log(covariance.ccd[:n_ccd] / power), np.log(covariance.nugget / power)]
    return np.array(packed)


def _unpack_parameters(packed: np.ndarray, power: float, extent: float, constant: float, n_ccd: int) -> Covariance:
    amplitude, matrix = np.empty(COMPONENTS), np.zeros((COMPONENTS, 2, 2))
    for j in range(COMPONENTS):
        log_amplitude, along, across, shear = packed[4 * j : 4 * j + 4]
        amplitude[j] = power * np.exp(log_amplitude)
        matrix[j] = np.array([[np.exp(along), np.exp(along) * shear], [0.0, np.exp(across)]]) / extent
    ccd = np.zeros(3)
    ccd[:n_ccd] = power * np.exp(packed[4 * COMPONENTS : -1])
    return Covariance(constant, amplitude, matrix, ccd, float(power * np.exp(packed[-1])))


def _negative_log_posterior(
    packed: np.ndarray, blocks: Sequence[_Block], guess: np.ndarray, width: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return minus the logarithm of the likelihood times the priors, and its gradient."""
    value, gradient = _negative_log_likelihood(packed, blocks)
    away = (packed - guess) / width
    return value + 0.5 * float(away @ away), gradient + away / width


def _negative_log_likelihood(packed: np.ndarray, blocks: Sequence[_Block]) -> tuple[float, np.ndarray]:
    """Return minus the logarithm of the likelihood, and its gradient."""
    total, gradient = 0.0, np.zeros(len(packed))
    variances = np.exp(packed[4 * COMPONENTS :])
    for block in blocks:
        matrix = block.fixed.copy()
        parts = []
        for j in range(COMPONENTS):
            log_amplitude, along, across, shear = packed[4 * j : 4 * j + 4]
            u = np.exp(along) * (block.difference[..., 0] + shear * block.difference[..., 1])
            v = np.exp(across) * block.difference[..., 1]
            length = np.sqrt(u * u + v * v)
            term = block.amplitudes * np.exp(log_amplitude - length)
            matrix += term
            parts.append((u, v, length, term))
        for variance, term in zip(variances[:-1], block.terms, strict=True):
            matrix += variance * term
        diagonal = np.diag_indices(len(matrix))
        matrix[diagonal] += variances[-1]
        root = scipy.linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
        inverse = inverse_from_cholesky(root)
        solved = inverse @ block.products
        total += 0.5 * float(np.trace(solved)) + float(np.log(root[diagonal]).sum())
        weight = 0.5 * (inverse - solved @ inverse)
        for j, (u, v, length, term) in enumerate(parts):
            weighted = weight * term
            gradient[4 * j] += weighted.sum()
            # The derivative of exp(-r) is -exp(-r) dr, with dr = (u du + v dv) / r, and 0 where r is 0.
            weighted /= np.where(length > 0.0, length, 1.0)
            weighted_u = weighted * u
            gradient[4 * j + 1] -= (weighted_u * u).sum()
            gradient[4 * j + 2] -= (weighted * v * v).sum()
            gradient[4 * j + 3] -= np.exp(packed[4 * j + 1]) * (weighted_u * block.difference[..., 1]).sum()
        for i, (variance, term) in enumerate(zip(variances[:-1], block.terms, strict=True)):
            gradient[4 * COMPONENTS + i] += variance * (weight * term).sum()
        gradient[-1] += variances[-1] * np.trace(weight)
    return total, gradient
