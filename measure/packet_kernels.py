"""Packets of pixels side by side, which kernels of images compute at once."""

from __future__ import annotations

import warp as wp

#: Pixels of one packet.
LANES = 8

packet = wp.types.vector(LANES, wp.float64)


@wp.func
def lane_sum(values: packet) -> wp.float64:
    """Sum over the pixels of a packet, in order."""
    total = wp.float64(0.0)
    for lane in range(LANES):
        total = total + values[lane]
    return total
