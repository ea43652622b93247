"""Sums of waves over the points of a pupil on spokes, for a packet of frequencies.

They are written in C with vectors of the compiler, which stay in the processor's registers: loops that Warp writes keep
an index, and its checks, beside every operation. Each operation is a statement, so that none is contracted.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .sample_packets import LANES, samples

wp.set_module_options(FORWARD_OPTIONS)

#: Numbers of a rim at one wavelength: its strip's part of the pupil per step of frequency, along x and y; the phase of
#: the strip over that part, per step, along x and y; and the light of its point.
RIM_NUMBERS = 5
# Lanes of rims whose sums, which are more than those of other points, stay in registers together.
_RIM_LANES = LANES // 2

# Products of cosines and sines along x (a, b) and y (c, d) of a point.
_PRODUCTS = f"""
                const packet a = *(const packet*)(x + 2 * {LANES} * point);
                const packet b = *(const packet*)(x + 2 * {LANES} * point + {LANES});
                const float c = y[2 * {LANES} * point];
                const float d = y[2 * {LANES} * point + {LANES}];
                const packet ca = c * a;
                const packet db = d * b;
                const packet da = d * a;
                const packet cb = c * b;
"""
_INNER_LOOP = f"""
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const float* x = (const float*)along_x.data;
    const float* y = (const float*)along_y.data + row % {LANES};
    packet cc = {{}}, ss = {{}}, cs = {{}}, sc = {{}};
    for (int depth = 0; depth < n_depth; ++depth)
        for (int point = depth * n_point + n_spoke; point < (depth + 1) * n_point - n_spoke; ++point) {{
            {_PRODUCTS}
            cc = cc + ca;
            ss = ss + db;
            cs = cs + da;
            sc = sc + cb;
        }}
    // At -row the sine along y has the other sign.
    packet* sum = (packet*)sums.data;
    sum[0] = cc - ss;
    sum[1] = cs + sc;
    sum[2] = cc + ss;
    sum[3] = sc - cs;
"""
_RIM_LOOP = f"""
    typedef float packet __attribute__((vector_size({4 * _RIM_LANES}), aligned(4)));
    const float* numbers = rims.data;
    float* sum = (float*)sums.data;
    for (int from = 0; from < {LANES}; from += {_RIM_LANES}) {{
        const float* x = (const float*)along_x.data + from;
        const float* y = (const float*)along_y.data + row % {LANES};
        const packet one = 1.0f - packet{{}};
        const packet tiny = 1e-20f - packet{{}};
        packet column;
        for (int i = 0; i < {_RIM_LANES}; ++i)
            column[i] = (float)(first_column + from + i);
        packet re_plus = *(packet*)(sum + from);
        packet im_plus = *(packet*)(sum + {LANES} + from);
        packet re_minus = *(packet*)(sum + {2 * LANES} + from);
        packet im_minus = *(packet*)(sum + {3 * LANES} + from);
        for (int rim = 0; rim < 2 * n_spoke; ++rim) {{
            int point = rim < n_spoke ? rim : rim + n_point - 2 * n_spoke;
            packet cc, ss, cs, sc;
            for (int depth = 0; depth < n_depth; ++depth) {{
                {_PRODUCTS}
                cc = depth ? cc + ca : ca;
                ss = depth ? ss + db : db;
                cs = depth ? cs + da : da;
                sc = depth ? sc + cb : cb;
                point += n_point;
            }}
            const float* own = numbers + {RIM_NUMBERS} * rim;
            const float across_y = own[1] * (float)row;
            const float lean_y = own[3] * (float)row;
            const float light = own[4];
            const packet across_x = own[0] * column;
            const packet lean_x = own[2] * column;
            packet plus = __builtin_elementwise_abs(across_x + across_y);
            packet minus = __builtin_elementwise_abs(across_x - across_y);
            if (meeting.data[rim]) {{
                const float* opposite = numbers + {RIM_NUMBERS} * ((rim + n_spoke) % (2 * n_spoke));
                const float opposite_y = opposite[1] * (float)row;
                const float whole = light * whole_spoke;
                const packet opposite_x = opposite[0] * column;
                const packet both_plus = plus + __builtin_elementwise_abs(opposite_x + opposite_y);
                const packet both_minus = minus + __builtin_elementwise_abs(opposite_x - opposite_y);
                const packet part_plus = whole / __builtin_elementwise_max(both_plus, tiny);
                const packet part_minus = whole / __builtin_elementwise_max(both_minus, tiny);
                plus = plus * __builtin_elementwise_min(one, part_plus);
                minus = minus * __builtin_elementwise_min(one, part_minus);
            }}
            const packet square_plus = plus * plus;
            const packet square_minus = minus * minus;
            const packet phase_plus = square_plus * (lean_x + lean_y);
            const packet phase_minus = square_minus * (lean_x - lean_y);
            const packet left_plus = light - plus;
            const packet left_minus = light - minus;
            const packet real_plus = cc - ss;
            const packet imaginary_plus = cs + sc;
            const packet real_minus = cc + ss;
            const packet imaginary_minus = sc - cs;
            packet part = left_plus * real_plus;
            re_plus = re_plus + part;
            part = phase_plus * imaginary_plus;
            re_plus = re_plus + part;
            part = left_plus * imaginary_plus;
            im_plus = im_plus + part;
            part = phase_plus * real_plus;
            im_plus = im_plus - part;
            part = left_minus * real_minus;
            re_minus = re_minus + part;
            part = phase_minus * imaginary_minus;
            re_minus = re_minus + part;
            part = left_minus * imaginary_minus;
            im_minus = im_minus + part;
            part = phase_minus * real_minus;
            im_minus = im_minus - part;
        }}
        *(packet*)(sum + from) = re_plus;
        *(packet*)(sum + {LANES} + from) = im_plus;
        *(packet*)(sum + {2 * LANES} + from) = re_minus;
        *(packet*)(sum + {3 * LANES} + from) = im_minus;
    }}
"""


@wp.func_native(_INNER_LOOP)
def add_inner_points(
    along_x: wp.array2d(dtype=samples),
    along_y: wp.array2d(dtype=samples),
    row: wp.int32,
    n_point: wp.int32,
    n_spoke: wp.int32,
    n_depth: wp.int32,
    sums: wp.array(dtype=samples),
):
    """Add up the waves of points between the rims.

    Arguments: along_x and along_y [depth * n_point + point, 2]: cosines and sines along x, of a packet of columns, and
    along y, of the packet with the row; sums [4]: real and imaginary parts at +row and at -row.
    """
    ...


@wp.func_native(_RIM_LOOP)
def add_rims(
    along_x: wp.array2d(dtype=samples),
    along_y: wp.array2d(dtype=samples),
    rims: wp.array2d(dtype=wp.float32),
    meeting: wp.array(dtype=wp.int32),
    first_column: wp.int32,
    row: wp.int32,
    whole_spoke: wp.float32,
    n_point: wp.int32,
    n_spoke: wp.int32,
    n_depth: wp.int32,
    sums: wp.array(dtype=samples),
):
    """Add the waves of points on the rims, less those of the strips that are cut off.

    Arguments, beside those of :func:`add_inner_points`: rims [2 n_spoke, RIM_NUMBERS]; meeting [2 n_spoke]: whether the
    strips of a spoke could meet, which then take together at most its light, whole_spoke times that of a point; the
    first of the packet's columns.
    """
    ...
