"""Several maps of sag on one grid, each with an amount of its own: the bending modes of a mirror."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from ...core.errors import PrescriptionError
from .grid import GridSag
from .shape import Triple


class GridModes(GridSag):
    """Sum of maps times amounts, interpolated as a :class:`~pachon.models.shapes.grid.GridSag`.

    Its figures are the amounts, by the names of the maps.

    Parameters
    ----------
    modes : mapping of str to GridSag
        The maps, all on the same nodes.
    amounts : mapping of str to float, optional
        How much of each; none by default.

    Raises
    ------
    PrescriptionError
        If there is no map, or their nodes differ.
    """

    def __init__(self, modes: Mapping[str, GridSag], amounts: Mapping[str, float] | None = None) -> None:
        if not modes:
            raise PrescriptionError("modes = {}: expected at least one map")
        self.modes = dict(modes)
        self.amounts = {name: float((amounts or {}).get(name, 0.0)) for name in self.modes}
        (first, grid), *others = self.modes.items()
        for name, other in others:
            if not (np.array_equal(grid.x, other.x) and np.array_equal(grid.y, other.y)):
                raise PrescriptionError(f"mode {name!r}: expected the nodes of mode {first!r}")
        super().__init__(grid.x, grid.y, sum(a * self.modes[name].values for name, a in self.amounts.items()))

    @cached_property
    def _identity(self) -> tuple[Any, ...]:
        return super()._identity, *((name, a, self.modes[name]) for name, a in self.amounts.items())

    def __repr__(self) -> str:
        return f"GridModes({', '.join(f'{name}: {amount:.6g}' for name, amount in self.amounts.items())})"

    @property
    def parameters(self) -> dict[str, float]:
        """The amounts by name [m, where a map is the sag of one metre of its mode]."""
        return dict(self.amounts)

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        mode = self.modes[name]
        return mode.sag(x, y), *mode.gradient(x, y)

    def with_parameter(self, name: str, value: float) -> GridModes:  # noqa: D102
        self._check_parameter(name)
        return GridModes(self.modes, self.amounts | {name: value})
