"""Packets: ``LANES`` rays side by side in one SIMD vector, every quantity of a ray a lane.

A kernel on packets traces the LSST about ten times as fast as the same kernel on single rays, because the compiler
keeps each quantity in full-width registers. A branch becomes a choice per lane (``wp.where``), so a lane's result
never depends on its neighbours: cutting a batch differently changes no byte.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ...core.buffers import empty
from ...core.launch import FORWARD_OPTIONS
from ...core.warp_arrays import warp_array

wp.set_module_options(FORWARD_OPTIONS)

#: Rays in one packet: four 512-bit registers a quantity, so that one vector can wait for its square root while the next
#: is computed (16 lanes take a fifth longer).
LANES = 32

lanes = wp.types.vector(LANES, wp.float64)
lane_flags = wp.types.vector(LANES, wp.int32)


@wp.func
def lanes_sqrt(a: lanes):
    """Square root of each lane (NaN where negative)."""
    out = lanes()
    for i in range(LANES):
        out[i] = wp.sqrt(a[i])
    return out


@wp.func
def components(vectors: wp.array3d(dtype=lanes), row: wp.int32, packet: wp.int32):
    """Components x, y, z of a packet of vectors [row, 3, packet]."""
    return vectors[row, 0, packet], vectors[row, 1, packet], vectors[row, 2, packet]


@wp.struct
class RayPackets:
    """Packets of rays at some surfaces, in the telescope frame.

    ``position`` [surface, 3, packet] [m], ``direction`` [surface, 3, packet], optical ``path`` [surface, packet] [m],
    ``status`` [surface, packet]. Without surfaces there is nothing to store.
    """

    position: wp.array3d(dtype=lanes)
    direction: wp.array3d(dtype=lanes)
    path: wp.array2d(dtype=lanes)
    status: wp.array2d(dtype=lane_flags)


def ray_packets(n_surface: int = 0, n_packet: int = 0) -> Any:
    """Return unset :class:`RayPackets` for a number of surfaces and of packets."""
    packets = RayPackets()
    vectors, numbers = (n_surface, 3, n_packet, LANES), (n_surface, n_packet, LANES)
    packets.position, packets.direction = (warp_array(empty(vectors), lanes) for _ in "pd")
    packets.path = warp_array(empty(numbers), lanes)
    packets.status = warp_array(empty(numbers, np.int32), lane_flags)
    return packets


def packet_count(n: int) -> int:
    """Return the number of packets that hold ``n`` rays."""
    return -(-n // LANES)


def to_packets(values: np.ndarray) -> np.ndarray:
    """Return values [..., n] as packets [..., n_packet, LANES], the last filled up with copies of the last value.

    The result is a view where ``n`` is a multiple of ``LANES`` and the values are contiguous float64, else a copy.
    """
    values = np.ascontiguousarray(values, dtype=np.float64)
    n = values.shape[-1]
    padding = packet_count(n) * LANES - n
    if padding:
        values = np.concatenate([values, np.repeat(values[..., -1:], padding, axis=-1)], axis=-1)
    return values.reshape(*values.shape[:-1], -1, LANES)


def from_packets(packets: wp.array, n: int) -> np.ndarray:
    """Return the first ``n`` values [..., n] of packets [..., n_packet] on the CPU, without a copy."""
    values = packets.numpy()
    return values.reshape(*packets.shape[:-1], packets.shape[-1] * LANES)[..., :n]
