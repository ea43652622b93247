"""Pieces of the backward sweep: the columns that it leaves, curvatures of sags, responses to polynomial sags."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ..kernels.packet import lanes, lanes_sqrt
from ..kernels.surface import ONE, TWO, ZERO
from ..kernels.trace import CONIC, CURVATURE, TERMS, PackedSurfaces

wp.set_module_options(FORWARD_OPTIONS)

# What a surface answers for, as columns: a change f of its sag and of its slopes at the hit; the index before and
# after; the hit itself; and force and torque in the gap in front of it. A row more holds those behind the last.
SAG = wp.constant(0)
INDEX = wp.constant(3)
HIT = wp.constant(5)
FORCE = wp.constant(7)
TORQUE = wp.constant(10)
COLUMNS = 13


@wp.func
def cross(ax: lanes, ay: lanes, az: lanes, bx: lanes, by: lanes, bz: lanes):
    """Vector product."""
    return (
        wp.cw_mul(ay, bz) - wp.cw_mul(az, by),
        wp.cw_mul(az, bx) - wp.cw_mul(ax, bz),
        wp.cw_mul(ax, by) - wp.cw_mul(ay, bx),
    )


@wp.func
def dot(ax: lanes, ay: lanes, az: lanes, bx: lanes, by: lanes, bz: lanes):
    """Scalar product."""
    return wp.cw_mul(ax, bx) + wp.cw_mul(ay, by) + wp.cw_mul(az, bz)


@wp.func
def sag_derivatives(surfaces: PackedSurfaces, s: wp.int32, x: lanes, y: lanes):
    """First and second derivatives of conic and even powers of a surface: sx, sy, sxx, sxy, syy.

    A figure of revolution has the slope r m(r^2) with m = c / q + p, q = sqrt(1 - (1 + k) c^2 r^2) and p that of the
    polynomial; m' below is the derivative of m with respect to r^2.
    """
    c = surfaces.numbers[s, CURVATURE]
    k = surfaces.numbers[s, CONIC]
    terms = surfaces.kinds[s, TERMS]
    r2 = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    bend = (ONE + k) * c * c
    inverse = wp.cw_div(lanes(ONE), lanes_sqrt(lanes(ONE) - bend * r2))
    m = c * inverse
    change = (wp.float64(0.5) * bend) * wp.cw_mul(m, wp.cw_mul(inverse, inverse))
    slope = lanes(ZERO)
    slope_change = lanes(ZERO)
    for j in range(terms):
        # Horner for p = r2 sum (4 + 2 j) a_j r2^j and its derivative, from the highest term down.
        i = terms - 1 - j
        a = surfaces.coefficients[s, i] * wp.float64(4 + 2 * i)
        slope = wp.cw_mul(slope, r2) + lanes(a)
        slope_change = wp.cw_mul(slope_change, r2) + lanes(a * wp.float64(i + 1))
    m = m + wp.cw_mul(slope, r2)
    change = TWO * (change + slope_change)
    sx = wp.cw_mul(m, x)
    sy = wp.cw_mul(m, y)
    sxx = m + wp.cw_mul(change, wp.cw_mul(x, x))
    sxy = wp.cw_mul(change, wp.cw_mul(x, y))
    syy = m + wp.cw_mul(change, wp.cw_mul(y, y))
    return sx, sy, sxx, sxy, syy


@wp.func
def keep(
    rows: wp.array2d(dtype=wp.int32),
    s: wp.int32,
    column: wp.int32,
    output: wp.int32,
    packet: wp.int32,
    value: lanes,
    response: wp.array3d(dtype=lanes),
):
    """Write one column, if it is wanted."""
    row = rows[s, column]
    if row >= 0:
        response[output, row, packet] = value


@wp.func
def keep_gap(
    rows: wp.array2d(dtype=wp.int32),
    gap: wp.int32,
    output: wp.int32,
    packet: wp.int32,
    px: lanes,
    py: lanes,
    pz: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    ax: lanes,
    ay: lanes,
    az: lanes,
    bx: lanes,
    by: lanes,
    bz: lanes,
    response: wp.array3d(dtype=lanes),
):
    """Write force and torque in a gap, if they are wanted; all vectors in the telescope frame."""
    if rows[gap, FORCE] >= 0:
        mx, my, mz = cross(px, py, pz, ax, ay, az)
        ox, oy, oz = cross(u, v, w, bx, by, bz)
        keep(rows, gap, FORCE, output, packet, ax, response)
        keep(rows, gap, FORCE + 1, output, packet, ay, response)
        keep(rows, gap, FORCE + 2, output, packet, az, response)
        keep(rows, gap, TORQUE, output, packet, mx + ox, response)
        keep(rows, gap, TORQUE + 1, output, packet, my + oy, response)
        keep(rows, gap, TORQUE + 2, output, packet, mz + oz, response)


@wp.func
def polynomial_response(
    polynomials: wp.array2d(dtype=wp.int32),
    scale: wp.float64,
    j: wp.int32,
    o: wp.int32,
    p: wp.int32,
    response: wp.array3d(dtype=lanes),
):
    """Write the responses to the sags s^k (x + i y)^m, m + 2 k <= degree, from those to sag and slopes at the hit.

    Row ``j`` of the table holds the degree, the first row of the sag's columns and of the hit's, and then the row in
    which each sag belongs, -1 where nobody asks, in the order: m from 0, for each k from 0, the real part and, for
    m > 0, the imaginary part. x and y are in units of ``scale``, s = x^2 + y^2. With F the response to the sag and G to
    its slopes::

        F s^k z^m + G.grad(s^k z^m) = z^m (F s^k + 2 k s^(k-1) (G.r)) + s^k m z^(m-1) (Gx + i Gy)
    """
    degree = polynomials[j, 0]
    sag_row = polynomials[j, 1]
    hit_row = polynomials[j, 2]
    f = response[o, sag_row, p]
    gx = (ONE / scale) * response[o, sag_row + 1, p]
    gy = (ONE / scale) * response[o, sag_row + 2, p]
    x = (ONE / scale) * response[o, hit_row, p]
    y = (ONE / scale) * response[o, hit_row + 1, p]
    s = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    outward = TWO * (wp.cw_mul(gx, x) + wp.cw_mul(gy, y))
    place = int(3)
    # z^m and m z^(m-1) (Gx + i Gy), real and imaginary parts.
    zr = lanes(ONE)
    zi = lanes(ZERO)
    tr = lanes(ZERO)
    ti = lanes(ZERO)
    for m in range(degree + 1):
        power = lanes(ONE)
        change = lanes(ZERO)
        for _k in range((degree - m) / 2 + 1):
            radial = wp.cw_mul(f, power) + wp.cw_mul(outward, change)
            row = polynomials[j, place]
            if row >= 0:
                response[o, row, p] = wp.cw_mul(zr, radial) + wp.cw_mul(power, tr)
            place += 1
            if m > 0:
                row = polynomials[j, place]
                if row >= 0:
                    response[o, row, p] = wp.cw_mul(zi, radial) + wp.cw_mul(power, ti)
                place += 1
            change = power + wp.cw_mul(change, s)
            power = wp.cw_mul(power, s)
        # (z^(m+1))' = z^m + z (z^m)'
        next_r = wp.cw_mul(x, tr) - wp.cw_mul(y, ti) + wp.cw_mul(zr, gx) - wp.cw_mul(zi, gy)
        ti = wp.cw_mul(x, ti) + wp.cw_mul(y, tr) + wp.cw_mul(zr, gy) + wp.cw_mul(zi, gx)
        tr = next_r
        next_r = wp.cw_mul(x, zr) - wp.cw_mul(y, zi)
        zi = wp.cw_mul(x, zi) + wp.cw_mul(y, zr)
        zr = next_r
