"""What the surface of a shape has beyond a conic with even powers of the radius: polynomials, toroids, grids, sums.

Each surface has a list of parts whose sags add up. The formulas are those of `models.shape_freeform`,
`models.shape_grid` and `models.polar_polynomial`, here for packets of rays in the frame of the surface.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lanes, lanes_sqrt
from .surface import FAR, NEWTON_LIMIT, ONE, ZERO, polynomial

wp.set_module_options(FORWARD_OPTIONS)

#: Lanes that a polynomial is worked out for at a time.
BLOCK = 16
block = wp.types.vector(BLOCK, wp.float64)

#: Newton stops for a lane when its step [m] is below this. The slopes of the last evaluation then hold where the ray
#: lands, and the step is above what rounding leaves of distances of tens of metres.
DEFORMATION_STEP = wp.constant(wp.float64(2.0e-13))

NAN = wp.constant(wp.float64(float("nan")))

# Kinds of parts; in brackets the four whole numbers beside the kind, and the figures.
POLAR = wp.constant(0)  #: (offset, degree, highest m): two numbers for s^k (x + iy)^m, m and k running down
ODD = wp.constant(1)  #: (offset, terms): coefficients of r^1, r^3, r^5...
BICONIC = wp.constant(2)  #: (offset): curvatures along x, y; (1 + k) c^2 along x, y
TOROID = wp.constant(3)  #: (offset): curvature along x; curvature and (1 + k) c^2 along y
GRID = wp.constant(4)  #: (offset, nx, ny): first node x, y; 1 / step x, y; then four numbers a node
PART_COLUMNS = 4
GRID_HEAD = wp.constant(4)


@wp.struct
class PackedDeformations:
    """The figures of a telescope's surfaces; see :mod:`pachon.raytrace.pack.shapes`.

    ``span`` [surface, 2]: first part of the surface, and the one after its last. ``parts`` [part, 4]: kind, and what
    the kinds above say. ``numbers``: figures of all parts, one after the other.
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
    for part in range(LANES // BLOCK + 0 * degree):
        start = part * BLOCK
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
            # Each line needs what the next one changes.
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
    turn = wp.cw_div(value, w)
    over = wp.cw_div(lanes(ONE), lanes(ONE) + w)
    two = wp.float64(2.0)
    return (
        value,
        wp.cw_mul(wp.cw_mul(lanes(two * cx) + px * turn, over), x),
        wp.cw_mul(wp.cw_mul(lanes(two * cy) + py * turn, over), y),
    )


@wp.func
def toroid_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of g + q x^2 / (1 + w), g(y) a conic, q = cx / (1 - cx g), w = sqrt(1 - q^2 x^2)."""
    cx = numbers[offset]
    cy = numbers[offset + 1]
    py = numbers[offset + 2]
    yy = wp.cw_mul(y, y)
    xx = wp.cw_mul(x, x)
    b = lanes_sqrt(lanes(ONE) - py * yy)
    g = wp.cw_div(cy * yy, lanes(ONE) + b)
    q = wp.cw_div(lanes(cx), lanes(ONE) - cx * g)
    qq = wp.cw_mul(q, q)
    w = lanes_sqrt(lanes(ONE) - wp.cw_mul(qq, xx))
    h = wp.cw_div(wp.cw_mul(q, xx), lanes(ONE) + w)
    h_q = wp.cw_div(wp.float64(0.5) * (xx + wp.cw_mul(h, h)), w)
    slope_y = wp.cw_mul(wp.cw_div(cy * y, b), lanes(ONE) + wp.cw_mul(h_q, qq))
    return g + h, wp.cw_div(wp.cw_mul(q, x), w), slope_y


@wp.func
def grid_sag(numbers: wp.array(dtype=wp.float64), offset: wp.int32, nx: wp.int32, ny: wp.int32, x: lanes, y: lanes):
    """Sag and slopes of a bicubic grid; beyond the grid its outermost cells go on, and the lane is flagged."""
    rate_x = numbers[offset + 2]
    rate_y = numbers[offset + 3]
    px = rate_x * (x - lanes(numbers[offset]))
    py = rate_y * (y - lanes(numbers[offset + 1]))
    value = lanes(ZERO)
    slope_x = lanes(ZERO)
    slope_y = lanes(ZERO)
    outside = lanes(ZERO)
    three = wp.float64(3.0)
    six = wp.float64(6.0)
    two = wp.float64(2.0)
    last_x = wp.float64(nx - 1)
    last_y = wp.float64(ny - 1)
    # A loop that the compiler does not unroll: the nodes are fetched lane by lane.
    for i in range(LANES + 0 * nx):
        a = px[i]
        b = py[i]
        if a >= ZERO and a <= last_x and b >= ZERO and b <= last_y:
            outside[i] = ZERO
        else:
            outside[i] = ONE
        # A NaN becomes the first cell, and stays a NaN.
        column = wp.clamp(wp.int32(wp.where(a > ZERO, wp.min(a, last_x), ZERO)), 0, nx - 2)
        row = wp.clamp(wp.int32(wp.where(b > ZERO, wp.min(b, last_y), ZERO)), 0, ny - 2)
        t = a - wp.float64(column)
        r = b - wp.float64(row)
        low = offset + GRID_HEAD + 4 * (row * nx + column)
        high = low + 4 * nx
        # Cubic Hermite weights: of the value (1 at the far end) and of the slopes at both ends, and their derivatives.
        tu = t * t * (three - two * t)
        ts = t * (ONE - t) * (ONE - t)
        te = t * t * (t - ONE)
        ru = r * r * (three - two * r)
        rs = r * (ONE - r) * (ONE - r)
        re = r * r * (r - ONE)
        dtu = six * t * (ONE - t)
        dts = (ONE - t) * (ONE - three * t)
        dte = t * (three * t - two)
        dru = six * r * (ONE - r)
        drs = (ONE - r) * (ONE - three * r)
        dre = r * (three * r - two)
        # At the lower and upper side of the cell: the sag, its slope along x, and the same of its slope along y.
        z0 = numbers[low]
        z1 = numbers[high]
        m0 = numbers[low + 2]
        m1 = numbers[high + 2]
        dz0 = numbers[low + 4] - z0
        dz1 = numbers[high + 4] - z1
        dm0 = numbers[low + 6] - m0
        dm1 = numbers[high + 6] - m1
        f0 = z0 + tu * dz0 + ts * numbers[low + 1] + te * numbers[low + 5]
        f1 = z1 + tu * dz1 + ts * numbers[high + 1] + te * numbers[high + 5]
        g0 = m0 + tu * dm0 + ts * numbers[low + 3] + te * numbers[low + 7]
        g1 = m1 + tu * dm1 + ts * numbers[high + 3] + te * numbers[high + 7]
        fx0 = dtu * dz0 + dts * numbers[low + 1] + dte * numbers[low + 5]
        fx1 = dtu * dz1 + dts * numbers[high + 1] + dte * numbers[high + 5]
        gx0 = dtu * dm0 + dts * numbers[low + 3] + dte * numbers[low + 7]
        gx1 = dtu * dm1 + dts * numbers[high + 3] + dte * numbers[high + 7]
        value[i] = f0 + ru * (f1 - f0) + rs * g0 + re * g1
        slope_x[i] = rate_x * (fx0 + ru * (fx1 - fx0) + rs * gx0 + re * gx1)
        slope_y[i] = rate_y * (dru * (f1 - f0) + drs * g0 + dre * g1)
    return value, slope_x, slope_y, outside


@wp.func
def extra_sag(deformations: PackedDeformations, s: wp.int32, x: lanes, y: lanes):
    """Sum of the parts of surface ``s``: sag [m], slopes along x and y, and whether a lane lies beyond a grid."""
    value = lanes(ZERO)
    slope_x = lanes(ZERO)
    slope_y = lanes(ZERO)
    outside = lanes(ZERO)
    for part in range(deformations.span[s, 0], deformations.span[s, 1]):
        kind = deformations.parts[part, 0]
        offset = deformations.parts[part, 1]
        a = deformations.parts[part, 2]
        b = deformations.parts[part, 3]
        if kind == POLAR:
            dz, dx, dy = polar_sag(deformations.numbers, offset, a, b, x, y)
            value = value + dz
            slope_x = slope_x + dx
            slope_y = slope_y + dy
        elif kind == ODD:
            dz, dx, dy = odd_sag(deformations.numbers, offset, a, x, y)
            value = value + dz
            slope_x = slope_x + dx
            slope_y = slope_y + dy
        elif kind == BICONIC:
            dz, dx, dy = biconic_sag(deformations.numbers, offset, x, y)
            value = value + dz
            slope_x = slope_x + dx
            slope_y = slope_y + dy
        elif kind == TOROID:
            dz, dx, dy = toroid_sag(deformations.numbers, offset, x, y)
            value = value + dz
            slope_x = slope_x + dx
            slope_y = slope_y + dy
        elif kind == GRID:
            dz, dx, dy, beyond = grid_sag(deformations.numbers, offset, a, b, x, y)
            value = value + dz
            slope_x = slope_x + dx
            slope_y = slope_y + dy
            outside = outside + beyond
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
    """Distance to surface ``s`` with its figure by Newton's method from ``start``, for a screen that distance itself.

    The implicit form is that of an asphere, with b = z - (a_4 r^4 + ...) - (the parts). Returned beside the distance:
    sag and slopes of the parts where the ray lands, and which lanes did not converge. Beyond a grid the distance is a
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
        value, slope_x, slope_y, outside = extra_sag(deformations, s, px, py)
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
            # The figure is a map on the plane, and moves no landing.
            step = ZERO * start
        for i in range(LANES):
            # A lane that has converged stays as it is, whatever its neighbours still need.
            on = running[i] > ZERO
            sag[i] = wp.where(on, value[i], sag[i])
            sag_x[i] = wp.where(on, slope_x[i], sag_x[i])
            sag_y[i] = wp.where(on, slope_y[i], sag_y[i])
            t[i] = wp.where(on, t[i] - step[i], t[i])
            finished = wp.where(outside[i] > ZERO, NAN, t[i])
            more = wp.abs(step[i]) > DEFORMATION_STEP
            # A ray may pass beyond a grid on its way, but not end there. A NaN (a ray that misses) stops too.
            t[i] = wp.where(on, wp.where(more, t[i], finished), t[i])
            running[i] = wp.where(more, running[i], ZERO)
        busy = wp.dot(running, running)
        steps += 1
    return t, sag, sag_x, sag_y, running


@wp.func
def through_screen(n: wp.float64, slope_x: lanes, slope_y: lanes, u: lanes, v: lanes, w: lanes):
    """Directions after a phase screen, n d' = n d + grad(path) in its plane; NaN where no wave travels on."""
    p = u + slope_x / n
    q = v + slope_y / n
    root = lanes_sqrt(lanes(ONE) - wp.cw_mul(p, p) - wp.cw_mul(q, q))
    for i in range(LANES):
        root[i] = wp.where(w[i] < ZERO, -root[i], root[i])
    return p, q, root
