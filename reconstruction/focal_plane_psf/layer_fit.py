r"""Winds and strengths of the layers of an exposure, from the shapes of its stars.

The covariance of the shapes is that of theory (:class:`.LayerCovariance`); winds, strengths, Fried parameter and outer
scale are those of the largest likelihood, with the layers of a site as prior: speeds within 30 % and strengths within
15 % of theirs, winds from any direction. The likelihood is that of blocks of neighbouring stars, as in
:mod:`.likelihood`. Its gradient follows the chain rule through a table of covariances at some lags, whose derivatives
are differences.

Winds of all layers turned around give the same covariances, and weak layers hardly matter: winds are found as far as
they change the prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ...core.random_streams import stream
from ...models.camera.camera import Camera
from ...wavefront.atmosphere.mean_wavefront import covariance_by_wavefront
from ...wavefront.atmosphere.moment_covariance import (
    COARSE,
    PAIRS,
    ExposedAir,
    MomentResponse,
    MomentSampling,
    as_matrices,
    as_pairs,
    moment_covariance,
)
from ...wavefront.atmosphere.polar_lags import PolarLags
from ..gaussian_field import inverse_from_cholesky
from .covariance import Places
from .kriging import map_on_threads
from .layer_covariance import LayerCovariance, in_blocks, in_order, root_of
from .likelihood import blocks_of
from .response import NOLL

# Stars of a block of the likelihood, and most blocks: the strengths of layers are common to all.
_BLOCK = 120
_MOST_BLOCKS = 64
# Rings and spokes of the theory while winds are searched: covariances are right within 2 %.
_SEARCH = (12, 16)
# The same of results: within 0.3 %.
_RESULT = (28, 36)
_FINE = MomentSampling(0.7, 0.35, 0.7, 0.25)
# Wind that it is chosen for, over the fastest of the prior.
_FASTEST = 1.3
# Directions of all winds that are tried first, and those over which the part of the mean wavefront is averaged before.
_DIRECTIONS = 64
_FIRST_DIRECTIONS = 4
# Standard deviations of the priors: logarithms of speeds, strengths, Fried parameter, which the mean size of the stars
# gives, and outer scale.
_SPEED = 0.3
_STRENGTH = 0.15
_FRIED = 0.03
_OUTER_SCALE = 0.3
# Unit of the components of winds [m/s], and least speed of a prior.
_WIND = 10.0
_LEAST_SPEED = 0.5
# Strength of a layer that a site lists without any, for its logarithm.
_LEAST_STRENGTH = 1e-12
# Steps of the differences: of winds, over less of which the sums over baselines are not smooth, and of logarithms.
_WIND_STEP = 0.05
_STEP = 0.01
# Nuggets over the variance that are tried first, the least of all among them, and the most.
_NUGGETS = (0.0003, 0.003, 0.01, 0.03, 0.1, 0.3)
_MOST_NUGGET = 1.0
# Gain of the likelihood that ends the search, a tenth of what matters, over its size for each value of a star.
_GAIN = 0.05
# Most steps of the search, and of one from a solution.
_ITERATIONS = 15
_AGAIN = 4


@dataclass(frozen=True, eq=False)
class LayerTheory:
    """Covariances of the shapes of stars by a telescope in turbulence.

    Attributes
    ----------
    response : MomentResponse
        Of ellipticity and size to the moments of turbulence.
    jacobian : ndarray, shape [2, 2]
        Positions on the detector by field slopes [m].
    products : ndarray, shape [6, n_noll, n_noll]
        Products of the derivatives of two shapes with respect to Zernikes of the mean wavefront, on the mean over the
        stars [1/m^2].
    camera : Camera
        Its size on the sky is the largest lag.
    threads : int or None
        Number of threads.
    """

    response: MomentResponse
    jacobian: np.ndarray
    products: np.ndarray
    camera: Camera
    threads: int | None

    @property
    def to_sky(self) -> np.ndarray:
        """Field slopes by positions on the detector [1/m], [2, 2]."""
        return np.asarray(np.linalg.inv(self.jacobian))

    def reach(self, extent: float) -> float:
        """Return the lag [rad] of a distance on the detector [m]."""
        return float(np.linalg.norm(self.to_sky, 2)) * extent

    def by_moments(self, air: ExposedAir, lags: np.ndarray, sampling: MomentSampling) -> np.ndarray:
        """Return covariances of the shapes by the moments of turbulence, of PAIRS, [n_lag, 6]."""
        response = self.response
        covariance = moment_covariance(air, lags, response.aberration, response.lit, self.threads, sampling)
        turned = _turn(self.jacobian)
        shapes = turned @ response.shapes(as_matrices(covariance.total(response))) @ turned.T
        return as_pairs(shapes)

    def by_wavefront(self, air: ExposedAir, lags: np.ndarray) -> np.ndarray:
        """Return covariances of the shapes by the mean wavefront of the air and the optics' aberrations, [n_lag, 6]."""
        return covariance_by_wavefront(air, lags, NOLL, self.products)

    def covariance(self, air: ExposedAir, constant: np.ndarray, nugget: np.ndarray) -> LayerCovariance:
        """Return the covariance function of an exposure."""
        camera = self.camera
        side = float(np.max(camera.half_sizes))
        reach = self.reach(2.0 * (float(np.hypot(*camera.centers.T).max()) + math.sqrt(2.0) * side))
        polar, smooth = PolarLags.of(air, reach, *_RESULT), PolarLags.of(air, reach)
        values = self.by_moments(air, polar.lags, _FINE)
        values += smooth.interpolation(polar.lags) @ self.by_wavefront(air, smooth.lags)
        return LayerCovariance(air, self.to_sky, polar, polar.table(values), constant, nugget)


class LayerFit:
    """Search for the winds of one exposure; :meth:`search` and :meth:`improve` return covariances.

    Parameters
    ----------
    theory : LayerTheory
        Covariances of an exposure.
    prior : ExposedAir
        Layers of the site.
    places : Places
        Of the stars.
    constant : ndarray, shape [3]
        Variances of the part of the shapes that all stars share.
    """

    def __init__(self, theory: LayerTheory, prior: ExposedAir, places: Places, constant: np.ndarray) -> None:
        self._theory, self._prior, self._constant = theory, prior, constant
        self._speeds = np.maximum(np.hypot(*np.array(prior.velocities).T), _LEAST_SPEED)
        self._sampling = COARSE._replace(wind=_FASTEST * float(self._speeds.max(initial=0.0)))
        blocks = blocks_of(places.xy, _BLOCK)
        numbers = np.unique(np.linspace(0, len(blocks) - 1, min(len(blocks), _MOST_BLOCKS)).astype(int))
        #: Stars of each block of the likelihood.
        self.blocks = [blocks[k] for k in numbers]
        extents = [float(np.hypot(*np.ptp(places.xy[block], axis=0))) for block in self.blocks]
        extent = max(*extents, float(np.max(theory.camera.half_sizes)))
        self._lags = PolarLags.of(prior, theory.reach(extent), *_SEARCH)
        to_sky = theory.to_sky.T
        self._amplitudes = [places[b].amplitudes_with(places[b]) for b in self.blocks]
        self._weights = [
            self._lags.interpolation(((places.xy[b][:, None] - places.xy[b]) @ to_sky).reshape(-1, 2))
            for b in self.blocks
        ]
        self._data: list[_BlockData] = []
        self._by_wavefront = np.zeros((len(self._lags.lags), len(PAIRS)))
        self._variance = theory.by_moments(prior, np.zeros((1, 2)), _FINE)[0, :3]

    def observe(
        self, values: np.ndarray, noise: np.ndarray, spread: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        """Take residuals of all stars and the variances of their noise [n, 3].

        ``spread`` returns a factor [3 m, k] of the covariance of the values of some stars due to fitted parameters.
        """

        def block(index: np.ndarray) -> _BlockData:
            factor = in_order(values[index])[:, None]
            if spread is not None:
                factor = np.concatenate([factor, spread(index)], axis=1)
            return _BlockData(in_order(noise[index]), factor)

        self._data = map_on_threads(block, self.blocks, self._theory.threads)

    def evaluations(self, forecast: bool) -> int:
        """Return about how many likelihoods :meth:`search` computes."""
        return _ITERATIONS + (1 if forecast else _DIRECTIONS)

    def search(self, forecast: bool = False, advance: Callable[[int], None] | None = None) -> LayerCovariance:
        """Find the winds, from the most likely of some random directions, or from those of the prior."""
        velocities = [np.array(self._prior.velocities)]
        if not forecast:
            angle = stream(0, "directions of layers").uniform(0.0, 2.0 * np.pi, (_DIRECTIONS, len(self._speeds)))
            velocities = list(self._speeds[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        starts = [self._parameters(v) for v in velocities]
        # Without it strengths would make up for it. By each wind it would take ten times as long as the likelihood.
        first = [self._wavefront_part(start) for start in starts[:_FIRST_DIRECTIONS]]
        self._by_wavefront = np.mean(first, axis=0)
        table = self._table(starts[0])
        # No small nugget grows: the likelihood hardly changes with its logarithm.
        nugget = max(_NUGGETS, key=lambda n: self._likelihood(table, n * self._variance, gradient=False)[0])
        values = []
        for start in starts:
            start[-3:] = math.log(nugget)
            values.append(self._likelihood(self._table(start), self._nugget(start), gradient=False)[0])
            if advance is not None:
                advance(1)
        best = starts[int(np.argmax(values))]
        self._by_wavefront = self._wavefront_part(best)
        return self._climb(best, _ITERATIONS, advance)

    def improve(self, covariance: LayerCovariance, advance: Callable[[int], None] | None = None) -> LayerCovariance:
        """Find the winds from those of a covariance."""
        start = self._parameters(np.array(covariance.air.velocities))
        n, air = len(self._speeds), covariance.air
        strength, usual = (np.maximum(weights, _LEAST_STRENGTH) for weights in (air.weights, self._prior.weights))
        start[2 * n : 3 * n] = np.log(strength / usual)
        start[3 * n] = math.log(air.r0 / self._prior.r0)
        start[3 * n + 1] = math.log(air.outer_scale / self._prior.outer_scale)
        start[3 * n + 2 :] = np.log(covariance.nugget / self._variance)
        self._by_wavefront = self._wavefront_part(start)
        return self._climb(start, _AGAIN, advance)

    def _climb(self, start: np.ndarray, steps: int, advance: Callable[[int], None] | None) -> LayerCovariance:
        from scipy.optimize import minimize  # a fifth of a second

        n = len(self._speeds)
        # In units of the priors all parameters matter alike.
        unit = np.r_[np.repeat(_SPEED * self._speeds / _WIND, 2), self._widths, np.ones(3)]

        def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
            if advance is not None:
                advance(1)
            value, gradient = self._negative_log_posterior(unit * scaled)
            return value, unit * gradient

        count = 3 * sum(len(block) for block in self.blocks)
        bounds: list[tuple[float | None, float | None]] = [(None, None)] * (3 * n + 2)
        low, high = math.log(_NUGGETS[0]), math.log(_MOST_NUGGET)
        optimum = minimize(
            objective,
            start / unit,
            jac=True,
            method="L-BFGS-B",
            bounds=[*bounds, *[(low, high)] * 3],
            options={"maxiter": steps, "maxfun": 2 * steps, "ftol": _GAIN / count},
        )
        best = unit * optimum.x
        return self._theory.covariance(self._air(best), self._constant, self._nugget(best))

    @property
    def _widths(self) -> np.ndarray:
        """Standard deviations of the logarithms of strengths, Fried parameter and outer scale, [n_layer + 2]."""
        return np.r_[np.full(len(self._speeds), _STRENGTH), _FRIED, _OUTER_SCALE]

    def _parameters(self, velocities: np.ndarray) -> np.ndarray:
        """Return parameters of winds [n_layer, 2] [m/s], all else as in the prior.

        They are winds, logarithms of the strengths of layers, of the Fried parameter, the outer scale and the nuggets.
        """
        n = len(velocities)
        return np.concatenate([velocities.ravel() / _WIND, np.zeros(n + 2), np.full(3, math.log(_NUGGETS[0]))])

    def _air(self, parameters: np.ndarray) -> ExposedAir:
        n, prior = len(self._speeds), self._prior
        strength = np.array(prior.weights) * np.exp(parameters[2 * n : 3 * n])
        velocities = _WIND * parameters[: 2 * n].reshape(n, 2)
        return prior._replace(
            velocities=tuple((x, y) for x, y in velocities.tolist()),
            weights=tuple((strength / strength.sum()).tolist()),
            r0=prior.r0 * math.exp(parameters[3 * n]),
            outer_scale=prior.outer_scale * math.exp(parameters[3 * n + 1]),
        )

    def _wavefront_part(self, parameters: np.ndarray) -> np.ndarray:
        """Return the part of the mean wavefront in the covariances at the lags, [n_lag, 6]."""
        return self._theory.by_wavefront(self._air(parameters), self._lags.lags)

    def _nugget(self, parameters: np.ndarray) -> np.ndarray:
        return np.asarray(self._variance * np.exp(parameters[-3:]))

    def _table(self, parameters: np.ndarray) -> np.ndarray:
        """Return covariances at the lags, [n_lag, 6]."""
        air = self._air(parameters)
        return self._theory.by_moments(air, self._lags.lags, self._sampling) + self._by_wavefront

    def _negative_log_posterior(self, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return minus the logarithm of the likelihood times the priors, and its gradient."""
        n = len(self._speeds)
        nugget = self._nugget(parameters)
        table = self._table(parameters)
        value, by_table, by_nugget = self._likelihood(table, nugget)
        gradient = np.empty_like(parameters)
        for k in range(len(parameters) - 3):
            step = np.zeros_like(parameters)
            step[k] = _WIND_STEP if k < 2 * n else _STEP
            gradient[k] = float(((self._table(parameters + step) - table) * by_table).sum()) / step[k]
        gradient[-3:] = by_nugget * nugget
        winds = _WIND * parameters[: 2 * n].reshape(n, 2)
        speed = np.maximum(np.hypot(*winds.T), 1e-3)
        faster = np.log(speed / self._speeds)
        logarithms, width = parameters[2 * n : -3], self._widths
        value -= 0.5 * float((faster**2).sum()) / _SPEED**2 + 0.5 * float(((logarithms / width) ** 2).sum())
        gradient[: 2 * n] -= (_WIND * winds * (faster / (_SPEED * speed) ** 2)[:, None]).ravel()
        gradient[2 * n : -3] -= logarithms / width**2
        return -value, -gradient

    def _likelihood(
        self, table: np.ndarray, nugget: np.ndarray, *, gradient: bool = True
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the logarithm of the likelihood, and its derivatives with respect to table and nuggets."""

        def contribution(k: int) -> tuple[float, np.ndarray, np.ndarray]:
            data, weights, m = self._data[k], self._weights[k], len(self.blocks[k])
            amplitudes = self._amplitudes[k]
            matrix = in_blocks((weights @ table).T.reshape(-1, m, m) * amplitudes, self._constant)
            matrix[np.diag_indices(3 * m)] += data.noise + np.repeat(nugget, m)
            root = root_of(matrix)
            white = scipy.linalg.solve_triangular(root, data.factor, lower=True, check_finite=False)
            value = -0.5 * float((white**2).sum()) - float(np.log(np.diagonal(root)).sum())
            if not gradient:
                return value, np.zeros(0), np.zeros(0)
            inverse = inverse_from_cholesky(root)
            weighted = inverse @ data.factor
            slope = 0.5 * (weighted @ weighted.T - inverse)
            by_block = slope.reshape(3, m, 3, m)
            # Covariances of different shapes stand in two blocks.
            by_pair = [(1.0 if i == j else 2.0) * (amplitudes * by_block[i, :, j]).ravel() for i, j in PAIRS]
            by_nugget = np.diagonal(slope).reshape(3, m).sum(axis=1)
            return value, weights.T @ np.stack(by_pair, axis=1), by_nugget

        parts = map_on_threads(contribution, range(len(self.blocks)), self._theory.threads)
        values, by_table, by_nugget = zip(*parts, strict=True)
        return float(sum(values)), np.sum(by_table, axis=0), np.sum(by_nugget, axis=0)


@dataclass(frozen=True, eq=False)
class _BlockData:
    noise: np.ndarray  #: variances, [3 m]
    factor: np.ndarray  #: values, and a factor of their covariance due to fitted parameters, [3 m, 1 + k]


def mean_products(columns: np.ndarray) -> np.ndarray:
    """Return products of derivatives of PAIRS of shapes on the mean over stars, [6, k, k], of columns [n, k, 3]."""
    products = [np.einsum("na,nb->ab", columns[..., i], columns[..., j]) / len(columns) for i, j in PAIRS]
    return np.stack(products)


def _turn(jacobian: np.ndarray) -> np.ndarray:
    """Return shapes e1, e2, ln size on the detector by those on the sky, [3, 3]."""
    turn = jacobian / math.sqrt(abs(np.linalg.det(jacobian)))
    out = np.eye(3)
    for k, moments in enumerate((np.diag([0.5, -0.5]), np.array([[0.0, 0.5], [0.5, 0.0]]))):
        turned = turn @ moments @ turn.T
        out[:2, k] = turned[0, 0] - turned[1, 1], 2.0 * turned[0, 1]
    return out
