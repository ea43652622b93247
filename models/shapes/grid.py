"""Sag on a grid of nodes, such as a measured deformation, interpolated by bicubics."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from ..content_equality import ContentEquality
from .bicubic import hermite, hermite_curvature, hermite_slope
from .shape import Pair, Shape, Triple

#: A bicubic needs the slopes at the four corners of its cell, and so a node beyond each of them.
LEAST_NODES = 4
#: Largest difference between the steps of a grid, relative to the step: rounding to six digits.
EQUAL_STEPS = 1e-5


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class GridSag(ContentEquality, Shape):
    """Bicubic interpolation of a sag on a regular grid.

    Within a cell the sag is the cubic in x and in y that has, at its corners, the values of the nodes and their slopes;
    slopes are central differences (one-sided at the rim of the grid). So the sag and its slopes are continuous, and
    linear in the nodes. Beyond the grid the sag is NaN: a ray there misses the surface.

    Parameters
    ----------
    x, y : array_like, shape [nx] and [ny]
        Nodes along x and y [m] of the surface's own frame, at equal steps, ascending.
    values : array_like, shape [ny, nx]
        Sag at the nodes [m].

    Raises
    ------
    PrescriptionError
        If there are fewer than four nodes along an axis, the steps are not equal, or a number is not finite.
    """

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        self._freeze(x=np.float64, y=np.float64, values=np.float64)
        for name, axis in (("x", self.x), ("y", self.y)):
            if axis.ndim != 1 or len(axis) < LEAST_NODES:
                raise PrescriptionError(
                    f"grid {name} has {axis.size} nodes: expected at least {LEAST_NODES} along each axis"
                )
            step = np.diff(axis)
            if not np.all(step > 0) or np.ptp(step) > EQUAL_STEPS * step.mean():
                raise PrescriptionError(f"grid {name} = {_shown(axis)}: expected ascending nodes at equal steps")
        if self.values.shape != (len(self.y), len(self.x)):
            raise PrescriptionError(
                f"grid values of shape {list(self.values.shape)}: expected [{len(self.y)}, {len(self.x)}], one per node"
            )
        if not np.all(np.isfinite(self.values)):
            row, column = np.argwhere(~np.isfinite(self.values))[0]
            raise PrescriptionError(
                f"grid values[{row}, {column}] = {self.values[row, column]}: expected finite numbers at all nodes"
            )

    @cached_property
    def _content(self) -> tuple[Hashable, ...]:
        return self.x.tobytes(), self.y.tobytes(), self.values.tobytes()

    def __repr__(self) -> str:
        return f"{type(self).__name__}(x={_shown(self.x)}, y={_shown(self.y)}, values={list(self.values.shape)})"

    @property
    def step(self) -> tuple[float, float]:
        """Steps along x and y [m]."""
        nx, ny = len(self.x), len(self.y)
        return float(self.x[-1] - self.x[0]) / (nx - 1), float(self.y[-1] - self.y[0]) / (ny - 1)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Value, slopes and mixed derivative times the steps along x, y and both, at each node [m], [ny, nx, 4]."""
        along_x = _differences(self.values)
        along_y = _differences(self.values.T).T
        return np.stack([self.values, along_x, along_y, _differences(along_y)], axis=-1)

    def _evaluate(self, x: np.ndarray, y: np.ndarray, *derivatives: tuple[int, int]) -> list[np.ndarray]:
        """Return derivatives of the sag, each given by how often along x and how often along y."""
        hx, hy = self.step
        px, py = (x - self.x[0]) / hx, (y - self.y[0]) / hy
        outside = ~((px >= 0) & (px <= len(self.x) - 1) & (py >= 0) & (py <= len(self.y) - 1))
        i = np.clip(np.where(outside, 0, px).astype(int), 0, len(self.x) - 2)
        j = np.clip(np.where(outside, 0, py).astype(int), 0, len(self.y) - 2)
        corners = np.stack([np.stack([self.nodes[j + b, i + a] for a in (0, 1)], -2) for b in (0, 1)], -3)
        values = []
        for nx, ny in derivatives:
            wx, wy = _weights(px - i, nx), _weights(py - j, ny)
            value = (
                np.einsum("...ba,...a,...b", corners[..., 0], wx[0], wy[0])
                + np.einsum("...ba,...a,...b", corners[..., 1], wx[1], wy[0])
                + np.einsum("...ba,...a,...b", corners[..., 2], wx[0], wy[1])
                + np.einsum("...ba,...a,...b", corners[..., 3], wx[1], wy[1])
            )
            values.append(np.where(outside, np.nan, value / (hx**nx * hy**ny)))
        return values

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._evaluate(x, y, (0, 0))[0]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        sx, sy = self._evaluate(x, y, (1, 0), (0, 1))
        return sx, sy

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        # Second derivatives jump where two cells meet.
        xx, xy, yy = self._evaluate(x, y, (2, 0), (1, 1), (0, 2))
        return xx, xy, yy

    @property
    def curvature(self) -> float:  # noqa: D102
        if not (self.x[0] <= 0 <= self.x[-1] and self.y[0] <= 0 <= self.y[-1]):
            return 0.0
        xx, _, yy = self.hessian(0.0, 0.0)
        return 0.5 * float(xx + yy)

    @property
    def fourth_order(self) -> float:
        """Zero: bicubics have no meaningful fourth derivative."""
        return 0.0

    @property
    def parameters(self) -> dict[str, float]:
        """The nodes, ``node[row,column]`` [m]."""
        return {f"node[{j},{i}]": float(v) for (j, i), v in np.ndenumerate(self.values)}

    def _place(self, name: str) -> tuple[int, int]:
        j, _, i = name.removeprefix("node[").removesuffix("]").partition(",")
        return int(j), int(i)

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        unit_values = np.zeros_like(self.values)
        unit_values[self._place(name)] = 1.0
        f, fx, fy = GridSag(self.x, self.y, unit_values)._evaluate(x, y, (0, 0), (1, 0), (0, 1))
        return f, fx, fy

    def _changed(self, name: str, value: float) -> GridSag:
        values = self.values.copy()
        values[self._place(name)] = value
        return GridSag(self.x, self.y, values)


def _weights(t: np.ndarray, derivative: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the values and of the slopes at the two ends of a cell, each [..., 2], at 0 <= t <= 1."""
    up, start, end = (hermite, hermite_slope, hermite_curvature)[derivative](t, 1.0)
    down = 1 - up if derivative == 0 else -up
    return np.stack([down, up], axis=-1), np.stack([start, end], axis=-1)


def _differences(values: np.ndarray) -> np.ndarray:
    """Return central differences along the last axis, one-sided at its ends, in units per step."""
    out = np.empty_like(values)
    out[:, 1:-1] = 0.5 * (values[:, 2:] - values[:, :-2])
    out[:, 0] = values[:, 1] - values[:, 0]
    out[:, -1] = values[:, -1] - values[:, -2]
    return out


def _shown(axis: np.ndarray) -> str:
    return f"[{axis[0]:.6g}, {axis[1]:.6g}, ... {axis[-1]:.6g}]"
