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


@wp.kernel
def add_powers(
    first: wp.int32,
    squares: wp.array2d(dtype=columns),
    spectrum: wp.array(dtype=wp.float64),
    relative: wp.array(dtype=columns),
    factors: wp.array(dtype=wp.float64),
    log_powers: wp.array2d(dtype=wp.float64),
    log_variances: wp.array2d(dtype=wp.float64),
):
    """Add up squares over variances for one packet of pixels; the logarithms of these powers and of all variances.

    Arguments: squares [packet, axis] of values in units of their noise; spectrum [axis], relative [packet]: variances
    of the signal are their product times one of the factors [factor]; log_powers, log_variances [packet, factor]: sums
    over the pixels of the packet and, of variances, the axes.
    """
    packet = first + wp.tid()
    one = columns(wp.float64(1.0))
    for i in range(factors.shape[0]):
        scale = relative[packet] * factors[i]
        power = columns()
        logarithm = wp.float64(0.0)
        for group in range((squares.shape[1] + TOGETHER - 1) // TOGETHER):
            # A sum of fractions over their common denominator: one division for all of them.
            product = one
            sum = columns()
            for axis in range(group * TOGETHER, wp.min((group + 1) * TOGETHER, squares.shape[1])):
                variance = one + scale * spectrum[axis]
                sum = wp.cw_mul(sum, variance) + wp.cw_mul(squares[packet, axis], product)
                product = wp.cw_mul(product, variance)
            logarithm = logarithm + log_of_product(product)
            power = power + wp.cw_div(sum, product)
        for lane in range(LANES):
            power[lane] = wp.where(power[lane] > wp.float64(0.0), wp.max(power[lane], LOW), wp.float64(1.0))
        log_powers[packet, i] = log_of_product(power)
        log_variances[packet, i] = logarithm
