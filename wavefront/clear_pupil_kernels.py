"""The kernel that finds which part of a pupil the apertures of a telescope leave clear."""

from __future__ import annotations

import warp as wp

from ..raytrace.launch import FORWARD_OPTIONS
from ..raytrace.trace_kernels import APERTURE, ROTATION, STOPPED, VERTEX, PackedSurfaces

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def squared_distance(
    surfaces: PackedSurfaces, s: wp.int32, position: wp.array3d(dtype=wp.float64), ray: wp.int32
) -> wp.float64:
    """Square of a ray's distance from the centre of the clear aperture of surface ``s``, in its own x and y [m^2]."""
    x = position[s, 0, ray] - surfaces.numbers[s, VERTEX]
    y = position[s, 1, ray] - surfaces.numbers[s, VERTEX + 1]
    z = position[s, 2, ray] - surfaces.numbers[s, VERTEX + 2]
    r = ROTATION
    along_x = surfaces.numbers[s, r] * x + surfaces.numbers[s, r + 3] * y + surfaces.numbers[s, r + 6] * z
    along_y = surfaces.numbers[s, r + 1] * x + surfaces.numbers[s, r + 4] * y + surfaces.numbers[s, r + 7] * z
    along_x = along_x - surfaces.numbers[s, APERTURE]
    along_y = along_y - surfaces.numbers[s, APERTURE + 1]
    return along_x * along_x + along_y * along_y


@wp.func
def sign_change(before: wp.float64, after: wp.float64, bend: wp.float64) -> wp.float64:
    """Where a parabola changes sign between two values, 0 to 1, or 0 if one is a NaN.

    ``bend`` is half of its second difference over that distance.
    """
    t = wp.float64(0.0)
    for _i in range(5):
        # before + (after - before) t - bend t (1 - t) = 0: what bends is small, so that this closes in quickly.
        t = before / (before - after + bend * (wp.float64(1.0) - t))
    return wp.where(t >= wp.float64(0.0), wp.min(t, wp.float64(1.0)), wp.float64(0.0))


@wp.kernel
def find_edges(
    first: wp.int32,
    surfaces: PackedSurfaces,
    position: wp.array3d(dtype=wp.float64),
    radius: wp.array(dtype=wp.float64),
    n_spoke: wp.int32,
    edges: wp.array3d(dtype=wp.float64),
):
    """Find between which radii one spoke of the pupil of one star is clear.

    Where a ray crosses a surface is nearly linear in its place in the pupil, so the square of its distance from the
    centre of the aperture there is a parabola along the spoke: three rays tell where it passes the rim.

    Arguments: position [surface, 3, (star * 3 + ring) * n_spoke + spoke]: telescope frame [m]; radius [3] of the rays
    in the pupil, at equal steps [m]; edges [star, spoke, 2]: inner and outer radius, the same where all is dark.
    """
    item = first + wp.tid()
    star = item // n_spoke
    spoke = item % n_spoke
    ray = 3 * star * n_spoke + spoke
    half = wp.float64(0.5)
    step = radius[1] - radius[0]
    inside = radius[0]
    outside = radius[2]
    for s in range(surfaces.kinds.shape[0]):
        if surfaces.kinds[s, STOPPED] == 1:
            a = squared_distance(surfaces, s, position, ray)
            b = squared_distance(surfaces, s, position, ray + n_spoke)
            c = squared_distance(surfaces, s, position, ray + 2 * n_spoke)
            bend = half * (a - wp.float64(2.0) * b + c)
            # Comparisons are such that a ray that missed the surface, a NaN, is beyond the rim.
            square = surfaces.numbers[s, APERTURE + 3] * surfaces.numbers[s, APERTURE + 3]
            rim = radius[2]
            if not a < square:
                rim = radius[0]
            elif not b < square:
                rim = radius[0] + step * sign_change(a - square, b - square, bend)
            elif not c < square:
                rim = radius[1] + step * sign_change(b - square, c - square, bend)
            square = surfaces.numbers[s, APERTURE + 2] * surfaces.numbers[s, APERTURE + 2]
            hole = radius[0]
            if c < square:
                hole = radius[2]
            elif b < square:
                hole = radius[1] + step * sign_change(b - square, c - square, bend)
            elif a < square:
                hole = radius[0] + step * sign_change(a - square, b - square, bend)
            inside = wp.max(inside, hole)
            outside = wp.min(outside, rim)
    if inside >= outside:
        inside = half * (inside + outside)
        outside = inside
    edges[star, spoke, 0] = inside
    edges[star, spoke, 1] = outside
