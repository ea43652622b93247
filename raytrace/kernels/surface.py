"""Intersection of rays with conics and even aspheres, reflection and refraction.

All in the frame of the surface (vertex at the origin, sag along z). Even asphere, conic, sphere and plane are one
family::

    sag(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a_4 r^4 + a_6 r^6 + ...

with curvature ``c = 1/R`` (0 for a plane) and conic constant ``k``.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lanes, lanes_sqrt

wp.set_module_options(FORWARD_OPTIONS)

#: Newton stops for a lane when its step [m] is below this: it converges quadratically, so with curvatures below 1/m
#: the step after it would be below 1e-15 m.
NEWTON_STEP = wp.constant(wp.float64(2.0e-8))
NEWTON_LIMIT = wp.constant(20)

#: No telescope is this large [m]: a distance beyond it, or a NaN, is a ray that missed.
FAR = wp.constant(wp.float64(1.0e9))

# Statuses are doubles within the kernels: a choice between lanes of one width stays a vector instruction.
OK = wp.constant(wp.float64(0.0))
VIGNETTED = wp.constant(wp.float64(1.0))
MISSED = wp.constant(wp.float64(2.0))
TOTAL_REFLECTION = wp.constant(wp.float64(3.0))
NOT_CONVERGED = wp.constant(wp.float64(4.0))
EVANESCENT = wp.constant(wp.float64(6.0))

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))


@wp.func
def conic_distance(
    c: wp.float64,
    k: wp.float64,
    sign_change: wp.float64,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
):
    """Distance along each ray to the conic, to its sheet at the vertex, in closed form; NaN where the ray misses.

    A t^2 - 2 B t + C = 0 with A = c (1 + k w^2), B = w - c (x u + y v + (1 + k) z w) and
    C = c (x^2 + y^2 + (1 + k) z^2) - 2 z. The normal's component along the ray, B - A t, is +r at one intersection and
    -r at the other, r = sqrt(B^2 - A C). On the vertex sheet it has the sign of w, unless the ray is so nearly
    perpendicular to the axis that both intersections are on that sheet. It is taken as -r for w below ``sign_change``,
    which is 0 or, for curved mirrors, close to it. With s = +-1 that sign, t = (B - s r) / A = C / (B + s r); of the
    two forms a lane takes the one that does not cancel (the second for all but rays that start beyond the centre of
    curvature).
    """
    a = c * (lanes(ONE) + k * wp.cw_mul(w, w))
    b = w - c * (wp.cw_mul(x, u) + wp.cw_mul(y, v) + (ONE + k) * wp.cw_mul(z, w))
    e = c * (wp.cw_mul(x, x) + wp.cw_mul(y, y) + (ONE + k) * wp.cw_mul(z, z)) - TWO * z
    r = lanes_sqrt(wp.cw_mul(b, b) - wp.cw_mul(a, e))
    for i in range(LANES):
        r[i] = wp.where(w[i] < sign_change, -r[i], r[i])
    top = lanes()
    bottom = lanes()
    for i in range(LANES):
        # Not the sign of a product with w, which is 0 for a ray perpendicular to the axis.
        same = wp.where(w[i] < sign_change, -b[i], b[i]) >= ZERO
        top[i] = wp.where(same, e[i], b[i] - r[i])
        bottom[i] = wp.where(same, b[i] + r[i], a[i])
    return wp.cw_div(top, bottom)


@wp.func
def second_conic_distance(
    c: wp.float64,
    k: wp.float64,
    sign_change: wp.float64,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
):
    """Distance along each ray to the crossing that :func:`conic_distance` does not return; NaN or infinite if none."""
    a = c * (lanes(ONE) + k * wp.cw_mul(w, w))
    b = w - c * (wp.cw_mul(x, u) + wp.cw_mul(y, v) + (ONE + k) * wp.cw_mul(z, w))
    e = c * (wp.cw_mul(x, x) + wp.cw_mul(y, y) + (ONE + k) * wp.cw_mul(z, z)) - TWO * z
    r = lanes_sqrt(wp.cw_mul(b, b) - wp.cw_mul(a, e))
    top = lanes()
    bottom = lanes()
    for i in range(int(LANES)):
        # The root of the other sign, in the form that does not cancel.
        signed = wp.where(w[i] < sign_change, r[i], -r[i])
        same = wp.where(w[i] < sign_change, b[i], -b[i]) >= ZERO
        top[i] = wp.where(same, e[i], b[i] - signed)
        bottom[i] = wp.where(same, b[i] + signed, a[i])
    return wp.cw_div(top, bottom)


@wp.func
def polynomial(coefficients: wp.array2d(dtype=wp.float64), surface: wp.int32, terms: wp.int32, r2: lanes):
    """Aspheric part of the sag, a_4 r^4 + a_6 r^6 + ... [m], and its slope divided by r [1/m]."""
    value = lanes(ZERO)
    slope = lanes(ZERO)
    for j in range(terms):
        # Horner from the highest term down: sum a_j r2^j and sum (4 + 2 j) a_j r2^j.
        m = terms - 1 - j
        a = coefficients[surface, m]
        value = wp.cw_mul(value, r2) + lanes(a)
        slope = wp.cw_mul(slope, r2) + lanes(a * wp.float64(4 + 2 * m))
    return wp.cw_mul(value, wp.cw_mul(r2, r2)), wp.cw_mul(slope, r2)


@wp.func
def aspheric_distance(
    c: wp.float64,
    k: wp.float64,
    coefficients: wp.array2d(dtype=wp.float64),
    surface: wp.int32,
    terms: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    start: lanes,
):
    """Distance to the asphere by Newton's method from ``start`` or the vertex plane, and which lanes did not converge.

    With b = z - (a_4 r^4 + ...), what is left must lie on the conic, G = c (r^2 + (1 + k) b^2) - 2 b = 0: the
    implicit form takes neither a root nor a division per evaluation.
    """
    t = wp.cw_div(-z, w)
    for i in range(LANES):
        # Where the ray misses the conic it starts from the vertex plane: the asphere may bend away from the conic.
        t[i] = wp.where(wp.abs(start[i]) < FAR, start[i], t[i])
    running = lanes(ONE)
    busy = wp.float64(1.0)
    steps = int(0)
    while busy > ZERO and steps < NEWTON_LIMIT:
        px = x + wp.cw_mul(t, u)
        py = y + wp.cw_mul(t, v)
        r2 = wp.cw_mul(px, px) + wp.cw_mul(py, py)
        outward = wp.cw_mul(px, u) + wp.cw_mul(py, v)
        value, slope = polynomial(coefficients, surface, terms, r2)
        b = z + wp.cw_mul(t, w) - value
        q = lanes(ONE) - ((ONE + k) * c) * b
        # G / 2 and its derivative along the ray, both with the opposite sign.
        g = b - (wp.float64(0.5) * c) * (r2 + (ONE + k) * wp.cw_mul(b, b))
        rate = wp.cw_mul(q, w - wp.cw_mul(slope, outward)) - c * outward
        step = wp.cw_div(g, rate)
        for i in range(LANES):
            # A lane that has converged stays as it is.
            t[i] = wp.where(running[i] > ZERO, t[i] - step[i], t[i])
            # Written so that a NaN (a ray that misses) stops too.
            running[i] = wp.where(wp.abs(step[i]) > NEWTON_STEP, running[i], ZERO)
        busy = wp.dot(running, running)
        steps += 1
    return t, running


@wp.func
def reflected(u: lanes, v: lanes, w: lanes, nx: lanes, ny: lanes, nz: lanes):
    """Directions after a mirror: d - 2 (d.N) N / (N.N), for normals of any length."""
    along = wp.cw_mul(u, nx) + wp.cw_mul(v, ny) + wp.cw_mul(w, nz)
    square = wp.cw_mul(nx, nx) + wp.cw_mul(ny, ny) + wp.cw_mul(nz, nz)
    twice = wp.cw_div(TWO * along, square)
    return u - wp.cw_mul(twice, nx), v - wp.cw_mul(twice, ny), w - wp.cw_mul(twice, nz)


@wp.func
def refracted(mu: wp.float64, u: lanes, v: lanes, w: lanes, nx: lanes, ny: lanes, nz: lanes):
    """Directions after refraction, mu = n_before / n_after, for normals N of any length; NaN if totally reflected.

    Snell's law in vectors, d' = mu d + g N with g = (+-sqrt((1 - mu^2) N.N + mu^2 (d.N)^2) - mu d.N) / N.N, the sign
    that of d.N.
    """
    along = wp.cw_mul(u, nx) + wp.cw_mul(v, ny) + wp.cw_mul(w, nz)
    square = wp.cw_mul(nx, nx) + wp.cw_mul(ny, ny) + wp.cw_mul(nz, nz)
    root = lanes_sqrt((ONE - mu * mu) * square + (mu * mu) * wp.cw_mul(along, along))
    for i in range(LANES):
        root[i] = wp.where(along[i] < ZERO, -root[i], root[i])
    g = wp.cw_div(root - mu * along, square)
    return mu * u + wp.cw_mul(g, nx), mu * v + wp.cw_mul(g, ny), mu * w + wp.cw_mul(g, nz)


@wp.func
def refracted(mu: lanes, u: lanes, v: lanes, w: lanes, nx: lanes, ny: lanes, nz: lanes):  # noqa: F811 - an overload
    """Directions after refraction of rays of different wavelengths; see above."""
    along = wp.cw_mul(u, nx) + wp.cw_mul(v, ny) + wp.cw_mul(w, nz)
    square = wp.cw_mul(nx, nx) + wp.cw_mul(ny, ny) + wp.cw_mul(nz, nz)
    mu2 = wp.cw_mul(mu, mu)
    root = lanes_sqrt(wp.cw_mul(lanes(ONE) - mu2, square) + wp.cw_mul(mu2, wp.cw_mul(along, along)))
    for i in range(LANES):
        root[i] = wp.where(along[i] < ZERO, -root[i], root[i])
    g = wp.cw_div(root - wp.cw_mul(mu, along), square)
    return (
        wp.cw_mul(mu, u) + wp.cw_mul(g, nx),
        wp.cw_mul(mu, v) + wp.cw_mul(g, ny),
        wp.cw_mul(mu, w) + wp.cw_mul(g, nz),
    )


@wp.func
def diffracted(
    mu: lanes,
    sense: wp.float64,
    p: lanes,
    q: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    nx: lanes,
    ny: lanes,
    nz: lanes,
):
    """Directions behind grooves, for normals N of any length; NaN where the order is evanescent.

    d' = e + g N with e = mu d + (p, q, 0), the gradient of the added path over the index behind, and
    g = (+-sqrt((e.N)^2 + (1 - e.e) N.N) - e.N) / N.N, the sign that of d.N times ``sense``: 1 for lenses, -1 for
    mirrors.
    """
    a = wp.cw_mul(mu, u) + p
    b = wp.cw_mul(mu, v) + q
    c = wp.cw_mul(mu, w)
    along = wp.cw_mul(a, nx) + wp.cw_mul(b, ny) + wp.cw_mul(c, nz)
    square = wp.cw_mul(nx, nx) + wp.cw_mul(ny, ny) + wp.cw_mul(nz, nz)
    size = wp.cw_mul(a, a) + wp.cw_mul(b, b) + wp.cw_mul(c, c)
    side = wp.cw_mul(u, nx) + wp.cw_mul(v, ny) + wp.cw_mul(w, nz)
    root = lanes_sqrt(wp.cw_mul(along, along) + wp.cw_mul(lanes(ONE) - size, square))
    for i in range(LANES):
        root[i] = wp.where(sense * side[i] < ZERO, -root[i], root[i])
    g = wp.cw_div(root - along, square)
    return a + wp.cw_mul(g, nx), b + wp.cw_mul(g, ny), c + wp.cw_mul(g, nz)
