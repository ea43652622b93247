"""Solver of optimisations: least squares with exact derivatives, from one start or from random ones too."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from ...core.arguments import check_arguments
from ...core.units import require_count
from .problem import DesignProblem
from .variables import random_starts

#: Effect of the longest first step, in units of the merit at the start.
_FIRST_STEP = 100.0


@dataclass(frozen=True)
class Solution:
    """Changes of the variables where a solver stops."""

    changes: np.ndarray  #: as the solver has them, shape [n_variable]
    history: list[float]  #: rms of all residuals before and after each step [m]
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
    """

    tolerance: float = 1e-10
    max_steps: int = 200
    restarts: int = 0
    spread: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        require_count(self.restarts, "restarts", 0)

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
        scale = np.divide(1.0, effect, out=np.ones_like(effect), where=effect > 0)
        best, history = self._descend(problem, box, np.zeros(len(effect)), residuals, scale)
        for start in random_starts(problem.variables, bounded, box, self.spread, self.seed, self.restarts):
            start_residuals = problem.residuals(start)
            if np.isfinite(start_residuals).all():
                end, end_history = self._descend(problem, box, start, start_residuals, scale)
                if end.cost < best.cost:
                    best, history = end, end_history
        return Solution(best.x * scale, history, str(best.message))

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

        def jacobian(scaled: np.ndarray) -> np.ndarray:
            # Called at the start and after each step.
            values, change = problem.linear(scaled * scale)
            history.append(float(np.linalg.norm(values)))
            return change * scale

        solution = least_squares(
            lambda scaled: problem.residuals(scaled * scale),
            start / scale,
            jac=jacobian,
            bounds=(box[0] / scale, box[1] / scale),
            method="trf",
            # Generous first steps: variables that compensate each other move far for little effect.
            x_scale=float(max(_FIRST_STEP * float(np.linalg.norm(residuals)), np.finfo(float).tiny)),
            ftol=self.tolerance,
            xtol=self.tolerance,
            gtol=1e-15,
            max_nfev=self.max_steps,
        )
        return solution, history
