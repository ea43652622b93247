"""Kernel of the clear part of a pupil."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...raytrace.kernels.surface_table import APERTURE, ROTATION, VERTEX, PackedSurfaces

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
def within(a: wp.float64, b: wp.float64, c: wp.float64, square: wp.float64):
    """Interval of 0 to 2 in which the parabola through a, b, c at 0, 1, 2 lies below a square; empty: equal ends."""
    zero = wp.float64(0.0)
    two = wp.float64(2.0)
    half = wp.float64(0.5)
    low = zero
    high = zero
    curvature = half * (a - two * b + c)
    slope = b - a - curvature
    start = a - square
    # A NaN fails all comparisons; a linear squared distance may have any small curvature.
    if curvature > zero and start < zero and c < square:
        # All of it, without roots: most rims of most spokes.
        high = two
    elif curvature > zero:
        inner = slope * slope - wp.float64(4.0) * curvature * start
        if inner > zero:
            # The two roots without the difference of near-equal numbers.
            scaled_root = -half * (slope + wp.where(slope < zero, -wp.sqrt(inner), wp.sqrt(inner)))
            first_root = scaled_root / curvature
            second_root = wp.where(scaled_root == zero, zero, start / scaled_root)
            low = wp.clamp(wp.min(first_root, second_root), zero, two)
            high = wp.clamp(wp.max(first_root, second_root), zero, two)
    elif curvature <= zero:
        end = c - square
        if start < zero and end < zero:
            high = two
        elif start < zero:
            high = two * start / (start - end)
        elif end < zero:
            low = two * start / (start - end)
            high = two
    return low, high


@wp.kernel
def square_distances(
    first: wp.int32,
    surfaces: PackedSurfaces,
    stops: wp.array(dtype=wp.int32),
    position: wp.array3d(dtype=wp.float64),
    squares: wp.array3d(dtype=wp.float64),
):
    """Square the distances of the rays of one star from the centres of clear apertures.

    Arguments: stops [stop]: surfaces with an aperture; position [surface, 3, star * n_ray + ray]: telescope frame [m];
    squares [star, stop, ray] [m^2].
    """
    star = first + wp.tid()
    for stop in range(stops.shape[0]):
        for ray in range(squares.shape[2]):
            squares[star, stop, ray] = squared_distance(surfaces, stops[stop], position, star * squares.shape[2] + ray)


@wp.kernel
def find_edges(
    first: wp.int32,
    surfaces: PackedSurfaces,
    stops: wp.array(dtype=wp.int32),
    squares: wp.array3d(dtype=wp.float64),
    radius: wp.array(dtype=wp.float64),
    n_spoke: wp.int32,
    edges: wp.array3d(dtype=wp.float64),
):
    """Find the radii between which one spoke of the pupil of one star is clear.

    The intersection of a ray with a surface is nearly linear in its place in the pupil. So the square of its distance
    from the centre of the aperture is a parabola along the spoke: three rays determine its intersection with the rim.

    Arguments: stops, squares [star, stop, ring * n_spoke + spoke]: those of :func:`square_distances`; radius [3] of the
    rays in the pupil, at equal steps [m]; edges [star, spoke, 2]: inner and outer radius, the same where all is dark.
    """
    item = first + wp.tid()
    star = item // n_spoke
    spoke = item % n_spoke
    half = wp.float64(0.5)
    step = radius[1] - radius[0]
    inside = radius[0]
    outside = radius[2]
    for stop in range(stops.shape[0]):
        s = stops[stop]
        a = squares[star, stop, spoke]
        b = squares[star, stop, spoke + n_spoke]
        c = squares[star, stop, spoke + 2 * n_spoke]
        missed = a != a or b != b or c != c
        rim = surfaces.numbers[s, APERTURE + 3] * surfaces.numbers[s, APERTURE + 3]
        low, high = within(a, b, c, rim)
        if missed:
            # Rays that miss a surface pass beyond its rim: what is clear ends before the first of them.
            low = wp.float64(0.0)
            high = wp.float64(0.0)
            if a < rim:
                high = wp.where(b < rim, wp.float64(1.0), wp.float64(0.0))
            elif c < rim:
                low = wp.where(b < rim, wp.float64(1.0), wp.float64(2.0))
                high = wp.float64(2.0)
        inside = wp.max(inside, radius[0] + step * low)
        outside = wp.min(outside, radius[0] + step * high)
        hole = surfaces.numbers[s, APERTURE + 2] * surfaces.numbers[s, APERTURE + 2]
        # A parabola may dip a little below zero where rays meet.
        if hole > wp.float64(0.0):
            low, high = within(a, b, c, hole)
            # The larger of the two pieces that the hole leaves.
            if high > low and low > wp.float64(2.0) - high:
                outside = wp.min(outside, radius[0] + step * low)
            elif high > low:
                inside = wp.max(inside, radius[0] + step * high)
    if inside >= outside:
        inside = half * (inside + outside)
        outside = inside
    edges[star, spoke, 0] = inside
    edges[star, spoke, 1] = outside
