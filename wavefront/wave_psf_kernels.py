"""Kernels of the wave PSF engine: the path of the atmosphere at every pupil point, and the field of each wavelength."""

from __future__ import annotations

import warp as wp

from ..raytrace.launch import FORWARD_OPTIONS
from .sample_packets import LANES, indices, places, samples

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def spline_weights(fraction: samples):
    """Weights of the four samples about a place, of which it lies so far [pixels] beyond the second."""
    sixth = wp.float32(1.0 / 6.0)
    before = samples()
    first = samples()
    second = samples()
    after = samples()
    for i in range(LANES):
        u = fraction[i]
        v = wp.float32(1.0) - u
        before[i] = v * v * v * sixth
        first[i] = (wp.float32(4.0) + u * u * (wp.float32(3.0) * u - wp.float32(6.0))) * sixth
        second[i] = (wp.float32(4.0) + v * v * (wp.float32(3.0) * v - wp.float32(6.0))) * sixth
        after[i] = u * u * u * sixth
    return before, first, second, after


@wp.func
def in_period(position: places, start: wp.float64, size: wp.int32):
    """Add a start to positions [pixels], take them modulo the screen; return samples and fractions beyond them."""
    sample = indices()
    fraction = samples()
    side = wp.float64(size)
    for i in range(LANES):
        wrapped = position[i] + start
        wrapped = wrapped - side * wp.floor(wrapped / side)
        whole = wp.int32(wrapped)
        fraction[i] = wp.float32(wrapped - wp.float64(whole))
        sample[i] = wp.where(whole >= size, whole - size, whole)
    return sample, fraction


@wp.func
def spline_row(
    screens: wp.array2d(dtype=wp.float32),
    layer: wp.int32,
    c0: wp.int32,
    c1: wp.int32,
    c2: wp.int32,
    c3: wp.int32,
    u0: wp.float32,
    u1: wp.float32,
    u2: wp.float32,
    u3: wp.float32,
):
    """Weighted sum of four samples of a row."""
    return u0 * screens[layer, c0] + u1 * screens[layer, c1] + u2 * screens[layer, c2] + u3 * screens[layer, c3]


@wp.func
def spline_path(
    screens: wp.array2d(dtype=wp.float32),
    layer: wp.int32,
    size: wp.int32,
    x: places,
    y: places,
    start_x: wp.float64,
    start_y: wp.float64,
):
    """Read a periodic screen of cubic B-spline coefficients at places x, y from a start [pixels]."""
    column, fraction_x = in_period(x, start_x, size)
    row, fraction_y = in_period(y, start_y, size)
    u0, u1, u2, u3 = spline_weights(fraction_x)
    v0, v1, v2, v3 = spline_weights(fraction_y)
    end = size * size
    path = samples()
    for i in range(LANES):
        c1 = column[i]
        c0 = wp.where(c1 > 0, c1, size) - 1
        c2 = wp.where(c1 + 1 < size, c1 + 1, 0)
        c3 = wp.where(c2 + 1 < size, c2 + 1, 0)
        r1 = row[i] * size
        r0 = wp.where(r1 > 0, r1, end) - size
        r2 = wp.where(r1 + size < end, r1 + size, 0)
        r3 = wp.where(r2 + size < end, r2 + size, 0)
        path[i] = (
            v0[i] * spline_row(screens, layer, r0 + c0, r0 + c1, r0 + c2, r0 + c3, u0[i], u1[i], u2[i], u3[i])
            + v1[i] * spline_row(screens, layer, r1 + c0, r1 + c1, r1 + c2, r1 + c3, u0[i], u1[i], u2[i], u3[i])
            + v2[i] * spline_row(screens, layer, r2 + c0, r2 + c1, r2 + c2, r2 + c3, u0[i], u1[i], u2[i], u3[i])
            + v3[i] * spline_row(screens, layer, r3 + c0, r3 + c1, r3 + c2, r3 + c3, u0[i], u1[i], u2[i], u3[i])
        )
    return path


@wp.func
def unit_circle(turns: samples):
    """Cosine and sine of an angle given in turns, to 1e-7; unlike the library's functions, polynomials vectorize.

    Taylor series over an eighth of a turn to either side of the nearest quarter: the first term left out is below
    3e-8.
    """
    cosine = samples()
    sine = samples()
    for i in range(LANES):
        quarter = wp.floor(wp.float32(4.0) * turns[i] + wp.float32(0.5))
        angle = (wp.float32(4.0) * turns[i] - quarter) * wp.float32(wp.HALF_PI)
        s = angle * angle
        near_sine = angle * (
            wp.float32(1.0)
            + s
            * (
                wp.float32(-1.0 / 6.0)
                + s * (wp.float32(1.0 / 120.0) + s * (wp.float32(-1.0 / 5040.0) + s * wp.float32(1.0 / 362880.0)))
            )
        )
        near_cosine = wp.float32(1.0) + s * (
            wp.float32(-0.5)
            + s * (wp.float32(1.0 / 24.0) + s * (wp.float32(-1.0 / 720.0) + s * wp.float32(1.0 / 40320.0)))
        )
        quadrant = wp.int32(quarter) & 3
        odd = (quadrant & 1) == 1
        c = wp.where(odd, near_sine, near_cosine)
        d = wp.where(odd, near_cosine, near_sine)
        cosine[i] = wp.where(quadrant == 1 or quadrant == 2, -c, c)
        sine[i] = wp.where(quadrant >= 2, -d, d)
    return cosine, sine


@wp.kernel
def pupil_fields(
    first: wp.int32,
    x: wp.array(dtype=places),
    y: wp.array(dtype=places),
    low: wp.array2d(dtype=wp.float32),
    low_size: wp.int32,
    high: wp.array2d(dtype=wp.float32),
    high_size: wp.int32,
    n_layer: wp.int32,
    start: wp.array2d(dtype=wp.float64),
    pixels_per_meter: wp.vec2d,
    turns_per_meter: wp.array(dtype=wp.float32),
    optics: wp.array2d(dtype=samples),
    amplitude: wp.array2d(dtype=samples),
    place: wp.array(dtype=indices),
    field: wp.array2d(dtype=wp.vec2f),
):
    """Write the complex field of every wavelength at one packet of pupil points.

    Arguments: x, y [packet]: pupil coordinates [m]; low, high [layer, y * size + x]: spline coefficients of path [m];
    start [layer, 4]: coordinates of the pupil's centre on the low (0, 1) and the high (2, 3) screen [pixels];
    pixels_per_meter of the low and the high screens; turns_per_meter [wave]; optics [wave, packet]: phase [turns];
    amplitude [wave, packet]; place [packet] of the points in a field; field [wave, place].
    """
    packet = first + wp.tid()
    path = samples()
    for layer in range(n_layer):
        scale = pixels_per_meter[0]
        path = path + spline_path(
            low, layer, low_size, x[packet] * scale, y[packet] * scale, start[layer, 0], start[layer, 1]
        )
        scale = pixels_per_meter[1]
        path = path + spline_path(
            high, layer, high_size, x[packet] * scale, y[packet] * scale, start[layer, 2], start[layer, 3]
        )
    at = place[packet]
    for wave in range(turns_per_meter.shape[0]):
        cosine, sine = unit_circle(path * turns_per_meter[wave] + optics[wave, packet])
        light = amplitude[wave, packet]
        for i in range(LANES):
            field[wave, at[i]] = wp.vec2f(light[i] * cosine[i], light[i] * sine[i])
