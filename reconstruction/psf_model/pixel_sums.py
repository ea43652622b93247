"""Sums over stars or terms at positions, and powers of stars by the size of the signal.

Sums are in the order of the stars, whatever the number of positions: no batch changes a byte.
"""

from __future__ import annotations

import numpy as np

from ...core.launch import launch
from .pixel_kernels import LANES, add_powers, add_products

# Variances whose product is taken before its logarithm: each is at most 4^12 times the 300 stars, so that none
# overflows.
_TOGETHER = 30


def sums_of_products(weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the sums over rows [n, k] times weights [m, n], [m, k], each in the order of the rows.

    A product of matrices rounds them in a way that depends on the number of positions.
    """
    count = rows.shape[1]
    if not (len(weights) and len(rows)):
        return np.zeros((len(weights), count))
    padded = _in_packets(rows)
    sums = np.empty((len(weights), *padded.shape[1:]))
    launch(add_products, len(weights), [weights, padded, sums], threads=1)
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
    powers = np.empty((len(factors), packets, LANES))
    products = np.empty((len(factors), groups, packets, LANES))
    inputs = [padded, spectrum, _in_packets(relative[None])[0], factors, _TOGETHER]
    launch(add_powers, packets, [*inputs, powers, products], threads=1)
    # Variances of the pixels that fill up the last packet are 1.
    return powers.reshape(len(factors), -1)[:, :count], np.log(products).sum(axis=(1, 2, 3))


def _in_packets(rows: np.ndarray) -> np.ndarray:
    """Return rows [n, k] as packets [n, packet, lane], the last one filled up with zeros."""
    packets = -(-rows.shape[1] // LANES)
    padded = np.zeros((len(rows), packets * LANES))
    padded[:, : rows.shape[1]] = rows
    return padded.reshape(len(rows), packets, LANES)
