"""Kernel of the Fourier transforms of galaxies cut out of a mosaic."""

from __future__ import annotations

import warp as wp

from ..core.launch import FORWARD_OPTIONS
from .galaxy_kernels import cubic_weights, product

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def interpolated(table: wp.array(dtype=wp.vec2), start: wp.int32, half: wp.int32, x: wp.float32, y: wp.float32):
    """Cubic interpolation of a transform at (x, y) steps of frequency; zero outside of the table."""
    # A real image: the transform at -k is the conjugate of that at k.
    sign = wp.where(x < 0.0, -1.0, 1.0)
    u = sign * x
    v = sign * y
    column = wp.int32(u)
    row = wp.int32(wp.floor(v))
    value = wp.vec2(0.0, 0.0)
    if column <= half - 2 and row >= 1 - half and row <= half - 2:
        across = cubic_weights(u - wp.float32(column))
        along = cubic_weights(v - wp.float32(row))
        width = half + 2
        # Columns begin at -1, rows at -half.
        corner = start + (row - 1 + half) * width + column
        for p in range(4):
            for q in range(4):
                value += along[p] * across[q] * table[corner + p * width + q]
    return wp.vec2(value[0], sign * value[1])


@wp.kernel
def transform_stamps(
    first: wp.int32,
    stamp: wp.array(dtype=wp.int32),
    steps: wp.array(dtype=wp.mat22d),
    offset: wp.array(dtype=wp.vec2d),
    table: wp.array(dtype=wp.vec2),
    start: wp.array(dtype=wp.int32),
    half: wp.array(dtype=wp.int32),
    size: wp.int32,
    result: wp.array3d(dtype=wp.vec2),
):
    """Interpolate the transform of one stamp on the frequencies of a grid.

    Arguments: stamp [item]; steps [item]: from frequencies of the grid (kx, ky) [1/size] to steps of the stamp's table;
    offset [item] of the galaxy [pixel]; table of all stamps; start, half [stamp]: first entry of each, and rows on
    either side of zero; size of the grid. Result [item, ky, kx]: complex.
    """
    item = first + wp.tid()
    stamp_index = stamp[item]
    step = wp.float64(wp.TAU) / wp.float64(size)
    turn = wp.vec2d(wp.cos(step * offset[item][0]), -wp.sin(step * offset[item][0]))
    for row in range(size):
        ky = wp.float64(wp.where(row < (size + 1) // 2, row, row - size))
        phase = wp.vec2d(wp.cos(step * ky * offset[item][1]), -wp.sin(step * ky * offset[item][1]))
        for column in range(size // 2 + 1):
            at = steps[item] * wp.vec2d(wp.float64(column), ky)
            value = interpolated(table, start[stamp_index], half[stamp_index], wp.float32(at[0]), wp.float32(at[1]))
            placed = product(wp.vec2d(wp.float64(value[0]), wp.float64(value[1])), phase)
            result[item, row, column] = wp.vec2(wp.float32(placed[0]), wp.float32(placed[1]))
            phase = product(phase, turn)
