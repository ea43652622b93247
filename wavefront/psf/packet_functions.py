"""Functions of several PSF kernels: the unit circle on packets, and filters tabulated against the baseline."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .sample_packets import LANES, samples

wp.set_module_options(FORWARD_OPTIONS)


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


@wp.func
def squared_baseline(metric: wp.array2d(dtype=wp.float32), star: wp.int32, kx: wp.float32, ky: wp.float32):
    """|J^T k|^2 of a frequency k, not negative; ``metric`` [star, 3] holds xx, xy, yy of jacobian @ jacobian.T."""
    squared = metric[star, 0] * kx * kx + wp.float32(2.0) * metric[star, 1] * kx * ky + metric[star, 2] * ky * ky
    return wp.max(squared, wp.float32(0.0))


# Loops in C, which the compiler turns into loads of whole packets; from indexed arrays it takes lane after lane. Each
# operation is a statement, so that none is contracted.
@wp.func_native(f"""
    const float* from = table.data;
    wp::vec_t<{LANES}, wp::float32> interpolated;
    for (int i = 0; i < {LANES}; ++i) {{
        const float at = place.c[i] < last ? place.c[i] : last;
        const int knot = (int)at;
        const float before = from[knot];
        const float step = from[knot + 1] - before;
        const float beyond = at - (float)knot;
        const float part = beyond * step;
        interpolated.c[i] = before + part;
    }}
    return interpolated;
""")
def tabulated_packet(
    table: wp.array(dtype=wp.float32),
    last: wp.float32,
    place: samples,
) -> samples:
    """Linear interpolation in a contiguous table [samples] at the places of a packet, held at the last one."""
    ...


@wp.func_native(f"""
    const float* from = values.data + first;
    wp::vec_t<{LANES}, wp::float32> packet;
    for (int i = 0; i < {LANES}; ++i)
        packet.c[i] = from[2 * i];
    return packet;
""")
def every_second(values: wp.array(dtype=wp.float32), first: wp.int32) -> samples:
    """Every second value of a contiguous array from the first: real, or imaginary, parts of complex numbers."""
    ...


@wp.func_native(f"""
    float* to = values.data + first;
    if (count >= {LANES}) {{
        for (int i = 0; i < {LANES}; ++i) {{
            to[2 * i] = real.c[i];
            to[2 * i + 1] = imaginary.c[i];
        }}
    }} else {{
        for (int i = 0; i < count; ++i) {{
            to[2 * i] = real.c[i];
            to[2 * i + 1] = imaginary.c[i];
        }}
    }}
""")
def store_complex(
    values: wp.array(dtype=wp.float32), first: wp.int32, count: wp.int32, real: samples, imaginary: samples
):
    """Store the first complex numbers of a packet in a contiguous array, real and imaginary parts side by side."""
    ...
