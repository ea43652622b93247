"""The kernel that traces photons, each of its own direction, pupil point and wavelength, to the detector."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .kernel_pair import kernel_pair
from .packet import RayPackets, lane_flags, lanes, lanes_sqrt
from .surface import ONE
from .surface_table import VERTEX, PackedSurfaces, to_local
from .trace import CHROMATIC_LOOPS, statuses

wp.set_module_options(FORWARD_OPTIONS)


@kernel_pair
def trace_photons(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that traces photons."""
    through_telescope = CHROMATIC_LOOPS[special]

    @wp.kernel(module=module)
    def trace_photons(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array2d(dtype=lanes),
        offset_x: wp.array(dtype=lanes),
        offset_y: wp.array(dtype=lanes),
        pupil_x: wp.array(dtype=lanes),
        pupil_y: wp.array(dtype=lanes),
        source: wp.array(dtype=wp.float64),
        pupil_z: wp.float64,
        distance: wp.float64,
        no_rays: RayPackets,
        landing: wp.array2d(dtype=lanes),
        status_out: wp.array(dtype=lane_flags),
    ):
        """Trace one packet of photons to the last surface.

        ``source`` [9]: the direction to the source at offsets 0, and its changes per offset along x and y, before
        normalisation. Written are the intersection [m] and the direction in the frame of the last surface, [6, packet].
        """
        p = first + wp.tid()
        ox = offset_x[p]
        oy = offset_y[p]
        u = -(lanes(source[0]) + source[3] * ox + source[6] * oy)
        v = -(lanes(source[1]) + source[4] * ox + source[7] * oy)
        w = -(lanes(source[2]) + source[5] * ox + source[8] * oy)
        scale = wp.cw_div(lanes(ONE), lanes_sqrt(wp.cw_mul(u, u) + wp.cw_mul(v, v) + wp.cw_mul(w, w)))
        u = wp.cw_mul(scale, u)
        v = wp.cw_mul(scale, v)
        w = wp.cw_mul(scale, w)
        px = pupil_x[p]
        py = pupil_y[p]
        back = wp.cw_mul(u, px) + wp.cw_mul(v, py) + pupil_z * w + lanes(distance)
        x, y, z, u, v, w, _, status = through_telescope(
            surfaces,
            indices,
            0,
            px - wp.cw_mul(back, u),
            py - wp.cw_mul(back, v),
            lanes(pupil_z) - wp.cw_mul(back, w),
            u,
            v,
            w,
            lanes(),
            p,
            no_rays,
        )
        last = surfaces.kinds.shape[0] - 1
        x = x - lanes(surfaces.numbers[last, VERTEX])
        y = y - lanes(surfaces.numbers[last, VERTEX + 1])
        z = z - lanes(surfaces.numbers[last, VERTEX + 2])
        x, y, z = to_local(surfaces, last, x, y, z)
        u, v, w = to_local(surfaces, last, u, v, w)
        landing[0, p] = x
        landing[1, p] = y
        landing[2, p] = z
        landing[3, p] = u
        landing[4, p] = v
        landing[5, p] = w
        status_out[p] = statuses(status)

    return trace_photons
