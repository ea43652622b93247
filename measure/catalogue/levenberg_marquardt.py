"""Levenberg-Marquardt fits of many galaxies at once, each on its own.

The Fisher matrix is all of the curvature of chi-square where the model fits without noise. In the noise of faint
galaxies the second derivatives of the model count too, and steps with the Fisher matrix alone converge slowly. A secant
estimate of that part (Dennis, Gay & Welsch 1981, ACM TOMS 7, 348) is learnt from the gradients of the steps already
made, at no cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import require_positive
from .fit_errors import error_covariance, fisher_inverse
from .gaussian_model import GaussianStamps, NormalEquations

# Damping of the first step (Marquardt 1963, scaled by the diagonal).
_DAMPING = 0.1
# Factor of the damping from step to step: less after an accepted one, more after a rejected one.
_FACTOR = 10.0
# Damping up to which a step is hardly shortened, so that a short one means convergence.
_WEAK_DAMPING = 0.1
# Damping at which a galaxy that finds no better step is given up.
_MOST_DAMPING = 1e10
# Longest step with the whole curvature, in lengths of the step with the Fisher matrix alone.
_LONGEST = 5.0


@dataclass(frozen=True)
class Bounds:
    """Domain of the parameters of n galaxies.

    Parameters
    ----------
    center : array
        Centres from which the fitted ones stay within `reach`, [n, 2] pixel.
    reach : float
        Largest distance along x and along y [pixel].
    least : array
        Smallest eigenvalue of the covariance, [n] pixel^2; negative where noise may make a point-like galaxy so.
    most : float
        Largest eigenvalue [pixel^2].
    """

    center: np.ndarray
    reach: float
    least: np.ndarray
    most: float

    def project(self, params: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Return the nearest parameters [k, 6] in the domain of the galaxies `indices` [k]."""
        inside = params.copy()
        center = self.center[indices]
        inside[:, 1:3] = np.clip(params[:, 1:3], center - self.reach, center + self.reach)
        mean, half = 0.5 * (params[:, 3] + params[:, 5]), 0.5 * (params[:, 3] - params[:, 5])
        radius = np.hypot(half, params[:, 4])
        low, high = (np.clip(v, self.least[indices], self.most) for v in (mean - radius, mean + radius))
        beyond = (low != mean - radius) | (high != mean + radius)
        scale = 0.5 * (high - low) / np.where(radius > 0.0, radius, 1.0)
        clipped = np.stack([0.5 * (low + high) + scale * half, scale * params[:, 4], 0.5 * (low + high) - scale * half])
        inside[beyond, 3:] = clipped.T[beyond]
        return inside


@dataclass(frozen=True)
class Minimum:
    """Minima of chi-square of n galaxies.

    Parameters
    ----------
    params : array
        [n, 6].
    equations : NormalEquations
        At the minima.
    converged, at_bounds : array of bool
        [n]; the last step fell below the tolerance, and would have left the domain.
    evaluations : array of int
        Models computed for each, [n].
    """

    params: np.ndarray
    equations: NormalEquations
    converged: np.ndarray
    at_bounds: np.ndarray
    evaluations: np.ndarray


@check_arguments
@dataclass(frozen=True)
class LevenbergMarquardt:
    """Fit galaxies by Levenberg-Marquardt steps with a learnt curvature.

    Parameters
    ----------
    max_evaluations : int
        Most models computed for a galaxy.
    tolerance : float
        Largest change of the model by the last step, relative to the data, as the root of the weighted sum of squares.
    whole_errors : bool
        Whether errors are those of the whole curvature of chi-square, of three more models; else of the Fisher matrix,
        by which the variance of e of exponential discs is 1.1 to 1.4 times too small.

    Raises
    ------
    DomainError
        If there is no evaluation, or the tolerance is not positive.
    """

    max_evaluations: int = 30
    tolerance: float = 1e-5
    whole_errors: bool = True

    def __post_init__(self) -> None:
        if self.max_evaluations < 1:
            raise DomainError(f"max_evaluations = {self.max_evaluations}: expected at least 1")
        require_positive(self.tolerance, "tolerance")

    def minimize(self, stamps: GaussianStamps, start: np.ndarray, bounds: Bounds) -> Minimum:
        """Minimize chi-square of every galaxy.

        A galaxy has converged once a step changes the model by less than the tolerance times the data, each measured
        by the root of its weighted sum of squares: independent of the unit of the image and of the scale of the
        weights. Every galaxy has its own damping and its own end, so splitting a batch changes no byte.
        """
        count = len(start)
        everything = np.arange(count)
        params = bounds.project(start, everything)
        first = stamps.normal_equations(params, everything)
        chi2, right, matrix = first.chi2, first.right, first.matrix
        damping = np.full(count, _DAMPING)
        second = np.zeros_like(matrix)
        converged, at_bounds = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        evaluations = np.ones(count, dtype=np.int32)
        active = everything
        for _ in range(self.max_evaluations - 1):
            if not len(active):
                break
            before = right[active]
            proposal = params[active] + _best_step(matrix[active], second[active], before, damping[active])
            trial = bounds.project(proposal, active)
            step = trial - params[active]
            at_bounds[active] = (trial != proposal).any(axis=1)
            change = _scalar_product(_matrix_vector(matrix[active], step), step)
            signal = params[active, 0] ** 2 * matrix[active, 0, 0] + chi2[active]
            trial_equations = stamps.normal_equations(trial, active)
            evaluations[active] += 1
            better = trial_equations.chi2 <= chi2[active]
            accepted = active[better]
            params[accepted], chi2[accepted] = trial[better], trial_equations.chi2[better]
            right[accepted], matrix[accepted] = trial_equations.right[better], trial_equations.matrix[better]
            second[active] = _updated_curvature(second[active], matrix[active], step, before - trial_equations.right)
            # A strongly damped step is short without being near the minimum; a short one that is rejected is rounding.
            done = (change <= self.tolerance**2 * signal) & (damping[active] <= _WEAK_DAMPING)
            damping[active] *= np.where(better, 1.0 / _FACTOR, _FACTOR)
            converged[active] = done
            active = active[~done & (damping[active] < _MOST_DAMPING)]
        return Minimum(params, NormalEquations(chi2, right, matrix), converged, at_bounds, evaluations)

    def covariance(self, stamps: GaussianStamps, minimum: Minimum) -> np.ndarray:
        """Return the covariances of the errors of minima [n, 6, 6]; NaN for a singular one."""
        if self.whole_errors:
            return error_covariance(stamps, minimum.params, minimum.equations)
        return fisher_inverse(minimum.equations.matrix)


def _scalar_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray((a * b).sum(axis=1))


def _matrix_vector(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray((matrix * vector[:, None, :]).sum(axis=2))


def _best_step(fisher: np.ndarray, second: np.ndarray, right: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the steps [n, 6] with the whole curvature where that leads downhill and not far, else with `fisher`."""
    diagonal = np.diagonal(fisher, axis1=1, axis2=2)
    # Parameters that change nothing stay.
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    damped = np.eye(fisher.shape[1]) * np.where(diagonal > 0.0, damping[:, None], 1.0)[:, None, :]
    fisher_step, full_step = (
        _solve_linear(matrix / (scale[:, :, None] * scale[:, None, :]) + damped, right / scale) / scale
        for matrix in (fisher, fisher + second)
    )
    length, limit = (_scalar_product(_matrix_vector(fisher, step), step) for step in (full_step, fisher_step))
    good = (_scalar_product(full_step, right) > 0.0) & (length <= _LONGEST**2 * limit)
    return np.where(good[:, None], full_step, fisher_step)


def _solve_linear(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solutions [n, 6] of linear equations; NaN for singular ones."""
    try:
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(right) == 1:
            return np.full(right.shape, np.nan)
        return np.concatenate([_solve_linear(matrix[i : i + 1], right[i : i + 1]) for i in range(len(right))])


def _updated_curvature(second: np.ndarray, fisher: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the second-order parts of the curvature [n, 6, 6] after steps and changes of the gradient, both [n, 6].

    The smallest change that explains the gradients, of the part made smaller where the last step shows it too large
    (Dennis, Gay & Welsch 1981, eqs. 2.5 and 2.8).
    """
    beyond = change - _matrix_vector(fisher, step)
    curvature_along = _scalar_product(_matrix_vector(second, step), step)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(
            curvature_along != 0.0, np.minimum(1.0, np.abs(_scalar_product(step, beyond) / curvature_along)), 1.0
        )
    second = second * size[:, None, None]
    missed = beyond - _matrix_vector(second, step)
    along = np.where((_scalar_product(change, step) > 0.0)[:, None], change, _matrix_vector(fisher, step))
    scale = _scalar_product(along, step)
    moved = scale > 0.0
    along = along / np.where(moved, scale, 1.0)[:, None]
    cross = missed[:, :, None] * along[:, None, :]
    update = cross + np.swapaxes(cross, 1, 2)
    update -= _scalar_product(missed, step)[:, None, None] * along[:, :, None] * along[:, None, :]
    return np.asarray(second + np.where(moved[:, None, None], update, 0.0))
