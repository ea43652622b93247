"""Vignetting of packets by apertures that set algebra makes of discs, rings, ellipses, rectangles, vanes and polygons.

Each such aperture is a small programme in postfix order: a region puts a bit on the stack of each lane (1 inside), a
set operation takes bits from it and puts back its own. The last bit is 1 where light passes.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lane_flags, lanes
from .surface import OK, VIGNETTED

wp.set_module_options(FORWARD_OPTIONS)

# Steps of a programme.
DISC = wp.constant(0)
RING = wp.constant(1)
BOX = wp.constant(2)
STRIP = wp.constant(3)
OUTLINE = wp.constant(4)
BOTH = wp.constant(5)
EITHER = wp.constant(6)
OUTSIDE = wp.constant(7)
ELLIPSE = wp.constant(8)


@wp.struct
class PackedApertures:
    """The general apertures of a telescope; see :mod:`pachon.raytrace.pack.apertures`.

    ``span`` [surface, 2]: first step of the surface's programme, and the one after its last. ``steps`` [step, 3]: kind,
    and for an outline the first of its edges and the one after its last. ``numbers`` [step, 6]: centre x, y
    [m], cosine and sine of the angle, two sizes: the square of the radius; squares of inner and outer radius; halves of
    width and height; semi-axes; where a strip begins, and half its width [m]. ``edges`` [edge, 4]: one end x, y [m],
    y of the other [m], slope dx/dy.
    """

    span: wp.array2d(dtype=wp.int32)
    steps: wp.array2d(dtype=wp.int32)
    numbers: wp.array2d(dtype=wp.float64)
    edges: wp.array2d(dtype=wp.float64)


@wp.func
def push_bit(stack: lane_flags, inside: lane_flags):
    """Put a bit on the stack of each lane."""
    for i in range(LANES):
        stack[i] = (stack[i] << 1) | inside[i]
    return stack


@wp.func
def within_outline(edges: wp.array2d(dtype=wp.float64), first: wp.int32, last: wp.int32, x: lanes, y: lanes):
    """Lanes inside an outline (1): a line towards +x crosses it an odd number of times."""
    inside = lane_flags()
    for edge in range(first, last):
        ax = edges[edge, 0]
        ay = edges[edge, 1]
        by = edges[edge, 2]
        slope = edges[edge, 3]
        for i in range(LANES):
            above = wp.where(ay > y[i], 1, 0) ^ wp.where(by > y[i], 1, 0)
            edge_ahead = wp.where(x[i] < ax + (y[i] - ay) * slope, 1, 0)
            inside[i] = inside[i] ^ (above & edge_ahead)
    return inside


@wp.func
def through_aperture(apertures: PackedApertures, s: wp.int32, x: lanes, y: lanes, status: lanes):
    """Statuses after the general aperture of surface ``s``, at x, y of its own frame."""
    stack = lane_flags()
    for step in range(apertures.span[s, 0], apertures.span[s, 1]):
        kind = apertures.steps[step, 0]
        a = apertures.numbers[step, 4]
        b = apertures.numbers[step, 5]
        dx = x - lanes(apertures.numbers[step, 0])
        dy = y - lanes(apertures.numbers[step, 1])
        inside = lane_flags()
        if kind == DISC:
            for i in range(LANES):
                inside[i] = wp.where(dx[i] * dx[i] + dy[i] * dy[i] < a, 1, 0)
            stack = push_bit(stack, inside)
        elif kind == RING:
            for i in range(LANES):
                r2 = dx[i] * dx[i] + dy[i] * dy[i]
                inside[i] = wp.where(r2 >= a, wp.where(r2 < b, 1, 0), 0)
            stack = push_bit(stack, inside)
        elif kind == BOX or kind == STRIP:
            cosine = apertures.numbers[step, 2]
            sine = apertures.numbers[step, 3]
            along = cosine * dx + sine * dy
            across = cosine * dy - sine * dx
            for i in range(LANES):
                reach = wp.where(kind == BOX, a - wp.abs(along[i]), along[i] - a)
                inside[i] = wp.where(wp.abs(across[i]) < b, wp.where(reach > wp.float64(0.0), 1, 0), 0)
            stack = push_bit(stack, inside)
        elif kind == ELLIPSE:
            cosine = apertures.numbers[step, 2]
            sine = apertures.numbers[step, 3]
            along = (cosine * dx + sine * dy) / a
            across = (cosine * dy - sine * dx) / b
            for i in range(LANES):
                inside[i] = wp.where(along[i] * along[i] + across[i] * across[i] < wp.float64(1.0), 1, 0)
            stack = push_bit(stack, inside)
        elif kind == OUTLINE:
            stack = push_bit(
                stack, within_outline(apertures.edges, apertures.steps[step, 1], apertures.steps[step, 2], x, y)
            )
        elif kind == BOTH:
            for i in range(LANES):
                stack[i] = (stack[i] >> 1) & (stack[i] | -2)
        elif kind == EITHER:
            for i in range(LANES):
                stack[i] = (stack[i] >> 1) | (stack[i] & 1)
        else:
            for i in range(LANES):
                stack[i] = stack[i] ^ 1
    for i in range(LANES):
        blocked = wp.where(status[i] == OK, VIGNETTED, status[i])
        status[i] = wp.where((stack[i] & 1) == 1, status[i], blocked)
    return status
