"""First and second derivatives of the parts of surfaces, for the backward pass."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...models.shapes import bicubic
from .packet import LANES, lanes, lanes_sqrt
from .shape import (
    BICONIC,
    GRID,
    GRID_HEAD,
    ODD,
    POLAR,
    QBFS,
    TOROID,
    PackedDeformations,
    biconic_sag,
    cubic,
    cubic_change,
    grid_cell,
    hermite_slopes,
    hermite_weights,
    qbfs_derivatives_by_s,
    toroid_pieces,
    toroid_powers,
)
from .surface import ONE, TWO, ZERO

wp.set_module_options(FORWARD_OPTIONS)

FOUR = wp.constant(wp.float64(4.0))

hermite_curvatures = wp.func(bicubic.hermite_curvature)


@wp.func
def horner(re: lanes, im: lanes, x: lanes, y: lanes, add_re: lanes, add_im: lanes):
    """Real and imaginary part of a step (re + i im)(x + iy) + (add_re + i add_im)."""
    return wp.cw_mul(re, x) - wp.cw_mul(im, y) + add_re, wp.cw_mul(re, y) + wp.cw_mul(im, x) + add_im


@wp.func
def polar_derivatives(
    numbers: wp.array(dtype=wp.float64), offset: wp.int32, degree: wp.int32, order: wp.int32, x: lanes, y: lanes
):
    """Return derivatives x, y, xx, xy, yy of Re f(z, s), f = sum_m q_m(s) z^m, by nested Horner schemes.

    With z = x + iy, s = x^2 + y^2: f_x = f_z + 2 x f_s, f_xx = f_zz + 4 x f_zs + 2 f_s + 4 x^2 f_ss, f_xy = i f_zz +
    2 (y + ix) f_zs + 4 xy f_ss, f_yy = -f_zz + 4 iy f_zs + 2 f_s + 4 y^2 f_ss.
    """
    s = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    # Real and imaginary parts of the sum and of its derivatives z, s, zz, zs, ss.
    fr = lanes(ZERO)
    fi = lanes(ZERO)
    zr = lanes(ZERO)
    zi = lanes(ZERO)
    sr = lanes(ZERO)
    si = lanes(ZERO)
    zzr = lanes(ZERO)
    zzi = lanes(ZERO)
    zsr = lanes(ZERO)
    zsi = lanes(ZERO)
    ssr = lanes(ZERO)
    ssi = lanes(ZERO)
    at = offset
    for i in range(order + 1):
        m = order - i
        qr = lanes(ZERO)
        qi = lanes(ZERO)
        dr = lanes(ZERO)
        di = lanes(ZERO)
        er = lanes(ZERO)
        ei = lanes(ZERO)
        for _k in range((degree - m) // 2 + 1):
            er = wp.cw_mul(er, s) + TWO * dr
            ei = wp.cw_mul(ei, s) + TWO * di
            dr = wp.cw_mul(dr, s) + qr
            di = wp.cw_mul(di, s) + qi
            qr = wp.cw_mul(qr, s) + lanes(numbers[at])
            qi = wp.cw_mul(qi, s) + lanes(numbers[at + 1])
            at += 2
        # Each line takes values that the lines below it change.
        zzr, zzi = horner(zzr, zzi, x, y, TWO * zr, TWO * zi)
        zsr, zsi = horner(zsr, zsi, x, y, sr, si)
        zr, zi = horner(zr, zi, x, y, fr, fi)
        fr, fi = horner(fr, fi, x, y, qr, qi)
        sr, si = horner(sr, si, x, y, dr, di)
        ssr, ssi = horner(ssr, ssi, x, y, er, ei)
    along = FOUR * wp.cw_mul(x, zsr) + TWO * sr + FOUR * wp.cw_mul(wp.cw_mul(x, x), ssr)
    across = TWO * sr + FOUR * wp.cw_mul(wp.cw_mul(y, y), ssr) - FOUR * wp.cw_mul(y, zsi)
    mixed = TWO * (wp.cw_mul(y, zsr) - wp.cw_mul(x, zsi)) + FOUR * wp.cw_mul(wp.cw_mul(x, y), ssr)
    return (
        zr + TWO * wp.cw_mul(x, sr),
        TWO * wp.cw_mul(y, sr) - zi,
        zzr + along,
        mixed - zzi,
        across - zzr,
    )


@wp.func
def odd_derivatives(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Return derivatives x, y, xx, xy, yy of a_1 r + a_3 r^3 + ...; at r = 0 all are zero."""
    s = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    slope = lanes(ZERO)
    change = lanes(ZERO)
    for j in range(terms):
        # p = sum n a_n r^(n - 1) and 2 dp/ds, n = 2 m + 1: the slope is p / r times x, y.
        m = terms - 1 - j
        a = numbers[offset + m] * wp.float64(2 * m + 1)
        change = wp.cw_mul(change, s) + TWO * slope
        slope = wp.cw_mul(slope, s) + lanes(a)
    r = lanes_sqrt(s)
    over = lanes()
    twist = lanes()
    for i in range(LANES):
        over[i] = wp.where(r[i] > ZERO, slope[i] / r[i], ZERO)
        twist[i] = wp.where(r[i] > ZERO, (change[i] - slope[i] / s[i]) / r[i], ZERO)
    return (
        wp.cw_mul(over, x),
        wp.cw_mul(over, y),
        over + wp.cw_mul(twist, wp.cw_mul(x, x)),
        wp.cw_mul(twist, wp.cw_mul(x, y)),
        over + wp.cw_mul(twist, wp.cw_mul(y, y)),
    )


@wp.func
def biconic_derivatives(numbers: wp.array(dtype=wp.float64), offset: wp.int32, x: lanes, y: lanes):
    """Return derivatives x, y, xx, xy, yy of u / (1 + w), from z (1 + w) = u and w^2 = 1 - px x^2 - py y^2."""
    cx = numbers[offset]
    cy = numbers[offset + 1]
    px = numbers[offset + 2]
    py = numbers[offset + 3]
    w = lanes_sqrt(lanes(ONE) - px * wp.cw_mul(x, x) - py * wp.cw_mul(y, y))
    z, zx, zy = biconic_sag(numbers, offset, x, y)
    wx = -wp.cw_div(px * x, w)
    wy = -wp.cw_div(py * y, w)
    over = wp.cw_div(lanes(ONE), lanes(ONE) + w)
    # (1 + w) z_ab = u_ab - z_a w_b - z_b w_a - z w_ab, and w w_ab = -p_ab - w_a w_b.
    wxx = -wp.cw_div(lanes(px) + wp.cw_mul(wx, wx), w)
    wyy = -wp.cw_div(lanes(py) + wp.cw_mul(wy, wy), w)
    wxy = -wp.cw_div(wp.cw_mul(wx, wy), w)
    return (
        zx,
        zy,
        wp.cw_mul(over, lanes(TWO * cx) - TWO * wp.cw_mul(zx, wx) - wp.cw_mul(z, wxx)),
        -wp.cw_mul(over, wp.cw_mul(zx, wy) + wp.cw_mul(zy, wx) + wp.cw_mul(z, wxy)),
        wp.cw_mul(over, lanes(TWO * cy) - TWO * wp.cw_mul(zy, wy) - wp.cw_mul(z, wyy)),
    )


@wp.func
def qbfs_derivatives(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Return derivatives x, y, xx, xy, yy of Forbes's Qbfs terms, functions of s = r^2."""
    _value, slope, second = qbfs_derivatives_by_s(numbers, offset, terms, x, y)
    along = TWO * slope
    twist = FOUR * second
    return (
        wp.cw_mul(along, x),
        wp.cw_mul(along, y),
        along + wp.cw_mul(twist, wp.cw_mul(x, x)),
        wp.cw_mul(twist, wp.cw_mul(x, y)),
        along + wp.cw_mul(twist, wp.cw_mul(y, y)),
    )


@wp.func
def toroid_derivatives(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Return derivatives x, y, xx, xy, yy of g + h(q, x), dq/dg = q^2, as in `models.shapes.freeform.Toroid`."""
    cy = numbers[offset + 1]
    xx = wp.cw_mul(x, x)
    added, added_s, added_ss = toroid_powers(numbers, offset, terms, y)
    b, _g, q, w, h, h_q = toroid_pieces(numbers, offset, added, x, y)
    g1 = wp.cw_div(cy * y, b) + TWO * wp.cw_mul(y, added_s)
    g2 = wp.cw_div(lanes(cy), wp.cw_mul(b, wp.cw_mul(b, b)))
    g2 = g2 + TWO * added_s + FOUR * wp.cw_mul(wp.cw_mul(y, y), added_ss)
    qq = wp.cw_mul(q, q)
    h_qq = wp.cw_mul(h_q, wp.cw_div(wp.cw_mul(q, xx), wp.cw_mul(w, w)) + wp.cw_div(h, w))
    cube = wp.cw_mul(w, wp.cw_mul(w, w))
    grown = wp.cw_mul(h_qq, wp.cw_mul(qq, qq)) + TWO * wp.cw_mul(h_q, wp.cw_mul(q, qq))
    return (
        wp.cw_div(wp.cw_mul(q, x), w),
        wp.cw_mul(g1, lanes(ONE) + wp.cw_mul(h_q, qq)),
        wp.cw_div(q, cube),
        wp.cw_mul(wp.cw_div(x, cube), wp.cw_mul(qq, g1)),
        wp.cw_mul(g2, lanes(ONE) + wp.cw_mul(h_q, qq)) + wp.cw_mul(wp.cw_mul(g1, g1), grown),
    )


@wp.func
def grid_derivatives(
    numbers: wp.array(dtype=wp.float64), offset: wp.int32, nx: wp.int32, ny: wp.int32, x: lanes, y: lanes
):
    """Return derivatives x, y, xx, xy, yy of a bicubic grid; beyond it its outermost cells are extrapolated."""
    rate_x = numbers[offset + 2]
    rate_y = numbers[offset + 3]
    px = rate_x * (x - lanes(numbers[offset]))
    py = rate_y * (y - lanes(numbers[offset + 1]))
    zx = lanes(ZERO)
    zy = lanes(ZERO)
    zxx = lanes(ZERO)
    zxy = lanes(ZERO)
    zyy = lanes(ZERO)
    # A loop that the compiler does not unroll: the nodes are fetched lane by lane.
    for i in range(LANES + 0 * nx):
        column = grid_cell(px[i], nx)
        row = grid_cell(py[i], ny)
        low = offset + GRID_HEAD + 4 * (row * nx + column)
        t = px[i] - wp.float64(column)
        r = py[i] - wp.float64(row)
        tu, ts, te = hermite_weights(t, ONE)
        dtu, dts, dte = hermite_slopes(t, ONE)
        ddtu, ddts, ddte = hermite_curvatures(t, ONE)
        ru, rs, re = hermite_weights(r, ONE)
        dru, drs, dre = hermite_slopes(r, ONE)
        ddru, ddrs, ddre = hermite_curvatures(r, ONE)
        for side in range(2):
            at = low + 4 * nx * side
            # Weights along y, of the value and of the slope at this side, and their derivatives.
            wu = ru
            ws = re
            du = dru
            ds = dre
            ddu = ddru
            dds = ddre
            if side == 0:
                wu = ONE - ru
                ws = rs
                du = -dru
                ds = drs
                ddu = -ddru
                dds = ddrs
            f = cubic(numbers, at, tu, ts, te)
            g = cubic(numbers, at + 2, tu, ts, te)
            fx = cubic_change(numbers, at, dtu, dts, dte)
            gx = cubic_change(numbers, at + 2, dtu, dts, dte)
            fxx = cubic_change(numbers, at, ddtu, ddts, ddte)
            gxx = cubic_change(numbers, at + 2, ddtu, ddts, ddte)
            zx[i] = zx[i] + rate_x * (wu * fx + ws * gx)
            zy[i] = zy[i] + rate_y * (du * f + ds * g)
            zxx[i] = zxx[i] + rate_x * rate_x * (wu * fxx + ws * gxx)
            zxy[i] = zxy[i] + rate_x * rate_y * (du * fx + ds * gx)
            zyy[i] = zyy[i] + rate_y * rate_y * (ddu * f + dds * g)
    return zx, zy, zxx, zxy, zyy


@wp.func
def added_derivatives(deformations: PackedDeformations, s: wp.int32, x: lanes, y: lanes):
    """Sum of the parts of surface ``s``: their slopes along x and y, and second derivatives xx, xy, yy [1/m]."""
    zx = lanes(ZERO)
    zy = lanes(ZERO)
    zxx = lanes(ZERO)
    zxy = lanes(ZERO)
    zyy = lanes(ZERO)
    for row in range(deformations.span[s, 0], deformations.span[s, 1]):
        kind = deformations.parts[row, 0]
        offset = deformations.parts[row, 1]
        n = deformations.parts[row, 2]
        m = deformations.parts[row, 3]
        a = lanes(ZERO)
        b = lanes(ZERO)
        c = lanes(ZERO)
        d = lanes(ZERO)
        e = lanes(ZERO)
        if kind == POLAR:
            a, b, c, d, e = polar_derivatives(deformations.numbers, offset, n, m, x, y)
        elif kind == ODD:
            a, b, c, d, e = odd_derivatives(deformations.numbers, offset, n, x, y)
        elif kind == BICONIC:
            a, b, c, d, e = biconic_derivatives(deformations.numbers, offset, x, y)
        elif kind == TOROID:
            a, b, c, d, e = toroid_derivatives(deformations.numbers, offset, n, x, y)
        elif kind == QBFS:
            a, b, c, d, e = qbfs_derivatives(deformations.numbers, offset, n, x, y)
        elif kind == GRID:
            a, b, c, d, e = grid_derivatives(deformations.numbers, offset, n, m, x, y)
        zx = zx + a
        zy = zy + b
        zxx = zxx + c
        zxy = zxy + d
        zyy = zyy + e
    return zx, zy, zxx, zxy, zyy
