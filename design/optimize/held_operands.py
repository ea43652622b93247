"""Operands held exactly: goals that move beyond the stated ones by what weights alone leave (method of multipliers).

Least squares of a merit and of weighted operands end where the merit pulls an operand off its goal. The goal of the
next solution lies beyond the stated one by that deviation; Hestenes, J. Optim. Theory Appl. 4, 303 (1969), and Powell
(1969).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from ...models.telescope import Telescope
from .operand import GoalOperand, Operand
from .problem import DesignState

#: Fraction of its deviation that an operand has to lose in a step, else its weight grows.
_SLOW = 0.3
#: Factor of such a weight.
_HEAVIER = 100.0
#: Factor of the stated weight at first. Where a number is constant along a curve, a heavy operand allows short steps
#: only, and the solver stops far from the best merit. Goals that move hold an operand of any weight.
_FIRST_FACTOR = 0.01
#: How often a weight grows before the operand is given up, which is to 10 000 times the stated one.
_MOST_FACTORS = 3


def deviation(operand: Operand, number: float) -> float:
    """Return by how much a number is above the value or the maximum of an operand, negative below its minimum."""
    if operand.value is not None:
        return number - operand.value
    low = -np.inf if operand.minimum is None else operand.minimum
    high = np.inf if operand.maximum is None else operand.maximum
    return number - float(np.clip(number, low, high))


def allowed_deviation(operand: Operand, number: float, relative: float, length_unit: float) -> float:
    """Return the deviation within which an operand of some number is held, from a relative one.

    At a goal of zero it is that of the unit of the number, of lengths the `length_unit` [m].
    """
    goal = number - deviation(operand, number)
    return relative * (abs(goal) or (length_unit if operand.unit == "m" else 1.0))


@dataclass(eq=False)
class HeldOperand:
    """An operand with a goal that moves until its number is the stated one.

    Attributes
    ----------
    stated : Operand
        The operand with the stated goal.
    shift : float
        Distance of the goal from the stated one, in SI.
    factor : float
        Factor of the stated weight.
    heavier : int
        How often the weight has grown.
    given_up : bool
        Whether the stated goal cannot be reached: the weight alone holds the operand.
    last : float
        Deviation before the last step, in SI.
    """

    stated: Operand
    shift: float = 0.0
    factor: float = 1.0
    heavier: int = 0
    given_up: bool = False
    last: float = np.inf

    @property
    def shifted(self) -> Operand:
        """The operand with the goal that the next solution aims at."""
        goal = cast(GoalOperand, self.stated)
        beyond = (None if end is None else end + self.shift for end in (goal.value, goal.minimum, goal.maximum))
        value, minimum, maximum = beyond
        return replace(goal, value=value, minimum=minimum, maximum=maximum, weight=self.factor * goal.weight)

    def move(self, number: float, allowed: float) -> None:
        """Move the goal by what the number of a solution is off the stated one, or give the operand up."""
        off = deviation(self.stated, number)
        slow = abs(off) > max(allowed, _SLOW * self.last)
        self.last = abs(off)
        if slow and self.heavier == _MOST_FACTORS:
            self.given_up, self.shift, self.factor = True, 0.0, 1.0
            return
        if self.stated.value is not None:
            self.shift -= off
        elif self.shift > 0.0 or off < 0.0:
            assert self.stated.minimum is not None
            self.shift = max(0.0, self.shift + self.stated.minimum - number)
        elif self.shift < 0.0 or off > 0.0:
            assert self.stated.maximum is not None
            self.shift = min(0.0, self.shift + self.stated.maximum - number)
        if slow:
            self.heavier += 1
            self.factor *= _HEAVIER
            # The force on the variables, weight squared times shift, stays.
            self.shift /= _HEAVIER**2


#: Operands with goals that move, of each configuration.
HeldOperands = tuple[tuple[HeldOperand, ...], ...]


def held_operands(operands: Sequence[Sequence[Operand]], *, exactly: bool) -> HeldOperands:
    """Return operands of configurations with the first of their goals and weights: the stated ones unless `exactly`."""
    factor = _FIRST_FACTOR if exactly else 1.0
    return tuple(tuple(HeldOperand(operand, factor=factor) for operand in stated) for stated in operands)


def with_operands(
    states: Sequence[DesignState], held: HeldOperands, telescopes: Sequence[Telescope]
) -> tuple[DesignState, ...]:
    """Return states with operands of moved goals, and with what these take from telescopes."""
    return tuple(
        replace(
            state,
            operands=tuple(goal.shifted.bound(telescope) for goal in goals),
            factors=tuple(goal.factor for goal in goals),
        )
        for state, goals, telescope in zip(states, held, telescopes, strict=True)
    )
