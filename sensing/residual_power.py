r"""Power of the residuals of a donut beyond its noise, and the errors that it makes.

Let :math:`e` be the residuals over the standard deviation of their noise, A the derivatives of the model over it, and
:math:`F = A^T A + P` the curvature with the priors' P. What the model lacks is taken for random fields with the
covariance :math:`\sum_k \theta_k R_k`: noise of some correlation length, light that moves as under a wavefront of more
terms, brightness and rims that differ. A fit removes from the residuals what its unknowns take up, so that the
covariance of the residuals is

.. math:: M \Big(I + \sum_k \theta_k R_k\Big) M + A F^{-1} P F^{-1} A^T, \qquad M = I - A F^{-1} A^T.

The strengths :math:`\theta_k \ge 0` are those whose covariance is nearest to :math:`e e^T` (minimum norm quadratic
estimation; Rao 1971, J. Multivariate Anal. 1, 257), of as few fields as the residuals ask for. Beside correlated noise
that of white noise may be down to -1: the noise of known variance is then correlated itself. Errors of the unknowns
have the sandwich covariance :math:`F^{-1} + F^{-1} A^T (\sum_k \theta_k R_k) A F^{-1}`, which is never less than that
of the noise alone.

A field of few patterns B with a covariance :math:`\theta B B^T`, light that moves as under terms of the wavefront which
air has, shows in them alone. The strengths of the other fields are then those of residuals without these patterns, and
:math:`\theta` is that of :mod:`.residual_patterns`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import solve_triangular, toeplitz
from scipy.optimize import nnls

from .likelihood import Linearized
from .residual_patterns import Patterns

#: Correlation lengths of noise [pixels of the fit].
_NOISE_LENGTHS = (0.5, 0.8, 1.25, 2.0)
#: Correlation length of brightness and rims over the resolution of the image: a Gaussian of nearly its width. Longer
#: ones take up most of what the unknowns do, and claim more than is seen of wrong spiders and rims.
_LIGHT_LENGTH = 0.35
#: Standard deviations beyond those of noise that the power of the residuals has at least, to be more than chance.
_SIGNIFICANT = 3.0
#: The same that a further field must explain.
_NEEDED = 3.0
#: Fields whose power in the residuals decides whether there is any beyond that of noise.
_SCREENED = ("white", "noise_0.8", "brightness", "rims")
#: Largest number of pixels; beyond, squares of them are summed.
_MOST_PIXELS = 17_000
#: Ridge of the normal equations of the strengths, over their diagonal: fields that differ little share the power.
_RIDGE = 1e-6
#: Correlation that is none: sums of numbers next to zero are slow.
_UNCORRELATED = 1e-9


@dataclass(frozen=True)
class ResidualPower:
    """What the residuals of a donut say about the errors of its unknowns.

    Attributes
    ----------
    root : ndarray, shape [n, n]
        Root of the covariance of the unknowns by noise and priors.
    power : ndarray, shape [n, n]
        Power of what the model lacks, in combinations of the unknowns that are independent of unit variance.
    strength : float
        Strength of the field of patterns, of which the power has nothing.
    figure : float
        Strength of what the telescope is expected to have in them.
    losses : ndarray, shape [n_figure, n_rms], optional
        Losses of the residuals by the rms of what the telescope has, and of that field, of
        :mod:`~pachon.sensing.residual_patterns`.
    """

    root: np.ndarray
    power: np.ndarray
    strength: float = 0.0
    figure: float = 1.0
    losses: np.ndarray | None = None

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the unknowns by what the model lacks, shape [n, n]."""
        return np.asarray(self.root @ self.power @ self.root.T)


class TelescopePatterns(NamedTuple):
    """Patterns of the telescope's further terms over the noise: of the rms expected, [n_pixel, k], and as priors have.

    Those of priors are of the terms that are fitted, [n_pixel, l].
    """

    expected: np.ndarray
    fitted: np.ndarray


class Field(Protocol):
    """Random field of residuals over their noise, of unit strength."""

    trace: float  #: of its covariance

    def times(self, columns: np.ndarray) -> np.ndarray:
        """Return the covariance times columns, shape [n_pixel, n]."""

    def times_sums(self, sums: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the same of sums over pairs of rows and columns by their matrices, [my, mx, n]."""

    def product(self, other: Field) -> float:
        """Return the trace of the product of the covariances of two fields."""


def residual_power(
    linearized: Linearized,
    covariance: np.ndarray,
    resolution: float,
    patterns: np.ndarray | None = None,
    telescope: TelescopePatterns | None = None,
    prior_gradient: np.ndarray | None = None,
    airless: bool = False,
) -> ResidualPower:
    """Return what the residuals of a donut say about the errors of its unknowns.

    Parameters
    ----------
    linearized : Linearized
        Residuals and derivatives of the model at the solution.
    covariance : ndarray, shape [n, n]
        Covariance of the unknowns by noise and priors, zero for those that are held.
    resolution : float
        Width of the finest detail of the image [pixels].
    patterns : ndarray, shape [n_pixel, m], optional
        Patterns over the noise, whose squares are the covariance of a further field.
    telescope : TelescopePatterns, optional
        The same of what the telescope is expected to have, within the span of the patterns.
    prior_gradient : ndarray, shape [n], optional
        Precisions of the priors times the deviations of the unknowns from their means: residuals are then those at the
        end of the last step of a search, which stops a part of a standard deviation short of it.
    airless : bool
        Whether there is none of that field: what is seen in its patterns is the telescope's.
    """
    spreads = np.sqrt(np.diag(covariance))
    scale = np.where(spreads > 0.0, spreads, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    squares = _Squares(linearized.used)
    columns = squares.of(linearized.columns @ (linearized.scales[:, None] * root).astype(np.float32))
    pulls = squares.of(linearized.pulls[:, None].astype(np.float32))[:, 0]
    if prior_gradient is not None:
        pulls = pulls - columns @ (columns.T @ pulls - root.T @ prior_gradient).astype(np.float32)
    beside = None if patterns is None else Patterns.of(squares.of(patterns), columns, pulls)
    if beside is not None:
        pulls = pulls - beside.columns @ beside.amplitudes.astype(np.float32)
        columns = np.hstack([columns, beside.columns])
    n = len(root)
    residuals = _Residuals(squares.used, pulls, columns, _fields(linearized, squares, resolution))
    if max(residuals.excess(name) for name in _SCREENED) < _SIGNIFICANT:
        inner, of_patterns = np.zeros((n, n)), np.zeros((columns.shape[1] - n,) * 2)
    else:
        inner, of_patterns = residuals.power(n)
    if beside is None:
        return ResidualPower(root, inner)
    of_telescope, fitted = np.zeros((2, *of_patterns.shape))
    if telescope is not None:
        of_telescope = beside.power_of(squares.of(telescope.expected))
        fitted = beside.power_of(squares.of(telescope.fitted))
    sizes = beside.sizes(of_patterns, of_telescope, fitted, airless)
    return ResidualPower(root, inner + sizes.level * (np.eye(n) + inner), sizes.strength, sizes.figure, sizes.losses)


class _Squares:
    """Squares of pixels of a stamp, few enough for quick sums: single pixels of a small one.

    Sums over a square of so many pixels are divided by its side, so that white noise keeps its variance.
    """

    def __init__(self, used: np.ndarray) -> None:
        self._used, self.side = used, 1
        while used.size / self.side**2 > _MOST_PIXELS and min(used.shape) >= 4 * self.side:
            self.side *= 2
        self.used = np.asarray(self._cut(used[..., None])[..., 0].all(axis=(1, 3)))

    def length(self, pixels: float) -> float:
        """Return the correlation length [squares] of sums over squares of a field of a length in pixels.

        The second moment of the correlation grows by twice that of a square about its pixels' centres.
        """
        return math.sqrt((pixels / self.side) ** 2 + (1.0 - self.side**-2) / 6.0)

    def _cut(self, images: np.ndarray) -> np.ndarray:
        """Return images [ny, nx, n] by squares, [ny, side, nx, side, n]."""
        ny, nx = (n // self.side for n in images.shape[:2])
        whole_squares = images[: ny * self.side, : nx * self.side]
        return whole_squares.reshape(ny, self.side, nx, self.side, -1)

    def of(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of pixels in use [n_pixel, n] as those of squares, [n_square, n]."""
        if self.side == 1:
            return columns
        images = columns
        if not self._used.all():
            images = np.zeros((self._used.size, columns.shape[1]), dtype=columns.dtype)
            images[self._used.ravel()] = columns
        squares = self._cut(images.reshape(*self._used.shape, -1))
        total = np.zeros_like(squares[:, 0, :, 0])
        # One place in the squares after the other: sums over two axes at once take several times as long.
        for i, j in itertools.product(range(self.side), repeat=2):
            total += squares[:, i, :, j]
        return np.asarray(total[self.used] / self.side)

    def mean(self, image: np.ndarray) -> np.ndarray:
        """Return an image [ny, nx] by the means of squares."""
        return np.asarray(self._cut(image[..., None])[..., 0].mean(axis=(1, 3)))


class _Residuals:
    """Residuals over their noise [n_pixel], changes of the image by independent unknowns [n_pixel, n], and fields.

    What a fit has taken from the power of fields is a small part of it, and computed by sums over pairs of rows and
    columns, in which the changes are nearly even.
    """

    def __init__(self, used: np.ndarray, pulls: np.ndarray, columns: np.ndarray, fields: Mapping[str, Field]) -> None:
        self._pulls, self._columns, self._fields = pulls, columns, fields
        self._pairs = _pairs(used.shape[0]), _pairs(used.shape[1])
        images = np.zeros((*used.shape, columns.shape[1]), dtype=np.float32)
        images[used] = columns
        self._sums = _along_both(*self._pairs, images)
        self._times_sums: dict[str, np.ndarray] = {}

    def _of_sums(self, name: str) -> np.ndarray:
        """Return the covariance of a field times the sums of the changes of the image, [my, mx, n]."""
        if name not in self._times_sums:
            self._times_sums[name] = self._fields[name].times_sums(self._sums, *self._pairs)
        return self._times_sums[name]

    def _surplus(self, name: str) -> float:
        """Return the power of the residuals in a field beyond that of noise."""
        field = self._fields[name]
        energy = float(self._pulls @ field.times(self._pulls[:, None])[:, 0])
        return energy - field.trace + float(np.vdot(self._sums, self._of_sums(name)))

    def excess(self, name: str) -> float:
        """Return the surplus in a field in standard deviations of noise."""
        return self._surplus(name) / math.sqrt(2.0 * self._fields[name].product(self._fields[name]))

    def power(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the power of the fields that the residuals need in the first n unknowns, and in the others."""
        names = list(self._fields)
        sums = self._sums.reshape(-1, self._sums.shape[-1])
        inner = [sums.T @ self._of_sums(name).reshape(sums.shape) for name in names]
        surplus = np.array([self._surplus(name) for name in names])
        products = np.zeros((len(names), len(names)))
        for a, first in enumerate(names):
            for b, second in enumerate(names[: a + 1]):
                taken = np.vdot(inner[a], inner[b]) - 2.0 * np.vdot(self._of_sums(first), self._of_sums(second))
                products[a, b] = products[b, a] = taken + self._fields[first].product(self._fields[second])
        freedom = self._pulls.size - float(np.vdot(self._columns, self._columns))
        level = max(float(self._pulls @ self._pulls) / max(freedom, 1.0), 1.0)
        strengths = _needed_strengths(products, surplus, level, range(1, 1 + len(_NOISE_LENGTHS)))
        columns = np.ascontiguousarray(self._columns[:, :n])
        power = sum(
            (s * (columns.T @ self._fields[names[k]].times(columns)) for k, s in strengths.items()),
            start=np.zeros((n, n)),
        )
        others = sum((s * inner[k][n:, n:] for k, s in strengths.items()), start=np.zeros((len(inner[0]) - n,) * 2))
        # Noise is correlated in pixels: in changes of the image, which are smooth, it is no less than without.
        values, vectors = np.linalg.eigh(power)
        return np.asarray(vectors * np.maximum(values, 0.0) @ vectors.T), np.asarray(others)


@lru_cache(maxsize=64)
def _pairs(count: int) -> np.ndarray:
    """Return the matrix of sums over pairs of n values, of the variance of one by noise, shape [ceil(n/2), n]."""
    matrix = np.zeros(((count + 1) // 2, count), dtype=np.float32)
    matrix[np.arange(count) // 2, np.arange(count)] = math.sqrt(0.5)
    matrix.flags.writeable = False
    return matrix


def _along_both(rows: np.ndarray, columns: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Return images [ny, nx, n] multiplied by matrices along both axes, [my, mx, n]."""
    along_rows = (rows @ images.reshape(len(images), -1)).reshape(len(rows), *images.shape[1:])
    return np.matmul(columns, along_rows)


class WhiteField:
    """Noise of pixels of its own."""

    def __init__(self, count: int) -> None:
        self.trace = float(count)

    def times(self, columns: np.ndarray) -> np.ndarray:
        """Return the columns; see :class:`Field`."""
        return columns

    def times_sums(self, sums: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the sums; see :class:`Field`."""
        return sums

    def product(self, other: Field) -> float:
        """Return the trace of the other field; see :class:`Field`."""
        return other.trace


class StationaryField:
    """Field that is stationary but for its amplitude, with Gaussian correlations.

    Parameters
    ----------
    used : ndarray of bool, shape [ny, nx]
        Pixels that count.
    amplitude : ndarray, shape [ny, nx]
        Rms of the field in units of itself: it is scaled to a mean square of 1.
    length : float
        Correlation length [pixels].
    """

    def __init__(self, used: np.ndarray, amplitude: np.ndarray, length: float) -> None:
        self._used, self._length = used, length
        size = np.sqrt((amplitude[used] ** 2).mean())
        self._amplitude = np.where(used, amplitude, 0.0) / (size if size > 0.0 else 1.0)
        self._even = bool((self._amplitude == 1.0).all())
        self.trace = float((self._amplitude**2).sum())

    @cached_property
    def _correlations(self) -> list[np.ndarray]:
        """Correlations of rows and of columns, whose product is that of pixels."""
        return [_gaussian(n, self._length).astype(np.float32) for n in self._used.shape]

    def times(self, columns: np.ndarray) -> np.ndarray:
        """Return the covariance times columns; see :class:`Field`."""
        # Products of matrices are quicker than transforms: the correlations are separable.
        every, (rows, along) = bool(self._used.all()), self._correlations
        amplitude, shape = self._amplitude.astype(np.float32)[..., None], (*self._used.shape, columns.shape[1])
        if every:
            images = columns.reshape(shape) if self._even else columns.reshape(shape) * amplitude
        else:
            images = np.zeros(shape, dtype=np.float32)
            images[self._used] = columns * amplitude[self._used]
        smooth = _along_both(rows, along, images.reshape(shape))
        if not self._even:
            smooth *= amplitude
        return np.asarray(smooth.reshape(columns.shape) if every else smooth[self._used])

    def times_sums(self, sums: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the covariance of sums times sums; see :class:`Field`."""
        of_rows, of_columns = self._correlations
        amplitude = (0.5 * rows @ self._amplitude.astype(np.float32) @ columns.T)[..., None]
        smooth = _along_both(rows @ of_rows @ rows.T, columns @ of_columns @ columns.T, sums * amplitude)
        smooth *= amplitude
        return np.asarray(smooth)

    def product(self, other: Field) -> float:
        """Return the trace of the product of the covariances; see :class:`Field`."""
        if not isinstance(other, StationaryField):
            return other.product(self)
        # The product of two Gaussians is one.
        length = 1.0 / math.hypot(1.0 / self._length, 1.0 / other._length)
        if self._even and other._even:
            return math.prod(_sum_of_gaussian(n, length) for n in self._used.shape)
        rows, along = (_gaussian(n, length) for n in self._used.shape)
        amplitude = self._amplitude * other._amplitude
        return float((amplitude * (rows @ amplitude @ along)).sum())


@lru_cache(maxsize=64)
def _gaussian(count: int, length: float) -> np.ndarray:
    """Return the Gaussian correlations of places on a line, of a length [pixels], shape [n, n]."""
    correlation = np.exp(-0.5 * (np.arange(count) / length) ** 2)
    matrix = np.asarray(toeplitz(np.where(correlation > _UNCORRELATED, correlation, 0.0)))
    matrix.flags.writeable = False
    return matrix


@lru_cache(maxsize=256)
def _sum_of_gaussian(count: int, length: float) -> float:
    """Return the sum of the Gaussian correlations of places on a line, of a length [pixels]."""
    return float(_gaussian(count, length).sum())


def _fields(linearized: Linearized, squares: _Squares, resolution: float) -> dict[str, Field]:
    """Return the fields of every donut: white and correlated noise, brightness, rims."""
    used, noise = squares.used, np.sqrt(squares.mean(linearized.variance))
    brightness = np.maximum(squares.mean(linearized.brightness), 0.0)
    slope = np.hypot(*np.gradient(brightness))
    length = squares.length(_LIGHT_LENGTH * resolution)
    fields: dict[str, Field] = {"white": WhiteField(int(used.sum()))}
    fields |= {f"noise_{x:g}": StationaryField(used, np.ones(used.shape), squares.length(x)) for x in _NOISE_LENGTHS}
    fields |= {"brightness": StationaryField(used, brightness / noise, length)}
    fields |= {"rims": StationaryField(used, slope / noise, length)}
    return fields


def _needed_strengths(products: np.ndarray, surplus: np.ndarray, level: float, correlated: range) -> dict[int, float]:
    """Return strengths of the fewest fields whose covariance is near to that of the residuals.

    Fields are added as long as one explains more than chance; `level` is the power of the residuals over that of noise,
    by which their own power scatters. The first one is white. With the `correlated` ones of noise it may be negative:
    the noise of known variance is then correlated itself.
    """
    strengths: dict[int, float] = {}
    gain = 0.0
    while True:
        trials = []
        for k in np.flatnonzero(surplus > 0.0):
            if int(k) not in strengths:
                trial = sorted({*strengths, int(k), *([0] if int(k) in correlated else [])})
                with_correlated = any(field in correlated for field in trial)
                least = np.where((np.array(trial) == 0) & with_correlated, -1.0, 0.0)
                values = _strengths(products[np.ix_(trial, trial)], surplus[trial], least)
                explained = float(2.0 * surplus[trial] @ values - values @ products[np.ix_(trial, trial)] @ values)
                trials.append((explained, dict(zip(trial, map(float, values), strict=True))))
        if not trials:
            return strengths
        best, best_strengths = max(trials, key=lambda trial: trial[0])
        if best - gain < 2.0 * (_NEEDED * level) ** 2:
            return strengths
        gain, strengths = best, best_strengths


def _strengths(products: np.ndarray, surplus: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return strengths from least ones of fields whose covariance is nearest to that of the residuals."""
    scale = np.sqrt(np.diag(products))
    normalized = products / np.outer(scale, scale)
    normalized[np.diag_indices_from(normalized)] += _RIDGE
    factor = np.linalg.cholesky(normalized)
    beyond = solve_triangular(factor, (surplus - products @ least) / scale, lower=True, check_finite=False)
    strengths = solve_triangular(factor, beyond, lower=True, trans="T", check_finite=False)
    if strengths.min() < 0.0:
        strengths, _ = nnls(factor.T, beyond)
    return np.asarray(strengths / scale + least)
