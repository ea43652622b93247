"""Changes that follow others by the pickups and solves of a design, with their derivatives.

A change of a shape, a medium or a thickness changes what follows it; motions of bodies do not. The change of a follower
that is asked for itself, as by a tolerance, comes on top. Thicknesses are solved for on the centred telescope; where it
has been tilted or decentred before, they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.errors import DomainError
from ..first_order import paraxial_rays
from ..links import Pickup, Solve
from ..paraxial import require_on_axis
from ..telescope import Telescope
from ..thickness import front_surface, light_axis, thickness

#: Step of the derivatives of a solved thickness over the size of a value, and sizes at least, by name, else 1.
_STEP = 1e-5
_LEAST = {"thickness": 1e-3, "radius": 1e-6, "curvature": 1e-1, "Z": 1e-3}


#: A Parameter; that class itself is built on this file.
Parameter = Any


@dataclass(frozen=True)
class Followers:
    """Parameters with all that follows them.

    Attributes
    ----------
    parameters : tuple of Parameter
        The parameters that were given, and those of the followers behind them.
    values : ndarray, shape [n]
        Change of each.
    chain : ndarray, shape [n, n_given]
        Derivatives of the changes with respect to the given ones.
    """

    parameters: tuple[Parameter, ...]
    values: np.ndarray
    chain: np.ndarray


def has_links(telescope: Telescope) -> bool:
    """Return whether values of a telescope follow others."""
    return bool(telescope.design_data.pickups or telescope.design_data.solves)


def with_followers(
    telescope: Telescope,
    parameters: Sequence[Parameter],
    values: Sequence[float] | np.ndarray,
    parse: Callable[[str], Parameter],
    apply: Callable[[Telescope, Mapping[Parameter, float]], Telescope],
) -> Followers:
    """Return parameters and their changes with all that follow them by the links of a telescope.

    `parse` makes the parameter of an address, and `apply` changes parameters without their followers.

    Raises
    ------
    DomainError
        If a thickness cannot be solved for.
    """
    changes = _Growing(
        telescope, list(parameters), list(map(float, values)), list(np.eye(len(parameters))), parse, apply
    )
    data, names = telescope.design_data, telescope.surface_names
    changes.pick_up(data.pickups)
    if data.solves and _centred(telescope):
        for solve in sorted(data.solves, key=lambda s: names.index(s.surface)):
            changes.solve(solve, len(parameters))
            # Thicknesses that follow a solved one.
            changes.pick_up([p for p in data.pickups if p.quantity == "thickness" and p.source == solve.surface])
    rates = np.array(changes.rates).reshape(len(changes.parameters), len(parameters))
    return Followers(tuple(changes.parameters), np.array(changes.values), rates)


def followers(telescope: Telescope) -> set[tuple[str, str]]:
    """Return surface and quantity of all values that follow others."""
    data = telescope.design_data
    return {(p.surface, p.quantity) for p in data.pickups} | {(s.surface, "thickness") for s in data.solves}


def quantity_of(parameter: Parameter, telescope: Telescope) -> tuple[str, str] | None:
    """Return surface and quantity that a parameter changes, None where no link is about such."""
    if parameter.kind == "thickness":
        return telescope.surface_names[front_surface(telescope, parameter.target)], "thickness"
    if parameter.kind in ("index", "abbe") and parameter.target in telescope.surface_names:
        return parameter.target, "glass"
    if parameter.kind == "shape" and parameter.name in ("radius", "curvature", "conic"):
        return parameter.target, "conic" if parameter.name == "conic" else "radius"
    return None


@dataclass
class _Growing:
    """Parameters, changes and derivatives, to which those of followers are added."""

    telescope: Telescope
    parameters: list[Parameter]
    values: list[float]
    rates: list[np.ndarray]
    parse: Callable[[str], Parameter]
    apply: Callable[[Telescope, Mapping[Parameter, float]], Telescope]

    def __post_init__(self) -> None:
        self._quantities = [quantity_of(p, self.telescope) for p in self.parameters]

    def pick_up(self, pickups: Sequence[Pickup]) -> None:
        """Add the changes of all followers, those of followers of followers too."""
        waiting = list(pickups)
        while waiting:
            sources = {p.source for p in waiting} & {p.surface for p in waiting}
            # Those come first whose source waits for nothing; check_links has refused circles.
            ready = [p for p in waiting if p.source not in sources or not any(self._leads(q, p) for q in waiting)]
            for pickup in ready:
                for i in range(len(self.parameters)):
                    if self._quantities[i] == (pickup.source, pickup.quantity):
                        self._follow(pickup, i)
            waiting = [p for p in waiting if p not in ready]

    @staticmethod
    def _leads(first: Pickup, second: Pickup) -> bool:
        return (first.surface, first.quantity) == (second.source, second.quantity)

    def _follow(self, pickup: Pickup, i: int) -> None:
        source, change = self.parameters[i], self.values[i]
        parameter = replace(source, address=f"{pickup.surface}.{source.name}", target=pickup.surface)
        if source.name == "curvature":
            # Of a radius a R + b the curvature is c / (a + b c).
            start = source.value(self.telescope)
            a, b = pickup.scale, pickup.offset
            before, after = start / (a + b * start), (start + change) / (a + b * (start + change))
            self._add(parameter, after - before, a / (a + b * (start + change)) ** 2 * self.rates[i])
        else:
            self._add(parameter, pickup.scale * change, pickup.scale * self.rates[i])

    def solve(self, solve: Solve, count: int) -> None:
        """Add the change of a thickness that is solved for, with its derivatives by differences."""
        index = self.telescope.surface_names.index(solve.surface)
        parameter = self.parse(f"{solve.surface}.thickness")
        before = thickness(self.telescope, index)
        values, rate = np.array(self.values), np.zeros(count)
        change = self._solved(solve, index, values) - before
        for k in range(count):
            direction = np.array([row[k] for row in self.rates])
            if not any(d and p.kind != "motion" for d, p in zip(direction, self.parameters, strict=True)):
                continue
            varied = self.parameters[k]
            least = _LEAST.get(varied.name.rstrip("0123456789"), 1.0)
            step = _STEP * max(abs(varied.value(self.telescope) + values[k]), least)
            ends = [self._solved(solve, index, values + sign * step * direction) for sign in (1.0, -1.0)]
            rate[k] = (ends[0] - ends[1]) / (2.0 * step)
        # What was asked for itself comes on top of the solution.
        self._add(parameter, change, rate)

    def _solved(self, solve: Solve, index: int, values: np.ndarray) -> float:
        """Return the thickness that meets a solve with changes other than motions."""
        still = {
            p: float(v)
            for p, v, about in zip(self.parameters, values, self._quantities, strict=True)
            if p.kind != "motion" and about != (solve.surface, "thickness")
        }
        return solved_thickness(self.apply(self.telescope, still), solve, index)

    def _add(self, parameter: Parameter, change: float, rate: np.ndarray) -> None:
        """Add a change to that of the same parameter, where there is one."""
        about = quantity_of(parameter, self.telescope)
        for i, candidate in enumerate(self.parameters):
            if self._quantities[i] == about and candidate.name == parameter.name:
                self.values[i] += change
                self.rates[i] = self.rates[i] + rate
                return
        self.parameters.append(parameter)
        self._quantities.append(about)
        self.values.append(change)
        self.rates.append(rate)


def solved_thickness(telescope: Telescope, solve: Solve, index: int) -> float:
    """Return the thickness [m] behind a surface, by its index, that meets a solve."""
    front, back = telescope.surfaces[index : index + 2]
    if solve.kind == "edge_thickness":
        along = light_axis(telescope, index)[2]
        edge = [float(s.shape.sag(0.0, solve.radius)) for s in (front, back)]
        if not np.isfinite(edge).all():
            raise DomainError(f"{solve.address}: expected surfaces that reach the radius {solve.radius:g} m")
        return solve.value - along * (edge[1] - edge[0])
    z, height, slope = paraxial_rays(telescope, front.name)[int(solve.kind == "chief_height")]
    if slope == 0.0:
        raise DomainError(f"{solve.address}: the ray is parallel to the axis behind {front.name}")
    place = z - (solve.value - height) / slope
    return float(light_axis(telescope, index)[2] * (place - front.vertex[2]))


def _centred(telescope: Telescope) -> bool:
    try:
        for surface in telescope.surfaces:
            require_on_axis(surface, telescope.name)
    except DomainError:
        return False
    return True


def without_links(telescope: Telescope) -> Telescope:
    """Return a telescope whose values follow no others."""
    if not has_links(telescope):
        return telescope
    return telescope.with_design(pickups=(), solves=())
