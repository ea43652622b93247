"""Kernel of bicubic resampling."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def weight(k: wp.int32, t: wp.float32) -> wp.float32:
    """Weight of the k-th of four neighbours of a point at t in 0 to 1 between the middle two (Keys 1981, a = -1/2)."""
    half = wp.float32(0.5)
    if k == 0:
        return -half * t * (wp.float32(1.0) - t) * (wp.float32(1.0) - t)
    if k == 1:
        return wp.float32(1.0) + t * t * (wp.float32(1.5) * t - wp.float32(2.5))
    if k == 2:
        return half * t * (wp.float32(1.0) + t * (wp.float32(4.0) - wp.float32(3.0) * t))
    return half * t * t * (t - wp.float32(1.0))


@wp.kernel
def resample_rows(
    first: wp.int32,
    images: wp.array3d(dtype=wp.float32),
    matrix: wp.array3d(dtype=wp.float64),
    factor: wp.array(dtype=wp.float32),
    result: wp.array3d(dtype=wp.float32),
):
    """One row of a resampled image; pixels that need one beyond the rim of the image are 0."""
    item = first + wp.tid()
    rows = result.shape[1]
    n = item / rows
    row = item - n * rows
    height = images.shape[1]
    width = images.shape[2]
    y = wp.float64(row - rows / 2)
    for column in range(result.shape[2]):
        x = wp.float64(column - result.shape[2] / 2)
        u = matrix[n, 0, 0] * x + matrix[n, 0, 1] * y + wp.float64(width / 2)
        v = matrix[n, 1, 0] * x + matrix[n, 1, 1] * y + wp.float64(height / 2)
        u_floor = wp.int32(wp.floor(u))
        v_floor = wp.int32(wp.floor(v))
        s = wp.float32(u - wp.float64(u_floor))
        t = wp.float32(v - wp.float64(v_floor))
        total = wp.float32(0.0)
        if u_floor >= 1 and v_floor >= 1 and u_floor < width - 2 and v_floor < height - 2:
            for j in range(4):
                line = wp.float32(0.0)
                for i in range(4):
                    line += weight(i, s) * images[n, v_floor - 1 + j, u_floor - 1 + i]
                total += weight(j, t) * line
        result[n, row, column] = factor[n] * total
