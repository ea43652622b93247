"""The general apertures of a telescope as the small programmes that the trace kernels run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ...core.errors import PrescriptionError
from ...core.warp_arrays import warp_array
from ...models.aperture import (
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
from ..kernels import aperture as kernels
from ..kernels.aperture import PackedApertures

#: Bits on the stack of a lane.
DEEPEST = 31


def depth(aperture: Aperture) -> int:
    """Return the largest number of bits that the programme of an aperture has on its stack."""
    if isinstance(aperture, Complement):
        return depth(aperture.part)
    if isinstance(aperture, (Union, Intersection)):
        # The first part is on the stack when the others come, each of which is taken off at once.
        first, *later_depths = (depth(operand) for operand in aperture.parts)
        return max([first, *(1 + d for d in later_depths)])
    return 1


class _Programme:
    """Steps, numbers and edges of several apertures."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, int, int]] = []
        self.numbers: list[tuple[float, ...]] = []
        self.edges: list[tuple[float, float, float, float]] = []

    def _step(self, kind: Any, *numbers: float, edges: tuple[int, int] = (0, 0)) -> None:
        self.steps.append((int(kind), *edges))
        self.numbers.append(numbers or (0.0,) * 6)

    def add(self, aperture: Aperture) -> None:
        """Add the steps of an aperture."""
        a = aperture
        if isinstance(a, Circle):
            self._step(kernels.DISC, a.x, a.y, 1.0, 0.0, a.radius**2, 0.0)
        elif isinstance(a, Annulus):
            self._step(kernels.RING, a.x, a.y, 1.0, 0.0, a.inner**2, a.outer**2)
        elif isinstance(a, Ellipse):
            self._step(kernels.ELLIPSE, a.x, a.y, math.cos(a.angle), math.sin(a.angle), a.semi_x, a.semi_y)
        elif isinstance(a, Rectangle):
            self._step(kernels.BOX, a.x, a.y, math.cos(a.angle), math.sin(a.angle), 0.5 * a.width, 0.5 * a.height)
        elif isinstance(a, Vane):
            start = -math.inf if a.both_ways else 0.0
            self._step(kernels.STRIP, a.x, a.y, math.cos(a.angle), math.sin(a.angle), start, 0.5 * a.width)
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
            for i, operand in enumerate(a.parts):
                self.add(operand)
                if i:
                    self._step(kernels.EITHER if isinstance(a, Union) else kernels.BOTH)


def pack_apertures(apertures: Sequence[Aperture | None], device: str = "cpu") -> Any:
    """Return the programmes of apertures, one per surface (None without); a PrescriptionError if nested too deeply."""
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
    packed.span = warp_array(span, wp.int32, device=device)
    packed.steps = warp_array(np.reshape(programme.steps, (-1, 3)), wp.int32, device=device)
    packed.numbers = warp_array(np.reshape(programme.numbers, (-1, 6)), device=device)
    packed.edges = warp_array(np.reshape(programme.edges, (-1, 4)), device=device)
    return packed
