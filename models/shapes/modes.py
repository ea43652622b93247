"""Several maps of sag on one grid with an amount each, such as the bending modes of a mirror."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from .grid import GridSag
from .shape import Triple


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class GridModes(GridSag):
    """Sum of maps times amounts, interpolated as a :class:`~pachon.models.shapes.grid.GridSag`.

    Its parameters are the amounts, by the names of the maps [m, where a map is the sag of one metre of its mode].

    Parameters
    ----------
    modes : mapping of str to GridSag
        The maps, all on the same nodes.
    amounts : mapping of str to float
        Amount of each map; zero for those left out.

    Raises
    ------
    PrescriptionError
        If there is no map, or their nodes differ.
    """

    x: np.ndarray = field(init=False)
    y: np.ndarray = field(init=False)
    values: np.ndarray = field(init=False)
    modes: Mapping[str, GridSag]
    amounts: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.modes:
            raise PrescriptionError("modes = {}: expected at least one map")
        amounts = {name: float(self.amounts.get(name, 0.0)) for name in self.modes}
        (first, grid), *other_modes = self.modes.items()
        for name, mode_grid in other_modes:
            if not (np.array_equal(grid.x, mode_grid.x) and np.array_equal(grid.y, mode_grid.y)):
                raise PrescriptionError(f"mode {name!r}: expected the nodes of mode {first!r}")
        values = sum(a * self.modes[name].values for name, a in amounts.items())
        for name, value in (("modes", dict(self.modes)), ("amounts", amounts), ("x", grid.x), ("y", grid.y)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "values", values)
        super().__post_init__()

    @cached_property
    def _content(self) -> tuple[Hashable, ...]:
        return super()._content, *((name, a, self.modes[name]) for name, a in self.amounts.items())

    def __repr__(self) -> str:
        return f"GridModes({', '.join(f'{name}: {amount:.6g}' for name, amount in self.amounts.items())})"

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        return dict(self.amounts)

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        mode = self.modes[name]
        return mode.sag(x, y), *mode.gradient(x, y)

    def _changed(self, name: str, value: float) -> GridModes:
        return replace(self, amounts={**self.amounts, name: value})
