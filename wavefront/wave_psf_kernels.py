"""Kernels of the wave PSF engine: the path of the atmosphere at every pupil point, and the field of each wavelength."""

from __future__ import annotations

import warp as wp

from ..raytrace.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Pupil points in one packet.
LANES = 16

points = wp.types.vector(LANES, wp.float32)
places = wp.types.vector(LANES, wp.float64)
indices = wp.types.vector(LANES, wp.int32)


@wp.func
def spline_path(screens: wp.array3d(dtype=wp.float32), layer: wp.int32, x: places, y: places):
    """Read a periodic screen of cubic B-spline coefficients at screen coordinates [pixels]."""
    n = screens.shape[1]
    path = points()
    for i in range(LANES):
        floor_x = wp.floor(x[i])
        floor_y = wp.floor(y[i])
        u = wp.float32(x[i] - floor_x)
        v = wp.float32(y[i] - floor_y)
        # from the sample before the one at the left; coordinates are within one period of the screen
        column = wp.int32(floor_x) - 1
        row = wp.int32(floor_y) - 1
        column = wp.where(column < 0, column + n, column)
        row = wp.where(row < 0, row + n, row)
        c1 = wp.where(column + 1 >= n, column + 1 - n, column + 1)
        c2 = wp.where(column + 2 >= n, column + 2 - n, column + 2)
        c3 = wp.where(column + 3 >= n, column + 3 - n, column + 3)
        sixth = wp.float32(1.0 / 6.0)
        one = wp.float32(1.0)
        three = wp.float32(3.0)
        u0 = (one - u) * (one - u) * (one - u) * sixth
        u1 = (wp.float32(4.0) + u * u * (three * u - wp.float32(6.0))) * sixth
        u3 = u * u * u * sixth
        u2 = one - u0 - u1 - u3
        v0 = (one - v) * (one - v) * (one - v) * sixth
        v1 = (wp.float32(4.0) + v * v * (three * v - wp.float32(6.0))) * sixth
        v3 = v * v * v * sixth
        v2 = one - v0 - v1 - v3
        total = wp.float32(0.0)
        for k in range(4):
            r = row + k
            r = wp.where(r >= n, r - n, r)
            line = (
                u0 * screens[layer, r, column]
                + u1 * screens[layer, r, c1]
                + u2 * screens[layer, r, c2]
                + u3 * screens[layer, r, c3]
            )
            weight = wp.where(k == 0, v0, wp.where(k == 1, v1, wp.where(k == 2, v2, v3)))
            total += weight * line
        path[i] = total
    return path


@wp.func
def in_period(position: places, start: wp.float64, size: wp.int32):
    """Add a start to positions [pixels] and take them modulo the screen."""
    out = places()
    n = wp.float64(size)
    for i in range(LANES):
        p = position[i] + start
        out[i] = wp.max(p - n * wp.floor(p / n), wp.float64(0.0))
    return out


@wp.func
def unit_circle(turns: points):
    """Cosine and sine of an angle given in turns, to 3e-7: a polynomial vectorizes, the library's functions do not."""
    cosine = points()
    sine = points()
    for i in range(LANES):
        # quarter turns: angle = pi/2 (q + r) with r in [-1/2, 1/2]
        quarters = turns[i] * wp.float32(4.0)
        q = wp.floor(quarters + wp.float32(0.5))
        r = (quarters - q) * wp.float32(1.5707963267948966)
        s = r * r
        sin_r = r * (
            wp.float32(1.0)
            + s * (wp.float32(-1.6666654611e-1) + s * (wp.float32(8.3321608736e-3) + s * wp.float32(-1.9515295891e-4)))
        )
        cos_r = (
            wp.float32(1.0)
            - wp.float32(0.5) * s
            + s * s * (wp.float32(4.166664568298827e-2) + s * (wp.float32(-1.388731625493765e-3) + s * wp.float32(2.443315711809948e-5)))
        )
        octant = wp.int32(q) & 3
        swapped = (octant & 1) == 1
        c = wp.where(swapped, sin_r, cos_r)
        d = wp.where(swapped, cos_r, sin_r)
        cosine[i] = wp.where(octant == 1 or octant == 2, -c, c)
        sine[i] = wp.where(octant >= 2, -d, d)
    return cosine, sine


@wp.kernel
def pupil_fields(
    first: wp.int32,
    x: wp.array(dtype=places),
    y: wp.array(dtype=places),
    low: wp.array3d(dtype=wp.float32),
    high: wp.array3d(dtype=wp.float32),
    n_layer: wp.int32,
    start: wp.array2d(dtype=wp.float64),
    pixels_per_meter: wp.vec2d,
    turns_per_meter: wp.array(dtype=wp.float32),
    optics: wp.array2d(dtype=points),
    amplitude: wp.array2d(dtype=points),
    place: wp.array(dtype=indices),
    field: wp.array2d(dtype=wp.vec2f),
):
    """Write the complex field of every wavelength at one packet of pupil points.

    Arguments: x, y [packet] pupil coordinates [m]; low, high [layer, y, x] spline coefficients of path [m]; start
    [layer, 4] coordinates of the pupil's centre on the low (0, 1) and high (2, 3) screen [pixels]; pixels_per_meter of the
    low and the high screens; turns_per_meter [wave]; optics [wave, packet] phase [turns]; amplitude [wave, packet];
    place [packet] of the points in a field; field [wave, place].
    """
    packet = first + wp.tid()
    path = points()
    for layer in range(n_layer):
        scale = pixels_per_meter[0]
        low_x = in_period(x[packet] * scale, start[layer, 0], low.shape[1])
        low_y = in_period(y[packet] * scale, start[layer, 1], low.shape[1])
        path = path + spline_path(low, layer, low_x, low_y)
        scale = pixels_per_meter[1]
        high_x = in_period(x[packet] * scale, start[layer, 2], high.shape[1])
        high_y = in_period(y[packet] * scale, start[layer, 3], high.shape[1])
        path = path + spline_path(high, layer, high_x, high_y)
    at = place[packet]
    for wave in range(turns_per_meter.shape[0]):
        cosine, sine = unit_circle(path * turns_per_meter[wave] + optics[wave, packet])
        a = amplitude[wave, packet]
        for i in range(LANES):
            field[wave, at[i]] = wp.vec2f(a[i] * cosine[i], a[i] * sine[i])
