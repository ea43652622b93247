"""Ideal thin lenses: directions and optical paths of rays, and their derivatives.

With the slopes t = (u, v) / |w| of a ray, its point P in the plane, power phi and indices n and n'::

    n' t' = n t - phi P
    path  = n (k P.P - 2 P.t) / (|(k P - t, 1)| + |(t, 1)|) + n' (k' P.P + 2 P.t') / (|(k' P + t', 1)| + |(t', 1)|)

The two parts are the differences of the paths from the object point of the ray to the vertex and to P, and of those
from there to its image point; k is one over the distance of the object, and n k + n' k' = phi.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lanes, lanes_sqrt
from .surface import ONE, TWO, ZERO

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def slope_length(p: lanes, q: lanes):
    """Length of (p, q, 1)."""
    return lanes_sqrt(lanes(ONE) + wp.cw_mul(p, p) + wp.cw_mul(q, q))


@wp.func
def lens_slopes(power: wp.float64, n: lanes, behind: lanes, x: lanes, y: lanes, u: lanes, v: lanes, w: lanes):
    """Slopes in front of the lens and behind it."""
    depth = lanes()
    for i in range(int(LANES)):
        depth[i] = wp.abs(w[i])
    p = wp.cw_div(u, depth)
    q = wp.cw_div(v, depth)
    return p, q, wp.cw_div(wp.cw_mul(n, p) - power * x, behind), wp.cw_div(wp.cw_mul(n, q) - power * y, behind)


@wp.func
def through_thin_lens(
    power: wp.float64,
    vergence: wp.float64,
    n: lanes,
    behind: lanes,
    x: lanes,
    y: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
):
    """Directions behind a thin lens, and the optical paths that it adds."""
    p, q, p1, q1 = lens_slopes(power, n, behind, x, y, u, v, w)
    k = lanes(vergence)
    k1 = wp.cw_div(lanes(power) - vergence * n, behind)
    square = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    before = vergence * square - TWO * (wp.cw_mul(x, p) + wp.cw_mul(y, q))
    after = wp.cw_mul(k1, square) + TWO * (wp.cw_mul(x, p1) + wp.cw_mul(y, q1))
    length = slope_length(p1, q1)
    front = slope_length(wp.cw_mul(k, x) - p, wp.cw_mul(k, y) - q) + slope_length(p, q)
    back = slope_length(wp.cw_mul(k1, x) + p1, wp.cw_mul(k1, y) + q1) + length
    added = wp.cw_mul(n, wp.cw_div(before, front)) + wp.cw_mul(behind, wp.cw_div(after, back))
    side = lanes()
    for i in range(int(LANES)):
        side[i] = wp.where(w[i] < ZERO, -ONE, ONE)
    return wp.cw_div(p1, length), wp.cw_div(q1, length), wp.cw_div(side, length), added


@wp.func
def thin_lens_adjoint(
    power: wp.float64,
    vergence: wp.float64,
    n: wp.float64,
    behind: wp.float64,
    x: lanes,
    y: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    bx: lanes,
    by: lanes,
    bz: lanes,
    per_path: lanes,
):
    """Return derivatives by the point (x, y), direction in front and both indices, from those by direction and path.

    Point and direction stay where the index in front changes.
    """
    p, q, p1, q1 = lens_slopes(power, lanes(n), lanes(behind), x, y, u, v, w)
    k = vergence
    k1 = (power - n * vergence) / behind
    square = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    side = lanes()
    for i in range(int(LANES)):
        side[i] = wp.where(w[i] < ZERO, -ONE, ONE)
    length = slope_length(p1, q1)
    # By the slopes behind: those of the unit direction, and of the path.
    along = wp.cw_div(wp.cw_mul(bx, p1) + wp.cw_mul(by, q1) + wp.cw_mul(bz, side), wp.cw_mul(length, length))
    gx = wp.cw_div(bx - wp.cw_mul(along, p1), length)
    gy = wp.cw_div(by - wp.cw_mul(along, q1), length)
    ax = k1 * x + p1
    ay = k1 * y + q1
    far = slope_length(ax, ay)
    inverse = wp.cw_div(lanes(ONE), far + length)
    scale = behind * wp.cw_mul(per_path, inverse)
    ratio = wp.cw_mul(k1 * square + TWO * (wp.cw_mul(x, p1) + wp.cw_mul(y, q1)), inverse)
    gx = gx + wp.cw_mul(scale, TWO * x - wp.cw_mul(ratio, wp.cw_div(ax, far) + wp.cw_div(p1, length)))
    gy = gy + wp.cw_mul(scale, TWO * y - wp.cw_mul(ratio, wp.cw_div(ay, far) + wp.cw_div(q1, length)))
    px = wp.cw_mul(scale, TWO * ax - k1 * wp.cw_mul(ratio, wp.cw_div(ax, far)))
    py = wp.cw_mul(scale, TWO * ay - k1 * wp.cw_mul(ratio, wp.cw_div(ay, far)))
    # By k'; both k' and the slopes behind are quotients by n', of n k and n t.
    by_k1 = wp.cw_mul(scale, square - wp.cw_mul(ratio, wp.cw_div(wp.cw_mul(ax, x) + wp.cw_mul(ay, y), far)))
    by_front = (ONE / behind) * (wp.cw_mul(gx, p) + wp.cw_mul(gy, q) - k * by_k1)
    by_behind = wp.cw_mul(per_path, ratio) - (ONE / behind) * (wp.cw_mul(gx, p1) + wp.cw_mul(gy, q1) + k1 * by_k1)
    # By the point through the slopes behind, and by the slopes in front.
    px = px - (power / behind) * gx
    py = py - (power / behind) * gy
    hx = (n / behind) * gx
    hy = (n / behind) * gy
    ax = k * x - p
    ay = k * y - q
    far = slope_length(ax, ay)
    length = slope_length(p, q)
    inverse = wp.cw_div(lanes(ONE), far + length)
    scale = n * wp.cw_mul(per_path, inverse)
    ratio = wp.cw_mul(k * square - TWO * (wp.cw_mul(x, p) + wp.cw_mul(y, q)), inverse)
    hx = hx - wp.cw_mul(scale, TWO * x + wp.cw_mul(ratio, wp.cw_div(p, length) - wp.cw_div(ax, far)))
    hy = hy - wp.cw_mul(scale, TWO * y + wp.cw_mul(ratio, wp.cw_div(q, length) - wp.cw_div(ay, far)))
    px = px + wp.cw_mul(scale, TWO * ax - k * wp.cw_mul(ratio, wp.cw_div(ax, far)))
    py = py + wp.cw_mul(scale, TWO * ay - k * wp.cw_mul(ratio, wp.cw_div(ay, far)))
    by_front = by_front + wp.cw_mul(per_path, ratio)
    # The slopes are (u, v) / |w|.
    depth = wp.cw_mul(side, w)
    return (
        px,
        py,
        wp.cw_div(hx, depth),
        wp.cw_div(hy, depth),
        -wp.cw_div(wp.cw_mul(hx, p) + wp.cw_mul(hy, q), w),
        by_front,
        by_behind,
    )
