"""Task of an optimisation apart from its variables: configurations, merit function and operands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import ConfigError, DomainError, PachonError
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from .configuration import DesignConfiguration
from .merit_function import MeritFunction
from .operand import Operand, check_operands
from .problem import DesignState


@dataclass(frozen=True)
class DesignTask:
    """Configurations that are optimised together, with the merit function and the operands of all of them."""

    configured: tuple[DesignConfiguration, ...]
    function: MeritFunction
    targets: tuple[Operand, ...]
    threads: int | None

    @property
    def weights(self) -> np.ndarray:
        """Weights of the configurations in the mean square, of sum 1, shape [n]."""
        weights = np.array([configuration.weight for configuration in self.configured])
        return weights / weights.sum()

    @property
    def operands(self) -> tuple[tuple[Operand, ...], ...]:
        """Operands of each configuration as they are stated."""
        return tuple((*self.targets, *configuration.operands) for configuration in self.configured)

    def states(self) -> tuple[DesignState, ...]:
        """Return merit, rays and operands of each configuration at the start; errors are those of the input."""
        if len(self.configured) > 1 and self.function.of_one_telescope:
            raise ConfigError(
                f"{len(self.configured)} configurations: expected no goal, and the merit 'spots' or 'wavefront'"
            )
        for operands in self.operands:
            check_operands(operands)
        states = self.remade([following_stop(configuration.telescope) for configuration in self.configured])
        for state in states:
            for operand in state.operands:
                _check_start(operand, state.telescope)
        return states

    def remade(self, lit: Sequence[Telescope]) -> tuple[DesignState, ...]:
        """Return the states with fields, rays and operands of telescopes that the variables have made."""
        states = []
        parts = zip(self.configured, self.operands, self.weights.tolist(), lit, strict=True)
        for configuration, operands, weight, lens in parts:
            beams = configuration.beams(lens, self.threads)
            # An operand that the telescope does not have is an error of the input, not a step that goes too far.
            bound = tuple(operand.bound(lens) for operand in operands)
            start = following_stop(configuration.telescope)
            states.append(DesignState(start, beams, self.function.of(lens, beams), bound, weight))
        return tuple(states)

    def measured(self, telescopes: Sequence[Telescope], *, filled: bool, dense: bool = False) -> float:
        """Return the rms merit [m] of telescopes as they stand, of the light that arrives in each.

        With `filled` rays fill the stop; else they are those that the design data of the telescopes state. They are
        those of the solver or, with `dense` and a merit that takes them, those of analyses where their number is not
        stated: spots are those of :func:`~pachon.design.metrics.spots.spots`. NaN without light.
        """
        squares, dense = [], dense and not self.function.of_one_telescope
        for configuration, telescope in zip(self.configured, telescopes, strict=True):
            lens = following_stop(telescope) if filled else telescope
            try:
                squares.append(self.function.rms(lens, configuration.beams(lens, self.threads, dense=dense)) ** 2)
            except PachonError:
                return np.nan
        return float(np.sqrt(self.weights @ np.array(squares)))


def _check_start(operand: Operand, telescope: Telescope) -> None:
    try:
        number = operand.measure(telescope)
    except PachonError as error:
        raise error.within(subject=f"operand {operand.label} of {telescope.name}") from None
    if not np.isfinite(number):
        raise DomainError(f"operand {operand.label} of {telescope.name} = {number!r}: expected a finite number")
