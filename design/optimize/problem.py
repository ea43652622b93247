"""Least-squares problem of an optimisation: residuals of merits and operands over all configurations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...core.errors import PachonError
from ...models.parameters.parameters import apply
from ...models.telescope import Telescope
from .jacobian import ParameterColumns
from .merit import Beams, Merit, WavefrontMerit
from .operand import Operand
from .variables import Variable


@dataclass(frozen=True)
class DesignState:
    """A telescope with its merit, the rays of it, operands and weight in the mean square.

    `factors` are those of the stated weights that are in the operands; empty where all are 1.
    """

    telescope: Telescope
    beams: Beams
    merit: Merit
    operands: tuple[Operand, ...]
    weight: float
    factors: tuple[float, ...] = ()


@dataclass
class DesignProblem:
    """Merits and operands as functions of the changes of all variables, as the solver has them."""

    states: Sequence[DesignState]
    variables: Sequence[Variable]
    #: Numbers of residuals of the merits, then of the operands, of each state; once they are known.
    sizes: list[tuple[int, int]] = field(default_factory=list)

    def on_far_spheres(self) -> DesignProblem:
        """Return the problem with wavefronts on reference spheres far away; itself where there are no spheres."""
        merits = [
            state.merit.on_far_spheres()
            if isinstance(state.merit, WavefrontMerit) and not state.telescope.design_data.afocal
            else state.merit
            for state in self.states
        ]
        if all(merit is state.merit for merit, state in zip(merits, self.states, strict=True)):
            return self
        states = [replace(state, merit=merit) for state, merit in zip(self.states, merits, strict=True)]
        return DesignProblem(states, self.variables)

    def telescopes(self, changes: np.ndarray) -> list[Telescope]:
        """Return the telescopes with changes applied."""
        return [self._telescope(i, changes) for i in range(len(self.states))]

    def _telescope(self, i: int, changes: np.ndarray) -> Telescope:
        values = {p: c for v, c in zip(self.variables, changes, strict=True) if (p := v.parameters[i])}
        return apply(self.states[i].telescope, values)

    def residuals(self, changes: np.ndarray) -> np.ndarray:
        """Return all residuals [m]; NaN, for a shorter step, where a telescope is not valid."""
        blocks: list[np.ndarray] = []
        try:
            for state, telescope in zip(self.states, self.telescopes(changes), strict=True):
                blocks.append(np.sqrt(state.weight) * state.merit.residuals(telescope))
                blocks += [operand.residuals(telescope) for operand in state.operands]
        except PachonError:
            if not self.sizes:
                raise
            return np.full(sum(a + b for a, b in self.sizes), np.nan)
        return np.concatenate(blocks)

    def linear(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all residuals [m] and their derivatives, shape [n, n_variable]."""
        blocks, rates, self.sizes = [], [], []
        for i, state in enumerate(self.states):
            places = [k for k, v in enumerate(self.variables) if v.parameters[i]]
            parameters = tuple(p for v in self.variables if (p := v.parameters[i]))
            columns = ParameterColumns.at(state.telescope, parameters, changes[places])
            values, slopes = state.merit.derivatives(columns)
            parts = [(np.sqrt(state.weight) * values, np.sqrt(state.weight) * slopes)]
            effect = np.linalg.norm(slopes, axis=0)
            near: dict[tuple[int, float], Telescope] = {}
            for operand in state.operands:
                if operand.exact:
                    parts.append(operand.derivatives(columns))
                else:
                    steps = np.divide(operand.step, effect, out=np.full_like(effect, operand.step), where=effect > 0)
                    parts.append(self._differences(operand, i, columns.telescope, changes, places, steps, near))
            self.sizes.append((len(values), len(state.operands)))
            for value, rate in parts:
                full = np.zeros((len(value), len(self.variables)))
                full[:, places] = rate
                blocks.append(value)
                rates.append(full)
        return np.concatenate(blocks), np.concatenate(rates)

    def rounding(self) -> np.ndarray:
        """Return the size of the terms that cancel where a variable has no effect on the merits [m], [n_variable]."""
        squares = np.zeros(len(self.variables))
        for i, state in enumerate(self.states):
            places = [k for k, v in enumerate(self.variables) if v.parameters[i]]
            parameters = tuple(p for v in self.variables if (p := v.parameters[i]))
            sizes = state.merit.size_of_terms(ParameterColumns.at(state.telescope, parameters))
            squares[places] += state.weight * sizes**2
        return np.sqrt(squares)

    def stated_rms(self, residuals: np.ndarray) -> float:
        """Return the rms of residuals [m], those of operands with the stated weights."""
        factors = np.ones(len(residuals))
        first = 0
        for state, (merit, operands) in zip(self.states, self.sizes, strict=True):
            first += merit
            factors[first : first + operands] = state.factors or 1.0
            first += operands
        return float(np.linalg.norm(residuals / factors))

    def merit_part(self, residuals: np.ndarray) -> np.ndarray:
        """Return the residuals [m] of the merits without those of the operands."""
        parts, first = [], 0
        for merit, operands in self.sizes:
            parts.append(residuals[first : first + merit])
            first += merit + operands
        return np.concatenate(parts)

    def _differences(
        self,
        operand: Operand,
        i: int,
        telescope: Telescope,
        changes: np.ndarray,
        places: Sequence[int],
        steps: np.ndarray,
        near: dict[tuple[int, float], Telescope],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residual and derivatives of an operand by central differences; telescopes `near` are kept."""
        residual, slope = operand.residual(operand.measure(telescope))
        rates = np.zeros((1, len(places)))
        if slope:
            for k, (place, step) in enumerate(zip(places, steps, strict=True)):
                ends = []
                for size in (step, -step):
                    if (place, size) not in near:
                        moved = changes.copy()
                        moved[place] += size
                        near[place, size] = self._telescope(i, moved)
                    ends.append(operand.measure(near[place, size]))
                rates[0, k] = slope * (ends[0] - ends[1]) / (2.0 * step)
        return np.array([residual]), rates
