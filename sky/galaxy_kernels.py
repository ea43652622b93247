"""Kernel of the Fourier transforms of galaxies made of Sersic components."""

from __future__ import annotations

import warp as wp

from ..core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Frequencies in one packet.
LANES = 16
samples = wp.types.vector(LANES, wp.float32)


@wp.func
def cubic_weights(u: wp.float32):
    """Weights of the values at -1, 0, 1, 2 in their interpolating cubic at ``u``."""
    below = u + 1.0
    above = u - 1.0
    beyond = u - 2.0
    return wp.vec4(
        -u * above * beyond / 6.0, below * above * beyond / 2.0, -below * u * beyond / 2.0, below * u * above / 6.0
    )


@wp.func
def cell(at: wp.float32, size: wp.int32):
    """Index of the second of the four nodes around a place, kept inside a table, and the distance from it."""
    inside = wp.clamp(at, 0.0, wp.float32(size - 1))
    i = wp.clamp(wp.int32(inside), 1, size - 3)
    return i, inside - wp.float32(i)


@wp.func
def product(a: wp.vec2d, b: wp.vec2d):
    """Product of two complex numbers."""
    return wp.vec2d(a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


@wp.func
def half_logarithms(x: samples):
    """Half of the natural logarithms of numbers that are not negative, to 1e-7; unlike the library's, it vectorizes.

    x = 2^n m with m within a factor sqrt(2) of 1, and log m = 2 artanh((m - 1)/(m + 1)). Zero gives -44.
    """
    half = samples()
    for i in range(LANES):
        bits = wp.cast(x[i], wp.int32)
        # Hexadecimal 3f3504f3 is the square root of one half.
        exponent = (bits - 0x3F3504F3) >> 23
        m = wp.cast(bits - (exponent << 23), wp.float32)
        s = (m - 1.0) / (m + 1.0)
        q = s * s
        half[i] = 0.34657359 * wp.float32(exponent) + s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q / 7.0)))
    return half


@wp.func
def profile_at(
    profile: wp.array2d(dtype=wp.float32),
    item: wp.int32,
    squared: samples,
    start: wp.float32,
    per_step: wp.float32,
):
    """Transform of a component at squared wave numbers, interpolated by cubics in their logarithm."""
    # The logarithm of zero lies below the table, where the transform is 1.
    at = half_logarithms(squared) * per_step
    value = samples()
    for lane in range(LANES):
        j, v = cell(at[lane] - start, profile.shape[1])
        w = cubic_weights(v)
        value[lane] = (
            w[0] * profile[item, j - 1]
            + w[1] * profile[item, j]
            + w[2] * profile[item, j + 1]
            + w[3] * profile[item, j + 2]
        )
    return value


@wp.kernel
def transform_galaxies(
    first: wp.int32,
    components: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    jacobian: wp.array(dtype=wp.mat22d),
    offset: wp.array(dtype=wp.vec2d),
    table: wp.array2d(dtype=wp.float32),
    steps: wp.vec4,
    size: wp.int32,
    profile: wp.array2d(dtype=wp.float32),
    result: wp.array3d(dtype=wp.vec2),
):
    """Add the transforms of the components of one galaxy.

    Arguments: components [item + 1]: first component of each galaxy; numbers [component, 7]: offset dx, dy [rad],
    fraction, half-light radius [rad], e1, e2, Sersic index; jacobian [item]: d(pixel) / d(sky) [pixel/rad]; offset
    [item] of the galaxy [pixel]; table [index, wave number] of the transforms; steps: first value and step of the
    logarithm of the index, then of the wave number; size of the grid; profile [item, wave number]: working space, for
    the transform of one component. Result [item, ky, kx]: complex, zero before.
    """
    item = first + wp.tid()
    unity = wp.float64(1.0)
    two_pi = wp.float64(wp.TAU)
    for c in range(components[item], components[item + 1]):
        fraction = numbers[c, 2]
        e1 = numbers[c, 4]
        e2 = numbers[c, 5]
        # The unit circle becomes the isophote that holds half of the light.
        scale = numbers[c, 3] / wp.sqrt(unity - e1 * e1 - e2 * e2)
        shape = scale * jacobian[item] * wp.mat22d(unity + e1, e2, e2, unity - e1)
        place = offset[item] + jacobian[item] * wp.vec2d(numbers[c, 0], numbers[c, 1])

        i, u = cell((wp.float32(wp.log(numbers[c, 6])) - steps[0]) / steps[1], table.shape[0])
        weights = cubic_weights(u) * wp.float32(fraction)
        for j in range(table.shape[1]):
            profile[item, j] = (
                weights[0] * table[i - 1, j]
                + weights[1] * table[i, j]
                + weights[2] * table[i + 1, j]
                + weights[3] * table[i + 2, j]
            )

        per_step = 1.0 / steps[3]
        start = steps[2] / steps[3]
        columns = size // 2 + 1
        # Where packets would hold the last column alone, packets along that column do.
        tail_columns = columns % LANES
        blocks = wp.where(tail_columns == 1, columns // LANES, (columns + LANES - 1) // LANES)
        # Wave vector of the unit circle: (ax kx + ay ky, bx kx + by ky).
        step = two_pi / wp.float64(size)
        ax = wp.float32(step * shape[0, 0])
        ay = wp.float32(step * shape[1, 0])
        bx = wp.float32(step * shape[0, 1])
        by = wp.float32(step * shape[1, 1])
        turn = wp.vec2d(wp.cos(step * place[0]), -wp.sin(step * place[0]))
        for row in range(size):
            ky = wp.where(row < (size + 1) // 2, row, row - size)
            y = wp.float32(ky)
            angle = step * wp.float64(ky) * place[1]
            phase = wp.vec2d(wp.cos(angle), -wp.sin(angle))
            for block in range(blocks):
                squared = samples()
                for lane in range(LANES):
                    x = wp.float32(block * LANES + lane)
                    a = ax * x + ay * y
                    b = bx * x + by * y
                    squared[lane] = a * a + b * b
                value = profile_at(profile, item, squared, start, per_step)
                for lane in range(LANES):
                    column = block * LANES + lane
                    if column < columns:
                        result[item, row, column] += value[lane] * wp.vec2(wp.float32(phase[0]), wp.float32(phase[1]))
                        phase = product(phase, turn)
        if tail_columns == 1:
            x = wp.float32(columns - 1)
            for block in range((size + LANES - 1) // LANES):
                squared = samples()
                for lane in range(LANES):
                    row = block * LANES + lane
                    y = wp.float32(wp.where(row < (size + 1) // 2, row, row - size))
                    a = ax * x + ay * y
                    b = bx * x + by * y
                    squared[lane] = a * a + b * b
                value = profile_at(profile, item, squared, start, per_step)
                for lane in range(LANES):
                    row = block * LANES + lane
                    if row < size:
                        ky = wp.where(row < (size + 1) // 2, row, row - size)
                        angle = step * (wp.float64(columns - 1) * place[0] + wp.float64(ky) * place[1])
                        result[item, row, columns - 1] += value[lane] * wp.vec2(
                            wp.float32(wp.cos(angle)), -wp.float32(wp.sin(angle))
                        )
