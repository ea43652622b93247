"""Sums over rows with the weights of positions: polynomials, kernels of Gaussian fields.

They are in the order of the rows, whatever the number of positions: no batch changes a byte.
"""

from __future__ import annotations

import numpy as np

from .launch import launch
from .row_sum_kernels import LANES, add_products, columns
from .warp_arrays import warp_array


def sums_of_products(weights: np.ndarray, rows: np.ndarray, threads: int | None = 1) -> np.ndarray:
    """Return the sums over rows [n, k] times weights [m, n], [m, k], each in the order of the rows.

    A product of matrices rounds them in a way that depends on the number of positions.
    """
    count = rows.shape[1]
    if not (len(weights) and len(rows)):
        return np.zeros((len(weights), count))
    return sums_of_packets(weights, in_packets(rows), threads)[:, :count]


def sums_of_packets(weights: np.ndarray, packets: np.ndarray, threads: int | None = 1) -> np.ndarray:
    """Return the sums of :func:`sums_of_products` over rows :func:`in_packets`, with what fills up the last one."""
    sums = np.empty((len(weights), len(packets), LANES))
    arrays = [warp_array(weights), warp_array(packets, columns), warp_array(sums, columns)]
    launch(add_products, len(packets), arrays, threads=threads)
    return sums.reshape(len(weights), -1)


def in_packets(rows: np.ndarray) -> np.ndarray:
    """Return rows [n, k] as packets [packet, n, lane], the last one filled up with zeros."""
    count, whole = rows.shape[1], rows.shape[1] // LANES
    packets = np.empty((-(-count // LANES), len(rows), LANES))
    packets[:whole] = rows[:, : whole * LANES].reshape(len(rows), whole, LANES).transpose(1, 0, 2)
    if count > whole * LANES:
        packets[whole, :, : count - whole * LANES] = rows[:, whole * LANES :]
        packets[whole, :, count - whole * LANES :] = 0.0
    return packets
