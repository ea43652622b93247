"""Kernels of :mod:`.pixel_sums`: columns, most often pixels, in packets."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...core.row_sum_kernels import LANES, columns

wp.set_module_options(FORWARD_OPTIONS)

#: Axes whose variances are multiplied before a logarithm is taken: each is at most 4^12 times 300 stars, so that the
#: product stays below 1e100.
TOGETHER = wp.constant(10)
#: Bounds of products of lanes.
HIGH = wp.constant(wp.float64(1e150))
LOW = wp.constant(wp.float64(1e-150))


@wp.func
def log_of_product(values: columns):
    """Logarithm of the product of lanes from 1e-150 to 1e150."""
    product = wp.float64(1.0)
    steps = wp.float64(0.0)
    for i in range(LANES):
        product = product * values[i]
        if product > HIGH:
            product = product * LOW
            steps = steps + wp.float64(1.0)
        elif product < LOW:
            product = product * HIGH
            steps = steps - wp.float64(1.0)
    return wp.log(product) + steps * wp.log(HIGH)


# Columns whose sums stay in the processor's registers together.
_COLUMNS = 8
_ADD = f"""
    typedef double part __attribute__((vector_size({8 * _COLUMNS}), aligned(8)));
    for (int from = 0; from < {LANES}; from += {_COLUMNS}) {{
        const double* square = (const double*)squares.data + from;
        const part scale = *(const part*)(scales.c + from);
        const part one = 1.0 - part{{}};
        part product = one, sum = {{}};
        for (int axis = start; axis < end; ++axis) {{
            const part signal = scale * spectrum.data[axis];
            const part variance = one + signal;
            const part before = sum * variance;
            const part own = *(const part*)(square + {LANES} * axis) * product;
            sum = before + own;
            product = product * variance;
        }}
        *(part*)(result.data[0].c + from) = sum;
        *(part*)(result.data[1].c + from) = product;
    }}
"""


# In C with vectors of the compiler: in the loops that Warp writes sums would leave the registers after every operation.
# Each operation is a statement, so that none is contracted.
@wp.func_native(_ADD)
def add_fractions(
    squares: wp.array(dtype=columns),
    spectrum: wp.array(dtype=wp.float64),
    scales: columns,
    start: wp.int32,
    end: wp.int32,
    result: wp.array(dtype=columns),
):
    """Add up squares of axes over variances, 1 plus spectrum times scales: numerator and common denominator, [2]."""
    ...


@wp.kernel
def add_powers(
    first: wp.int32,
    squares: wp.array2d(dtype=columns),
    spectrum: wp.array(dtype=wp.float64),
    relative: wp.array(dtype=columns),
    factors: wp.array(dtype=wp.float64),
    fractions: wp.array2d(dtype=columns),
    log_powers: wp.array2d(dtype=wp.float64),
    log_variances: wp.array2d(dtype=wp.float64),
):
    """Add up squares over variances for one packet of pixels; the logarithms of these powers and of all variances.

    Arguments: squares [packet, axis] of values in units of their noise; spectrum [axis], relative [packet]: variances
    of the signal are their product times one of the factors [factor]; fractions [packet, 2]: room; log_powers,
    log_variances [packet, factor]: sums over the pixels of the packet and, of variances, the axes.
    """
    packet = first + wp.tid()
    for i in range(factors.shape[0]):
        scale = relative[packet] * factors[i]
        power = columns()
        logarithm = wp.float64(0.0)
        for group in range((squares.shape[1] + TOGETHER - 1) // TOGETHER):
            # A sum of fractions over their common denominator: one division for all of them.
            end = wp.min((group + 1) * TOGETHER, squares.shape[1])
            add_fractions(squares[packet], spectrum, scale, group * TOGETHER, end, fractions[packet])
            product = fractions[packet, 1]
            logarithm = logarithm + log_of_product(product)
            power = power + wp.cw_div(fractions[packet, 0], product)
        for lane in range(LANES):
            power[lane] = wp.where(power[lane] > wp.float64(0.0), wp.max(power[lane], LOW), wp.float64(1.0))
        log_powers[packet, i] = log_of_product(power)
        log_variances[packet, i] = logarithm
