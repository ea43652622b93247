"""Sags beyond conics with even powers of the radius: polynomials, odd powers, biconics, toroids, grids.

Each surface has a list of parts whose sags add up, in the frame of the surface. The formulas are those of
`models.shapes`, here for packets of rays.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...models.shapes import bicubic
from .packet import LANES, lanes, lanes_sqrt
from .surface import FAR, NEWTON_LIMIT, ONE, ZERO, polynomial

wp.set_module_options(FORWARD_OPTIONS)

#: Lanes for which a polynomial is evaluated at a time.
BLOCK = 16
block = wp.types.vector(BLOCK, wp.float64)

#: Newton's method stops for a lane when its step [m] is below this. The slopes of the last evaluation then hold at the
#: intersection, and the step is above the rounding of distances of tens of metres.
DEFORMATION_STEP = wp.constant(wp.float64(2.0e-13))

NAN = wp.constant(wp.float64(float("nan")))

hermite_weights = wp.func(bicubic.hermite)
hermite_slopes = wp.func(bicubic.hermite_slope)

# Kinds of parts; in brackets the whole numbers beside the kind, then the numbers.
POLAR = wp.constant(0)  #: (offset, degree, highest m): two numbers for s^k (x + iy)^m, m and k running down
ODD = wp.constant(1)  #: (offset, terms): coefficients of r^1, r^3, r^5...
BICONIC = wp.constant(2)  #: (offset): curvatures along x, y; (1 + k) c^2 along x, y
TOROID = wp.constant(3)  #: (offset, terms): curvature along x; curvature and (1 + k) c^2 along y; powers y^2, y^4...
GRID = wp.constant(4)  #: (offset, nx, ny): first node x, y; 1 / step x, y; then four numbers a node
QBFS = wp.constant(5)  #: (offset, terms): k c^2, (1 + k) c^2, 1 / norm radius^2; coefficients of Forbes's P_m
PART_COLUMNS = 4
GRID_HEAD = wp.constant(4)


@wp.struct
class PackedDeformations:
    """Departures of surfaces from conics with even powers; see :mod:`pachon.raytrace.pack.shapes`.

    ``span`` [surface, 2]: first part of the surface, and the one after its last. ``parts`` [part, 4]: kind, offset of
    its numbers, two whole numbers. ``numbers``: numbers of all parts, one after the other.
    """

    span: wp.array2d(dtype=wp.int32)
    parts: wp.array2d(dtype=wp.int32)
    numbers: wp.array(dtype=wp.float64)


@wp.func
def polar_sag(
    numbers: wp.array(dtype=wp.float64), offset: wp.int32, degree: wp.int32, order: wp.int32, x: lanes, y: lanes
):
    """Sag and slopes of Re sum_m q_m(s) z^m, z = x + iy, s = x^2 + y^2, by nested Horner schemes in z and s.

    Block by block, so that all that the schemes carry along stays in registers.
    """
    value = lanes()
    slope_x = lanes()
    slope_y = lanes()
    for block_index in range(LANES // BLOCK + 0 * degree):
        start = block_index * BLOCK
        bx = block()
        by = block()
        for i in range(BLOCK):
            bx[i] = x[start + i]
            by[i] = y[start + i]
        s = wp.cw_mul(bx, bx) + wp.cw_mul(by, by)
        # The sum f, and its derivatives by z and by s, with real and imaginary parts.
        fr = block(ZERO)
        fi = block(ZERO)
        zr = block(ZERO)
        zi = block(ZERO)
        sr = block(ZERO)
        si = block(ZERO)
        at = offset
        for i in range(order + 1):
            m = order - i
            qr = block(ZERO)
            qi = block(ZERO)
            dr = block(ZERO)
            di = block(ZERO)
            for _k in range((degree - m) // 2 + 1):
                dr = wp.cw_mul(dr, s) + qr
                di = wp.cw_mul(di, s) + qi
                qr = wp.cw_mul(qr, s) + block(numbers[at])
                qi = wp.cw_mul(qi, s) + block(numbers[at + 1])
                at += 2
            # Each line needs the value that the next one changes.
            hr = wp.cw_mul(zr, bx) - wp.cw_mul(zi, by) + fr
            zi = wp.cw_mul(zr, by) + wp.cw_mul(zi, bx) + fi
            zr = hr
            hr = wp.cw_mul(fr, bx) - wp.cw_mul(fi, by) + qr
            fi = wp.cw_mul(fr, by) + wp.cw_mul(fi, bx) + qi
            fr = hr
            hr = wp.cw_mul(sr, bx) - wp.cw_mul(si, by) + dr
            si = wp.cw_mul(sr, by) + wp.cw_mul(si, bx) + di
            sr = hr
        along = zr + wp.cw_mul(sr + sr, bx)
        across = wp.cw_mul(sr + sr, by) - zi
        for i in range(BLOCK):
            value[start + i] = fr[i]
            slope_x[start + i] = along[i]
            slope_y[start + i] = across[i]
    return value, slope_x, slope_y


@wp.func
def odd_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of a_1 r + a_3 r^3 + ...; at r = 0 the slope is zero."""
    s = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    value = lanes(ZERO)
    slope = lanes(ZERO)
    for j in range(terms):
        m = terms - 1 - j
        a = numbers[offset + m]
        value = wp.cw_mul(value, s) + lanes(a)
        slope = wp.cw_mul(slope, s) + lanes(a * wp.float64(2 * m + 1))
    r = lanes_sqrt(s)
    over = lanes()
    for i in range(LANES):
        over[i] = wp.where(r[i] > ZERO, slope[i] / r[i], ZERO)
    return wp.cw_mul(value, r), wp.cw_mul(over, x), wp.cw_mul(over, y)


@wp.func
def biconic_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of u / (1 + w), u = cx x^2 + cy y^2, w = sqrt(1 - px x^2 - py y^2); NaN beyond it."""
    cx = numbers[offset]
    cy = numbers[offset + 1]
    px = numbers[offset + 2]
    py = numbers[offset + 3]
    xx = wp.cw_mul(x, x)
    yy = wp.cw_mul(y, y)
    w = lanes_sqrt(lanes(ONE) - px * xx - py * yy)
    value = wp.cw_div(cx * xx + cy * yy, lanes(ONE) + w)
    # From z = u / (1 + w): dz = (du - z dw) / (1 + w), dw = -(px x dx + py y dy) / w.
    ratio = wp.cw_div(value, w)
    over = wp.cw_div(lanes(ONE), lanes(ONE) + w)
    two = wp.float64(2.0)
    return (
        value,
        wp.cw_mul(wp.cw_mul(lanes(two * cx) + px * ratio, over), x),
        wp.cw_mul(wp.cw_mul(lanes(two * cy) + py * ratio, over), y),
    )


@wp.func
def toroid_powers(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, y: lanes):
    """Sum of a_1 y^2 + a_2 y^4 + ..., and its derivative and second derivative by s = y^2."""
    s = wp.cw_mul(y, y)
    value = lanes(ZERO)
    slope = lanes(ZERO)
    second = lanes(ZERO)
    for j in range(terms):
        second = wp.cw_mul(second, s) + wp.float64(2.0) * slope
        slope = wp.cw_mul(slope, s) + value
        value = wp.cw_mul(value, s) + lanes(numbers[offset + 2 + terms - j])
    # One power of s more.
    return wp.cw_mul(value, s), wp.cw_mul(slope, s) + value, wp.cw_mul(second, s) + wp.float64(2.0) * slope


@wp.func
def toroid_pieces(numbers: wp.array(dtype=wp.float64), offset: wp.int32, added: lanes, x: lanes, y: lanes):
    """Root b of the conic in y, sag g of the curve, q, the root w, h = q x^2 / (1 + w), and dh/dq."""
    cx = numbers[offset]
    cy = numbers[offset + 1]
    py = numbers[offset + 2]
    yy = wp.cw_mul(y, y)
    xx = wp.cw_mul(x, x)
    b = lanes_sqrt(lanes(ONE) - py * yy)
    g = wp.cw_div(cy * yy, lanes(ONE) + b) + added
    q = wp.cw_div(lanes(cx), lanes(ONE) - cx * g)
    w = lanes_sqrt(lanes(ONE) - wp.cw_mul(wp.cw_mul(q, q), xx))
    h = wp.cw_div(wp.cw_mul(q, xx), lanes(ONE) + w)
    h_q = wp.cw_div(wp.float64(0.5) * (xx + wp.cw_mul(h, h)), w)
    return b, g, q, w, h, h_q


@wp.func
def toroid_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of g + q x^2 / (1 + w), q = cx / (1 - cx g), w = sqrt(1 - q^2 x^2); g(y) a conic and powers."""
    added, added_s, _ = toroid_powers(numbers, offset, terms, y)
    b, g, q, w, h, h_q = toroid_pieces(numbers, offset, added, x, y)
    along = wp.cw_div(numbers[offset + 1] * y, b) + wp.float64(2.0) * wp.cw_mul(y, added_s)
    slope_y = wp.cw_mul(along, lanes(ONE) + wp.cw_mul(h_q, wp.cw_mul(q, q)))
    return g + h, wp.cw_div(wp.cw_mul(q, x), w), slope_y


@wp.func
def qbfs_derivatives_by_s(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Sag of Forbes's Qbfs terms and its two derivatives by s = r^2, as in `models.shapes.qbfs`."""
    along = numbers[offset]
    beneath = numbers[offset + 1]
    scale = numbers[offset + 2]
    two = wp.float64(2.0)
    s = wp.cw_mul(x, x) + wp.cw_mul(y, y)
    t = scale * s
    factor = lanes(two) - wp.float64(4.0) * t
    p = lanes(ZERO)
    p1 = lanes(ZERO)
    p2 = lanes(ZERO)
    r = lanes(ZERO)
    r1 = lanes(ZERO)
    r2 = lanes(ZERO)
    for j in range(terms):
        b = numbers[offset + 2 + terms - j]
        next0 = lanes(b) + wp.cw_mul(factor, p) - r
        next1 = wp.cw_mul(factor, p1) - wp.float64(4.0) * p - r1
        next2 = wp.cw_mul(factor, p2) - wp.float64(8.0) * p1 - r2
        r = p
        r1 = p1
        r2 = p2
        p = next0
        p1 = next1
        p2 = next2
    p = two * (p + r)
    p1 = two * (p1 + r1)
    p2 = two * (p2 + r2)
    bump = wp.cw_mul(t, lanes(ONE) - t)
    bump1 = lanes(ONE) - two * t
    value = wp.cw_mul(bump, p)
    slope = scale * (wp.cw_mul(bump, p1) + wp.cw_mul(bump1, p))
    second = (scale * scale) * (wp.cw_mul(bump, p2) + two * wp.cw_mul(bump1, p1) - two * p)
    top = lanes(ONE) - along * s
    bottom = lanes(ONE) - beneath * s
    secant = lanes_sqrt(wp.cw_div(top, bottom))
    la = wp.cw_div(lanes(along), top)
    lb = wp.cw_div(lanes(beneath), bottom)
    log1 = wp.float64(0.5) * (lb - la)
    log2 = wp.float64(0.5) * (wp.cw_mul(lb, lb) - wp.cw_mul(la, la))
    return (
        wp.cw_mul(secant, value),
        wp.cw_mul(secant, slope + wp.cw_mul(value, log1)),
        wp.cw_mul(secant, second + two * wp.cw_mul(slope, log1) + wp.cw_mul(value, wp.cw_mul(log1, log1) + log2)),
    )


@wp.func
def qbfs_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, terms: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of Forbes's Qbfs terms."""
    value, slope, _ = qbfs_derivatives_by_s(numbers, offset, terms, x, y)
    slope = wp.float64(2.0) * slope
    return value, wp.cw_mul(slope, x), wp.cw_mul(slope, y)


@wp.func
def grid_cell(a: wp.float64, nodes: wp.int32):
    """Cell in which a place lies, in units of cells; the outermost beyond them, and the first for a NaN."""
    last = wp.float64(nodes - 1)
    return wp.clamp(wp.int32(wp.where(a > ZERO, wp.min(a, last), ZERO)), 0, nodes - 2)


@wp.func
def cubic(numbers: wp.array(dtype=wp.float64), at: wp.int32, up: wp.float64, start: wp.float64, end: wp.float64):
    """Cubic along x between a node and the next, given the weights at a place of the cell."""
    return numbers[at] + up * (numbers[at + 4] - numbers[at]) + start * numbers[at + 1] + end * numbers[at + 5]


@wp.func
def cubic_change(numbers: wp.array(dtype=wp.float64), at: wp.int32, up: wp.float64, start: wp.float64, end: wp.float64):
    """Slope or second derivative of the cubic, given those of the weights."""
    return up * (numbers[at + 4] - numbers[at]) + start * numbers[at + 1] + end * numbers[at + 5]


@wp.func
def grid_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, nx: wp.int32, ny: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of a bicubic grid; beyond it its outermost cells are extrapolated, and the lane is flagged."""
    rate_x = numbers[offset + 2]
    rate_y = numbers[offset + 3]
    px = rate_x * (x - lanes(numbers[offset]))
    py = rate_y * (y - lanes(numbers[offset + 1]))
    value = lanes(ZERO)
    slope_x = lanes(ZERO)
    slope_y = lanes(ZERO)
    outside = lanes(ZERO)
    # A loop that the compiler does not unroll: the nodes are fetched lane by lane.
    for i in range(LANES + 0 * nx):
        a = px[i]
        b = py[i]
        if a >= ZERO and a <= wp.float64(nx - 1) and b >= ZERO and b <= wp.float64(ny - 1):
            outside[i] = ZERO
        else:
            outside[i] = ONE
        column = grid_cell(a, nx)
        row = grid_cell(b, ny)
        low = offset + GRID_HEAD + 4 * (row * nx + column)
        high = low + 4 * nx
        tu, ts, te = hermite_weights(a - wp.float64(column), ONE)
        dtu, dts, dte = hermite_slopes(a - wp.float64(column), ONE)
        ru, rs, re = hermite_weights(b - wp.float64(row), ONE)
        dru, drs, dre = hermite_slopes(b - wp.float64(row), ONE)
        # At the lower and upper side of the cell: the sag, its slope along x, and the same of its slope along y.
        f0 = cubic(numbers, low, tu, ts, te)
        f1 = cubic(numbers, high, tu, ts, te)
        g0 = cubic(numbers, low + 2, tu, ts, te)
        g1 = cubic(numbers, high + 2, tu, ts, te)
        fx0 = cubic_change(numbers, low, dtu, dts, dte)
        fx1 = cubic_change(numbers, high, dtu, dts, dte)
        gx0 = cubic_change(numbers, low + 2, dtu, dts, dte)
        gx1 = cubic_change(numbers, high + 2, dtu, dts, dte)
        value[i] = f0 + ru * (f1 - f0) + rs * g0 + re * g1
        slope_x[i] = rate_x * (fx0 + ru * (fx1 - fx0) + rs * gx0 + re * gx1)
        slope_y[i] = rate_y * (dru * (f1 - f0) + drs * g0 + dre * g1)
    return value, slope_x, slope_y, outside


@wp.func
def added_sag(deformations: PackedDeformations, s: wp.int32, x: lanes, y: lanes):
    """Sum of the parts of surface ``s``: sag [m], slopes along x and y, and whether a lane lies beyond a grid."""
    value = lanes(ZERO)
    slope_x = lanes(ZERO)
    slope_y = lanes(ZERO)
    outside = lanes(ZERO)
    for row in range(deformations.span[s, 0], deformations.span[s, 1]):
        kind = deformations.parts[row, 0]
        offset = deformations.parts[row, 1]
        a = deformations.parts[row, 2]
        b = deformations.parts[row, 3]
        dz = lanes(ZERO)
        dx = lanes(ZERO)
        dy = lanes(ZERO)
        if kind == POLAR:
            dz, dx, dy = polar_sag(deformations.numbers, offset, a, b, x, y)
        elif kind == ODD:
            dz, dx, dy = odd_sag(deformations.numbers, offset, a, x, y)
        elif kind == BICONIC:
            dz, dx, dy = biconic_sag(deformations.numbers, offset, x, y)
        elif kind == TOROID:
            dz, dx, dy = toroid_sag(deformations.numbers, offset, a, x, y)
        elif kind == QBFS:
            dz, dx, dy = qbfs_sag(deformations.numbers, offset, a, x, y)
        elif kind == GRID:
            dz, dx, dy, beyond = grid_sag(deformations.numbers, offset, a, b, x, y)
            outside = outside + beyond
        value = value + dz
        slope_x = slope_x + dx
        slope_y = slope_y + dy
    return value, slope_x, slope_y, outside


@wp.func
def deformed_distance(
    deformations: PackedDeformations,
    c: wp.float64,
    k: wp.float64,
    coefficients: wp.array2d(dtype=wp.float64),
    s: wp.int32,
    terms: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    start: lanes,
    screen: wp.int32,
):
    """Distance to surface ``s`` with its parts by Newton's method from ``start``; to a screen, ``start`` itself.

    The implicit form is that of an asphere, with b = z - (a_4 r^4 + ...) - (the parts). Returned with the distance:
    sag and slopes of the parts at the intersection, and which lanes did not converge. Beyond a grid the distance is
    NaN.
    """
    # A ray beyond the first guess starts from the vertex plane.
    t = wp.cw_div(-z, w)
    for i in range(LANES):
        t[i] = wp.where(wp.abs(start[i]) < FAR, start[i], t[i])
    sag = lanes(ZERO)
    sag_x = lanes(ZERO)
    sag_y = lanes(ZERO)
    running = lanes(ONE)
    busy = wp.float64(1.0)
    steps = int(0)
    while busy > ZERO and steps < NEWTON_LIMIT:
        px = x + wp.cw_mul(t, u)
        py = y + wp.cw_mul(t, v)
        r2 = wp.cw_mul(px, px) + wp.cw_mul(py, py)
        outward = wp.cw_mul(px, u) + wp.cw_mul(py, v)
        value, slope_x, slope_y, outside = added_sag(deformations, s, px, py)
        b = z + wp.cw_mul(t, w) - value
        along = w - wp.cw_mul(slope_x, u) - wp.cw_mul(slope_y, v)
        if terms > 0:
            even, even_slope = polynomial(coefficients, s, terms, r2)
            b = b - even
            along = along - wp.cw_mul(even_slope, outward)
        q = lanes(ONE) - ((ONE + k) * c) * b
        g = b - (wp.float64(0.5) * c) * (r2 + (ONE + k) * wp.cw_mul(b, b))
        rate = wp.cw_mul(q, along) - c * outward
        step = wp.cw_div(g, rate)
        if screen == 1:
            # The sag of a screen is a map on its plane: intersections stay where they are.
            step = ZERO * start
        for i in range(LANES):
            # A lane that has converged stays as it is.
            on = running[i] > ZERO
            sag[i] = wp.where(on, value[i], sag[i])
            sag_x[i] = wp.where(on, slope_x[i], sag_x[i])
            sag_y[i] = wp.where(on, slope_y[i], sag_y[i])
            t[i] = wp.where(on, t[i] - step[i], t[i])
            finished = wp.where(outside[i] > ZERO, NAN, t[i])
            moving = wp.abs(step[i]) > DEFORMATION_STEP
            # A ray may pass beyond a grid on its way, but not end there. A NaN (a ray that misses) stops too.
            t[i] = wp.where(on, wp.where(moving, t[i], finished), t[i])
            running[i] = wp.where(moving, running[i], ZERO)
        busy = wp.dot(running, running)
        steps += 1
    return t, sag, sag_x, sag_y, running


@wp.func
def through_screen(n: wp.float64, slope_x: lanes, slope_y: lanes, u: lanes, v: lanes, w: lanes):
    """Directions after a phase screen, n d' = n d + grad(path) in its plane; NaN where no wave travels on."""
    return deflected(u + slope_x / n, v + slope_y / n, w)


@wp.func
def through_screen(n: lanes, slope_x: lanes, slope_y: lanes, u: lanes, v: lanes, w: lanes):  # noqa: F811
    """Directions after a phase screen of rays of different wavelengths; see above."""
    return deflected(u + wp.cw_div(slope_x, n), v + wp.cw_div(slope_y, n), w)


@wp.func
def deflected(p: lanes, q: lanes, w: lanes):
    """Directions of components p and q in a plane, on the side of w; NaN where no wave travels on."""
    root = lanes_sqrt(lanes(ONE) - wp.cw_mul(p, p) - wp.cw_mul(q, q))
    for i in range(LANES):
        root[i] = wp.where(w[i] < ZERO, -root[i], root[i])
    return p, q, root
