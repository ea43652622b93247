"""Outlines of apertures: where they run, how they move, and apertures with outlines moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..models.aperture import (
    Annulus,
    Aperture,
    Circle,
    Complement,
    Ellipse,
    Intersection,
    Polygon,
    Rectangle,
    Union,
    Vane,
)

#: Length over width from which on a rectangle is a vane.
_SLENDER = 4.0
#: Least size of a region that shrinks, over what it was.
_LEAST = 0.1
#: Fewest and most pieces of a curve.
_FEWEST_PIECES = 12
_MOST_PIECES = 4000


class RimMotion(NamedTuple):
    """Motion of an outline in the plane of its surface: shift, offset along its outward normal [m], turn [rad].

    The turn is about the origin of the surface, from x towards y.
    """

    x: float = 0.0
    y: float = 0.0
    growth: float = 0.0
    rotation: float = 0.0


#: Number of the motions of an outline.
MOTIONS = len(RimMotion._fields)


@dataclass(frozen=True)
class Outline:
    """Pieces of an outline in the plane of its surface.

    Attributes
    ----------
    start, middle, end : ndarray, shape [n, 2]
        Places of the pieces [m].
    motion : ndarray, shape [n, 4, 2]
        Change of the middles by each motion of :class:`RimMotion`.
    """

    start: np.ndarray
    middle: np.ndarray
    end: np.ndarray
    motion: np.ndarray


#: Regions with outlines of their own; a ring has two discs' outlines.
Simple = Circle | Ellipse | Rectangle | Vane | Polygon


def is_vane(region: Simple) -> bool:
    """Return whether a region is a vane of a spider."""
    if isinstance(region, Rectangle):
        return max(region.width, region.height) > _SLENDER * min(region.width, region.height)
    return isinstance(region, Vane)


def vane_width(region: Simple) -> float:
    """Return the width of a vane [m]."""
    return min(region.width, region.height) if isinstance(region, Rectangle) else getattr(region, "width", 0.0)


def widened(vane: Simple, margin: float) -> Simple:
    """Return a vane that is wider, and longer if it has ends, by a margin [m]."""
    if isinstance(vane, Rectangle):
        return replace(vane, width=vane.width + margin, height=vane.height + margin)
    assert isinstance(vane, Vane)
    return replace(vane, width=vane.width + margin)


def simple_regions(aperture: Aperture | None) -> list[Simple]:
    """Return the regions of an aperture that have outlines, in the order that :func:`moved_aperture` counts."""
    if aperture is None:
        return []
    if isinstance(aperture, Union | Intersection):
        return [simple for region in aperture.parts for simple in simple_regions(region)]
    if isinstance(aperture, Complement):
        return simple_regions(aperture.part)
    if isinstance(aperture, Annulus):
        # A ring without a hole has an outline of no length there.
        discs: list[Simple] = [Circle(aperture.outer, aperture.x, aperture.y)]
        return discs + ([Circle(aperture.inner, aperture.x, aperture.y)] if aperture.inner > 0.0 else [])
    return [aperture]


def moved_aperture(aperture: Aperture, motions: Mapping[int, RimMotion]) -> Aperture:
    """Return an aperture with some of its simple regions moved, by their number."""
    return _moved(aperture, motions, 0)[0]


def concentric(aperture: Aperture | None) -> Aperture | None:
    """Return a ring whose hole has moved as one about the centre of its rim; any other aperture as it is."""
    if isinstance(aperture, Intersection) and len(aperture.parts) == 2:
        outer, hole = aperture.parts
        if isinstance(outer, Circle) and isinstance(hole, Complement) and isinstance(hole.part, Circle):
            return Annulus(min(hole.part.radius, 0.999 * outer.radius), outer.radius, outer.x, outer.y)
    return aperture


def _moved(aperture: Aperture, motions: Mapping[int, RimMotion], first: int) -> tuple[Aperture, int]:
    """Return the moved aperture, and the number of the next region."""
    if isinstance(aperture, Union | Intersection):
        regions = []
        for unmoved in aperture.parts:
            region, first = _moved(unmoved, motions, first)
            regions.append(region)
        return type(aperture)(tuple(regions)), first
    if isinstance(aperture, Complement):
        region, following = _moved(aperture.part, motions, first)
        return Complement(region), following
    discs = simple_regions(aperture)
    following = first + len(discs)
    if not any(number in motions for number in range(first, following)):
        return aperture, following
    outlines = [_moved_region(disc, motions.get(first + k, RimMotion())) for k, disc in enumerate(discs)]
    if len(outlines) == 1 and not isinstance(aperture, Annulus):
        return outlines[0], following
    outer, inner = outlines[0], outlines[1] if len(outlines) > 1 else None
    assert isinstance(outer, Circle)
    if inner is None:
        return Annulus(0.0, outer.radius, outer.x, outer.y), following
    assert isinstance(inner, Circle)
    if (outer.x, outer.y) == (inner.x, inner.y) and inner.radius < outer.radius:
        return Annulus(inner.radius, outer.radius, outer.x, outer.y), following
    return Intersection((outer, Complement(inner))), following


def _moved_region(region: Simple, motion: RimMotion) -> Simple:
    """Return a simple region that is turned about the origin, shifted and grown."""
    growth = motion.growth
    if isinstance(region, Polygon):
        corners = np.array(region.corners)
        middle = corners.mean(axis=0)
        scaled = middle + (corners - middle) * (1.0 + growth / _mean_radius(corners))
        return Polygon(tuple((float(x), float(y)) for x, y in scaled @ _turn(motion.rotation).T + motion[:2]))
    x, y = _turn(motion.rotation) @ [region.x, region.y] + motion[:2]
    place: dict[str, Any] = {"x": float(x), "y": float(y)}
    if isinstance(region, Circle):
        return replace(region, radius=_grown(region.radius, growth), **place)
    angle = region.angle + motion.rotation
    if isinstance(region, Ellipse):
        sides: dict[str, Any] = {"semi_x": _grown(region.semi_x, growth), "semi_y": _grown(region.semi_y, growth)}
    elif isinstance(region, Rectangle):
        sides = {"width": _grown(region.width, 2.0 * growth), "height": _grown(region.height, 2.0 * growth)}
    else:
        return replace(region, width=_grown(region.width, 2.0 * growth), angle=angle, **place)
    return replace(region, angle=angle, **sides, **place)


def _grown(size: float, growth: float) -> float:
    """Return a length that has grown; regions do not vanish."""
    return max(size + growth, _LEAST * size)


def _turn(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _mean_radius(corners: np.ndarray) -> float:
    return float(np.hypot(*(corners - corners.mean(axis=0)).T).mean())


def outline(region: Simple, spacing: float, reach: float) -> Outline:
    """Return the outline of a region in pieces of about a length [m]; vanes end at a reach from the origin [m]."""
    if isinstance(region, Circle | Ellipse):
        return _oval(region, spacing)
    corners = np.array(region.corners) if isinstance(region, Polygon) else _corners(region, reach)
    sides = np.roll(corners, -1, axis=0) - corners
    starts, middles, ends = [], [], []
    for corner, side in zip(corners, sides, strict=True):
        count = int(np.clip(math.ceil(float(np.hypot(*side)) / spacing), 1, _MOST_PIECES))
        along = np.arange(count)[:, None] / count * side + corner
        starts.append(along)
        middles.append(along + 0.5 / count * side)
        ends.append(along + side / count)
    middle = np.concatenate(middles)
    if isinstance(region, Polygon):
        growth = (middle - corners.mean(axis=0)) / _mean_radius(corners)
    else:
        # Corners run counterclockwise.
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=-1) / np.hypot(*sides.T)[:, None]
        growth = np.concatenate([np.tile(n, (len(m), 1)) for n, m in zip(normals, middles, strict=True)])
        if isinstance(region, Vane):
            # Growth moves the sides alone: the second and the last edge are the ends.
            growth[len(middles[0]) : len(middles[0]) + len(middles[1])] = 0.0
            growth[len(middle) - len(middles[3]) :] = 0.0
    return Outline(np.concatenate(starts), middle, np.concatenate(ends), _motion(middle, growth))


def _oval(region: Circle | Ellipse, spacing: float) -> Outline:
    """Return the outline of a disc or an ellipse."""
    semi = np.array([region.radius] * 2 if isinstance(region, Circle) else [region.semi_x, region.semi_y])
    angle = 0.0 if isinstance(region, Circle) else region.angle
    count = int(np.clip(2.0 * math.pi * semi.max() / spacing, _FEWEST_PIECES, _MOST_PIECES))
    turns = math.pi * np.arange(2 * count + 1) / count
    unit = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    places = unit * semi @ _turn(angle).T + [region.x, region.y]
    # The semi-axes grow alike: along the unit vector of the parameter.
    growth = unit[1::2] @ _turn(angle).T
    middle = places[1::2]
    return Outline(places[:-2:2], middle, places[2::2], _motion(middle, growth))


def _motion(places: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return the change of places [n, 2] by each motion, [n, 4, 2]."""
    unit = np.ones((len(places), 1))
    turn = np.stack([-places[:, 1], places[:, 0]], axis=-1)
    return np.stack([unit * [1.0, 0.0], unit * [0.0, 1.0], growth, turn], axis=1)


def _corners(region: Rectangle | Vane, reach: float) -> np.ndarray:
    """Return the corners of a rectangle, or of a vane as far as it matters, counterclockwise."""
    if isinstance(region, Rectangle):
        first, last, half = -0.5 * region.width, 0.5 * region.width, 0.5 * region.height
    else:
        far = reach + math.hypot(region.x, region.y)
        first, last, half = -far if region.both_ways else 0.0, far, 0.5 * region.width
    corners = np.array([[first, -half], [last, -half], [last, half], [first, half]])
    return corners @ _turn(region.angle).T + [region.x, region.y]
