"""Kernel of :class:`.pixel_kernel.Deposit`: light of points and its derivatives on the cells of a grid."""

from __future__ import annotations

import warp as wp

from ..core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Columns that are added at once.
_LANES = 8
# In C with vectors of the compiler: the loops over columns are all of the time.
_ADD = f"""
    typedef float lanes __attribute__((vector_size({4 * _LANES}), aligned(4)));
    const int n = weights.shape[0];
    const int n_x = columns.shape[0], n_y = rows.shape[0];
    const int n_moved = response.shape[2], n_rate = rates.shape[1];
    const int n_column = cells.shape[1];
    const long long in_x = (long long)n_x * n, in_y = (long long)n_y * n;
    const float* along_x = (const float*)response.data;
    const float* along_y = along_x + (long long)n * n_moved;
    for (int i = 0; i < n; ++i) {{
        const float weight = weights.data[i];
        const float half_xx = spread.data[i], xy = spread.data[n + i], half_yy = spread.data[2 * n + i];
        const float* by_x = along_x + (long long)i * n_moved;
        const float* by_y = along_y + (long long)i * n_moved;
        const float* rate = rates.data + (long long)i * n_rate;
        for (int b = 0; b < n_y; ++b) {{
            const float* y = y_taps.data + (long long)b * n + i;
            const float y_value = y[0] + half_yy * y[2 * in_y], y_slope = y[in_y] + half_yy * y[3 * in_y];
            const float y_mixed = xy * y[in_y], y_bent = xy * y[2 * in_y];
            if (rows.data[b * n + i] < 0) continue;
            const long long row = (long long)rows.data[b * n + i] * width;
            for (int a = 0; a < n_x; ++a) {{
                if (columns.data[a * n + i] < 0) continue;
                const float* x = x_taps.data + (long long)a * n + i;
                const float x_value = x[0] + half_xx * x[2 * in_x], x_slope = x[in_x] + half_xx * x[3 * in_x];
                const float value = y_value * x_value + y_mixed * x[in_x];
                const float left = weight * (y_value * x_slope + y_mixed * x[2 * in_x]);
                const float down = weight * (y_slope * x_value + y_bent * x[in_x]);
                float* out = cells.data + (row + columns.data[a * n + i]) * n_column;
                out[0] += weight * value;
                if (n_column == 1) continue;
                out[1] += left;
                out[2] += down;
                out += head;
                const float scaled_left = scale * left, scaled_down = scale * down;
                int k = 0;
                for (; k + {_LANES} <= n_moved; k += {_LANES})
                    *(lanes*)(out + k) +=
                        scaled_left * *(const lanes*)(by_x + k) + scaled_down * *(const lanes*)(by_y + k);
                for (; k < n_moved; ++k) out[k] += scaled_left * by_x[k] + scaled_down * by_y[k];
                out += n_moved;
                for (k = 0; k < n_rate; ++k) out[k] += value * rate[k];
            }}
        }}
    }}
"""


@wp.func_native(_ADD)
def add_points(
    x_taps: wp.array3d(dtype=wp.float32),
    y_taps: wp.array3d(dtype=wp.float32),
    columns: wp.array2d(dtype=wp.int32),
    rows: wp.array2d(dtype=wp.int32),
    width: wp.int32,
    spread: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    response: wp.array3d(dtype=wp.float32),
    rates: wp.array2d(dtype=wp.float32),
    scale: wp.float32,
    head: wp.int32,
    cells: wp.array2d(dtype=wp.float32),
):
    """Add all points of a star to the cells of its grid, from contiguous arrays."""
    ...


@wp.kernel
def deposit_points(
    first: wp.int32,
    x_taps: wp.array3d(dtype=wp.float32),
    y_taps: wp.array3d(dtype=wp.float32),
    columns: wp.array2d(dtype=wp.int32),
    rows: wp.array2d(dtype=wp.int32),
    width: wp.int32,
    spread: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    response: wp.array3d(dtype=wp.float32),
    rates: wp.array2d(dtype=wp.float32),
    scale: wp.float32,
    head: wp.int32,
    cells: wp.array2d(dtype=wp.float32),
):
    """Add the points of one star, the only item, to the cells of its grid.

    Arguments: x_taps, y_taps [4, tap, point]: kernels and their first three derivatives; columns, rows [tap, point],
    negative beside the grid; width of the grid [cell]; spread [3, point]: halves of the second moments xx and yy, and
    xy between them; weights [point]; response [2, point, k] in units of the inverse scale [cell]; rates [point, j].
    Result [cell, column]: the light, then by x and y; from column head on by the response and by the rates. With a
    single column there is the light alone.
    """
    if first + wp.tid() == 0:
        add_points(x_taps, y_taps, columns, rows, width, spread, weights, response, rates, scale, head, cells)
