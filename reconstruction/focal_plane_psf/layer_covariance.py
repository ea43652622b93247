"""Covariance of the contribution of turbulence to the shapes, together, from the theory of its layers.

e1, e2 and ln size of all stars are one Gaussian random field: their covariances, those between different shapes among
them, follow from heights, strengths and winds of the layers (:mod:`~.atmosphere.moment_covariance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import warp as wp

from ...core.launch import launch
from ...core.warp_arrays import warp_array
from ...wavefront.atmosphere.field_kernels import pairs, read_lags
from ...wavefront.atmosphere.moment_covariance import PAIRS, ExposedAir
from ...wavefront.atmosphere.polar_lags import PolarLags
from .covariance import Covariance, Places

# Part of the variances that is added where a matrix is indefinite, doubled at each attempt.
_MORE = 1e-3
_ATTEMPTS = 12


@dataclass(frozen=True, eq=False)
class LayerCovariance:
    """Covariance function of e1, e2 and ln size of one exposure. Matrices are in blocks, one shape after the other.

    Attributes
    ----------
    air : ExposedAir
        Layers, their winds on the sky, Fried parameter, outer scale and exposure.
    to_sky : ndarray, shape [2, 2]
        Field slopes by positions on the detector [1/m].
    lags : PolarLags
        Rings and spokes of lags on the sky.
    table : ndarray, shape [n_ring, n_spoke, 6]
        Covariances there, of the pairs of :data:`~.moment_covariance.PAIRS`.
    constant : ndarray, shape [3]
        Variances of the part that all stars share.
    nugget : ndarray, shape [3]
        Variances of each star beside its stated noise.
    """

    air: ExposedAir
    to_sky: np.ndarray
    lags: PolarLags
    table: np.ndarray
    constant: np.ndarray
    nugget: np.ndarray

    @property
    def variance(self) -> np.ndarray:
        """Variances about the part that all stars share, [3]."""
        return np.asarray(self.table[0, 0, :3])

    def between(self, one: Places, other: Places) -> np.ndarray:
        """Return the covariance between two sets of places, without the nugget, shape [3 n, 3 m]."""
        n, m = len(one), len(other)
        apart = (one.xy[:, None] - other.xy) @ (self.to_sky.T / self.lags.unit)
        values = np.empty((len(PAIRS), n, m), dtype=np.float32)
        launch(
            read_lags,
            n * m,
            [
                warp_array(apart.reshape(-1, 2), wp.vec2f),
                warp_array(self.table, pairs),
                self.lags.step,
                warp_array(values.reshape(len(PAIRS), -1), wp.float32),
            ],
            threads=1,
        )
        return in_blocks(values * one.amplitudes_with(other), self.constant)

    def root(self, places: Places, noise: np.ndarray) -> np.ndarray:
        """Return the lower Cholesky factor of the covariance of stars, nugget and noise variances [3 n] included."""
        matrix = self.between(places, places)
        matrix[np.diag_indices(len(matrix))] += noise + np.repeat(self.nugget, len(places))
        return root_of(matrix)

    def at(self, places: Places) -> np.ndarray:
        """Return the variance at places, shape [3 n]."""
        about_common = self.variance[:, None] * (places.squares * np.ones(len(places)))
        return (self.constant[:, None] + about_common).ravel()


def root_of(matrix: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor of a covariance matrix [n, n], of one a little larger where it has none.

    Errors of interpolation between lags can make it indefinite where stars have next to no noise.
    """
    for k in range(_ATTEMPTS):
        with_more = matrix.copy()
        if k:
            with_more[np.diag_indices(len(matrix))] *= 1.0 + _MORE * 2.0**k
        try:
            return scipy.linalg.cholesky(with_more, lower=True, overwrite_a=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            continue
    return scipy.linalg.cholesky(np.diag(np.diagonal(matrix)), lower=True)


def in_blocks(values: np.ndarray, constant: np.ndarray) -> np.ndarray:
    """Return the matrix [3 n, 3 m] of covariances of pairs of shapes [6, n, m], and variances common to all [3]."""
    _, n, m = values.shape
    matrix = np.empty((3, n, 3, m))
    for value, (i, j) in zip(values, PAIRS, strict=True):
        matrix[i, :, j] = value
        if i == j:
            matrix[i, :, j] += constant[i]
        else:
            matrix[j, :, i] = value
    return matrix.reshape(3 * n, 3 * m)


def shape_groups(
    covariances: Sequence[Covariance | LayerCovariance],
) -> list[tuple[slice, Covariance | LayerCovariance]]:
    """Return the shapes that covary, and their covariance: each shape by itself, or all three."""
    if isinstance(covariances[0], LayerCovariance):
        return [(slice(0, 3), covariances[0])]
    return [(slice(i, i + 1), covariance) for i, covariance in enumerate(covariances)]


def in_order(values: np.ndarray) -> np.ndarray:
    """Return values [n, k] of k shapes one shape after the other, [k n]."""
    return values.T.ravel()
