"""Packets: ``LANES`` rays side by side in one SIMD vector, every quantity of a ray a lane.

A kernel on packets traces the LSST about ten times as fast as the same kernel on single rays, because the compiler
keeps each quantity in full-width registers. A branch becomes a choice per lane (``wp.where``), so a lane's result
never depends on its neighbours: cutting a batch differently changes no byte.

Loops over ``range(LANES)`` are unrolled whole, which is fast and compiles slowly. Where few telescopes come along they
are ``range(int(LANES))``, which Warp leaves a loop.
"""

from __future__ import annotations

import math
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


def whole_packets(shape: tuple[int, ...], n: int) -> np.ndarray:
    """Return unset values [*shape, n] in memory that goes on to whole packets, which :func:`to_packets` need not copy.

    Lanes of the last packet without a value hold any.
    """
    return empty((*shape, packet_count(n) * LANES))[..., :n]


def to_packets(values: np.ndarray) -> np.ndarray:
    """Return values [..., n] as packets [..., n_packet, LANES], the last filled up with copies of the last value.

    The result is a view of contiguous float64 where ``n`` is a multiple of ``LANES``, or the memory of the values goes
    on to whole packets (the last of which is then filled up with what is there); else a copy.
    """
    n = values.shape[-1]
    if n % LANES:
        packets = _packets_around(values)
        if packets is not None:
            return packets
    values = np.ascontiguousarray(values, dtype=np.float64)
    padding = packet_count(n) * LANES - n
    if padding:
        values = np.concatenate([values, np.repeat(values[..., -1:], padding, axis=-1)], axis=-1)
    return values.reshape(*values.shape[:-1], -1, LANES)


def _packets_around(values: np.ndarray) -> np.ndarray | None:
    """Return the packets [..., n_packet, LANES] that values [..., n] are the first of; None where they are not."""
    owner, count = values.base, packet_count(values.shape[-1])
    if not (isinstance(owner, np.ndarray) and owner.flags.c_contiguous and values.dtype == owner.dtype == np.float64):
        return None
    shape = (*values.shape[:-1], count * LANES)
    strides = np.cumprod((values.itemsize, *shape[:0:-1]))[::-1].tolist()
    if any(have != want for length, have, want in zip(shape, values.strides, strides, strict=True) if length > 1):
        return None
    first = (values.__array_interface__["data"][0] - owner.__array_interface__["data"][0]) // values.itemsize
    room = math.prod(shape)
    if first < 0 or first + room > owner.size:
        return None
    return owner.reshape(-1)[first : first + room].reshape(*shape[:-1], count, LANES)


def from_packets(packets: wp.array, n: int) -> np.ndarray:
    """Return the first ``n`` values [..., n] of packets [..., n_packet] on the CPU, without a copy."""
    values = packets.numpy()
    return values.reshape(*packets.shape[:-1], packets.shape[-1] * LANES)[..., :n]
