"""Which of two crossings of a ray with a surface is meant, by the aperture of the surface."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .aperture import through_aperture
from .packet import LANES, lanes
from .shape import NAN, deformed_distance
from .surface import FAR, OK, ONE, ZERO, aspheric_distance, polynomial, second_conic_distance
from .surface_table import (
    APERTURE,
    CONIC,
    CURVATURE,
    DEFORMED,
    FIRST_CURVATURE,
    SIGN_CHANGE,
    STOPPED,
    TERMS,
    PackedSurfaces,
)

wp.set_module_options(FORWARD_OPTIONS)

#: A ray meets a crossing farther ahead than this [m]: above the rounding of places, below any thickness.
AHEAD = wp.constant(wp.float64(1.0e-9))


@wp.func
def reaches_twice(w: lanes, limit: wp.float64):
    """Whether the direction cosine of a lane is within a limit."""
    count = wp.int32(0)
    for i in range(int(LANES)):
        count += wp.where(wp.abs(w[i]) <= limit, 1, 0)
    return count > 0


@wp.func
def landing(
    surfaces: PackedSurfaces,
    s: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    start: lanes,
):
    """Distance to surface ``s`` by the search from ``start``, and the rank of the crossing there.

    The rank is 2 within the aperture, 1 in the hole of a ring, 0 beside it, and -1 where the conic has its other sheet,
    or no crossing is.
    """
    c = surfaces.numbers[s, CURVATURE]
    k = surfaces.numbers[s, CONIC]
    terms = surfaces.kinds[s, TERMS]
    t = start
    sag = lanes(ZERO)
    if surfaces.kinds[s, DEFORMED] == 1:
        t, sag, _sag_x, _sag_y, _running = deformed_distance(
            surfaces.deformations, c, k, surfaces.coefficients, s, terms, x, y, z, u, v, w, start, 0
        )
    elif terms > 0:
        t, _running = aspheric_distance(c, k, surfaces.coefficients, s, terms, x, y, z, u, v, w, start)
    px = x + wp.cw_mul(t, u)
    py = y + wp.cw_mul(t, v)
    b = z + wp.cw_mul(t, w) - sag
    if terms > 0:
        even, _slope = polynomial(surfaces.coefficients, s, terms, wp.cw_mul(px, px) + wp.cw_mul(py, py))
        b = b - even
    ax = px - lanes(surfaces.numbers[s, APERTURE])
    ay = py - lanes(surfaces.numbers[s, APERTURE + 1])
    a2 = wp.cw_mul(ax, ax) + wp.cw_mul(ay, ay)
    inner = surfaces.numbers[s, APERTURE + 2]
    outer = surfaces.numbers[s, APERTURE + 3]
    status = lanes(OK)
    if surfaces.kinds[s, STOPPED] == 2:
        status = through_aperture(surfaces.apertures, s, px, py, status)
    rank = lanes(ZERO)
    for i in range(int(LANES)):
        within = wp.where(a2[i] < outer * outer, ONE, ZERO)
        rank[i] = within + wp.where(a2[i] >= inner * inner, within, ZERO)
        if surfaces.kinds[s, STOPPED] == 2:
            rank[i] = wp.where(status[i] == OK, wp.float64(2.0), ZERO)
        # A NaN fails the comparison.
        rank[i] = wp.where(ONE - (ONE + k) * c * b[i] > ZERO, rank[i], -ONE)
    return t, rank


@wp.func
def start_by_aperture(
    surfaces: PackedSurfaces,
    s: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    start: lanes,
):
    """Distance to that crossing of the first conic which the aperture of surface ``s`` means; NaN where none is on it.

    Of two crossings within a rim, one of them behind the ray, it is the one ahead, and about the axis without regard to
    the rim: a ray that leaves through the opening of a reflector does not come back. Else it is that of the higher
    rank; else ``start``, the one by the sign of w.
    """
    first_curvature = surfaces.numbers[s, FIRST_CURVATURE]
    second_start = second_conic_distance(
        first_curvature, surfaces.numbers[s, CONIC], surfaces.numbers[s, SIGN_CHANGE], x, y, z, u, v, w
    )
    distance, rank = landing(surfaces, s, x, y, z, u, v, w, start)
    second_distance, second_rank = landing(surfaces, s, x, y, z, u, v, w, second_start)
    centred = surfaces.kinds[s, STOPPED] == 1
    if surfaces.numbers[s, APERTURE] != ZERO or surfaces.numbers[s, APERTURE + 1] != ZERO:
        centred = False
    least = wp.where(centred, ZERO, ONE)
    t = lanes()
    for i in range(int(LANES)):
        better = wp.where(second_rank[i] > rank[i], ONE, ZERO)
        ahead = wp.where(distance[i] > AHEAD, ONE, ZERO)
        second_ahead = wp.where(second_distance[i] > AHEAD, ONE, ZERO)
        alike = wp.min(rank[i], second_rank[i]) >= least and surfaces.numbers[s, APERTURE + 3] < FAR
        better = wp.where(alike and ahead != second_ahead, second_ahead, better)
        t[i] = wp.where(better > ZERO, second_start[i], start[i])
        t[i] = wp.where(wp.max(rank[i], second_rank[i]) < ZERO, NAN, t[i])
    return t
