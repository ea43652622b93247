"""Kernels of :mod:`.pixel_sums`: columns, most often pixels, in packets."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Columns of one packet.
LANES = 32
columns = wp.types.vector(LANES, wp.float64)


@wp.kernel
def add_products(
    first: wp.int32,
    weights: wp.array2d(dtype=wp.float64),
    rows: wp.array2d(dtype=columns),
    sums: wp.array2d(dtype=columns),
):
    """Add up weights [position, row] times rows [row, packet] at one position, row after row."""
    position = first + wp.tid()
    for packet in range(rows.shape[1]):
        total = columns()
        for row in range(rows.shape[0]):
            product = rows[row, packet] * weights[position, row]
            total = total + product
        sums[position, packet] = total


@wp.kernel
def add_powers(
    first: wp.int32,
    squares: wp.array2d(dtype=columns),
    spectrum: wp.array(dtype=wp.float64),
    relative: wp.array(dtype=columns),
    factors: wp.array(dtype=wp.float64),
    together: wp.int32,
    powers: wp.array2d(dtype=columns),
    products: wp.array3d(dtype=columns),
):
    """Add up squares over variances for one packet of pixels, and multiply variances, `together` axes at a time.

    Arguments: squares [axis, packet] of values in units of their noise; spectrum [axis], relative [packet]: variances
    of the signal are their product times one of the factors [factor]; powers [factor, packet]; products [factor, group
    of axes, packet].
    """
    packet = first + wp.tid()
    one = columns(wp.float64(1.0))
    for i in range(factors.shape[0]):
        scale = relative[packet] * factors[i]
        power = columns()
        for group in range(products.shape[1]):
            product = one
            for axis in range(group * together, wp.min((group + 1) * together, squares.shape[0])):
                variance = one + scale * spectrum[axis]
                power = power + wp.cw_div(squares[axis, packet], variance)
                product = wp.cw_mul(product, variance)
            products[i, group, packet] = product
        powers[i, packet] = power
