"""The general apertures of a telescope as the small programmes that the trace kernels run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ...core.errors import PrescriptionError
from ...models.aperture import (
    Annulus,
    Aperture,
    Circle,
    Complement,
    Intersection,
    Polygon,
    Rectangle,
    Union,
    Vane,
)
from ..kernels import aperture as kernels
from ..kernels.aperture import PackedApertures

#: Bits on the stack of a lane.
DEEPEST = 31


def depth(aperture: Aperture) -> int:
    """Return how many bits the programme of an aperture keeps on its stack at most."""
    if isinstance(aperture, Complement):
        return depth(aperture.part)
    if isinstance(aperture, (Union, Intersection)):
        # The first part is on the stack when the others come, each of which is taken off at once.
        first, *others = (depth(part) for part in aperture.parts)
        return max([first, *(1 + d for d in others)])
    return 1


class _Programme:
    """Steps, figures and edges of several apertures."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, int, int]] = []
        self.figures: list[tuple[float, ...]] = []
        self.edges: list[tuple[float, float, float, float]] = []

    def _step(self, what: Any, *figures: float, edges: tuple[int, int] = (0, 0)) -> None:
        self.steps.append((int(what), *edges))
        self.figures.append(figures or (0.0,) * 6)

    def add(self, aperture: Aperture) -> None:
        """Add the steps of an aperture."""
        a = aperture
        if isinstance(a, Circle):
            self._step(kernels.DISC, a.x, a.y, 1.0, 0.0, a.radius**2, 0.0)
        elif isinstance(a, Annulus):
            self._step(kernels.RING, a.x, a.y, 1.0, 0.0, a.inner**2, a.outer**2)
        elif isinstance(a, Rectangle):
            turn = (math.cos(a.angle), math.sin(a.angle))
            self._step(kernels.BOX, a.x, a.y, *turn, 0.5 * a.width, 0.5 * a.height)
        elif isinstance(a, Vane):
            turn = (math.cos(a.angle), math.sin(a.angle))
            self._step(kernels.STRIP, a.x, a.y, *turn, -math.inf if a.both_ways else 0.0, 0.5 * a.width)
        elif isinstance(a, Polygon):
            first = len(self.edges)
            for (ax, ay), (bx, by) in zip(a.corners, (*a.corners[1:], a.corners[0]), strict=True):
                if ay != by:
                    self.edges.append((ax, ay, by, (bx - ax) / (by - ay)))
            self._step(kernels.OUTLINE, edges=(first, len(self.edges)))
        elif isinstance(a, Complement):
            self.add(a.part)
            self._step(kernels.OUTSIDE)
        else:
            for i, part in enumerate(a.parts):
                self.add(part)
                if i:
                    self._step(kernels.EITHER if isinstance(a, Union) else kernels.BOTH)


def pack_apertures(apertures: Sequence[Aperture | None], device: str = "cpu") -> Any:
    """Return the programmes of apertures, one per surface (None for a surface that needs none).

    Raises
    ------
    PrescriptionError
        If an aperture is nested too deeply.
    """
    programme = _Programme()
    span = []
    for aperture in apertures:
        first = len(programme.steps)
        if aperture is not None:
            if depth(aperture) > DEEPEST:
                raise PrescriptionError(f"aperture nested {depth(aperture)} deep: expected at most {DEEPEST}")
            programme.add(aperture)
        span.append((first, len(programme.steps)))
    packed = PackedApertures()
    packed.span = wp.array(np.array(span, dtype=np.int32), dtype=wp.int32, device=device)
    packed.steps = wp.array(np.array(programme.steps, dtype=np.int32).reshape(-1, 3), dtype=wp.int32, device=device)
    for name, rows, columns in (("figures", programme.figures, 6), ("edges", programme.edges, 4)):
        table = np.array(rows, dtype=np.float64).reshape(-1, columns)
        setattr(packed, name, wp.array(table, dtype=wp.float64, device=device))
    return packed
