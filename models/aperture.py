"""Clear apertures of a surface: discs, rings, ellipses, rectangles, polygons, spider vanes, unions, intersections.

An aperture is the region of a surface's own x, y that light passes. The complement of an obstacle is what it leaves
clear: ``Complement(Circle(1.1))`` for a camera body, ``Complement(Union((vane, vane, vane, vane)))`` for a spider.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import PrescriptionError
from ..core.units import plane_points


class Region(ABC):
    """A region of the x, y plane of a surface's own frame."""

    @abstractmethod
    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return whether points x, y [m] of the surface's own frame lie in the region."""


def _require(condition: bool | np.bool_, problem: str) -> None:
    if not condition:
        raise PrescriptionError(problem)


def _require_sides(kind: str, first: float, second: float) -> None:
    _require(
        0 < first < np.inf and 0 < second < np.inf, f"{kind} = [{first!r}, {second!r}] m: expected two positive lengths"
    )


def _require_place(text: str, x: float, y: float, angle: float, expected: str = "centre") -> None:
    problem = f"{text} ({x!r}, {y!r}) m, {angle!r} rad: expected finite {expected} and angle"
    _require(np.all(np.isfinite((x, y, angle))), problem)


def _shifted(x: ArrayLike, y: ArrayLike, centre_x: float, centre_y: float) -> tuple[np.ndarray, np.ndarray]:
    px, py = plane_points(x, y)
    return px - centre_x, py - centre_y


def _rotated(x: np.ndarray, y: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates along axes rotated by an angle [rad] from x towards y."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return x * cosine + y * sine, y * cosine - x * sine


@check_arguments
@dataclass(frozen=True)
class Circle(Region):
    """Disc; its rim is outside.

    Parameters
    ----------
    radius : float
        Radius [m].
    x, y : float
        Centre [m].
    """

    radius: float
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        _require(
            0 < self.radius < np.inf and np.all(np.isfinite((self.x, self.y))),
            f"circle = {self.radius!r} m: expected a positive radius and finite centre",
        )

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        dx, dy = _shifted(x, y, self.x, self.y)
        return dx**2 + dy**2 < self.radius**2


@check_arguments
@dataclass(frozen=True)
class Annulus(Region):
    """Ring; its inner rim is inside, its outer rim outside.

    Parameters
    ----------
    inner, outer : float
        Radii [m].
    x, y : float
        Centre [m].
    """

    inner: float
    outer: float
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        _require(
            0 <= self.inner < self.outer < np.inf and np.all(np.isfinite((self.x, self.y))),
            f"annulus = [{self.inner!r}, {self.outer!r}] m: expected 0 <= inner < outer and finite centre",
        )

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        dx, dy = _shifted(x, y, self.x, self.y)
        r2 = dx**2 + dy**2
        return (r2 >= self.inner**2) & (r2 < self.outer**2)


@check_arguments
@dataclass(frozen=True)
class Ellipse(Region):
    """Ellipse; its rim is outside.

    Parameters
    ----------
    semi_x, semi_y : float
        Semi-axes [m].
    x, y : float
        Centre [m].
    angle : float
        Angle of the first axis from x towards y [rad].
    """

    semi_x: float
    semi_y: float
    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0

    def __post_init__(self) -> None:
        _require_sides("ellipse", self.semi_x, self.semi_y)
        _require_place("ellipse at", self.x, self.y, self.angle)

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        along, across = _rotated(*_shifted(x, y, self.x, self.y), self.angle)
        return (along / self.semi_x) ** 2 + (across / self.semi_y) ** 2 < 1.0


@check_arguments
@dataclass(frozen=True)
class Rectangle(Region):
    """Rectangle without rim.

    Parameters
    ----------
    width, height : float
        Sides [m].
    x, y : float
        Centre [m].
    angle : float
        Angle of the first side from x towards y [rad].
    """

    width: float
    height: float
    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0

    def __post_init__(self) -> None:
        _require_sides("rectangle", self.width, self.height)
        _require_place("rectangle at", self.x, self.y, self.angle)

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        along, across = _rotated(*_shifted(x, y, self.x, self.y), self.angle)
        return (np.abs(along) < 0.5 * self.width) & (np.abs(across) < 0.5 * self.height)


@check_arguments
@dataclass(frozen=True)
class Vane(Region):
    """Strip from a point outwards; endless, without rims.

    Parameters
    ----------
    width : float
        Width [m].
    x, y : float
        The point [m].
    angle : float
        Direction from x towards y [rad].
    both_ways : bool
        Whether it extends to the other side of the point too.
    """

    width: float
    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    both_ways: bool = False

    def __post_init__(self) -> None:
        _require(0 < self.width < np.inf, f"vane = {self.width!r} m: expected a positive width")
        _require_place("vane from", self.x, self.y, self.angle, "point")

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        along, across = _rotated(*_shifted(x, y, self.x, self.y), self.angle)
        beside = np.abs(across) < 0.5 * self.width
        return beside if self.both_ways else beside & (along > 0.0)


@check_arguments
@dataclass(frozen=True)
class Polygon(Region):
    """Polygon, in either sense; the last corner is joined to the first.

    Of two polygons that share an edge, one contains it.

    Parameters
    ----------
    corners : tuple of tuple of float
        At least three corners (x, y) [m].
    """

    corners: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        corners = self.corners
        _require(
            len(corners) >= 3 and all(len(c) == 2 for c in corners) and np.all(np.isfinite(np.array(corners))),
            f"polygon of {len(corners)} corners: expected at least three finite (x, y) pairs",
        )
        crossing = _crossing_edges(np.array(corners, dtype=np.float64))
        if crossing is not None:
            first, second = crossing
            raise PrescriptionError(
                f"polygon = {len(corners)} corners: edge {first + 1}, from {corners[first]}, meets edge {second + 1}, "
                f"from {corners[second]}: expected an outline that does not touch or cross itself"
            )

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        start = np.array(self.corners, dtype=np.float64)
        return start, np.roll(start, -1, axis=0)

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return whether points lie inside, by the number of edges that a line towards +x crosses.

        See Shimrat (1962), Communications of the ACM 5, 434 (algorithm 112).
        """
        x, y = plane_points(x, y)
        inside = np.zeros(x.shape, dtype=bool)
        for (ax, ay), (bx, by) in zip(*self._edges, strict=True):
            if ay != by:
                inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * ((bx - ax) / (by - ay)))
        return inside


def _crossing_edges(corners: np.ndarray) -> tuple[int, int] | None:
    """Return the first pair of edges of a closed outline [n, 2] that touch where they should not, or None."""
    n = len(corners)
    start, end = corners, np.roll(corners, -1, axis=0)

    def side(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return on which side of the line from a to b points lie: 1 left, -1 right, 0 on it."""
        along, beyond = np.moveaxis(b - a, -1, 0), np.moveaxis(p - a, -1, 0)
        return np.sign(along[0] * beyond[1] - along[1] * beyond[0])

    def beside(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return whether a point of the line through a and b lies between them."""
        return np.all((p >= np.minimum(a, b)) & (p <= np.maximum(a, b)), axis=-1)

    # An edge and the next share a corner; they cross only where the next runs back over it, or the edge has no length.
    following = np.roll(end, -1, axis=0)
    forward = np.sum((end - start) * (following - end), axis=1)
    backward = np.flatnonzero(np.all(start == end, axis=1) | (side(start, end, following) == 0) & (forward < 0))
    crossings = [(i, (i + 1) % n) for i in backward[:1].tolist()]
    for i, j in _edges_near_each_other(start, end):
        a, b, c, d = start[i], end[i], start[j], end[j]
        side_c, side_d, side_a, side_b = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
        meet = (side_c * side_d < 0) & (side_a * side_b < 0)
        meet |= (side_c == 0) & beside(a, b, c) | (side_d == 0) & beside(a, b, d)
        meet |= (side_a == 0) & beside(c, d, a) | (side_b == 0) & beside(c, d, b)
        crossings += zip(i[meet].tolist(), j[meet].tolist(), strict=True)
    return min(crossings, default=None)


def _edges_near_each_other(start: np.ndarray, end: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs (i, j), i < j, of edges without a common corner whose bounding boxes meet, in batches of some 1e6."""
    n = len(start)
    lower, upper = np.minimum(start, end), np.maximum(start, end)
    order = np.argsort(lower[:, 0], kind="stable")
    # In order of their left ends, an edge overlaps in x with those that follow until one begins beyond its right end.
    counts = np.searchsorted(lower[order, 0], upper[order, 0], side="right") - np.arange(n) - 1
    batches = np.cumsum(counts) // 1_000_000
    for positions in np.split(np.arange(n), np.flatnonzero(np.diff(batches)) + 1):
        number = counts[positions]
        steps = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + 1
        one, two = order[np.repeat(positions, number)], order[np.repeat(positions, number) + steps]
        i, j = np.minimum(one, two), np.maximum(one, two)
        apart = (j - i > 1) & (j - i < n - 1)
        near = apart & (lower[i, 1] <= upper[j, 1]) & (lower[j, 1] <= upper[i, 1])
        yield i[near], j[near]


@check_arguments
@dataclass(frozen=True)
class _Combination(Region):
    """Base of unions and intersections."""

    parts: tuple[Aperture, ...]

    def __post_init__(self) -> None:
        _require(bool(self.parts), f"{type(self).__name__.lower()} of no parts: expected at least one region")


@check_arguments
class Union(_Combination):
    """Points of at least one of several regions."""

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        return np.logical_or.reduce([region.contains(x, y) for region in self.parts])


@check_arguments
class Intersection(_Combination):
    """Points of all of several regions."""

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        return np.logical_and.reduce([region.contains(x, y) for region in self.parts])


@check_arguments
@dataclass(frozen=True)
class Complement(Region):
    """Points outside a region: what an obscuration leaves clear."""

    part: Aperture

    def contains(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:  # noqa: D102
        return np.logical_not(self.part.contains(x, y))


Aperture = Circle | Annulus | Ellipse | Rectangle | Vane | Polygon | Union | Intersection | Complement


def shifted(aperture: Aperture, x: float, y: float) -> Aperture:
    """Return an aperture shifted in the plane of its surface [m]."""
    if isinstance(aperture, Union | Intersection):
        return type(aperture)(tuple(shifted(region, x, y) for region in aperture.parts))
    if isinstance(aperture, Complement):
        return Complement(shifted(aperture.part, x, y))
    if isinstance(aperture, Polygon):
        return Polygon(tuple((a + x, b + y) for a, b in aperture.corners))
    return replace(aperture, x=aperture.x + x, y=aperture.y + y)


def enclosing_circle(aperture: Aperture) -> tuple[float, float, float]:
    """Return centre x, y and radius [m] of a circle that holds an aperture; a radius of infinity where none does."""
    if isinstance(aperture, Circle | Annulus):
        return aperture.x, aperture.y, aperture.radius if isinstance(aperture, Circle) else aperture.outer
    if isinstance(aperture, Ellipse):
        return aperture.x, aperture.y, max(aperture.semi_x, aperture.semi_y)
    if isinstance(aperture, Rectangle):
        return aperture.x, aperture.y, 0.5 * math.hypot(aperture.width, aperture.height)
    if isinstance(aperture, Polygon):
        corners = np.array(aperture.corners)
        x, y = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return float(x), float(y), float(np.hypot(*(corners - [x, y]).T).max())
    if isinstance(aperture, Intersection):
        return min((enclosing_circle(region) for region in aperture.parts), key=lambda circle: circle[2])
    if isinstance(aperture, Union):
        circles = [enclosing_circle(region) for region in aperture.parts]
        x, y = (float(np.mean([circle[i] for circle in circles])) for i in range(2))
        return x, y, max(math.hypot(cx - x, cy - y) + radius for cx, cy, radius in circles)
    return 0.0, 0.0, math.inf
