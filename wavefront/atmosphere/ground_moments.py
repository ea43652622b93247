r"""Moments of images by layers on the ground, which stars share as far as their light takes the same part of the pupil.

Through pupils P and P' the covariances of :mod:`.moment_covariance` are means over the baselines u with the weight

.. math:: X(u) = \int P(x + u) \, P'(x) \, d^2x .

Each is a product of one pupil with the other, convolved with a function of u that depends on the air alone.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np

from ...core.threads import one_blas_thread
from .field_pupils import FieldPupils
from .moment_covariance import (
    FINE,
    MICRO,
    Delays,
    ExposedAir,
    as_matrices,
    by_mean_slope,
    ground_slopes,
    moment_covariance,
    wick_products,
)

# Least autocorrelation of the full pupil, over its largest, at baselines that count.
_LEAST = 1e-3


class GroundMoments(NamedTuple):
    """Moments that all stars with the same pupil share."""

    values: np.ndarray  #: p, q, s at the nodes [rad^2], [n_node, 3]
    pupils: FieldPupils | None  #: None where all stars have one pupil

    @classmethod
    def draw(cls, factor: np.ndarray, pupils: FieldPupils | None, normal: np.ndarray) -> Self:
        """Return those of a :func:`ground_factor` and standard normal numbers [3 n_node]."""
        return cls((factor @ normal).reshape(-1, 3), pupils)

    def at(self, slopes: np.ndarray) -> np.ndarray:
        """Return the moments at field slopes [n, 2] [rad], [n, 3]."""
        if self.pupils is None:
            return np.repeat(self.values, len(slopes), axis=0)
        return np.einsum("nk,kc->nc", self.pupils.weights(slopes), self.values)


def ground_factor(
    air: ExposedAir, lit: tuple[float, ...], pupils: FieldPupils | None, shared: np.ndarray
) -> np.ndarray:
    """Return a lower Cholesky factor of the covariance of :class:`GroundMoments`, [3 n_node, 3 n_node] [rad^2].

    ``shared`` [3, 3] is the covariance that stars far apart have through the mean pupil, whose lit pairs are those of
    :attr:`.MomentResponse.lit`. It has all orders, which change with the pupil as the second does.
    """
    factor, ground = np.linalg.cholesky(shared), air.on_ground()
    if pupils is None:
        return factor
    count = len(pupils.light)
    if not ground.altitudes:
        return np.hstack([np.tile(factor, (count, 1)), np.zeros((3 * count, 3 * count - 3))])
    with one_blas_thread():  # bytes of a seed do not depend on the number of threads
        mean = as_matrices(moment_covariance(ground, np.zeros((1, 2)), lit=lit, sampling=FINE).second[0])
        onto = factor @ np.linalg.inv(np.linalg.cholesky(mean))
        blocks = onto @ as_matrices(ground_covariance(ground, pupils)) @ onto.T
        values, vectors = np.linalg.eigh(blocks.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count))
        # Equal pupils have eigenvalues of zero, and the errors of covariances, of a per cent, make some negative.
        root = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r"))
        return np.asarray(root.T * np.where(np.diag(root) < 0.0, -1.0, 1.0))


def ground_covariance(air: ExposedAir, pupils: FieldPupils) -> np.ndarray:
    """Return covariances of the moments of the second order of layers on the ground at the nodes [rad^4].

    They are those of :data:`.PAIRS`, [n_node, n_node, 6].
    """
    delays = Delays.of(air, (0.0,), (1.0,), FINE)
    count, packets = len(pupils.light), np.diff(delays.packet_start)
    # Opposite delays are those of the stars in the other order.
    half = len(packets) // 2
    after = slice(delays.packet_start[half], None)
    x, y, weight = (delays.baseline[after, k].astype(np.float64).ravel() for k in range(3))
    delay = np.repeat(np.arange(half), packets[half:] * delays.baseline.shape[2])
    slopes = ground_slopes(air, delays)[:, after].reshape(3, -1).astype(np.float64)
    products = wick_products(slopes) * delays.weight[half:][delay]
    second = _through_pupils(pupils, x, y, weight, products, np.zeros_like(delay))[0]
    # Mean slopes vary little with the pupil: half of the cells along each side do.
    means = _through_pupils(pupils.halved(), x, y, weight, slopes, delay)
    means = np.concatenate([np.swapaxes(means[::-1], 2, 3), means])
    lost = by_mean_slope(
        np.ascontiguousarray(means.reshape(len(packets), 3, -1).transpose(2, 0, 1)), delays, air.exposure
    )
    lost = lost.reshape(count, count, 6)
    second = np.moveaxis(second, 0, 2)
    return MICRO**4 * (second + np.swapaxes(second, 0, 1) - 0.5 * (lost + np.swapaxes(lost, 0, 1)))


def _through_pupils(
    pupils: FieldPupils, x: np.ndarray, y: np.ndarray, weight: np.ndarray, values: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """Return means of values [n_value, n_baseline] through all pairs of pupils, [n_group, n_value, n_node, n_node].

    Baselines x, y [m] have weights of sum 1 through the full pupil, and belong to groups.
    """
    side, count = pupils.light.shape[1], len(pupils.light)
    light = pupils.light.reshape(count, -1)
    light = (light / light.sum(axis=1, keepdims=True)).astype(np.float32)
    cells, groups = _baseline_cells(side), int(group.max()) + 1
    sums = _Spread.of(x, y, weight, pupils).sums(values, group, groups).astype(np.float32)
    means = np.empty((groups, len(values), count, count))
    for n in range(groups):
        means[n] = light @ sums[:, n][:, cells] @ light.T
    return means


class _Spread(NamedTuple):
    """Places of baselines among cells of baselines, between which values are linear."""

    cells: np.ndarray  #: [4, n_baseline] int
    shares: np.ndarray  #: [4, n_baseline], over the full pupil's autocorrelation
    size: int  #: number of cells

    @classmethod
    def of(cls, x: np.ndarray, y: np.ndarray, weight: np.ndarray, pupils: FieldPupils) -> Self:
        """Return those of baselines x, y [m], with weights of the full pupil."""
        side = len(pupils.full)
        width = 2 * side - 1
        full = pupils.full.ravel() / pupils.full.sum()
        correlation = np.bincount(_baseline_cells(side).ravel(), np.outer(full, full).ravel(), width**2)
        enough = correlation > _LEAST * correlation.max()
        place_x, place_y = (v * (side / pupils.diameter) + side - 1 for v in (x, y))
        column, row = (np.clip(np.floor(v).astype(int), 0, width - 2) for v in (place_x, place_y))
        right, down = np.clip(place_x - column, 0.0, 1.0), np.clip(place_y - row, 0.0, 1.0)
        cells = np.stack([row * width + column + step for step in (0, 1, width, width + 1)])
        shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
        # The linear function through the cells' correlations is what the weights stand for.
        total = (shares * correlation[cells]).sum(axis=0)
        shares = shares * np.where(enough[cells], 1.0, 0.0) * weight / np.maximum(total, _LEAST * correlation.max())
        return cls(cells, shares, width**2)

    def sums(self, values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
        """Return sums of values [n_value, n_baseline] in cells for each group, [n_value, n_group, n_cell]."""
        place = (group * self.size + self.cells).ravel()
        total = [np.bincount(place, (self.shares * v).ravel(), groups * self.size) for v in values]
        return np.stack(total).reshape(len(values), groups, self.size)


@lru_cache(maxsize=4)
def _baseline_cells(side: int) -> np.ndarray:
    """Return the cell of the baseline from each cell of a pupil to each, [side^2, side^2] int."""
    row, column = (index.ravel() for index in np.indices((side, side)))
    apart = [(index[:, None] - index) + side - 1 for index in (row, column)]
    return np.asarray(apart[0] * (2 * side - 1) + apart[1])
