"""Sums of waves over the points of a pupil on spokes, for a packet of frequencies.

They are written in C with vectors of the compiler, which stay in the processor's registers: loops that Warp writes keep
an index, and its checks, beside every operation. A product and a sum in one expression are one operation of the
processor, where it has that.
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

_WAVES_ALONG = f"""
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    packet cosine = *(const packet*)&first_cosine;
    packet sine = *(const packet*)&first_sine;
    // Each packet is the one before, turned by as many numbers as it has.
    const float turned_cosine = cosine[{LANES - 1}] * cosine[1] - sine[{LANES - 1}] * sine[1];
    const float turned_sine = sine[{LANES - 1}] * cosine[1] + cosine[{LANES - 1}] * sine[1];
    float* out = (float*)along.data + 2 * {LANES} * sample;
    const float* filter = (const float*)fade.data;
    for (int k = 0; k < n_packet; ++k) {{
        const packet scales = scale * *(const packet*)filter;
        *(packet*)out = scales * cosine;
        *(packet*)(out + {LANES}) = scales * sine;
        const packet next = turned_cosine * cosine - turned_sine * sine;
        sine = turned_cosine * sine + turned_sine * cosine;
        cosine = next;
        filter += {LANES};
        out += 2 * {LANES} * n_sample;
    }}
"""
# Sums of products of cosines and sines along x (a, b) and y (c, d) of a point.
_ADD_WAVES = f"""
                const packet a = *(const packet*)(x + 2 * {LANES} * point);
                const packet b = *(const packet*)(x + 2 * {LANES} * point + {LANES});
                const float c = y[2 * {LANES} * point];
                const float d = y[2 * {LANES} * point + {LANES}];
                cc = cc + c * a;
                ss = ss + d * b;
                cs = cs + d * a;
                sc = sc + c * b;
"""
_INNER_LOOP = f"""
    #pragma clang fp contract(fast)
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const float* x = (const float*)along_x.data;
    const float* y = (const float*)along_y.data + row % {LANES};
    packet cc = {{}}, ss = {{}}, cs = {{}}, sc = {{}};
    for (int depth = 0; depth < n_depth; ++depth)
        for (int point = depth * n_point + n_spoke; point < (depth + 1) * n_point - n_spoke; ++point) {{
            {_ADD_WAVES}
        }}
    // At -row the sine along y has the other sign.
    packet* sum = (packet*)sums.data;
    sum[0] = cc - ss;
    sum[1] = cs + sc;
    sum[2] = cc + ss;
    sum[3] = sc - cs;
"""
_RIM_LOOP = f"""
    #pragma clang fp contract(fast)
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
        const float* own = numbers;
        packet re_plus = *(packet*)(sum + from);
        packet im_plus = *(packet*)(sum + {LANES} + from);
        packet re_minus = *(packet*)(sum + {2 * LANES} + from);
        packet im_minus = *(packet*)(sum + {3 * LANES} + from);
        for (int rim = 0; rim < 2 * n_spoke; ++rim) {{
            if (rim == n_spoke) {{
                x += 2 * {LANES} * (n_point - 2 * n_spoke);
                y += 2 * {LANES} * (n_point - 2 * n_spoke);
            }}
            packet cc = {{}}, ss = {{}}, cs = {{}}, sc = {{}};
            #pragma clang loop unroll(disable)
            for (int depth = 0; depth < n_depth; ++depth) {{
                const int point = depth * n_point;
                {_ADD_WAVES}
            }}
            x += 2 * {LANES};
            y += 2 * {LANES};
            const float across_y = own[1] * (float)row;
            const float lean_y = own[3] * (float)row;
            const float light = own[4];
            packet plus = __builtin_elementwise_abs(own[0] * column + across_y);
            packet minus = __builtin_elementwise_abs(own[0] * column - across_y);
            if (meeting.data[rim]) {{
                const float* opposite = numbers + {RIM_NUMBERS} * ((rim + n_spoke) % (2 * n_spoke));
                const float opposite_y = opposite[1] * (float)row;
                const float whole = light * whole_spoke;
                const packet both_plus = plus + __builtin_elementwise_abs(opposite[0] * column + opposite_y);
                const packet both_minus = minus + __builtin_elementwise_abs(opposite[0] * column - opposite_y);
                plus = plus * __builtin_elementwise_min(one, whole / __builtin_elementwise_max(both_plus, tiny));
                minus = minus * __builtin_elementwise_min(one, whole / __builtin_elementwise_max(both_minus, tiny));
            }}
            const packet phase_plus = plus * plus * (own[2] * column + lean_y);
            const packet phase_minus = minus * minus * (own[2] * column - lean_y);
            const packet left_plus = light - plus;
            const packet left_minus = light - minus;
            const packet real_plus = cc - ss;
            const packet imaginary_plus = cs + sc;
            const packet real_minus = cc + ss;
            const packet imaginary_minus = sc - cs;
            // In brackets: the next rim waits for one sum only.
            re_plus = re_plus + (left_plus * real_plus + phase_plus * imaginary_plus);
            im_plus = im_plus + (left_plus * imaginary_plus - phase_plus * real_plus);
            re_minus = re_minus + (left_minus * real_minus + phase_minus * imaginary_minus);
            im_minus = im_minus + (left_minus * imaginary_minus - phase_minus * real_minus);
            own += {RIM_NUMBERS};
        }}
        *(packet*)(sum + from) = re_plus;
        *(packet*)(sum + {LANES} + from) = im_plus;
        *(packet*)(sum + {2 * LANES} + from) = re_minus;
        *(packet*)(sum + {3 * LANES} + from) = im_minus;
    }}
"""


@wp.func_native(_WAVES_ALONG)
def lay_waves(
    first_cosine: samples,
    first_sine: samples,
    scale: wp.float32,
    fade: wp.array(dtype=samples),
    sample: wp.int32,
    n_sample: wp.int32,
    n_packet: wp.int32,
    along: wp.array3d(dtype=samples),
):
    """Lay the wave of one point along an axis, for all packets of frequencies by that of the first one, to 1e-7.

    Arguments: cosines and sines of the first packet, whose first number is zero; scale and fade [packet], filters of
    the frequencies; along [packet, n_sample, 2]: results at a sample.
    """
    ...


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
