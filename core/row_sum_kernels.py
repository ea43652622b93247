"""Kernel of :mod:`.row_sums`: columns in packets."""

from __future__ import annotations

import warp as wp

from .launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Columns of one packet.
LANES = 32
columns = wp.types.vector(LANES, wp.float64)


# Positions and columns whose sums stay in the processor's registers together.
_POSITIONS = 4
_COLUMNS = 8
_ADD = f"""
    typedef double part __attribute__((vector_size({8 * _COLUMNS}), aligned(8)));
    const int n_position = weights.shape[0];
    const int n_row = weights.shape[1];
    double* out = (double*)sums.data + {LANES} * packet;
    const long long stride = {LANES} * (long long)sums.shape[1];
    for (int from = 0; from < {LANES}; from += {_COLUMNS}) {{
        const double* values = (const double*)rows.data + from;
        int position = 0;
        for (; position + {_POSITIONS} <= n_position; position += {_POSITIONS}) {{
            const double* weight = weights.data + (long long)position * n_row;
            part total[{_POSITIONS}] = {{}};
            for (int row = 0; row < n_row; ++row) {{
                const part value = *(const part*)(values + {LANES} * row);
                for (int k = 0; k < {_POSITIONS}; ++k) {{
                    const part product = value * weight[(long long)k * n_row + row];
                    total[k] = total[k] + product;
                }}
            }}
            for (int k = 0; k < {_POSITIONS}; ++k)
                *(part*)(out + (position + k) * stride + from) = total[k];
        }}
        for (; position < n_position; ++position) {{
            const double* weight = weights.data + (long long)position * n_row;
            part total = {{}};
            for (int row = 0; row < n_row; ++row) {{
                const part product = *(const part*)(values + {LANES} * row) * weight[row];
                total = total + product;
            }}
            *(part*)(out + position * stride + from) = total;
        }}
    }}
"""


# In C with vectors of the compiler: in the loops that Warp writes each sum would leave the registers after every
# operation. Each operation is a statement, so that none is contracted.
@wp.func_native(_ADD)
def add_rows(
    weights: wp.array2d(dtype=wp.float64),
    rows: wp.array(dtype=columns),
    packet: wp.int32,
    sums: wp.array2d(dtype=columns),
):
    """Add up contiguous weights [position, row] times the rows of a packet at all positions, row after row."""
    ...


@wp.kernel
def add_products(
    first: wp.int32,
    weights: wp.array2d(dtype=wp.float64),
    rows: wp.array2d(dtype=columns),
    sums: wp.array2d(dtype=columns),
):
    """Add up weights [position, row] times rows [packet, row] of one packet at all positions, row after row."""
    packet = first + wp.tid()
    add_rows(weights, rows[packet], packet, sums)
