"""Bicubic resampling of PSF stamps onto a common frame, as of images."""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.errors import DomainError
from ...core.launch import launch
from ...core.warp_arrays import warp_array
from .resample_kernels import resample_rows


def resample_stamps(stamps: np.ndarray, matrix: np.ndarray, size: int, *, threads: int | None = None) -> np.ndarray:
    """Return stamps resampled by cubic convolution (Keys 1981, a = -1/2), flux conserved.

    Parameters
    ----------
    stamps : ndarray, shape [n, ny, nx]
        Stamps, centred on the pixel ``[ny // 2, nx // 2]``.
    matrix : ndarray, shape [n, 2, 2]
        d(x, y of the stamp)/d(x, y of the result).
    size : int
        Pixels on a side of the result, whose middle pixel is the middle of the stamp.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Returns
    -------
    ndarray of float32, shape [n, size, size]
        Surface brightness times the ratio of the pixels' areas; 0 where a stamp does not reach.
    """
    if stamps.ndim != 3 or matrix.shape != (len(stamps), 2, 2):
        raise DomainError(
            f"stamps, matrix of shapes {stamps.shape}, {matrix.shape}: expected [n, ny, nx] and [n, 2, 2]"
        )
    result = np.empty((len(stamps), size, size), dtype=np.float32)
    area = np.abs(np.linalg.det(matrix)).astype(np.float32)
    inputs = [
        warp_array(stamps, wp.float32),
        warp_array(matrix),
        warp_array(area, wp.float32),
        warp_array(result, wp.float32),
    ]
    launch(resample_rows, len(stamps) * size, inputs, threads=threads)
    return result
