"""The kernels that carry packets of rays through a whole telescope."""

from __future__ import annotations

import warp as wp

from .launch import FORWARD_OPTIONS
from .packet import LANES, lane_flags, lanes, lanes_sqrt
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
def through_surface(
    surfaces: PackedSurfaces,
    s: wp.int32,
    before: wp.float64,
    after: wp.float64,
    gx: lanes,
    gy: lanes,
    gz: lanes,
    gu: lanes,
    gv: lanes,
    gw: lanes,
    path: lanes,
    status: lanes,
):
    """Carry a packet to surface ``s`` and through it; positions and directions in the telescope frame."""
    x = gx - lanes(surfaces.numbers[s, VERTEX])
    y = gy - lanes(surfaces.numbers[s, VERTEX + 1])
    z = gz - lanes(surfaces.numbers[s, VERTEX + 2])
    u = gu
    v = gv
    w = gw
    turned = surfaces.kinds[s, ROTATED]
    if turned == 1:
        # Columns of the rotation are the local axes, so its transpose takes telescope to local components.
        r00 = surfaces.numbers[s, ROTATION]
        r01 = surfaces.numbers[s, ROTATION + 1]
        r02 = surfaces.numbers[s, ROTATION + 2]
        r10 = surfaces.numbers[s, ROTATION + 3]
        r11 = surfaces.numbers[s, ROTATION + 4]
        r12 = surfaces.numbers[s, ROTATION + 5]
        r20 = surfaces.numbers[s, ROTATION + 6]
        r21 = surfaces.numbers[s, ROTATION + 7]
        r22 = surfaces.numbers[s, ROTATION + 8]
        x_local = r00 * x + r10 * y + r20 * z
        y_local = r01 * x + r11 * y + r21 * z
        z = r02 * x + r12 * y + r22 * z
        x = x_local
        y = y_local
        u_local = r00 * u + r10 * v + r20 * w
        v_local = r01 * u + r11 * v + r21 * w
        w = r02 * u + r12 * v + r22 * w
        u = u_local
        v = v_local

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
            status[i] = wp.where(a2[i] >= outer * outer, blocked, wp.where(a2[i] < inner * inner, blocked, status[i]))

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
        r00 = surfaces.numbers[s, ROTATION]
        r01 = surfaces.numbers[s, ROTATION + 1]
        r02 = surfaces.numbers[s, ROTATION + 2]
        r10 = surfaces.numbers[s, ROTATION + 3]
        r11 = surfaces.numbers[s, ROTATION + 4]
        r12 = surfaces.numbers[s, ROTATION + 5]
        r20 = surfaces.numbers[s, ROTATION + 6]
        r21 = surfaces.numbers[s, ROTATION + 7]
        r22 = surfaces.numbers[s, ROTATION + 8]
        x_frame = r00 * x + r01 * y + r02 * z
        y_frame = r10 * x + r11 * y + r12 * z
        z = r20 * x + r21 * y + r22 * z
        x = x_frame
        y = y_frame
        u_frame = r00 * u + r01 * v + r02 * w
        v_frame = r10 * u + r11 * v + r12 * w
        w = r20 * u + r21 * v + r22 * w
        u = u_frame
        v = v_frame
    x = x + lanes(surfaces.numbers[s, VERTEX])
    y = y + lanes(surfaces.numbers[s, VERTEX + 1])
    z = z + lanes(surfaces.numbers[s, VERTEX + 2])
    return x, y, z, u, v, w, path, status


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

    The only place that calls ``through_surface``, so that the compiler puts it in line here.
    """
    status = lanes(OK)
    n_surfaces = surfaces.kinds.shape[0]
    skipped = n_surfaces - position_out.shape[0]
    for s in range(n_surfaces):
        x, y, z, u, v, w, path, status = through_surface(
            surfaces, s, indices[row, s], indices[row, s + 1], x, y, z, u, v, w, path, status
        )
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


@wp.func
def launched(px: lanes, py: lanes, pz: wp.float64, u: wp.float64, v: wp.float64, w: wp.float64, distance: wp.float64):
    """Start parallel rays through (px, py, pz) on the plane at -distance along the direction of the light."""
    back = u * px + v * py + lanes(w * pz + distance)
    return px - u * back, py - v * back, lanes(pz) - w * back


@wp.kernel
def trace_pupils(
    first: wp.int32,
    surfaces: PackedSurfaces,
    n_packets: wp.int32,
    indices: wp.array2d(dtype=wp.float64),
    medium: wp.array(dtype=wp.int32),
    direction: wp.array2d(dtype=wp.float64),
    pupil: wp.array2d(dtype=lanes),
    pupil_z: wp.float64,
    distance: wp.float64,
    reference: wp.array2d(dtype=wp.float64),
    radius: wp.float64,
    no_position: wp.array3d(dtype=lanes),
    no_direction: wp.array3d(dtype=lanes),
    no_path: wp.array2d(dtype=lanes),
    no_status: wp.array2d(dtype=lane_flags),
    displacement_x: wp.array2d(dtype=lanes),
    displacement_y: wp.array2d(dtype=lanes),
    path_out: wp.array2d(dtype=lanes),
    status_out: wp.array2d(dtype=lane_flags),
):
    """Trace packet ``item % n_packets`` of the pupil for bundle ``item // n_packets`` and keep what a PSF needs.

    A bundle is one star at one wavelength. ``reference`` holds, per bundle, a point of the CCD surface and its
    normal (-dh/dx, -dh/dy, 1) before normalisation [6]. Kept: where the rays meet the tangent plane of the CCD there,
    relative to the point, and their optical path to the sphere of that radius about the point, beyond it.
    """
    item = first + wp.tid()
    b = item / n_packets
    p = item - b * n_packets
    row = medium[b]
    n_surfaces = surfaces.kinds.shape[0]
    du = direction[b, 0]
    dv = direction[b, 1]
    dw = direction[b, 2]
    x, y, z = launched(pupil[0, p], pupil[1, p], pupil_z, du, dv, dw, distance)
    x, y, z, u, v, w, path, status = through_telescope(
        surfaces,
        indices,
        row,
        x,
        y,
        z,
        lanes(du),
        lanes(dv),
        lanes(dw),
        lanes(ZERO),
        p,
        no_position,
        no_direction,
        no_path,
        no_status,
    )
    x = x - lanes(reference[b, 0])
    y = y - lanes(reference[b, 1])
    z = z - lanes(reference[b, 2])
    nx = reference[b, 3]
    ny = reference[b, 4]
    nz = reference[b, 5]
    along = wp.cw_div(nx * x + ny * y + nz * z, nx * u + ny * v + nz * w)
    displacement_x[b, p] = x - wp.cw_mul(along, u)
    displacement_y[b, p] = y - wp.cw_mul(along, v)
    # Distance from here on to the sphere beyond the image: sqrt((q.d)^2 - |q|^2 + R^2) - q.d.
    qd = wp.cw_mul(x, u) + wp.cw_mul(y, v) + wp.cw_mul(z, w)
    qq = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
    ahead = lanes_sqrt(wp.cw_mul(qd, qd) - qq + lanes(radius * radius)) - qd
    path_out[b, p] = path + indices[row, n_surfaces - 1] * ahead
    status_out[b, p] = statuses(status)
