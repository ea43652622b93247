"""Backward pass: derivatives of an output of rays, carried from the last surface back to the start.

The position and direction of a ray after each surface are functions of those before it. Their transposed derivatives,
applied from the last surface to the first, carry the adjoint: the derivatives of one output with respect to position
and direction of the ray. At each surface the adjoint gives the derivatives by the parameters of that surface. With the
intersection Q = P + t d, the normal N = (-sx, -sy, 1) of the sag z = sag(x, y), a = d.N and S = N.N, in the frame of
the surface::

    intersection  dt = (f - N.(dP + t dd)) / a            f: a change of the sag
    normal        dN = -(H dQ + grad f)                   H: second derivatives of the sag
    refraction    d' = mu d + g N,  g = (root - mu a) / S,  root = sign(a) sqrt((1 - mu^2) S + mu^2 a^2)
    mirror        the same with mu = 1 and root = -a
    path          dL = n dt + t dn
    grooves       d' = e + g N,  e = mu d + p / n',  g = (root - e.N) / S,  root = +-sqrt((e.N)^2 + (1 - e.e) S)
                  dL = p.dQ                          p: the gradient of the path that the grooves add

A backward pass takes about as long as a forward pass, whatever the number of parameters.

Rigid motions follow from the adjoint alone. With A and B the derivatives with respect to position P and direction d of
a ray in the gap between two surfaces, the force A and the torque P x A + d x B are constant along the gap. The
derivative by a motion ``v + w x r`` of a body is v.(force) + w.(torque) behind it less that in front of it.
"""

from __future__ import annotations

from functools import partial

import warp as wp

from ...core.launch import ROLLED_OPTIONS
from ..kernels.kernel_pair import kernel_pair
from ..kernels.packet import LANES, RayPackets, components, lanes, lanes_sqrt
from ..kernels.shape_derivatives import added_derivatives
from ..kernels.surface import ONE, TWO, ZERO
from ..kernels.surface_table import (
    DEFORMED,
    GROOVES,
    INTERACTION,
    MIRROR,
    PHASE,
    POWER,
    REFRACT,
    ROTATED,
    RULED,
    THIN_LENS,
    VERGENCE,
    VERTEX,
    PackedSurfaces,
    to_local,
    to_telescope,
)
from ..kernels.thin_lens import thin_lens_adjoint
from .column_kernels import (
    GROOVE,
    INDEX,
    INTERSECTION,
    SAG,
    dot,
    polynomial_columns,
    sag_derivatives,
    write_column,
    write_gap,
)

wp.set_module_options(ROLLED_OPTIONS)


def backward_loop(special: bool) -> wp.Function:
    """Return the loop back over the surfaces, for plain telescopes or for any, as `surface_loop` does."""

    @wp.func
    def backward_through(
        surfaces: PackedSurfaces,
        indices: wp.array(dtype=wp.float64),
        start: RayPackets,
        rays: RayPackets,
        slot: wp.int32,
        per_path: lanes,
        ax: lanes,
        ay: lanes,
        az: lanes,
        bx: lanes,
        by: lanes,
        bz: lanes,
        columns: wp.array2d(dtype=wp.int32),
        o: wp.int32,
        p: wp.int32,
        matrix: wp.array3d(dtype=lanes),
    ):
        """Carry the adjoint of output ``o`` back through packet ``p``, and return it at the start of the rays.

        Packet ``slot`` of ``start`` and ``rays`` holds the rays before the first surface and after each. a, b and
        ``per_path`` are the derivatives of the output with respect to position, direction and path after the last
        surface, all in the telescope frame. ``columns`` gives the column of ``matrix`` for each quantity of a surface,
        -1 for none; force and torque have columns together.
        """
        n_surfaces = surfaces.kinds.shape[0]
        last = n_surfaces - 1
        x, y, z = components(rays.position, last, slot)
        u, v, w = components(rays.direction, last, slot)
        write_gap(columns, n_surfaces, o, p, x, y, z, u, v, w, ax, ay, az, bx, by, bz, matrix)
        for back in range(n_surfaces):
            s = last - back
            before = indices[s]
            after = indices[s + 1]
            x, y, z = components(rays.position, s, slot)
            du, dv, dw = components(start.direction, 0, slot)
            px, py, pz = components(start.position, 0, slot)
            if s > 0:
                du, dv, dw = components(rays.direction, s - 1, slot)
                px, py, pz = components(rays.position, s - 1, slot)
            t = dot(x - px, y - py, z - pz, du, dv, dw)
            u = du
            v = dv
            w = dw
            x = x - lanes(surfaces.numbers[s, VERTEX])
            y = y - lanes(surfaces.numbers[s, VERTEX + 1])
            z = z - lanes(surfaces.numbers[s, VERTEX + 2])
            rotated = surfaces.kinds[s, ROTATED]
            if rotated == 1:
                x, y, z = to_local(surfaces, s, x, y, z)
                u, v, w = to_local(surfaces, s, u, v, w)
                ax, ay, az = to_local(surfaces, s, ax, ay, az)
                bx, by, bz = to_local(surfaces, s, bx, by, bz)

            sx, sy, sxx, sxy, syy = sag_derivatives(surfaces, s, x, y)
            if wp.static(special):
                if surfaces.kinds[s, DEFORMED] == 1:
                    zx, zy, zxx, zxy, zyy = added_derivatives(surfaces.deformations, s, x, y)
                    sx = sx + zx
                    sy = sy + zy
                    sxx = sxx + zxx
                    sxy = sxy + zxy
                    syy = syy + zyy
            interaction = surfaces.kinds[s, INTERACTION]
            nx = -sx
            ny = -sy
            if wp.static(special):
                if interaction == PHASE:
                    # The screen is flat; its map acts below.
                    nx = lanes(ZERO)
                    ny = lanes(ZERO)
            nz = lanes(ONE)
            along = dot(u, v, w, nx, ny, nz)
            square = dot(nx, ny, nz, nx, ny, nz)

            # d' = mu d + g N, and the derivatives of g with respect to a = d.N, to S = N.N and to mu.
            mu = ONE
            g = lanes(ZERO)
            g_along = lanes(ZERO)
            g_square = lanes(ZERO)
            g_mu = lanes(ZERO)
            inverse = wp.cw_div(lanes(ONE), square)
            if interaction == MIRROR:
                g_along = -TWO * inverse
                g = wp.cw_mul(g_along, along)
                g_square = -wp.cw_mul(g, inverse)
            if interaction == REFRACT:
                mu = before / after
                root = lanes_sqrt((ONE - mu * mu) * square + (mu * mu) * wp.cw_mul(along, along))
                for i in range(LANES):
                    root[i] = wp.where(along[i] < ZERO, -root[i], root[i])
                by_root = wp.cw_div(lanes(ONE), root)
                g = wp.cw_mul(root - mu * along, inverse)
                g_along = wp.cw_mul((mu * mu) * wp.cw_mul(along, by_root) - lanes(mu), inverse)
                g_square = wp.cw_mul((wp.float64(0.5) * (ONE - mu * mu)) * by_root - g, inverse)
                g_mu = wp.cw_mul(wp.cw_mul(mu * (wp.cw_mul(along, along) - square), by_root) - along, inverse)

            b_normal = dot(bx, by, bz, nx, ny, nz)
            by_along = wp.cw_mul(b_normal, g_along)
            by_square = TWO * wp.cw_mul(b_normal, g_square)
            # With respect to the normal; its third component never changes.
            cx = wp.cw_mul(by_along, u) + wp.cw_mul(by_square, nx) + wp.cw_mul(g, bx)
            cy = wp.cw_mul(by_along, v) + wp.cw_mul(by_square, ny) + wp.cw_mul(g, by)
            fx = mu * bx + wp.cw_mul(by_along, nx)
            fy = mu * by + wp.cw_mul(by_along, ny)
            fz = mu * bz + by_along
            by_value = lanes(ZERO)
            if wp.static(special):
                if interaction == PHASE:
                    # d' = (u + sx / n, v + sy / n, +-root): the third component follows from the first two.
                    ahead_x = u + (ONE / before) * sx
                    ahead_y = v + (ONE / before) * sy
                    ahead = lanes_sqrt(lanes(ONE) - wp.cw_mul(ahead_x, ahead_x) - wp.cw_mul(ahead_y, ahead_y))
                    for i in range(LANES):
                        ahead[i] = wp.where(w[i] < ZERO, -ahead[i], ahead[i])
                    fx = bx - wp.cw_div(wp.cw_mul(bz, ahead_x), ahead)
                    fy = by - wp.cw_div(wp.cw_mul(bz, ahead_y), ahead)
                    fz = lanes(ZERO)
                    cx = (-ONE / before) * fx
                    cy = (-ONE / before) * fy
                    by_value = per_path
            by_grooves = lanes(ZERO)
            by_after = lanes(ZERO)
            by_front = lanes(ZERO)
            by_behind = lanes(ZERO)
            groove_x = ZERO
            groove_y = ZERO
            ruled = int(0)
            if wp.static(special):
                ruled = surfaces.kinds[s, RULED]
                if ruled == 1:
                    # d' = e + g N with e = mu d + grooves / n': by e.N, N.N and e.e in place of d.N, N.N and mu.
                    wavelength = indices[indices.shape[0] - 1]
                    groove_x = wavelength * surfaces.numbers[s, GROOVES]
                    groove_y = wavelength * surfaces.numbers[s, GROOVES + 1]
                    mu = before / after
                    ex = mu * u + lanes(groove_x / after)
                    ey = mu * v + lanes(groove_y / after)
                    ez = mu * w
                    e_along = dot(ex, ey, ez, nx, ny, nz)
                    spare = lanes(ONE) - dot(ex, ey, ez, ex, ey, ez)
                    root = lanes_sqrt(wp.cw_mul(e_along, e_along) + wp.cw_mul(spare, square))
                    sense = wp.where(interaction == MIRROR, -ONE, ONE)
                    for i in range(LANES):
                        root[i] = wp.where(sense * along[i] < ZERO, -root[i], root[i])
                    by_root = wp.cw_div(b_normal, root)
                    g = wp.cw_mul(root - e_along, inverse)
                    by_along = wp.cw_mul(wp.cw_mul(e_along, by_root) - b_normal, inverse)
                    by_square = wp.cw_mul(wp.cw_mul(spare, by_root) - TWO * wp.cw_mul(g, b_normal), inverse)
                    cx = wp.cw_mul(by_along, ex) + wp.cw_mul(by_square, nx) + wp.cw_mul(g, bx)
                    cy = wp.cw_mul(by_along, ey) + wp.cw_mul(by_square, ny) + wp.cw_mul(g, by)
                    # With respect to e.
                    fx = bx + wp.cw_mul(by_along, nx) - wp.cw_mul(by_root, ex)
                    fy = by + wp.cw_mul(by_along, ny) - wp.cw_mul(by_root, ey)
                    fz = bz + by_along - wp.cw_mul(by_root, ez)
                    by_grooves = dot(fx, fy, fz, u, v, w)
                    by_after = dot(fx, fy, fz, ex, ey, ez)
                    by_groove = wavelength * ((ONE / after) * fx + wp.cw_mul(per_path, x))
                    write_column(columns, s, GROOVE, o, p, by_groove, matrix)
                    by_groove = wavelength * ((ONE / after) * fy + wp.cw_mul(per_path, y))
                    write_column(columns, s, GROOVE + 1, o, p, by_groove, matrix)
                    fx = mu * fx
                    fy = mu * fy
                    fz = mu * fz
            # With respect to the intersection, along the surface and the ray; a screen's map adds to the path there.
            hx = ax - wp.cw_mul(sxx, cx) - wp.cw_mul(sxy, cy)
            hy = ay - wp.cw_mul(sxy, cx) - wp.cw_mul(syy, cy)
            if wp.static(special):
                hx = hx + wp.cw_mul(by_value, sx)
                hy = hy + wp.cw_mul(by_value, sy)
                if ruled == 1:
                    hx = hx + groove_x * per_path
                    hy = hy + groove_y * per_path
                if interaction == THIN_LENS:
                    power = surfaces.numbers[s, POWER]
                    vergence = surfaces.numbers[s, VERGENCE]
                    ex, ey, fx, fy, fz, by_front, by_behind = thin_lens_adjoint(
                        power, vergence, before, after, x, y, u, v, w, bx, by, bz, per_path
                    )
                    hx = hx + ex
                    hy = hy + ey
            height = wp.cw_div(dot(hx, hy, az, u, v, w) + before * per_path, along)
            # With respect to the ray in front, its position anywhere along it and its direction about the intersection.
            ex = hx - wp.cw_mul(height, nx)
            ey = hy - wp.cw_mul(height, ny)
            ez = az - height

            if wp.static(special):
                if interaction == PHASE:
                    height = by_value
            write_column(columns, s, SAG, o, p, height, matrix)
            write_column(columns, s, SAG + 1, o, p, -cx, matrix)
            write_column(columns, s, SAG + 2, o, p, -cy, matrix)
            write_column(columns, s, INTERSECTION, o, p, x, matrix)
            write_column(columns, s, INTERSECTION + 1, o, p, y, matrix)
            by_mu = lanes(ZERO)
            if interaction == REFRACT:
                by_mu = dot(bx, by, bz, u, v, w) + wp.cw_mul(b_normal, g_mu)
            if wp.static(special):
                if interaction == PHASE:
                    by_mu = wp.cw_mul(cx, sx) + wp.cw_mul(cy, sy)
                if ruled == 1:
                    by_mu = by_grooves
                    if interaction == MIRROR:
                        # One medium on both sides.
                        by_mu = by_grooves - by_after
            write_column(columns, s, INDEX, o, p, wp.cw_mul(per_path, t) + (ONE / after) * by_mu, matrix)
            if wp.static(special):
                if interaction == PHASE:
                    by_mu = lanes(ZERO)
                if ruled == 1:
                    by_mu = wp.where(interaction == MIRROR, ZERO, after / before) * by_after
            write_column(columns, s, INDEX + 1, o, p, (-before / (after * after)) * by_mu, matrix)
            if wp.static(special):
                if interaction == THIN_LENS:
                    write_column(columns, s, INDEX, o, p, wp.cw_mul(per_path, t) + by_front, matrix)
                    write_column(columns, s, INDEX + 1, o, p, by_behind, matrix)

            ax = ex
            ay = ey
            az = ez
            bx = fx + wp.cw_mul(t, ex)
            by = fy + wp.cw_mul(t, ey)
            bz = fz + wp.cw_mul(t, ez)
            if rotated == 1:
                ax, ay, az = to_telescope(surfaces, s, ax, ay, az)
                bx, by, bz = to_telescope(surfaces, s, bx, by, bz)
            write_gap(columns, s, o, p, px, py, pz, du, dv, dw, ax, ay, az, bx, by, bz, matrix)
        return ax, ay, az, bx, by, bz

    return backward_through


#: The loops of the variants of `kernel_pair`.
BACKWARD_LOOPS = (backward_loop(False), backward_loop(True))


@partial(kernel_pair, shared=__package__, options=ROLLED_OPTIONS)
def backward_rays(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel of the backward pass."""
    backward_through = BACKWARD_LOOPS[special]

    @wp.kernel(module=module)
    def backward_rays(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array(dtype=wp.float64),
        n_packets: wp.int32,
        start: RayPackets,
        rays: RayPackets,
        by_position: wp.array3d(dtype=lanes),
        by_direction: wp.array3d(dtype=lanes),
        by_path: wp.array(dtype=wp.float64),
        columns: wp.array2d(dtype=wp.int32),
        polynomials: wp.array2d(dtype=wp.int32),
        scales: wp.array(dtype=wp.float64),
        matrix: wp.array3d(dtype=lanes),
        at_start: wp.array3d(dtype=lanes),
    ):
        """Carry the adjoint of output ``item // n_packets`` back through packet ``item % n_packets``.

        ``by_position``, ``by_direction`` and ``by_path`` are the derivatives of each output with respect to the rays
        after the last surface. ``at_start``, unless empty, takes those with respect to the start of the ray.
        """
        item = first + wp.tid()
        o = item / n_packets
        p = item - o * n_packets
        ax, ay, az = components(by_position, o, p)
        bx, by, bz = components(by_direction, o, p)
        ax, ay, az, bx, by, bz = backward_through(
            surfaces, indices, start, rays, p, lanes(by_path[o]), ax, ay, az, bx, by, bz, columns, o, p, matrix
        )
        for j in range(scales.shape[0]):
            polynomial_columns(polynomials, scales[j], j, o, p, matrix)
        if at_start.shape[0] > 0:
            at_start[o, 0, p] = ax
            at_start[o, 1, p] = ay
            at_start[o, 2, p] = az
            at_start[o, 3, p] = bx
            at_start[o, 4, p] = by
            at_start[o, 5, p] = bz

    return backward_rays
