"""Kernels of pixels in packets: sums over stars or terms at positions, and powers of stars by the size of the signal.

Sums are in the order of the stars, whatever the number of positions: no batch changes a byte.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.launch import FORWARD_OPTIONS, launch
from ...core.warp_arrays import warp_array

wp.set_module_options(FORWARD_OPTIONS)

#: Columns of one packet.
_LANES = 32
# Variances whose product is taken before its logarithm: each is at most 4^12 times the 300 stars, so that none
# overflows.
_TOGETHER = 30
_columns = wp.types.vector(_LANES, wp.float64)


@wp.kernel
def add_products(
    first: wp.int32,
    weights: wp.array2d(dtype=wp.float64),
    rows: wp.array2d(dtype=_columns),
    sums: wp.array2d(dtype=_columns),
):
    """Add up weights [position, row] times rows [row, packet] at one position, row after row."""
    position = first + wp.tid()
    for packet in range(rows.shape[1]):
        total = _columns()
        for row in range(rows.shape[0]):
            product = rows[row, packet] * weights[position, row]
            total = total + product
        sums[position, packet] = total


@wp.kernel
def add_powers(
    first: wp.int32,
    squares: wp.array2d(dtype=_columns),
    spectrum: wp.array(dtype=wp.float64),
    relative: wp.array(dtype=_columns),
    factors: wp.array(dtype=wp.float64),
    together: wp.int32,
    powers: wp.array2d(dtype=_columns),
    products: wp.array3d(dtype=_columns),
):
    """Add up squares over variances for one packet of pixels, and multiply variances, `together` axes at a time.

    Arguments: squares [axis, packet] of values in units of their noise; spectrum [axis], relative [packet]: variances
    of the signal are their product times one of the factors [factor]; powers [factor, packet]; products [factor, group
    of axes, packet].
    """
    packet = first + wp.tid()
    one = _columns(wp.float64(1.0))
    for i in range(factors.shape[0]):
        scale = relative[packet] * factors[i]
        power = _columns()
        for group in range(products.shape[1]):
            product = one
            for axis in range(group * together, wp.min((group + 1) * together, squares.shape[0])):
                variance = one + scale * spectrum[axis]
                power = power + wp.cw_div(squares[axis, packet], variance)
                product = wp.cw_mul(product, variance)
            products[i, group, packet] = product
        powers[i, packet] = power


def sums_of_products(weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the sums over rows [n, k] times weights [m, n], [m, k], each in the order of the rows.

    A product of matrices rounds them in a way that depends on the number of positions.
    """
    count = rows.shape[1]
    if not (len(weights) and len(rows)):
        return np.zeros((len(weights), count))
    padded = _in_packets(rows)
    sums = np.empty((len(weights), *padded.shape[1:]))
    arrays = [warp_array(weights), warp_array(padded, _columns), warp_array(sums, _columns)]
    launch(add_products, len(weights), arrays, threads=1)
    return sums.reshape(len(weights), -1)[:, :count]


def powers_and_variances(
    squares: np.ndarray, spectrum: np.ndarray, relative: np.ndarray, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return powers [n_factor, k] and sums of the logarithms of the variances [n_factor] for factors of the signal.

    The variances of squares [n, k] are 1 plus a factor times `spectrum` [n] times `relative` [k]; the power of a column
    is the sum of its squares over them.
    """
    count, padded = squares.shape[1], _in_packets(squares)
    packets, groups = padded.shape[1], -(-len(squares) // _TOGETHER)
    powers = np.empty((len(factors), packets, _LANES))
    products = np.empty((len(factors), groups, packets, _LANES))
    arrays = [warp_array(padded, _columns), warp_array(spectrum), warp_array(_in_packets(relative[None])[0], _columns)]
    outputs = [warp_array(powers, _columns), warp_array(products, _columns)]
    launch(add_powers, packets, [*arrays, warp_array(factors), _TOGETHER, *outputs], threads=1)
    # Variances of the pixels that fill up the last packet are 1.
    return powers.reshape(len(factors), -1)[:, :count], np.log(products).sum(axis=(1, 2, 3))


def _in_packets(rows: np.ndarray) -> np.ndarray:
    """Return rows [n, k] as packets [n, packet, lane], the last one filled up with zeros."""
    padding = -rows.shape[1] % _LANES
    return np.pad(rows, ((0, 0), (0, padding))).reshape(len(rows), -1, _LANES)
