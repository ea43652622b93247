"""Gaussian processes of each component in files of earlier versions, which kriging has replaced: read and evaluated.

Each component has a squared-exponential kernel of its own over a polynomial trend, which is not shrunk. On noise-free
PSFs and on noisy stars :class:`~.kriging.Kriging` predicts shapes better (docs/howto/psf_models.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import scipy.linalg

from ...core.errors import ConfigError
from ...core.threads import one_blas_thread
from .file_parts import ModelParts
from .interpolation import FittedInterpolation, Interpolation, StarField
from .polynomial import mapped


@dataclass(frozen=True)
class GaussianProcess(Interpolation):
    """Retired: no longer fitted."""

    name = "gp"
    label = "Gaussian process"
    words = "a Gaussian process over "

    def fit(self, stars: StarField) -> FittedInterpolation:
        """Raise ConfigError."""
        raise ConfigError("interpolation = 'gp': expected kriging, which replaced Gaussian processes")


@dataclass(frozen=True, eq=False)
class FittedGaussianProcess(FittedInterpolation, kind=GaussianProcess):
    """Polynomials and processes of a file."""

    kernel_columns = range(3, 4)

    kernels: np.ndarray  #: variance, correlation length where the extent is 2 wide, variance of the noise, [k, 3]
    alpha: np.ndarray  #: dual coefficients: inverse covariance times coefficients less trend, [n, k]

    def at(self, positions: Any) -> np.ndarray:
        """Evaluate the coefficients at positions [m, 2], [m, k]; no batch size matters."""
        trend, places = super().at(positions), mapped(positions, self.extent)
        process = np.zeros(trend.shape)
        variance, length = self.kernels[:, :2].T
        for point, alpha in zip(mapped(self.positions, self.extent), self.alpha, strict=True):
            squares = ((places - point) ** 2).sum(axis=1)
            process += variance * np.exp(-0.5 * squares[:, None] / length**2) * alpha
        return trend + process

    def leave_one_out(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients [n, k] of the stars less their prediction by the others, by the same kernels."""
        points, terms = mapped(self.positions, self.extent), self.terms()
        squares = ((points[:, None] - points) ** 2).sum(axis=2)
        # Files of the first versions have no noise of their stars, which was taken to be the same.
        noise = np.ones(len(points)) if self.weights is None else 1.0 / self.weights
        residuals = np.empty(coefficients.shape)
        with one_blas_thread():
            for kernel in np.unique(self.kernels, axis=0):
                group = (self.kernels == kernel).all(axis=1)
                variance, length, of_middle = kernel
                covariance = variance * np.exp(-0.5 * squares / length**2) + (of_middle or 1.0) * np.diag(noise)
                # Everything in units whitened by the root of the covariance: ordinary least squares.
                root = scipy.linalg.cholesky(covariance, lower=True)
                whitening = scipy.linalg.solve_triangular(root, np.eye(len(points)), lower=True)
                q, _ = np.linalg.qr(whitening @ terms)
                projected = whitening - q @ (q.T @ whitening)
                precision = (projected**2).sum(axis=0)
                precision = np.where(precision * np.diagonal(covariance) > 1e-10, precision, np.nan)
                residuals[:, group] = projected.T @ (projected @ coefficients[:, group]) / precision[:, None]
        return residuals

    def truncated(self, count: int) -> Self:
        """Return the interpolation of the first components only."""
        return replace(super().truncated(count), kernels=self.kernels[:count], alpha=self.alpha[:, :count])

    def parts(self) -> ModelParts:
        """Return what the interpolation has in a FITS file."""
        return super().parts().extended({"KERNEL": self.kernels}, {"pull": self.alpha})

    @classmethod
    def _fields_of(cls, parts: ModelParts) -> dict[str, Any]:
        return {"kernels": parts.image("KERNEL"), "alpha": parts.columns["pull"]}
