"""Kernel of :mod:`.row_sums`: columns in packets."""

from __future__ import annotations

import warp as wp

from .launch import FORWARD_OPTIONS

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
    """Add up weights [position, row] times rows [packet, row] of one packet at all positions, row after row."""
    packet = first + wp.tid()
    for position in range(weights.shape[0]):
        total = columns()
        for row in range(rows.shape[1]):
            product = rows[packet, row] * weights[position, row]
            total = total + product
        sums[position, packet] = total
