"""Columns of the adjoint matrix: their storage, second derivatives of sags, and polynomial sags."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ..kernels.packet import lanes, lanes_sqrt
from ..kernels.surface import ONE, TWO, ZERO
from ..kernels.surface_table import CONIC, CURVATURE, TERMS, PackedSurfaces

wp.set_module_options(FORWARD_OPTIONS)

# Quantities of a surface, a column each: a change of its sag and the slopes of that change; the index before and after;
# the intersection itself; force and torque in the gap in front of it; the grooves of a grating (those of the table of
# numbers, GROOVES). One surface more holds the gap behind the last.
SAG = wp.constant(0)
INDEX = wp.constant(3)
INTERSECTION = wp.constant(5)
FORCE = wp.constant(7)
TORQUE = wp.constant(10)
GROOVE = wp.constant(13)
QUANTITIES = 15


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

    A shape of revolution has the slope r m(r^2) with m = c / q + p, q = sqrt(1 - (1 + k) c^2 r^2) and p that of the
    polynomial; m' below is the derivative of m with respect to r^2.
    """
    c = surfaces.numbers[s, CURVATURE]
    k = surfaces.numbers[s, CONIC]
    terms = surfaces.kinds[s, TERMS]
    r2 = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    square = (ONE + k) * c * c
    inverse = wp.cw_div(lanes(ONE), lanes_sqrt(lanes(ONE) - square * r2))
    m = c * inverse
    change = (wp.float64(0.5) * square) * wp.cw_mul(m, wp.cw_mul(inverse, inverse))
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
def write_column(
    columns: wp.array2d(dtype=wp.int32),
    s: wp.int32,
    quantity: wp.int32,
    output: wp.int32,
    packet: wp.int32,
    value: lanes,
    matrix: wp.array3d(dtype=lanes),
):
    """Write the column of one quantity, if it has one."""
    column = columns[s, quantity]
    if column >= 0:
        matrix[output, column, packet] = value


@wp.func
def write_gap(
    columns: wp.array2d(dtype=wp.int32),
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
    matrix: wp.array3d(dtype=lanes),
):
    """Write force and torque in a gap, if they have columns; all vectors in the telescope frame."""
    if columns[gap, FORCE] >= 0:
        mx, my, mz = cross(px, py, pz, ax, ay, az)
        ox, oy, oz = cross(u, v, w, bx, by, bz)
        write_column(columns, gap, FORCE, output, packet, ax, matrix)
        write_column(columns, gap, FORCE + 1, output, packet, ay, matrix)
        write_column(columns, gap, FORCE + 2, output, packet, az, matrix)
        write_column(columns, gap, TORQUE, output, packet, mx + ox, matrix)
        write_column(columns, gap, TORQUE + 1, output, packet, my + oy, matrix)
        write_column(columns, gap, TORQUE + 2, output, packet, mz + oz, matrix)


@wp.func
def polynomial_columns(
    polynomials: wp.array2d(dtype=wp.int32),
    scale: wp.float64,
    j: wp.int32,
    o: wp.int32,
    p: wp.int32,
    matrix: wp.array3d(dtype=lanes),
):
    """Write the columns of the sags s^k (x + i y)^m, m + 2 k <= degree, from those of sag, slopes and intersection.

    Row ``j`` of the table holds the degree, the first column of the sag and of the intersection, and then the column of
    each sag, -1 for none, in the order: m from 0, for each k from 0, the real part and, for m > 0, the imaginary part.
    x and y are in units of ``scale``, s = x^2 + y^2. With F the derivative by the sag and G by its slopes::

        F s^k z^m + G.grad(s^k z^m) = z^m (F s^k + 2 k s^(k-1) (G.r)) + s^k m z^(m-1) (Gx + i Gy)
    """
    degree = polynomials[j, 0]
    sag_column = polynomials[j, 1]
    place_column = polynomials[j, 2]
    f = matrix[o, sag_column, p]
    gx = (ONE / scale) * matrix[o, sag_column + 1, p]
    gy = (ONE / scale) * matrix[o, sag_column + 2, p]
    x = (ONE / scale) * matrix[o, place_column, p]
    y = (ONE / scale) * matrix[o, place_column + 1, p]
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
            column = polynomials[j, place]
            if column >= 0:
                matrix[o, column, p] = wp.cw_mul(zr, radial) + wp.cw_mul(power, tr)
            place += 1
            if m > 0:
                column = polynomials[j, place]
                if column >= 0:
                    matrix[o, column, p] = wp.cw_mul(zi, radial) + wp.cw_mul(power, ti)
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
