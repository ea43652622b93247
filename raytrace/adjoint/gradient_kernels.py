"""The backward sweep: from a number that rays end with to every surface that made it.

A ray is carried from surface to surface by functions of where it is and where it goes. Transposed and taken from the
last surface to the first, their derivatives carry a row vector (the adjoint: derivatives of one output with respect to
position and direction of the ray) back to the start, and tell on the way what each surface's own figures would have
done. With the hit Q = P + t d, the normal N = (-sx, -sy, 1) of the sag z = sag(x, y), a = d.N and S = N.N, in the
surface's frame::

    hit         dt = (f - N.(dP + t dd)) / a              f: a change of the sag
    normal      dN = -(H dQ + grad f)                     H: second derivatives of the sag
    refraction  d' = mu d + g N,  g = (root - mu a) / S,  root = sign(a) sqrt((1 - mu^2) S + mu^2 a^2)
    mirror      the same with mu = 1 and root = -a
    path        dL = n dt + t dn

so a ray costs a second sweep of about the same work, however many figures there are.

A rigid motion is read off the adjoint alone. With A and B the derivatives with respect to position P and direction d
of a ray in the gap between two surfaces, the force A and the torque P x A + d x B are the same all along the gap, and a
body that moves by ``v + w x r`` answers with v.(force) + w.(torque) behind it less that in front of it.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ..kernels.kernel_pair import kernel_pair
from ..kernels.packet import LANES, lanes, lanes_sqrt
from ..kernels.shape_derivatives import extra_derivatives
from ..kernels.surface import ONE, TWO, ZERO
from ..kernels.trace import (
    DEFORMED,
    INTERACTION,
    MIRROR,
    PHASE,
    REFRACT,
    ROTATED,
    VERTEX,
    PackedSurfaces,
    to_local,
    to_telescope,
)
from .adjoint_kernels import HIT, INDEX, SAG, dot, keep, keep_gap, polynomial_response, sag_derivatives

wp.set_module_options(FORWARD_OPTIONS)


def back_loop(special: bool) -> wp.Function:
    """Return the loop back over the surfaces, with or without what only few telescopes need, as `surface_loop` does."""

    @wp.func
    def back_through(
        surfaces: PackedSurfaces,
        indices: wp.array(dtype=wp.float64),
        start: wp.array2d(dtype=lanes),
        start_direction: wp.array2d(dtype=lanes),
        position: wp.array3d(dtype=lanes),
        direction: wp.array3d(dtype=lanes),
        kept: wp.int32,
        per_path: lanes,
        ax: lanes,
        ay: lanes,
        az: lanes,
        bx: lanes,
        by: lanes,
        bz: lanes,
        rows: wp.array2d(dtype=wp.int32),
        o: wp.int32,
        p: wp.int32,
        response: wp.array3d(dtype=lanes),
    ):
        """Carry the adjoint of output ``o`` back through packet ``p``, and return it at the start of the rays.

        ``start``, ``position`` and ``direction`` at ``kept`` are what the forward sweep began with and left after every
        surface; a, b and ``per_path`` the derivatives of the output with respect to the last of them and to the path,
        all in the telescope frame. ``rows`` says in which row of ``response`` a column of a surface belongs, -1 where
        nobody asks; force and torque are asked for together.
        """
        n_surfaces = surfaces.kinds.shape[0]
        last = n_surfaces - 1
        keep_gap(
            rows,
            n_surfaces,
            o,
            p,
            position[last, 0, kept],
            position[last, 1, kept],
            position[last, 2, kept],
            direction[last, 0, kept],
            direction[last, 1, kept],
            direction[last, 2, kept],
            ax,
            ay,
            az,
            bx,
            by,
            bz,
            response,
        )
        for back in range(n_surfaces):
            s = last - back
            before = indices[s]
            after = indices[s + 1]
            x = position[s, 0, kept]
            y = position[s, 1, kept]
            z = position[s, 2, kept]
            du = start_direction[0, kept]
            dv = start_direction[1, kept]
            dw = start_direction[2, kept]
            px = start[0, kept]
            py = start[1, kept]
            pz = start[2, kept]
            if s > 0:
                du = direction[s - 1, 0, kept]
                dv = direction[s - 1, 1, kept]
                dw = direction[s - 1, 2, kept]
                px = position[s - 1, 0, kept]
                py = position[s - 1, 1, kept]
                pz = position[s - 1, 2, kept]
            t = dot(x - px, y - py, z - pz, du, dv, dw)
            u = du
            v = dv
            w = dw
            x = x - lanes(surfaces.numbers[s, VERTEX])
            y = y - lanes(surfaces.numbers[s, VERTEX + 1])
            z = z - lanes(surfaces.numbers[s, VERTEX + 2])
            turned = surfaces.kinds[s, ROTATED]
            if turned == 1:
                x, y, z = to_local(surfaces, s, x, y, z)
                u, v, w = to_local(surfaces, s, u, v, w)
                ax, ay, az = to_local(surfaces, s, ax, ay, az)
                bx, by, bz = to_local(surfaces, s, bx, by, bz)

            sx, sy, sxx, sxy, syy = sag_derivatives(surfaces, s, x, y)
            if wp.static(special):
                if surfaces.kinds[s, DEFORMED] == 1:
                    zx, zy, zxx, zxy, zyy = extra_derivatives(surfaces.deformations, s, x, y)
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
                    bend_x = u + (ONE / before) * sx
                    bend_y = v + (ONE / before) * sy
                    ahead = lanes_sqrt(lanes(ONE) - wp.cw_mul(bend_x, bend_x) - wp.cw_mul(bend_y, bend_y))
                    for i in range(LANES):
                        ahead[i] = wp.where(w[i] < ZERO, -ahead[i], ahead[i])
                    fx = bx - wp.cw_div(wp.cw_mul(bz, bend_x), ahead)
                    fy = by - wp.cw_div(wp.cw_mul(bz, bend_y), ahead)
                    fz = lanes(ZERO)
                    cx = (-ONE / before) * fx
                    cy = (-ONE / before) * fy
                    by_value = per_path
            # With respect to the hit, along the surface and along the ray; a screen's map adds to the path there.
            hx = ax - wp.cw_mul(sxx, cx) - wp.cw_mul(sxy, cy)
            hy = ay - wp.cw_mul(sxy, cx) - wp.cw_mul(syy, cy)
            if wp.static(special):
                hx = hx + wp.cw_mul(by_value, sx)
                hy = hy + wp.cw_mul(by_value, sy)
            height = wp.cw_div(dot(hx, hy, az, u, v, w) + before * per_path, along)
            # With respect to the ray in front, its position anywhere along it and its direction about the hit.
            ex = hx - wp.cw_mul(height, nx)
            ey = hy - wp.cw_mul(height, ny)
            ez = az - height

            if wp.static(special):
                if interaction == PHASE:
                    height = by_value
            keep(rows, s, SAG, o, p, height, response)
            keep(rows, s, SAG + 1, o, p, -cx, response)
            keep(rows, s, SAG + 2, o, p, -cy, response)
            keep(rows, s, HIT, o, p, x, response)
            keep(rows, s, HIT + 1, o, p, y, response)
            by_mu = lanes(ZERO)
            if interaction == REFRACT:
                by_mu = dot(bx, by, bz, u, v, w) + wp.cw_mul(b_normal, g_mu)
            if wp.static(special):
                if interaction == PHASE:
                    by_mu = wp.cw_mul(cx, sx) + wp.cw_mul(cy, sy)
            keep(rows, s, INDEX, o, p, wp.cw_mul(per_path, t) + (ONE / after) * by_mu, response)
            if wp.static(special):
                if interaction == PHASE:
                    by_mu = lanes(ZERO)
            keep(rows, s, INDEX + 1, o, p, (-before / (after * after)) * by_mu, response)

            ax = ex
            ay = ey
            az = ez
            bx = fx + wp.cw_mul(t, ex)
            by = fy + wp.cw_mul(t, ey)
            bz = fz + wp.cw_mul(t, ez)
            if turned == 1:
                ax, ay, az = to_telescope(surfaces, s, ax, ay, az)
                bx, by, bz = to_telescope(surfaces, s, bx, by, bz)
            keep_gap(rows, s, o, p, px, py, pz, du, dv, dw, ax, ay, az, bx, by, bz, response)
        return ax, ay, az, bx, by, bz

    return back_through


#: Without and with figures beside conics with even powers, and phase screens.
BACK_LOOPS = (back_loop(False), back_loop(True))


@kernel_pair
def sweep_back(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that sweeps back."""
    back_through = BACK_LOOPS[special]

    @wp.kernel(module=module)
    def sweep_back(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array(dtype=wp.float64),
        n_packets: wp.int32,
        start: wp.array2d(dtype=lanes),
        start_direction: wp.array2d(dtype=lanes),
        position: wp.array3d(dtype=lanes),
        direction: wp.array3d(dtype=lanes),
        seed_position: wp.array3d(dtype=lanes),
        seed_direction: wp.array3d(dtype=lanes),
        seed_path: wp.array(dtype=wp.float64),
        rows: wp.array2d(dtype=wp.int32),
        polynomials: wp.array2d(dtype=wp.int32),
        scales: wp.array(dtype=wp.float64),
        response: wp.array3d(dtype=lanes),
        response_start: wp.array3d(dtype=lanes),
    ):
        """Carry the adjoint of output ``item // n_packets`` back through packet ``item % n_packets``.

        The seeds are the derivatives of each output with respect to position, direction and path after the last
        surface.
        ``response_start`` takes those with respect to the start of the ray, position and direction, if it has room.
        """
        item = first + wp.tid()
        o = item / n_packets
        p = item - o * n_packets
        ax, ay, az, bx, by, bz = back_through(
            surfaces,
            indices,
            start,
            start_direction,
            position,
            direction,
            p,
            lanes(seed_path[o]),
            seed_position[o, 0, p],
            seed_position[o, 1, p],
            seed_position[o, 2, p],
            seed_direction[o, 0, p],
            seed_direction[o, 1, p],
            seed_direction[o, 2, p],
            rows,
            o,
            p,
            response,
        )
        for j in range(scales.shape[0]):
            polynomial_response(polynomials, scales[j], j, o, p, response)
        if response_start.shape[0] > 0:
            response_start[o, 0, p] = ax
            response_start[o, 1, p] = ay
            response_start[o, 2, p] = az
            response_start[o, 3, p] = bx
            response_start[o, 4, p] = by
            response_start[o, 5, p] = bz

    return sweep_back
