"""Sums over stars or terms at positions, and powers of stars by the size of the signal.

Sums are in the order of the stars, whatever the number of positions: no batch changes a byte.
"""

from __future__ import annotations

import numpy as np

from ...core.launch import launch
from ...core.warp_arrays import warp_array
from .pixel_kernels import LANES, add_powers, add_products, columns

# Largest square: those of stars without noise have no bound.
_LARGEST_SQUARE = 1e100


def sums_of_products(weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the sums over rows [n, k] times weights [m, n], [m, k], each in the order of the rows.

    A product of matrices rounds them in a way that depends on the number of positions.
    """
    count = rows.shape[1]
    if not (len(weights) and len(rows)):
        return np.zeros((len(weights), count))
    packets = _in_packets(rows)
    sums = np.empty((len(weights), len(packets), LANES))
    arrays = [warp_array(weights), warp_array(packets, columns), warp_array(sums, columns)]
    launch(add_products, len(packets), arrays, threads=1)
    return sums.reshape(len(weights), -1)[:, :count]


def log_powers_and_variances(
    squares: np.ndarray, spectrum: np.ndarray, relative: np.ndarray, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of the logarithms of powers and of variances, [n_factor] both, for factors of the signal.

    The variances of squares [n, k] are 1 plus a factor times `spectrum` [n] times `relative` [k]; the power of a column
    is the sum of its squares over them. Columns without any power are left out of its sums.
    """
    packets = _in_packets(np.minimum(squares, _LARGEST_SQUARE))
    # Variances of the pixels that fill up the last packet are 1.
    of_pixels = _in_packets(relative[None])[:, 0]
    sums = np.empty((2, len(packets), len(factors)))
    arrays = [warp_array(packets, columns), warp_array(spectrum), warp_array(of_pixels, columns), warp_array(factors)]
    launch(add_powers, len(packets), [*arrays, *map(warp_array, sums)], threads=1)
    log_powers, log_variances = sums.sum(axis=1)
    return log_powers, log_variances


def _in_packets(rows: np.ndarray) -> np.ndarray:
    """Return rows [n, k] as packets [packet, n, lane], the last one filled up with zeros."""
    count, whole = rows.shape[1], rows.shape[1] // LANES
    packets = np.empty((-(-count // LANES), len(rows), LANES))
    packets[:whole] = rows[:, : whole * LANES].reshape(len(rows), whole, LANES).transpose(1, 0, 2)
    if count > whole * LANES:
        packets[whole, :, : count - whole * LANES] = rows[:, whole * LANES :]
        packets[whole, :, count - whole * LANES :] = 0.0
    return packets
