"""End of an optimisation: telescopes whose merit is the measured one, and whose operands are held."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np

from ...core.errors import DomainError
from ...models.paraxial import following_pupil, following_stop, stop_makes_pupil, with_true_aperture
from ...models.telescope import Telescope
from ...wavefront.vignetting_factors import with_vignetting_factors
from .design_task import DesignTask
from .held_operands import HeldOperand, HeldOperands, allowed_deviation, held_operands, with_operands
from .optimum import OperandChange
from .problem import DesignProblem

#: Relative difference of the merit of the solver from the measured one that is an error.
_DIFFERENT = 1e-2
#: The same, of the merit at the start: the rounding of paths and landing points.
_ROUNDING = 1e-9
#: Kinds of fields whose angles change with the telescope.
_IMAGE_HEIGHTS = ("paraxial_image_height", "real_image_height")
#: Most solutions after the first one.
_ROUNDS = 12
#: What is said of light that the solver has lost.
_LOST = "after the optimisation: hold the focal length by an operand, or limit the variables"


@dataclass(frozen=True)
class Settled:
    """Problem, changes, telescopes and operands at the end of an optimisation."""

    problem: DesignProblem
    changes: np.ndarray
    telescopes: tuple[Telescope, ...]
    operands: tuple[OperandChange, ...]


@dataclass(frozen=True)
class _Round:
    """One solution: what it is of, the telescopes as they are solved and saved, and the merits of both [m]."""

    problem: DesignProblem
    changes: np.ndarray
    solved: tuple[Telescope, ...]
    telescopes: tuple[Telescope, ...]
    operands: tuple[OperandChange, ...]
    merit: float
    measured: float

    @property
    def names(self) -> str:
        """Names of the telescopes, for messages."""
        return ", ".join(telescope.name for telescope in self.telescopes)

    @property
    def rank(self) -> tuple[int, float]:
        """Operands that do not hold, and the measured merit: the least is the best."""
        return sum(not operand.holds for operand in self.operands), self.measured


def settle(
    task: DesignTask,
    problem: DesignProblem,
    held: HeldOperands,
    changes: np.ndarray,
    resume: Callable[[DesignProblem, np.ndarray], np.ndarray],
    tolerance: float,
) -> Settled:
    """Solve again until the measured merit is that of the solver and operands are held.

    Rays, fields and what operands take from a telescope are those of the start at first. They are made anew from the
    solution where its merit, measured on the telescopes as they are saved, is another one: where apertures cut other
    rays, or image heights are the fields and the magnification changes. `resume` solves a changed problem from changes.
    Where apertures go on cutting other rays, the best solution by its measured merit is the end.

    Raises
    ------
    DomainError
        If the light of a field is lost, or the measured merit differs from that of the solver by more than one per cent
        for another reason than apertures.
    """
    start = task.measured([state.telescope for state in problem.states], filled=True)
    weighted_end = changes
    rounds: list[_Round] = []
    for count in range(_ROUNDS + 1):
        end = _round_of(task, problem, changes, tolerance)
        same = abs(end.measured - end.merit) <= _DIFFERENT * end.merit + _ROUNDING * start
        if np.isfinite(end.measured):
            rounds.append(end)
        moved = _moved_goals(held, end.operands)
        if count == _ROUNDS or (same and not moved):
            break
        solved = end.solved
        if any(goal.given_up for goal in moved):
            # What cannot be reached has drawn the telescope away from the others' solution.
            changes = weighted_end
            solved = tuple(problem.telescopes(changes))
        try:
            states = problem.states if same else task.remade(solved)
        except DomainError as error:
            if rounds:
                break
            raise DomainError(f"{error} {_LOST}") from None
        problem = DesignProblem(with_operands(states, held, solved), problem.variables)
        changes = resume(problem, changes)
    if not same:
        if not rounds:
            raise DomainError(f"{end.names}: no light is measured {_LOST}")
        end = min(rounds, key=lambda solution: solution.rank)
    stated = held_operands(task.operands, exactly=False)
    states = end.problem.states if same else task.remade(end.solved)
    problem = DesignProblem(with_operands(states, stated, end.solved), end.problem.variables)
    if not same:
        _require_merit(end, problem)
    return Settled(problem, end.changes, end.telescopes, end.operands)


def _require_merit(end: _Round, remade: DesignProblem) -> None:
    """Raise DomainError where a solution has another measured merit than with the rays that its apertures leave."""
    residuals, _ = remade.linear(end.changes)
    merit = float(np.linalg.norm(remade.merit_part(residuals)))
    heights = any(t.design_data.fields and t.design_data.field_type in _IMAGE_HEIGHTS for t in end.telescopes)
    if heights or not abs(end.measured - merit) <= _DIFFERENT * merit:
        advice = "fields are image heights: hold focal length or magnification" if heights else "limit the variables"
        raise DomainError(
            f"{end.names}: the rays of the optimisation have a merit of {end.merit:.6g} m at its end, and the "
            f"telescope as it would be saved {end.measured:.6g} m: expected them within {_DIFFERENT:.0%}; {advice}"
        )


def _round_of(task: DesignTask, problem: DesignProblem, changes: np.ndarray, tolerance: float) -> _Round:
    """Return the solution of a problem at changes, measured."""
    solved = tuple(problem.telescopes(changes))
    telescopes = tuple(
        final_telescope(lens, configuration.telescope)
        for lens, configuration in zip(solved, task.configured, strict=True)
    )
    merit = float(np.linalg.norm(problem.merit_part(problem.residuals(changes))))
    measured = task.measured(telescopes, filled=True)
    operands = _operand_changes(task, telescopes, tolerance)
    return _Round(problem, changes, solved, telescopes, operands, merit, measured)


def _moved_goals(held: HeldOperands, operands: tuple[OperandChange, ...]) -> list[HeldOperand]:
    """Move the goals of operands that are not held; return those that have moved or were given up."""
    moved = []
    for goal, change in zip(chain.from_iterable(held), operands, strict=True):
        if goal.given_up or change.holds:
            continue
        goal.move(change.end, change.allowed)
        moved.append(goal)
    if moved:
        for goal, change in zip(chain.from_iterable(held), operands, strict=True):
            if goal not in moved and goal.shift:
                # Goals that are farther than they need to be come back.
                goal.move(change.end, change.allowed)
    return moved


def _operand_changes(
    task: DesignTask, telescopes: tuple[Telescope, ...], tolerance: float
) -> tuple[OperandChange, ...]:
    """Return the operands of the telescopes at the start and as they are saved, with rays that fill the stop."""
    changes = []
    for configuration, operands, end in zip(task.configured, task.operands, telescopes, strict=True):
        ends = [following_stop(lens) for lens in (configuration.telescope, end)]
        for operand in operands:
            before, after = (operand.bound(lens).measure(lens) for lens in ends)
            allowed = allowed_deviation(operand, after, tolerance, end.length_unit[1])
            changes.append(OperandChange(operand, end.name, before, after, allowed))
    return tuple(changes)


def final_telescope(solved: Telescope, start: Telescope) -> Telescope:
    """Return an optimised telescope with the aiming of the start and its stop in its place.

    Its entrance pupil is where the stop is imaged now. Without such a pupil rays stay aimed at the stop.
    """
    aiming = start.design_data.aiming
    if start.design_data.remake_vignetting and start.design_data.fields:
        # Lens files hold the factors alone.
        solved = with_vignetting_factors(solved)
    if start.design_data.telecentric:
        return following_pupil(solved, start)
    if solved.design_data.aiming == aiming:
        return with_true_aperture(solved)
    stated = following_pupil(solved, start).with_design(aiming=aiming)
    return stated if stop_makes_pupil(stated) else with_true_aperture(solved)
