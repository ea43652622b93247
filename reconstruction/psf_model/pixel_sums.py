"""Powers of stars in pixels by the size of the signal."""

from __future__ import annotations

import numpy as np

from ...core.launch import launch
from ...core.row_sum_kernels import columns
from ...core.row_sums import in_packets
from ...core.warp_arrays import warp_array
from .pixel_kernels import add_powers

# Largest square: those of stars without noise have no bound.
_LARGEST_SQUARE = 1e100


def log_powers_and_variances(
    squares: np.ndarray, spectrum: np.ndarray, relative: np.ndarray, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of the logarithms of powers and of variances, [n_factor] both, for factors of the signal.

    The variances of squares [n, k] are 1 plus a factor times `spectrum` [n] times `relative` [k]; the power of a column
    is the sum of its squares over them. Columns without any power are left out of its sums.
    """
    packets = in_packets(np.minimum(squares, _LARGEST_SQUARE))
    # Variances of the pixels that fill up the last packet are 1.
    of_pixels = in_packets(relative[None])[:, 0]
    sums = np.empty((2, len(packets), len(factors)))
    arrays = [warp_array(packets, columns), warp_array(spectrum), warp_array(of_pixels, columns), warp_array(factors)]
    launch(add_powers, len(packets), [*arrays, *map(warp_array, sums)], threads=1)
    log_powers, log_variances = sums.sum(axis=1)
    return log_powers, log_variances
