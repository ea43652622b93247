"""The kernel that traces the same pupil points for many stars, to displacements and paths at the image."""

from __future__ import annotations

from functools import partial

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .kernel_pair import kernel_pair
from .packet import RayPackets, lane_flags, lanes, lanes_sqrt
from .sphere import sphere_distance
from .surface import ONE, ZERO
from .surface_table import PackedSurfaces
from .trace import LOOPS, statuses

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def plane_wave_start(
    px: lanes, py: lanes, pz: wp.float64, u: wp.float64, v: wp.float64, w: wp.float64, distance: wp.float64
):
    """Points of a plane wave front, at -distance along the light from the pupil points (px, py, pz)."""
    back = u * px + v * py + lanes(w * pz + distance)
    return px - u * back, py - v * back, lanes(pz) - w * back


@wp.func
def direction_from_point(px: lanes, py: lanes, pz: wp.float64, x: wp.float64, y: wp.float64, z: wp.float64):
    """Return the directions of light from the point (x, y, z) of an object through (px, py, pz)."""
    du = px - lanes(x)
    dv = py - lanes(y)
    dw = lanes(pz - z)
    # The plane of the pupil may lie behind the object; the light still travels downwards.
    scale = -wp.sign(pz - z) * lanes(ONE)
    scale = wp.cw_div(scale, lanes_sqrt(wp.cw_mul(du, du) + wp.cw_mul(dv, dv) + wp.cw_mul(dw, dw)))
    return wp.cw_mul(scale, du), wp.cw_mul(scale, dv), wp.cw_mul(scale, dw)


@partial(kernel_pair, shared=__package__)
def trace_pupils(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that traces pupils."""
    through_telescope = LOOPS[special]

    @wp.kernel(module=module)
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
        no_rays: RayPackets,
        displacement_x: wp.array2d(dtype=lanes),
        displacement_y: wp.array2d(dtype=lanes),
        path_out: wp.array2d(dtype=lanes),
        status_out: wp.array2d(dtype=lane_flags),
    ):
        """Trace packet ``item % n_packets`` of the pupil for bundle ``item // n_packets``.

        A bundle is one star at one wavelength. ``reference`` holds, per bundle, a point of the CCD surface, its normal
        (-dh/dx, -dh/dy, 1) before normalisation, and the detector's x and y axes [12]. Written: the intersections with
        the tangent plane of the CCD there, relative to the point, along these axes, and the optical paths to the sphere
        of that radius about the point, beyond it.
        """
        item = first + wp.tid()
        b = item / n_packets
        p = item - b * n_packets
        row = medium[b]
        n_surfaces = surfaces.kinds.shape[0]
        du = direction[b, 0]
        dv = direction[b, 1]
        dw = direction[b, 2]
        x, y, z = plane_wave_start(pupil[0, p], pupil[1, p], pupil_z, du, dv, dw, distance)
        x, y, z, u, v, w, path, status = through_telescope(
            surfaces, indices, row, x, y, z, lanes(du), lanes(dv), lanes(dw), lanes(ZERO), p, no_rays
        )
        x = x - lanes(reference[b, 0])
        y = y - lanes(reference[b, 1])
        z = z - lanes(reference[b, 2])
        nx = reference[b, 3]
        ny = reference[b, 4]
        nz = reference[b, 5]
        along = wp.cw_div(nx * x + ny * y + nz * z, nx * u + ny * v + nz * w)
        on_x = x - wp.cw_mul(along, u)
        on_y = y - wp.cw_mul(along, v)
        on_z = z - wp.cw_mul(along, w)
        displacement_x[b, p] = reference[b, 6] * on_x + reference[b, 7] * on_y + reference[b, 8] * on_z
        displacement_y[b, p] = reference[b, 9] * on_x + reference[b, 10] * on_y + reference[b, 11] * on_z
        ahead, _along, _root = sphere_distance(x, y, z, u, v, w, radius)
        path_out[b, p] = path + indices[row, n_surfaces - 1] * ahead
        status_out[b, p] = statuses(status)

    return trace_pupils
