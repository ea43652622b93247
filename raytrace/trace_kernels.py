"""The kernels that carry packets of rays through a whole telescope."""

from __future__ import annotations

import warp as wp

from .launch import FORWARD_OPTIONS
from .packet import LANES, lane_flags, lanes
from .surface_kernels import (
    MISSED,
    NOT_CONVERGED,
    OK,
    ONE,
    TOTAL_REFLECTION,
    VIGNETTED,
    ZERO,
    aspheric_distance,
    conic_distance,
    polynomial,
    reflected,
    refracted,
)

wp.set_module_options(FORWARD_OPTIONS)

#: No telescope is this large [m]: a distance beyond it, or a NaN, is a ray that missed.
FAR = wp.constant(wp.float64(1.0e9))
MIRROR = wp.constant(0)
REFRACT = wp.constant(1)


# Columns of the table of numbers, a row per surface: curvature [1/m], conic constant, vertex [m] (3), rotation (9,
# row by row), clear aperture: centre x, y, inner and outer radius [m].
CURVATURE = wp.constant(0)
CONIC = wp.constant(1)
VERTEX = wp.constant(2)
ROTATION = wp.constant(5)
APERTURE = wp.constant(14)
NUMBERS = 18
# Columns of the table of kinds: interaction, number of aspheric coefficients, whether rotated, whether stopped down.
INTERACTION = wp.constant(0)
TERMS = wp.constant(1)
ROTATED = wp.constant(2)
STOPPED = wp.constant(3)
KINDS = 4


@wp.struct
class PackedSurfaces:
    """A telescope as three tables, a row per surface; see :mod:`pachon.raytrace.packed`."""

    numbers: wp.array2d(dtype=wp.float64)
    kinds: wp.array2d(dtype=wp.int32)
    coefficients: wp.array2d(dtype=wp.float64)


@wp.func
def to_local(surfaces: PackedSurfaces, s: wp.int32, x: lanes, y: lanes, z: lanes):
    """Components along the axes of surface ``s``, the columns of its rotation, of vectors of the telescope frame."""
    return (
        surfaces.numbers[s, ROTATION] * x
        + surfaces.numbers[s, ROTATION + 3] * y
        + surfaces.numbers[s, ROTATION + 6] * z,
        surfaces.numbers[s, ROTATION + 1] * x
        + surfaces.numbers[s, ROTATION + 4] * y
        + surfaces.numbers[s, ROTATION + 7] * z,
        surfaces.numbers[s, ROTATION + 2] * x
        + surfaces.numbers[s, ROTATION + 5] * y
        + surfaces.numbers[s, ROTATION + 8] * z,
    )


@wp.func
def to_telescope(surfaces: PackedSurfaces, s: wp.int32, x: lanes, y: lanes, z: lanes):
    """Components in the telescope frame of vectors along the axes of surface ``s``."""
    return (
        surfaces.numbers[s, ROTATION] * x
        + surfaces.numbers[s, ROTATION + 1] * y
        + surfaces.numbers[s, ROTATION + 2] * z,
        surfaces.numbers[s, ROTATION + 3] * x
        + surfaces.numbers[s, ROTATION + 4] * y
        + surfaces.numbers[s, ROTATION + 5] * z,
        surfaces.numbers[s, ROTATION + 6] * x
        + surfaces.numbers[s, ROTATION + 7] * y
        + surfaces.numbers[s, ROTATION + 8] * z,
    )


@wp.func
def statuses(status: lanes):
    """Statuses as integers."""
    out = lane_flags()
    for i in range(LANES):
        out[i] = wp.int32(status[i])
    return out


@wp.func
def through_telescope(
    surfaces: PackedSurfaces,
    indices: wp.array2d(dtype=wp.float64),
    row: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    path: lanes,
    packet: wp.int32,
    position_out: wp.array3d(dtype=lanes),
    direction_out: wp.array3d(dtype=lanes),
    path_out: wp.array2d(dtype=lanes),
    status_out: wp.array2d(dtype=lane_flags),
):
    """Carry a packet through every surface, and write it after the last ones, as many as the outputs have room for.

    Positions and directions are in the telescope frame. The body of the loop stands here in line: as a function of
    its own it would hand a dozen vectors to and fro through memory, and the trace would take a third longer.
    """
    status = lanes(OK)
    n_surfaces = surfaces.kinds.shape[0]
    skipped = n_surfaces - position_out.shape[0]
    for s in range(n_surfaces):
        before = indices[row, s]
        after = indices[row, s + 1]
        x = x - lanes(surfaces.numbers[s, VERTEX])
        y = y - lanes(surfaces.numbers[s, VERTEX + 1])
        z = z - lanes(surfaces.numbers[s, VERTEX + 2])
        turned = surfaces.kinds[s, ROTATED]
        if turned == 1:
            x, y, z = to_local(surfaces, s, x, y, z)
            u, v, w = to_local(surfaces, s, u, v, w)

        c = surfaces.numbers[s, CURVATURE]
        k = surfaces.numbers[s, CONIC]
        terms = surfaces.kinds[s, TERMS]
        t = conic_distance(c, k, x, y, z, u, v, w)
        if terms > 0:
            t, running = aspheric_distance(c, k, surfaces.coefficients, s, terms, x, y, z, u, v, w, t)
            for i in range(LANES):
                status[i] = wp.where(running[i] > ZERO, NOT_CONVERGED, status[i])
        for i in range(LANES):
            # A NaN fails every comparison; wp.isfinite would be a call per lane and stop the compiler's vectors.
            status[i] = wp.where(wp.abs(t[i]) < FAR, status[i], wp.where(status[i] <= VIGNETTED, MISSED, status[i]))

        x = x + wp.cw_mul(t, u)
        y = y + wp.cw_mul(t, v)
        z = z + wp.cw_mul(t, w)
        path = path + before * t

        if surfaces.kinds[s, STOPPED] == 1:
            ax = x - lanes(surfaces.numbers[s, APERTURE])
            ay = y - lanes(surfaces.numbers[s, APERTURE + 1])
            a2 = wp.cw_mul(ax, ax) + wp.cw_mul(ay, ay)
            inner = surfaces.numbers[s, APERTURE + 2]
            outer = surfaces.numbers[s, APERTURE + 3]
            for i in range(LANES):
                blocked = wp.where(status[i] == OK, VIGNETTED, status[i])
                status[i] = wp.where(
                    a2[i] >= outer * outer, blocked, wp.where(a2[i] < inner * inner, blocked, status[i])
                )

        interaction = surfaces.kinds[s, INTERACTION]
        if interaction == MIRROR or interaction == REFRACT:
            # The gradient of the implicit form G is normal to the surface, and its length does not matter.
            b = z
            bend = lanes(c)
            if terms > 0:
                value, slope = polynomial(surfaces.coefficients, s, terms, wp.cw_mul(x, x) + wp.cw_mul(y, y))
                b = z - value
                bend = bend + wp.cw_mul(slope, lanes(ONE) - ((ONE + k) * c) * b)
            nx = -wp.cw_mul(bend, x)
            ny = -wp.cw_mul(bend, y)
            nz = lanes(ONE) - ((ONE + k) * c) * b
            if interaction == MIRROR:
                u, v, w = reflected(u, v, w, nx, ny, nz)
            else:
                u, v, w = refracted(before / after, u, v, w, nx, ny, nz)
                for i in range(LANES):
                    total = wp.where(status[i] <= VIGNETTED, TOTAL_REFLECTION, status[i])
                    status[i] = wp.where(wp.abs(u[i]) < FAR, status[i], total)

        if turned == 1:
            x, y, z = to_telescope(surfaces, s, x, y, z)
            u, v, w = to_telescope(surfaces, s, u, v, w)
        x = x + lanes(surfaces.numbers[s, VERTEX])
        y = y + lanes(surfaces.numbers[s, VERTEX + 1])
        z = z + lanes(surfaces.numbers[s, VERTEX + 2])
        if s >= skipped:
            o = s - skipped
            position_out[o, 0, packet] = x
            position_out[o, 1, packet] = y
            position_out[o, 2, packet] = z
            direction_out[o, 0, packet] = u
            direction_out[o, 1, packet] = v
            direction_out[o, 2, packet] = w
            path_out[o, packet] = path
            status_out[o, packet] = statuses(status)
    return x, y, z, u, v, w, path, status


@wp.kernel
def trace_rays(
    first: wp.int32,
    surfaces: PackedSurfaces,
    indices: wp.array2d(dtype=wp.float64),
    position: wp.array2d(dtype=lanes),
    direction: wp.array2d(dtype=lanes),
    path_in: wp.array(dtype=lanes),
    position_out: wp.array3d(dtype=lanes),
    direction_out: wp.array3d(dtype=lanes),
    path_out: wp.array2d(dtype=lanes),
    status_out: wp.array2d(dtype=lane_flags),
):
    """Trace one packet of given rays through every surface; write the last surface, or all of them.

    ``indices`` holds the refractive index before the first surface and after each. Outputs have a leading axis of
    length 1 (the last surface) or ``n_surfaces``.
    """
    p = first + wp.tid()
    through_telescope(
        surfaces,
        indices,
        0,
        position[0, p],
        position[1, p],
        position[2, p],
        direction[0, p],
        direction[1, p],
        direction[2, p],
        path_in[p],
        p,
        position_out,
        direction_out,
        path_out,
        status_out,
    )
