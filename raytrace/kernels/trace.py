"""The kernel that traces packets of rays through a telescope.

It has variants (`kernel_pair`): code for rare kinds of surfaces slows the loop by a seventh even where no surface
is of that kind, because it takes registers and prevents the compiler from inlining functions.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .aperture import through_aperture
from .crossings import reaches_twice, start_by_aperture
from .kernel_pair import kernel_pair
from .mesh import mesh_distance
from .obstruction import obstructed_status
from .packet import LANES, RayPackets, components, lane_flags, lanes
from .shape import NAN, deformed_distance, through_screen
from .surface import (
    EVANESCENT,
    FAR,
    MISSED,
    NOT_CONVERGED,
    OK,
    ONE,
    TOTAL_REFLECTION,
    VIGNETTED,
    ZERO,
    aspheric_distance,
    conic_distance,
    diffracted,
    polynomial,
    reflected,
    refracted,
)
from .surface_table import (
    APERTURE,
    CHOSEN,
    CONIC,
    CURVATURE,
    DEFORMED,
    DIFFRACT,
    FIRST_CURVATURE,
    GROOVES,
    INTERACTION,
    MEDIUM_AFTER,
    MEDIUM_BEFORE,
    MIRROR,
    OBSTRUCTED,
    PHASE,
    POWER,
    REFRACT,
    ROTATED,
    RULED,
    SIGN_CHANGE,
    STOPPED,
    TERMS,
    THIN_LENS,
    TWO_CROSSINGS,
    VERGENCE,
    VERTEX,
    PackedSurfaces,
    to_local,
    to_telescope,
)
from .thin_lens import through_thin_lens

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def obstructed_status_at_surface(
    surfaces: PackedSurfaces,
    s: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    t: lanes,
    status: lanes,
):
    """Ray statuses after obstructions on a path of length t from (x, y, z), relative to the vertex of surface ``s``."""
    vertex_x = lanes(surfaces.numbers[s, VERTEX])
    vertex_y = lanes(surfaces.numbers[s, VERTEX + 1])
    vertex_z = lanes(surfaces.numbers[s, VERTEX + 2])
    return obstructed_status(surfaces.obstructions, s, x + vertex_x, y + vertex_y, z + vertex_z, u, v, w, t, status)


@wp.func
def statuses(status: lanes):
    """Statuses as integers."""
    out = lane_flags()
    for i in range(LANES):
        out[i] = wp.int32(status[i])
    return out


def surface_loop(special: bool, chromatic: bool = False) -> wp.Function:
    """Return the loop over the surfaces of a telescope, of plain ones or of any.

    Plain telescopes have conics with even powers, discs and rings as apertures that choose between no crossings, no
    phase screens, gratings, thin lenses or obstructions. The ``indices`` are a row of numbers, before the first surface
    and after each, and the wavelength [m] as the last of the row; in a chromatic loop, where every ray has its own
    wavelength, packets of indices [medium, packet] and of the wavelength behind them, and optical paths are left out.
    """

    @wp.func
    def through_telescope(
        surfaces: PackedSurfaces,
        indices: Any,
        row: wp.int32,
        x: lanes,
        y: lanes,
        z: lanes,
        u: lanes,
        v: lanes,
        w: lanes,
        path: lanes,
        packet: wp.int32,
        out: RayPackets,
    ):
        """Trace a packet through every surface, and write it after the last ones, as many as ``out`` has surfaces.

        Positions and directions are in the telescope frame. The body of the loop is inline: a function of its own would
        pass a dozen vectors through memory, and the trace would take a third longer.
        """
        status = lanes(OK)
        n_surfaces = surfaces.kinds.shape[0]
        skipped = n_surfaces - out.position.shape[0]
        for s in range(n_surfaces):
            if wp.static(not chromatic):
                before = indices[row, s]
                after = indices[row, s + 1]
            x = x - lanes(surfaces.numbers[s, VERTEX])
            y = y - lanes(surfaces.numbers[s, VERTEX + 1])
            z = z - lanes(surfaces.numbers[s, VERTEX + 2])
            rotated = surfaces.kinds[s, ROTATED]
            if rotated == 1:
                x, y, z = to_local(surfaces, s, x, y, z)
                u, v, w = to_local(surfaces, s, u, v, w)

            c = surfaces.numbers[s, CURVATURE]
            k = surfaces.numbers[s, CONIC]
            terms = surfaces.kinds[s, TERMS]
            first_curvature = surfaces.numbers[s, FIRST_CURVATURE]
            t = conic_distance(first_curvature, k, surfaces.numbers[s, SIGN_CHANGE], x, y, z, u, v, w)
            if wp.static(special):
                if surfaces.kinds[s, CHOSEN] > 0:
                    if reaches_twice(w, surfaces.numbers[s, TWO_CROSSINGS]):
                        t = start_by_aperture(surfaces, s, x, y, z, u, v, w, t)
                    if surfaces.kinds[s, CHOSEN] == 2:
                        # At grazing incidence the closed form has lost digits, which a step of Newton's method finds.
                        t, _running = aspheric_distance(c, k, surfaces.coefficients, s, 0, x, y, z, u, v, w, t)
            if terms > 0:
                t, running = aspheric_distance(c, k, surfaces.coefficients, s, terms, x, y, z, u, v, w, t)
                for i in range(LANES):
                    status[i] = wp.where(running[i] > ZERO, NOT_CONVERGED, status[i])
            interaction = surfaces.kinds[s, INTERACTION]
            if wp.static(special):
                deformed = surfaces.kinds[s, DEFORMED]
                sag = lanes()
                sag_x = lanes()
                sag_y = lanes()
                if deformed == 2:
                    t, sag_x, sag_y = mesh_distance(surfaces.meshes, s, x, y, z, u, v, w)
                elif deformed == 1:
                    screen = wp.where(interaction == PHASE, 1, 0)
                    t, sag, sag_x, sag_y, running = deformed_distance(
                        surfaces.deformations, c, k, surfaces.coefficients, s, terms, x, y, z, u, v, w, t, screen
                    )
                    for i in range(LANES):
                        status[i] = wp.where(running[i] > ZERO, NOT_CONVERGED, status[i])
            for i in range(LANES):
                # A NaN fails every comparison; wp.isfinite would be a call per lane and prevent vectorization.
                status[i] = wp.where(wp.abs(t[i]) < FAR, status[i], wp.where(status[i] <= VIGNETTED, MISSED, status[i]))

            if wp.static(special):
                if surfaces.kinds[s, OBSTRUCTED] == 1:
                    # Two calls on purpose: a function with one caller is inlined, which slows the whole loop.
                    if rotated == 1:
                        sx, sy, sz = to_telescope(surfaces, s, x, y, z)
                        su, sv, sw = to_telescope(surfaces, s, u, v, w)
                        status = obstructed_status_at_surface(surfaces, s, sx, sy, sz, su, sv, sw, t, status)
                    else:
                        status = obstructed_status_at_surface(surfaces, s, x, y, z, u, v, w, t, status)

            x = x + wp.cw_mul(t, u)
            y = y + wp.cw_mul(t, v)
            z = z + wp.cw_mul(t, w)
            if wp.static(not chromatic):
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
            if wp.static(special):
                if surfaces.kinds[s, STOPPED] == 2:
                    status = through_aperture(surfaces.apertures, s, x, y, status)

            if interaction == MIRROR or interaction == REFRACT:
                # The gradient of the implicit form G is normal to the surface, and its length does not matter.
                b = z
                radial = lanes(c)
                if terms > 0:
                    value, slope = polynomial(surfaces.coefficients, s, terms, wp.cw_mul(x, x) + wp.cw_mul(y, y))
                    b = z - value
                    radial = radial + wp.cw_mul(slope, lanes(ONE) - ((ONE + k) * c) * b)
                nx = -wp.cw_mul(radial, x)
                ny = -wp.cw_mul(radial, y)
                if wp.static(special):
                    if deformed > 0:
                        b = b - sag
                        if terms > 0:
                            radial = lanes(c) + wp.cw_mul(slope, lanes(ONE) - ((ONE + k) * c) * b)
                        nx = -wp.cw_mul(radial, x) - wp.cw_mul(sag_x, lanes(ONE) - ((ONE + k) * c) * b)
                        ny = -wp.cw_mul(radial, y) - wp.cw_mul(sag_y, lanes(ONE) - ((ONE + k) * c) * b)
                nz = lanes(ONE) - ((ONE + k) * c) * b
                for i in range(LANES):
                    # The other sheet of a hyperboloid, or the half of an ellipsoid beyond its equator, is no surface.
                    status[i] = wp.where(nz[i] > ZERO, status[i], wp.where(status[i] <= VIGNETTED, MISSED, status[i]))
                    x[i] = wp.where(nz[i] > ZERO, x[i], NAN)
                    y[i] = wp.where(nz[i] > ZERO, y[i], NAN)
                    z[i] = wp.where(nz[i] > ZERO, z[i], NAN)
                if wp.static(special):
                    if surfaces.kinds[s, RULED] == 1:
                        if wp.static(chromatic):
                            n = indices[surfaces.kinds[s, MEDIUM_AFTER], packet]
                            ratio = wp.cw_div(indices[surfaces.kinds[s, MEDIUM_BEFORE], packet], n)
                            length = wp.cw_div(indices[indices.shape[0] - 1, packet], n)
                        else:
                            ratio = lanes(before / after)
                            length = lanes(indices[row, indices.shape[1] - 1] / after)
                            path = path + after * wp.cw_mul(
                                length, surfaces.numbers[s, GROOVES] * x + surfaces.numbers[s, GROOVES + 1] * y
                            )
                        u, v, w = diffracted(
                            ratio,
                            wp.where(interaction == MIRROR, -ONE, ONE),
                            surfaces.numbers[s, GROOVES] * length,
                            surfaces.numbers[s, GROOVES + 1] * length,
                            u,
                            v,
                            w,
                            nx,
                            ny,
                            nz,
                        )
                        for i in range(LANES):
                            lost = wp.where(status[i] <= VIGNETTED, EVANESCENT, status[i])
                            status[i] = wp.where(wp.abs(u[i]) < FAR, status[i], lost)
                        interaction = DIFFRACT
                if interaction == MIRROR:
                    u, v, w = reflected(u, v, w, nx, ny, nz)
                elif interaction == REFRACT:
                    if wp.static(chromatic):
                        ratio = wp.cw_div(
                            indices[surfaces.kinds[s, MEDIUM_BEFORE], packet],
                            indices[surfaces.kinds[s, MEDIUM_AFTER], packet],
                        )
                        u, v, w = refracted(ratio, u, v, w, nx, ny, nz)
                    else:
                        u, v, w = refracted(before / after, u, v, w, nx, ny, nz)
                    for i in range(LANES):
                        total = wp.where(status[i] <= VIGNETTED, TOTAL_REFLECTION, status[i])
                        status[i] = wp.where(wp.abs(u[i]) < FAR, status[i], total)
            if wp.static(special):
                if interaction == PHASE:
                    if wp.static(chromatic):
                        n = indices[surfaces.kinds[s, MEDIUM_BEFORE], packet]
                        u, v, w = through_screen(n, sag_x, sag_y, u, v, w)
                    else:
                        path = path + sag
                        u, v, w = through_screen(before, sag_x, sag_y, u, v, w)
                    for i in range(LANES):
                        total = wp.where(status[i] <= VIGNETTED, TOTAL_REFLECTION, status[i])
                        status[i] = wp.where(wp.abs(w[i]) < FAR, status[i], total)

                if interaction == THIN_LENS:
                    if wp.static(chromatic):
                        n = indices[surfaces.kinds[s, MEDIUM_BEFORE], packet]
                        behind = indices[surfaces.kinds[s, MEDIUM_AFTER], packet]
                    else:
                        n = lanes(before)
                        behind = lanes(after)
                    power = surfaces.numbers[s, POWER]
                    vergence = surfaces.numbers[s, VERGENCE]
                    u, v, w, added = through_thin_lens(power, vergence, n, behind, x, y, u, v, w)
                    if wp.static(not chromatic):
                        path = path + added

            if rotated == 1:
                x, y, z = to_telescope(surfaces, s, x, y, z)
                u, v, w = to_telescope(surfaces, s, u, v, w)
            x = x + lanes(surfaces.numbers[s, VERTEX])
            y = y + lanes(surfaces.numbers[s, VERTEX + 1])
            z = z + lanes(surfaces.numbers[s, VERTEX + 2])
            if s >= skipped:
                o = s - skipped
                out.position[o, 0, packet] = x
                out.position[o, 1, packet] = y
                out.position[o, 2, packet] = z
                out.direction[o, 0, packet] = u
                out.direction[o, 1, packet] = v
                out.direction[o, 2, packet] = w
                out.path[o, packet] = path
                out.status[o, packet] = statuses(status)
        return x, y, z, u, v, w, path, status

    return through_telescope


#: The loops of the variants of `kernel_pair`; the same for rays of a wavelength each.
LOOPS = (surface_loop(False), surface_loop(True))
CHROMATIC_LOOPS = (surface_loop(False, chromatic=True), surface_loop(True, chromatic=True))


@partial(kernel_pair, shared=__package__)
def trace_rays(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that traces given rays."""
    through_telescope = LOOPS[special]

    @wp.kernel(module=module)
    def trace_rays(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array2d(dtype=wp.float64),
        start: RayPackets,
        out: RayPackets,
    ):
        """Trace one packet of given rays through every surface; write the last surface, or all of them.

        ``indices`` holds the refractive index before the first surface and after each. Outputs have a leading axis of
        length 1 (the last surface) or ``n_surfaces``.
        """
        p = first + wp.tid()
        x, y, z = components(start.position, 0, p)
        u, v, w = components(start.direction, 0, p)
        through_telescope(surfaces, indices, 0, x, y, z, u, v, w, start.path[0, p], p, out)

    return trace_rays
