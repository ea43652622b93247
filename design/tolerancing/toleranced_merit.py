"""Merit of a telescope as a function of deviations within tolerances, with compensators: traced, linear, quadratic."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core.errors import DomainError, PachonError
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.parameters import Parameter, apply
from ...models.parameters.tolerances import Tolerance, draw
from ...models.telescope import Telescope
from ..optimize.jacobian import ParameterColumns
from ..optimize.optimize import NO_EFFECT
from .criterion import Criterion

#: Steps of the differences of gradients, in standard deviations of the tolerances.
_STEP = 0.5
#: Relative size of effects of combinations of compensators that depend on each other but for rounding.
_DEPENDENT = 1e-9
#: Drawn telescopes whose derivatives say how far those of the telescope as designed hold, and the seed of the draw.
_DRAWS = 4
_SEED = 0
#: Halvings of the moves of compensators that leave a drawn telescope without light.
_HALVINGS = 20
#: Steps by which the compensators of a traced telescope settle at most.
_SETTLING_STEPS = 10
#: Fraction of the mean square that another step would take away, below which they stay: 5e-5 of the merit.
_SETTLED = 1e-4
#: The same where derivatives are taken, which an error of the compensators spoils to first order.
_WELL_SETTLED = 1e-6


class SecondOrder(NamedTuple):
    """Least square of a merit over its compensators, to second order in the deviations.

    Attributes
    ----------
    start : float
        The square without deviations [m^2].
    gradient, hessian : ndarray, shape [n_tolerance], [n_tolerance, n_tolerance]
        First and second derivatives.
    moves : ndarray, shape [n_compensator]
        Compensators without deviations.
    moves_by_deviation : ndarray, shape [n_tolerance, n_compensator]
        Their derivatives.
    """

    start: float
    gradient: np.ndarray
    hessian: np.ndarray
    moves: np.ndarray
    moves_by_deviation: np.ndarray


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
    changes : ndarray, shape [n_changed, n_compensator]
        Changes of the derivatives `by_free` in drawn telescopes with their compensators, whose sum of squares is a mean
        square.
    combinations : ndarray, shape [n_compensator, n_combination]
        Combinations of compensators that follow: those whose effect is larger than its changes. A tilt that hardly acts
        on the fields would else go as far as its effect is small.
    setting : ndarray, shape [n_compensator, n]
        Matrix from residuals to minus the best setting of these combinations.
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
    changes: np.ndarray
    combinations: np.ndarray
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
        no_changes = np.zeros((0, len(compensators)))
        _require_effects(by_free, compensators, least)
        toleranced = cls(
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
            no_changes,
            *_best_settings(by_free, no_changes),
        )
        if not compensators:
            return toleranced
        deviations = draw(tolerances, _SEED, _DRAWS)
        for moves in (np.zeros((_DRAWS, len(compensators))), None):
            # Moves that the deviations alone leave possible may be too large for derivatives themselves.
            values = deviations, toleranced.moves(deviations) if moves is None else moves
            changes = np.concatenate([toleranced.changes, toleranced._changes(*values)])
            combinations, setting = _best_settings(by_free, changes)
            toleranced = replace(toleranced, changes=changes, combinations=combinations, setting=setting)
        return toleranced

    def _changes(self, deviations: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Return changes of `by_free` at deviations and moves of compensators, shape [n_changed, n_compensator]."""
        changes = []
        for deviation, move in zip(deviations, moves, strict=True):
            for power in range(_HALVINGS):
                values = np.append(deviation, 0.5**power * move)
                try:
                    slopes = self._derivatives(values)[1][:, len(self.tolerances) :]
                except PachonError:
                    continue
                if np.isfinite(slopes).all():
                    changes.append((slopes - self.by_free) / np.sqrt(len(deviations)))
                    break
        return np.concatenate(changes) if changes else np.zeros((0, len(self.compensators)))

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
        start, gradient, hessian = self.second_order[:3]
        square = start + deviations @ gradient + 0.5 * np.einsum("ni,ij,nj->n", deviations, hessian, deviations)
        return np.sqrt(np.maximum(square, 0.0))

    def quadratic_moves(self, deviations: np.ndarray) -> np.ndarray:
        """Return the compensators of :meth:`quadratic`, linear in the deviations, shape [n, n_compensator]."""
        return self.second_order.moves + deviations @ self.second_order.moves_by_deviation

    @cached_property
    def second_order(self) -> SecondOrder:
        """Expansion of the least square of the merit over the compensators.

        Second derivatives are differences of exact gradients between telescopes whose compensators have settled. At
        fixed compensators they would be those of spots far out of focus.
        """
        n = len(self.tolerances)
        steps = _STEP * self.spreads
        hessian, moves_by_deviation = np.empty((n, n)), np.empty((n, len(self.compensators)))
        values, start, gradient = self._least(np.zeros(n))
        for i, step in enumerate(steps):
            (high, _, above), (low, _, below) = (self._least(sign * step * np.eye(n)[i]) for sign in (1.0, -1.0))
            hessian[i] = (above - below) / (2.0 * step)
            moves_by_deviation[i] = (high - low)[n:] / (2.0 * step)
        return SecondOrder(start, gradient, 0.5 * (hessian + hessian.T), values[n:], moves_by_deviation)

    def _least(self, deviations: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Return deviations with the best compensators, the square of the merit there [m^2], and its gradient."""
        n = len(self.tolerances)
        values, residuals, slopes = self._settle(self.compensated(deviations[None])[0], _WELL_SETTLED)
        by_draw, by_free = slopes[:, :n], slopes[:, n:] @ self.combinations
        # What compensators follow to first order is no change of the least.
        by_draw = by_draw - by_free @ np.linalg.lstsq(by_free, by_draw, rcond=_DEPENDENT)[0]
        return values, float(residuals @ residuals), np.asarray(2.0 * residuals @ by_draw)

    def _derivatives(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals [m], and their derivatives [m per unit], at deviations and compensators."""
        columns = ParameterColumns.at(self.prepared, self.parameters, self.matrix @ values)
        residuals, slopes = self.criterion.judge.derivatives(columns)
        return residuals, slopes @ self.matrix

    def compensated(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations [n, n_tolerance] with their compensators behind, [n, n_tolerance + n_compensator]."""
        return np.concatenate([deviations, self.moves(deviations)], axis=1)

    def settled(self, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return deviations with compensators that settle from those given, and the criterion there as :meth:`traced`.

        Derivatives change along large moves: a primary of f/2.5 whose radius is 0.3 % off moves the focus of an f/8
        telescope by 77 mm, of which linear least squares leave 0.6 mm. Gauss-Newton steps on the traced telescope
        follow until another one would hardly lessen the mean square.
        """
        if not self.combinations.size:
            return values, self.traced(values)
        try:
            residuals = self.criterion.judge.residuals(self.telescope_at(values))
            # By the derivatives of the telescope as designed, which cost nothing.
            if not _is_small(self.by_free @ (self.setting @ residuals), residuals, _SETTLED):
                values, residuals, _ = self._settle(values, _SETTLED)
        except PachonError:
            return values, self.traced(values)
        if self.criterion.function is not None:
            return values, self.traced(values)
        return values, float(np.linalg.norm(residuals))

    def _settle(self, values: np.ndarray, gain: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values with compensators from which another step would gain less, and residuals and slopes there."""
        residuals, slopes = self._derivatives(values)
        for _ in range(_SETTLING_STEPS):
            by_free = slopes[:, len(self.tolerances) :] @ self.combinations
            step, *_ = np.linalg.lstsq(by_free, -residuals, rcond=_DEPENDENT)
            if _is_small(by_free @ step, residuals, gain):
                break
            stepped = self._stepped(values, self.combinations @ step, residuals)
            if stepped is None:
                break
            values = stepped
            residuals, slopes = self._derivatives(values)
        return values, residuals, slopes

    def _stepped(self, values: np.ndarray, step: np.ndarray, residuals: np.ndarray) -> np.ndarray | None:
        """Return values with compensators a step farther, halved until the merit is less; None where it never is."""
        for power in range(_HALVINGS):
            stepped = values + np.append(np.zeros(len(self.tolerances)), 0.5**power * step)
            try:
                lessened = self.criterion.judge.residuals(self.telescope_at(stepped))
            except PachonError:
                continue
            if lessened @ lessened < residuals @ residuals:
                return stepped
        return None

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
        """Criterion of the telescope as designed, compensated, in SI."""
        return self.settled(self.compensated(np.zeros((1, len(self.tolerances))))[0])[1]


def _is_small(change: np.ndarray, residuals: np.ndarray, fraction: float) -> bool:
    """Return whether the square of a change of the residuals is at most a fraction of theirs."""
    return bool(change @ change <= fraction * (residuals @ residuals))


def _require_effects(slopes: np.ndarray, names: tuple[str, ...], least: np.ndarray) -> None:
    """Raise DomainError of a compensator whose effect is rounding."""
    for name, value, rounding in zip(names, np.linalg.norm(slopes, axis=0), least, strict=True):
        if not value > rounding:
            raise DomainError(f"compensator {name!r} has no effect on the merit: expected one that has")


def _best_settings(slopes: np.ndarray, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the combinations of compensators that follow, and the matrix from residuals to minus their best setting.

    Slopes and their changes together are made orthogonal and normal; the singular values of the slopes' part are then
    the root of the fraction that is theirs.
    """
    if not slopes.shape[1]:
        return np.zeros((0, 0)), np.zeros((0, len(slopes)))
    size = np.linalg.norm(slopes, axis=0)
    both, scales, axes = np.linalg.svd(np.concatenate([slopes, changes]) / size, full_matrices=False)
    full = scales > _DEPENDENT * scales[0]
    effects, fractions, turned = np.linalg.svd(both[: len(slopes), full], full_matrices=False)
    follow = fractions**2 > 0.5
    combinations = (axes[full].T / scales[full] @ turned[follow].T) / size[:, None]
    return combinations, combinations / fractions[follow] @ effects[:, follow].T
