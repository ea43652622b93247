"""The forward sweep to a reference sphere and the way back, packet by packet, while the packet is at hand.

A module of its own: with one caller of the surface loop in a module the compiler puts all of it in line.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ..kernels.kernel_pair import kernel_pair
from ..kernels.packet import LANES, lane_flags, lanes, lanes_sqrt
from ..kernels.pupil import launched
from ..kernels.surface import OK, ONE, ZERO
from ..kernels.trace import LOOPS, PackedSurfaces, statuses
from .adjoint_kernels import INDEX, polynomial_response
from .gradient_kernels import BACK_LOOPS

wp.set_module_options(FORWARD_OPTIONS)

#: Rows that this sweep adds: the path beyond that of the chief ray [m], and its derivative by the landing point (3).
SPHERE_ROWS = 4


@kernel_pair
def sweep_sphere(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that sweeps to the sphere and back."""
    through_telescope = LOOPS[special]
    back_through = BACK_LOOPS[special]

    @wp.kernel(module=module)
    def sweep_sphere(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array2d(dtype=wp.float64),
        media: wp.array(dtype=wp.float64),
        fields: wp.array2d(dtype=wp.float64),
        pupil: wp.array2d(dtype=lanes),
        pupil_z: wp.float64,
        distance: wp.float64,
        radius: wp.float64,
        rows: wp.array2d(dtype=wp.int32),
        polynomials: wp.array2d(dtype=wp.int32),
        scales: wp.array(dtype=wp.float64),
        sphere_row: wp.int32,
        lit_only: wp.int32,
        first_field: wp.int32,
        n_items: wp.int32,
        start: wp.array2d(dtype=lanes),
        start_direction: wp.array2d(dtype=lanes),
        position: wp.array3d(dtype=lanes),
        direction: wp.array3d(dtype=lanes),
        path_kept: wp.array2d(dtype=lanes),
        status_kept: wp.array2d(dtype=lane_flags),
        response: wp.array3d(dtype=lanes),
        status_out: wp.array(dtype=lane_flags),
    ):
        """Sweep one of ``n_items`` equal parts of the packets; a packet's rays overwrite those of the one before.

        The packets are those of the pupil, field point by field point. ``fields`` holds for each of these the direction
        of its light, the centre of its sphere and the path of its chief ray to that [m]. The rows that the sweep adds
        begin with ``sphere_row``. With ``lit_only`` all is zero for rays that are vignetted.
        """
        item = first + wp.tid()
        count = status_out.shape[0]
        n_packets = pupil.shape[1]
        n_surfaces = surfaces.kinds.shape[0]
        n = media[n_surfaces - 1]
        for p in range(count * item / n_items, count * (item + 1) / n_items):
            f = first_field + p / n_packets
            q = p % n_packets
            du = fields[f, 0]
            dv = fields[f, 1]
            dw = fields[f, 2]
            px, py, pz = launched(pupil[0, q], pupil[1, q], pupil_z, du, dv, dw, distance)
            start[0, item] = px
            start[1, item] = py
            start[2, item] = pz
            start_direction[0, item] = lanes(du)
            start_direction[1, item] = lanes(dv)
            start_direction[2, item] = lanes(dw)
            x, y, z, u, v, w, path, status = through_telescope(
                surfaces,
                indices,
                0,
                px,
                py,
                pz,
                lanes(du),
                lanes(dv),
                lanes(dw),
                lanes(ZERO),
                item,
                position,
                direction,
                path_kept,
                status_kept,
            )
            status_out[p] = statuses(status)
            counts = lanes(ONE)
            if lit_only == 1:
                for i in range(LANES):
                    counts[i] = wp.where(status[i] == OK, ONE, ZERO)
            x = x - lanes(fields[f, 3])
            y = y - lanes(fields[f, 4])
            z = z - lanes(fields[f, 5])
            # Beyond the image the sphere is at root - q.d, with root = sqrt((q.d)^2 - q.q + R^2).
            along = wp.cw_mul(x, u) + wp.cw_mul(y, v) + wp.cw_mul(z, w)
            square = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
            root = lanes_sqrt(wp.cw_mul(along, along) - square + lanes(radius * radius))
            ahead = root - along
            ratio = wp.cw_div(along, root) - lanes(ONE)
            ax = n * wp.cw_mul(counts, wp.cw_mul(ratio, u) - wp.cw_div(x, root))
            ay = n * wp.cw_mul(counts, wp.cw_mul(ratio, v) - wp.cw_div(y, root))
            az = n * wp.cw_mul(counts, wp.cw_mul(ratio, w) - wp.cw_div(z, root))
            response[0, sphere_row, p] = wp.cw_mul(counts, path + n * ahead - lanes(fields[f, 6]))
            response[0, sphere_row + 1, p] = ax
            response[0, sphere_row + 2, p] = ay
            response[0, sphere_row + 3, p] = az
            back_through(
                surfaces,
                media,
                start,
                start_direction,
                position,
                direction,
                item,
                counts,
                ax,
                ay,
                az,
                n * wp.cw_mul(counts, wp.cw_mul(ratio, x)),
                n * wp.cw_mul(counts, wp.cw_mul(ratio, y)),
                n * wp.cw_mul(counts, wp.cw_mul(ratio, z)),
                rows,
                0,
                p,
                response,
            )
            row = rows[n_surfaces - 1, INDEX]
            if row >= 0:
                # The index in front of the last surface acts up to the sphere.
                response[0, row, p] = response[0, row, p] + wp.cw_mul(counts, ahead)
            for j in range(scales.shape[0]):
                polynomial_response(polynomials, scales[j], j, 0, p, response)

    return sweep_sphere
