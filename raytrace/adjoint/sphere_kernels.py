"""Forward pass to reference spheres and backward pass in one kernel, packet by packet."""

from __future__ import annotations

from functools import partial

import warp as wp

from ...core.launch import ROLLED_OPTIONS
from ..kernels.kernel_pair import kernel_pair
from ..kernels.packet import LANES, RayPackets, lane_flags, lanes
from ..kernels.pupil import direction_from_point, plane_wave_start
from ..kernels.sphere import sphere_distance
from ..kernels.surface import OK, ONE, ZERO
from ..kernels.surface_table import PackedSurfaces
from ..kernels.trace import LOOPS, statuses
from .backward_kernels import BACKWARD_LOOPS
from .column_kernels import INDEX, polynomial_columns

wp.set_module_options(ROLLED_OPTIONS)

#: Columns of the sphere: the path beyond that of the chief ray [m], and its derivatives by the landing point (3).
SPHERE_COLUMNS = 4


@partial(kernel_pair, shared=__package__, options=ROLLED_OPTIONS)
def sphere_paths(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel of both passes."""
    through_telescope = LOOPS[special]
    backward_through = BACKWARD_LOOPS[special]

    @wp.kernel(module=module)
    def sphere_paths(
        first: wp.int32,
        surfaces: PackedSurfaces,
        indices: wp.array2d(dtype=wp.float64),
        media: wp.array(dtype=wp.float64),
        fields: wp.array2d(dtype=wp.float64),
        objects: wp.array2d(dtype=wp.float64),
        pupil: wp.array3d(dtype=lanes),
        pupil_z: wp.float64,
        distance: wp.float64,
        radius: wp.float64,
        columns: wp.array2d(dtype=wp.int32),
        polynomials: wp.array2d(dtype=wp.int32),
        scales: wp.array(dtype=wp.float64),
        sphere_column: wp.int32,
        lit_only: wp.int32,
        first_field: wp.int32,
        n_items: wp.int32,
        start: RayPackets,
        rays: RayPackets,
        matrix: wp.array3d(dtype=lanes),
        status_out: wp.array(dtype=lane_flags),
    ):
        """Trace one of ``n_items`` equal parts of the packets; a packet's rays overwrite those of the one before.

        The packets are those of the pupil, field point by field point. ``fields`` holds for each of these the direction
        of its light, the centre of its sphere and the path of its chief ray to that [m]; ``objects`` the point that the
        light comes from, where it is not empty. ``pupil`` [set, 2, packet] has one set for all field points, or one for
        each. ``sphere_column`` is the first column of the sphere. With ``lit_only`` all is zero for rays that are
        vignetted.
        """
        item = first + wp.tid()
        count = status_out.shape[0]
        n_packets = pupil.shape[2]
        n_surfaces = surfaces.kinds.shape[0]
        n = media[n_surfaces - 1]
        for p in range(count * item / n_items, count * (item + 1) / n_items):
            f = first_field + p / n_packets
            q = p % n_packets
            pupil_set = f % pupil.shape[0]
            du = lanes(fields[f, 0])
            dv = lanes(fields[f, 1])
            dw = lanes(fields[f, 2])
            at_x = pupil[pupil_set, 0, q]
            at_y = pupil[pupil_set, 1, q]
            px, py, pz = plane_wave_start(at_x, at_y, pupil_z, fields[f, 0], fields[f, 1], fields[f, 2], distance)
            if objects.shape[0] > 0:
                px = lanes(objects[f, 0])
                py = lanes(objects[f, 1])
                pz = lanes(objects[f, 2])
                du, dv, dw = direction_from_point(at_x, at_y, pupil_z, objects[f, 0], objects[f, 1], objects[f, 2])
            start.position[0, 0, item] = px
            start.position[0, 1, item] = py
            start.position[0, 2, item] = pz
            start.direction[0, 0, item] = du
            start.direction[0, 1, item] = dv
            start.direction[0, 2, item] = dw
            x, y, z, u, v, w, path, status = through_telescope(
                surfaces, indices, 0, px, py, pz, du, dv, dw, lanes(ZERO), item, rays
            )
            status_out[p] = statuses(status)
            weight = lanes(ONE)
            if lit_only == 1:
                for i in range(LANES):
                    weight[i] = wp.where(status[i] == OK, ONE, ZERO)
            x = x - lanes(fields[f, 3])
            y = y - lanes(fields[f, 4])
            z = z - lanes(fields[f, 5])
            ahead, along, root = sphere_distance(x, y, z, u, v, w, radius)
            ratio = wp.cw_div(along, root) - lanes(ONE)
            ax = n * wp.cw_mul(weight, wp.cw_mul(ratio, u) - wp.cw_div(x, root))
            ay = n * wp.cw_mul(weight, wp.cw_mul(ratio, v) - wp.cw_div(y, root))
            az = n * wp.cw_mul(weight, wp.cw_mul(ratio, w) - wp.cw_div(z, root))
            matrix[0, sphere_column, p] = wp.cw_mul(weight, path + n * ahead - lanes(fields[f, 6]))
            matrix[0, sphere_column + 1, p] = ax
            matrix[0, sphere_column + 2, p] = ay
            matrix[0, sphere_column + 3, p] = az
            bx = n * wp.cw_mul(weight, wp.cw_mul(ratio, x))
            by = n * wp.cw_mul(weight, wp.cw_mul(ratio, y))
            bz = n * wp.cw_mul(weight, wp.cw_mul(ratio, z))
            backward_through(surfaces, media, start, rays, item, weight, ax, ay, az, bx, by, bz, columns, 0, p, matrix)
            column = columns[n_surfaces - 1, INDEX]
            if column >= 0:
                # The index in front of the last surface acts up to the sphere.
                matrix[0, column, p] = matrix[0, column, p] + wp.cw_mul(weight, ahead)
            for j in range(scales.shape[0]):
                polynomial_columns(polynomials, scales[j], j, 0, p, matrix)

    return sphere_paths
