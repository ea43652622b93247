"""The kernel that traces the pupil of many field points and stores nothing but optical path differences."""

from __future__ import annotations

from functools import partial

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .kernel_pair import kernel_pair
from .packet import LANES, RayPackets, lane_flags, lanes
from .pupil import direction_from_point, plane_wave_start
from .sphere import sphere_distance
from .surface import OK, ZERO
from .surface_table import PackedSurfaces
from .trace import LOOPS

wp.set_module_options(FORWARD_OPTIONS)


@partial(kernel_pair, shared=__package__)
def trace_opds(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that traces optical path differences."""
    through_telescope = LOOPS[special]

    @wp.kernel(module=module)
    def trace_opds(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array2d(dtype=wp.float64),
        work: wp.array(dtype=wp.int32),
        pupil: wp.array2d(dtype=lanes),
        place: wp.array(dtype=lane_flags),
        pupil_z: wp.float64,
        distance: wp.float64,
        direction: wp.array2d(dtype=wp.float64),
        start: wp.array2d(dtype=wp.float64),
        sphere: wp.array2d(dtype=wp.float64),
        radius: wp.float64,
        no_rays: RayPackets,
        value: wp.array2d(dtype=wp.float64),
        lit: wp.array(dtype=wp.int32),
    ):
        """Trace one packet of the pupil for one field point: item ``i`` of the work is field ``i // n_packets``.

        ``place``: column of ``value`` for each lane (-1: none). ``direction`` [field, 3], or ``start`` [field, 3] where
        it is not empty: directions of light from infinity, points of the object otherwise. ``sphere`` [field, 4]:
        centre of the reference sphere, and path of the chief ray to it. ``value`` [field, pupil] is that path less the
        ray's where the ray is lit; it may be empty. ``lit`` [item]: number of lit lanes of the packet.
        """
        item = work[first + wp.tid()]
        n_packets = pupil.shape[1]
        b = item / n_packets
        p = item - b * n_packets
        px = pupil[0, p]
        py = pupil[1, p]
        du = lanes(direction[b, 0])
        dv = lanes(direction[b, 1])
        dw = lanes(direction[b, 2])
        x, y, z = plane_wave_start(px, py, pupil_z, direction[b, 0], direction[b, 1], direction[b, 2], distance)
        if start.shape[0] > 0:
            x = lanes(start[b, 0])
            y = lanes(start[b, 1])
            z = lanes(start[b, 2])
            du, dv, dw = direction_from_point(px, py, pupil_z, start[b, 0], start[b, 1], start[b, 2])
        x, y, z, u, v, w, path, status = through_telescope(
            surfaces, indices, 0, x, y, z, du, dv, dw, lanes(ZERO), p, no_rays
        )
        count = wp.int32(0)
        for i in range(LANES):
            count += wp.where(status[i] == OK, wp.int32(1), wp.int32(0))
        lit[item] = count
        if count == 0 or value.shape[0] == 0:
            return
        x = x - lanes(sphere[b, 0])
        y = y - lanes(sphere[b, 1])
        z = z - lanes(sphere[b, 2])
        ahead, _along, _root = sphere_distance(x, y, z, u, v, w, radius)
        opd = lanes(sphere[b, 3]) - (path + indices[0, surfaces.kinds.shape[0] - 1] * ahead)
        for i in range(LANES):
            at = place[p][i]
            if status[i] == OK and at >= 0:
                value[b, at] = opd[i]

    return trace_opds
