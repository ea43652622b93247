"""Kernel that adds a resampled image to sums."""

from __future__ import annotations

import warp as wp

from ....core.launch import FORWARD_OPTIONS
from ..resample_kernels import weight

wp.set_module_options(FORWARD_OPTIONS)


@wp.kernel
def add_rows(
    first: wp.int32,
    image: wp.array2d(dtype=wp.float32),
    variance: wp.array2d(dtype=wp.float32),
    mask: wp.array2d(dtype=wp.int16),
    nodes: wp.array3d(dtype=wp.float64),
    step: wp.int32,
    corner_x: wp.int32,
    corner_y: wp.int32,
    width: wp.int32,
    data_sum: wp.array2d(dtype=wp.float32),
    variance_sum: wp.array2d(dtype=wp.float32),
    count: wp.array2d(dtype=wp.int16),
):
    """One row of a part of a tile; pixels that need one that is masked or beyond the rim of the image are left out.

    `nodes` are x and y in the image, and the area of a pixel of the tile in pixels of the image, at every `step`-th
    pixel of the part of `width` pixels whose first one in the sums is (corner_x, corner_y).
    """
    row = first + wp.tid()
    cell_y = row / step
    v = wp.float64(row - cell_y * step) / wp.float64(step)
    unit = wp.float64(1.0)
    for column in range(width):
        cell_x = column / step
        u = wp.float64(column - cell_x * step) / wp.float64(step)
        a = (unit - u) * (unit - v)
        b = u * (unit - v)
        c = (unit - u) * v
        d = u * v
        x = a * nodes[cell_y, cell_x, 0]
        x += b * nodes[cell_y, cell_x + 1, 0]
        x += c * nodes[cell_y + 1, cell_x, 0]
        x += d * nodes[cell_y + 1, cell_x + 1, 0]
        y = a * nodes[cell_y, cell_x, 1]
        y += b * nodes[cell_y, cell_x + 1, 1]
        y += c * nodes[cell_y + 1, cell_x, 1]
        y += d * nodes[cell_y + 1, cell_x + 1, 1]
        x_floor = wp.int32(wp.floor(x))
        y_floor = wp.int32(wp.floor(y))
        if x_floor >= 1 and y_floor >= 1 and x_floor < image.shape[1] - 2 and y_floor < image.shape[0] - 2:
            area = a * nodes[cell_y, cell_x, 2]
            area += b * nodes[cell_y, cell_x + 1, 2]
            area += c * nodes[cell_y + 1, cell_x, 2]
            area += d * nodes[cell_y + 1, cell_x + 1, 2]
            s = wp.float32(x - wp.float64(x_floor))
            t = wp.float32(y - wp.float64(y_floor))
            bad = wp.int32(0)
            value = wp.float32(0.0)
            spread = wp.float32(0.0)
            for j in range(4):
                line = wp.float32(0.0)
                line_spread = wp.float32(0.0)
                for i in range(4):
                    w = weight(i, s)
                    bad += wp.int32(mask[y_floor - 1 + j, x_floor - 1 + i])
                    line += w * image[y_floor - 1 + j, x_floor - 1 + i]
                    line_spread += w * w * variance[y_floor - 1 + j, x_floor - 1 + i]
                w = weight(j, t)
                value += w * line
                spread += w * w * line_spread
            if bad == 0:
                factor = wp.float32(area)
                at_y = corner_y + row
                at_x = corner_x + column
                data_sum[at_y, at_x] = data_sum[at_y, at_x] + factor * value
                variance_sum[at_y, at_x] = variance_sum[at_y, at_x] + factor * factor * spread
                count[at_y, at_x] = count[at_y, at_x] + wp.int16(1)
