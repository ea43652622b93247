"""Merit of a telescope as a function of deviations within tolerances, with compensators: traced, linear, quadratic."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.errors import DomainError, PachonError
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.parameters import Parameter, apply
from ...models.parameters.tolerances import Tolerance
from ...models.telescope import Telescope
from ..optimize.jacobian import ParameterColumns
from ..optimize.optimize import NO_EFFECT
from .criterion import Criterion

#: Steps of the differences of gradients, in standard deviations of the tolerances.
_STEP = 0.5
#: Relative curvature along combinations of compensators below which they have no effect.
_FLAT = 1e-9


@dataclass(frozen=True)
class TolerancedMerit:
    """A merit of deviations of degrees of freedom; compensators follow by least squares.

    Attributes
    ----------
    telescope : Telescope
        The telescope as designed.
    tolerances : tuple of Tolerance
        The tolerances, in the order of deviations.
    compensators : tuple of str
        Degrees of freedom that follow, behind the tolerances in `degrees_of_freedom`.
    degrees_of_freedom : DegreesOfFreedom
        Degrees of freedom of tolerances and compensators, in this order.
    criterion : Criterion
        The number, and the merit with derivatives that sets the compensators.
    prepared, parameters, matrix
        As in :meth:`DegreesOfFreedom.parameter_matrix`.
    residuals : ndarray, shape [n]
        Residuals of the telescope as designed [m].
    by_draw, by_free : ndarray, shape [n, n_tolerance], [n, n_compensator]
        Their derivatives with respect to deviations and compensators.
    setting : ndarray, shape [n_compensator, n]
        Matrix from residuals to minus the best setting of compensators.
    """

    telescope: Telescope
    tolerances: tuple[Tolerance, ...]
    compensators: tuple[str, ...]
    degrees_of_freedom: DegreesOfFreedom
    criterion: Criterion
    prepared: Telescope
    parameters: tuple[Parameter, ...]
    matrix: np.ndarray
    residuals: np.ndarray
    by_draw: np.ndarray
    by_free: np.ndarray
    setting: np.ndarray

    @classmethod
    def of(
        cls,
        telescope: Telescope,
        tolerances: tuple[Tolerance, ...],
        compensators: tuple[str, ...],
        degrees_of_freedom: DegreesOfFreedom,
        criterion: Criterion,
    ) -> TolerancedMerit:
        """Return the merit with its derivatives; a compensator without effect is a DomainError."""
        prepared, parameters, matrix = degrees_of_freedom.parameter_matrix(telescope)
        columns = ParameterColumns.at(prepared, parameters)
        residuals, slopes = criterion.judge.derivatives(columns)
        slopes = slopes @ matrix
        n = len(tolerances)
        by_draw, by_free = slopes[:, :n], slopes[:, n:]
        # Rounding errors of the effects, a fraction of the terms that cancel.
        least = np.zeros(0)
        if compensators:
            least = NO_EFFECT * (criterion.judge.size_of_terms(columns) @ np.abs(matrix))[n:]
        setting = _settings(by_free, compensators, least)
        return cls(
            telescope,
            tolerances,
            compensators,
            degrees_of_freedom,
            criterion,
            prepared,
            parameters,
            matrix,
            residuals,
            by_draw,
            by_free,
            setting,
        )

    @cached_property
    def fixed(self) -> np.ndarray:
        """Residuals of the telescope as designed, compensated [m], shape [n]."""
        return self.residuals - self.by_free @ (self.setting @ self.residuals)

    @cached_property
    def by_deviation(self) -> np.ndarray:
        """Derivatives of the residuals with respect to the deviations, compensated, shape [n, n_tolerance]."""
        return self.by_draw - self.by_free @ (self.setting @ self.by_draw)

    @property
    def nominal(self) -> float:
        """Merit of the telescope as designed, compensated to first order [m]."""
        return float(np.linalg.norm(self.fixed))

    @property
    def spreads(self) -> np.ndarray:
        """Standard deviations of the tolerances, each in its unit, shape [n_tolerance]."""
        return np.array([t.spread for t in self.tolerances])

    @property
    def contribution(self) -> np.ndarray:
        """Rms contribution of each tolerance alone, in quadrature, to first order [m], shape [n_tolerance]."""
        return np.linalg.norm(self.by_deviation, axis=0) * self.spreads

    def moves(self, deviations: np.ndarray) -> np.ndarray:
        """Return the compensators for deviations [n, n_tolerance] by linear least squares, [n, n_compensator]."""
        return -(deviations @ (self.setting @ self.by_draw).T + self.setting @ self.residuals)

    def linear(self, deviations: np.ndarray) -> np.ndarray:
        """Return the merit for deviations [n, n_tolerance], residuals linear in them [m], shape [n]."""
        # |r + J v|^2 through the small matrices J^T J and J^T r.
        square = self.fixed @ self.fixed + 2.0 * deviations @ (self.by_deviation.T @ self.fixed)
        square = square + np.einsum("ni,ij,nj->n", deviations, self.by_deviation.T @ self.by_deviation, deviations)
        return np.sqrt(np.maximum(square, 0.0))

    def quadratic(self, deviations: np.ndarray) -> np.ndarray:
        """Return the merit for deviations [n, n_tolerance], its square quadratic in them [m], shape [n]."""
        start, gradient, hessian = self.second_order
        n = len(self.tolerances)
        g, c, h = gradient[:n], gradient[n:], hessian[:n, :n]
        if self.compensators:
            # The minimum over the compensators is quadratic too (Schur's complement).
            across, inverse = hessian[:n, n:], _scaled_inverse(hessian[n:, n:])
            start = start - 0.5 * float(c @ inverse @ c)
            g, h = g - across @ inverse @ c, h - across @ inverse @ across.T
        square = start + deviations @ g + 0.5 * np.einsum("ni,ij,nj->n", deviations, h, deviations)
        return np.sqrt(np.maximum(square, 0.0))

    def quadratic_moves(self, deviations: np.ndarray) -> np.ndarray:
        """Return the compensators at the least of :meth:`quadratic` for deviations, shape [n, n_compensator]."""
        _, gradient, hessian = self.second_order
        n = len(self.tolerances)
        return -(gradient[n:] + deviations @ hessian[:n, n:]) @ _scaled_inverse(hessian[n:, n:])

    @cached_property
    def second_order(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Square of the merit [m^2], its gradient, and its second derivatives by differences of exact gradients.

        Deviations come first, then compensators; the latter have steps of the effect of all deviations together. Their
        usual moves are none, where by symmetry they do not respond to deviations to first order.
        """
        effect = np.linalg.norm(np.append(self.by_draw * self.spreads, self.residuals[:, None], axis=1))
        steps = _STEP * np.append(self.spreads, effect / np.linalg.norm(self.by_free, axis=0))
        hessian = np.empty((len(steps), len(steps)))
        for i, step in enumerate(steps):
            ends = [self._gradient(sign * step * np.eye(len(steps))[i]) for sign in (1.0, -1.0)]
            hessian[i] = (ends[0] - ends[1]) / (2.0 * step)
        slopes = np.concatenate([self.by_draw, self.by_free], axis=1)
        return float(self.residuals @ self.residuals), 2.0 * self.residuals @ slopes, 0.5 * (hessian + hessian.T)

    def _gradient(self, values: np.ndarray) -> np.ndarray:
        """Return the gradient of the square of the merit [m^2 per unit] at deviations and compensators."""
        columns = ParameterColumns.at(self.prepared, self.parameters, self.matrix @ values)
        residuals, slopes = self.criterion.judge.derivatives(columns)
        gradient: np.ndarray = 2.0 * residuals @ slopes @ self.matrix
        return gradient

    def compensated(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations [n, n_tolerance] with their compensators behind, [n, n_tolerance + n_compensator]."""
        return np.concatenate([deviations, self.moves(deviations)], axis=1)

    def telescope_at(self, values: np.ndarray) -> Telescope:
        """Return the telescope at deviations and compensators, shape [n_tolerance + n_compensator]."""
        return apply(self.prepared, dict(zip(self.parameters, self.matrix @ values, strict=True)))

    def traced(self, values: np.ndarray) -> float:
        """Return the criterion at deviations and compensators, in SI; NaN where there is no such telescope."""
        if not values.any():
            return self.criterion.measure(self.telescope)
        try:
            telescope = self.telescope_at(values)
        except PachonError:
            return np.nan
        return self.criterion.measure(telescope)

    @cached_property
    def traced_nominal(self) -> float:
        """Criterion of the telescope as designed, compensated to first order, in SI."""
        return self.traced(self.compensated(np.zeros((1, len(self.tolerances))))[0])


def _scaled_inverse(hessian: np.ndarray) -> np.ndarray:
    """Return the inverse of second derivatives by compensators, in each its own unit; without flat combinations."""
    scale = np.sqrt(np.abs(np.diag(hessian)))
    inverse: np.ndarray = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=_FLAT, hermitian=True)
    return inverse / np.outer(scale, scale)


def _settings(slopes: np.ndarray, names: tuple[str, ...], least: np.ndarray) -> np.ndarray:
    """Return the matrix from residuals to minus the best setting of compensators, shape [n_free, n]."""
    size = np.linalg.norm(slopes, axis=0)
    for name, value, rounding in zip(names, size, least, strict=True):
        if not value > rounding:
            raise DomainError(f"compensator {name!r} has no effect on the merit: expected one that has")
    return np.linalg.pinv(slopes / size, rcond=1e-9) / size[:, None] if names else np.zeros((0, len(slopes)))
