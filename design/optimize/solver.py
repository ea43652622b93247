"""Solver of optimisations: least squares with exact derivatives, from one start or from random ones too."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import require_count, require_positive, require_within
from .problem import DesignProblem
from .variables import random_starts

#: Effect of the longest first step, in units of the merit at the start.
_FIRST_STEP = 100.0
#: How often the solver begins where derivatives were last finite, and the factor of its first step each time.
_ATTEMPTS = 5
_SHORTER = 0.01
#: Tolerance of solutions that begin at another one: operands are held more exactly than merits are minimised.
_RESUMED = 1e-8
#: Most evaluations of such a solution, which is near its start.
_RESUMED_STEPS = 25


@dataclass(frozen=True)
class Solution:
    """Changes of the variables where a solver stops."""

    changes: np.ndarray  #: as the solver has them, shape [n_variable]
    history: list[float]  #: rms of all residuals, with stated weights, before and after each step [m]
    message: str  #: why it stopped


@check_arguments
@dataclass(frozen=True)
class LeastSquares:
    """Trust-region least-squares solver, with random starts beside the telescope as it is.

    Parameters
    ----------
    tolerance : float
        Relative change of the sum of squares, or of the variables, at which the solver stops.
    max_steps : int
        Largest number of evaluations of the merit, from each start.
    restarts : int
        Number of random starts beside the telescope as it is; the best end is returned.
    spread : float
        Width of the random starts, relative to the values of the variables; those with two bounds are drawn evenly
        between them.
    seed : int
        Seed of the random starts.
    constraint_tolerance : float
        Deviation from the value or limit of an operand within which it is held, relative to it; at a goal of zero in
        the unit of the lens. Infinite: operands are held as their weights do it.
    """

    tolerance: float = 1e-10
    max_steps: int = 200
    restarts: int = 0
    spread: float = 0.3
    seed: int = 0
    constraint_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        require_count(self.restarts, "restarts", 0)
        require_positive(self.tolerance, "tolerance")
        require_within(self.spread, "spread", 0.0, 1e3)
        if not self.constraint_tolerance > 0.0:
            raise DomainError(f"constraint_tolerance = {self.constraint_tolerance!r}: expected a positive number")

    def solve(
        self,
        problem: DesignProblem,
        box: tuple[np.ndarray, np.ndarray],
        bounded: Iterable[str],
        residuals: np.ndarray,
        effect: np.ndarray,
    ) -> Solution:
        """Return the best solution of a problem.

        Parameters
        ----------
        problem : DesignProblem
            Residuals as functions of the changes.
        box : tuple of ndarray, shape [n_variable]
            Limits of the changes.
        bounded : iterable of str
            Addresses of variables whose limits are stated.
        residuals : ndarray, shape [n]
            Residuals without changes [m].
        effect : ndarray, shape [n_variable]
            Rms change of the residuals by each variable, which scales it [m per unit].
        """
        scale = _scale(effect)
        best, history = self._descend(problem, box, np.zeros(len(effect)), residuals, scale)
        for start in random_starts(problem.variables, bounded, box, self.spread, self.seed, self.restarts):
            start_residuals = problem.residuals(start)
            if np.isfinite(start_residuals).all():
                try:
                    end, end_history = self._descend(problem, box, start, start_residuals, scale)
                except DomainError:
                    # Rays of a random telescope may be lost where derivatives are taken.
                    continue
                if end.cost < best.cost:
                    best, history = end, [history[0], *end_history]
        return Solution(best.x * scale, history, str(best.message))

    def resume(
        self, problem: DesignProblem, box: tuple[np.ndarray, np.ndarray], changes: np.ndarray, effect: np.ndarray
    ) -> np.ndarray:
        """Return the solution of a problem that begins at the changes of another one, a little different."""
        scale, start = _scale(effect), np.clip(changes, *box)
        finer = replace(self, tolerance=min(self.tolerance, _RESUMED), max_steps=min(self.max_steps, _RESUMED_STEPS))
        end, _ = finer._descend(problem, box, start, problem.residuals(start), scale)
        return np.asarray(end.x * scale)

    def _descend(
        self,
        problem: DesignProblem,
        box: tuple[np.ndarray, np.ndarray],
        start: np.ndarray,
        residuals: np.ndarray,
        scale: np.ndarray,
    ) -> tuple[OptimizeResult, list[float]]:
        """Return the solution in variables over their scale, and the rms of all residuals before and after steps."""
        history: list[float] = []
        # Generous first steps: variables that compensate each other move far for little effect.
        first_step = max(_FIRST_STEP * float(np.linalg.norm(residuals)), float(np.finfo(float).tiny))
        origin, begin = np.zeros(len(scale)), start / scale
        for attempt in range(_ATTEMPTS):
            try:
                solution = self._solution(problem, box, origin, begin, scale, first_step, history)
            except _NoDerivativesError as lost:
                if lost.before is None or attempt == _ATTEMPTS - 1:
                    break
                # Steps of a solver that begins at 0 are no longer than the first one.
                origin, begin, first_step = lost.before, np.zeros(len(scale)), _SHORTER * first_step
            else:
                solution.x = origin + solution.x
                return solution, history
        names = ", ".join(variable.address for variable in problem.variables)
        raise DomainError(
            f"the merit has no derivatives on the way of {names}: expected bounds that keep to the surfaces"
        )

    def _solution(
        self,
        problem: DesignProblem,
        box: tuple[np.ndarray, np.ndarray],
        origin: np.ndarray,
        begin: np.ndarray,
        scale: np.ndarray,
        first_step: float,
        history: list[float],
    ) -> OptimizeResult:
        """Return the solution relative to an origin, all in variables over their scale; appends to the history."""
        before: np.ndarray | None = None

        def jacobian(scaled: np.ndarray) -> np.ndarray:
            # Called at the start and after each step.
            nonlocal before
            values, change = problem.linear((origin + scaled) * scale)
            if not np.isfinite(change).all():
                raise _NoDerivativesError(before)
            history.append(problem.stated_rms(values))
            before = origin + scaled
            return change * scale

        return least_squares(
            lambda scaled: problem.residuals((origin + scaled) * scale),
            begin,
            jac=jacobian,
            bounds=(box[0] / scale - origin, box[1] / scale - origin),
            method="trf",
            x_scale=first_step,
            ftol=self.tolerance,
            xtol=self.tolerance,
            gtol=1e-15,
            max_nfev=self.max_steps,
        )


class _NoDerivativesError(Exception):
    """A step has led to where derivatives are not finite, as at the equator of a surface."""

    def __init__(self, before: np.ndarray | None) -> None:
        super().__init__()
        self.before = before  #: variables over their scale before that step; None at the start


def _scale(effect: np.ndarray) -> np.ndarray:
    """Return the size of each variable that has an effect of 1 m."""
    return np.divide(1.0, effect, out=np.ones_like(effect), where=effect > 0)
