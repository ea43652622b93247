"""Kernel of :class:`.pupil_rims.PupilRims`: sums of the waves of strips along rims, and their derivatives."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .sample_packets import LANES

wp.set_module_options(FORWARD_OPTIONS)

#: Numbers of a piece of rim: halves of the normal along x and y [m], place where its light lands along x and y [m],
#: halves of the change of that per metre along x and y, its part of the light [1/m], its curvature [1/m] and the width
#: of a vane [m].
PIECE_NUMBERS = 9

# Sine and cosine by polynomials between multiples of a quarter of a turn (Moshier's Cephes), to 1e-7.
_SINE_AND_COSINE = """
    const packet turned_{name} = {name} * 0.636619772f + magic;
    const integers quarter_{name} = *(const integers*)&turned_{name};
    const packet whole_{name} = turned_{name} - magic;
    const packet left_{name} = (({name} - whole_{name} * 1.5703125f) - whole_{name} * 4.837512969970703e-4f)
        - whole_{name} * 7.549789948768648e-8f;
    const packet square_{name} = left_{name} * left_{name};
    const packet odd_{name} = left_{name} + left_{name} * square_{name}
        * (-1.6666654611e-1f + square_{name} * (8.3321608736e-3f - square_{name} * 1.9515295891e-4f));
    const packet even_{name} = 1.0f - 0.5f * square_{name} + square_{name} * square_{name}
        * (4.166664568298827e-2f + square_{name} * (2.443315711809948e-5f * square_{name} - 1.388731625493765e-3f));
    const packet sine_{name} = ((quarter_{name} & 2) ? -1.0f : 1.0f - packet{{}})
        * ((quarter_{name} & 1) ? even_{name} : odd_{name});
    const packet cosine_{name} = (((quarter_{name} + 1) & 2) ? -1.0f : 1.0f - packet{{}})
        * ((quarter_{name} & 1) ? odd_{name} : even_{name});
"""
_STRIPS = f"""
    #pragma clang fp contract(fast)
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    typedef int integers __attribute__((vector_size({4 * LANES}), aligned(4)));
    const packet magic = 12582912.0f - packet{{}};
    const int n = pieces.shape[1];
    const float b_x = baseline.data[2 * frequency], b_y = baseline.data[2 * frequency + 1];
    const float k_x = wave.data[2 * frequency], k_y = wave.data[2 * frequency + 1];
    const float eighth = 0.125f * (b_x * b_x + b_y * b_y);
    const bool slopes = parts.shape[0] > 0;
    packet real_sum = {{}}, imaginary_sum = {{}};
    for (int i = 0; i < n; i += {LANES}) {{
        const float* own = pieces.data + i;
        #define PIECE(k) (*(const packet*)(own + (k) * n))
        const packet width = __builtin_elementwise_abs(b_x * PIECE(0) + b_y * PIECE(1));
        const packet lean = (k_x * PIECE(4) + k_y * PIECE(5)) * width;
        const packet part = PIECE(6), thick = PIECE(8);
        packet phase = k_x * PIECE(2) + k_y * PIECE(3);
        packet light, aside = {{}}, change, change_aside = {{}};
        if (i < n_rim) {{
            phase = phase + lean;
            {_SINE_AND_COSINE.format(name="lean")}
            const packet square = lean * lean;
            // Quotients of small numbers by their series.
            const packet far = __builtin_elementwise_max(__builtin_elementwise_abs(lean), 0.5f - packet{{}});
            const packet divisor = (lean < 0.0f) ? -far : far;
            const packet quotient = sine_lean / divisor;
            const packet mean = (square < 0.25f)
                ? 1.0f + square * (-1.0f / 6.0f + square * (1.0f / 120.0f - square * (1.0f / 5040.0f)))
                : quotient;
            const packet mean_slope = (square < 0.25f)
                ? lean * (-1.0f / 3.0f + square * (1.0f / 30.0f - square * (1.0f / 840.0f)))
                : (cosine_lean - quotient) / divisor;
            const packet mean_bend = (square < 0.25f)
                ? -1.0f / 3.0f + square * (0.1f - square * (1.0f / 168.0f))
                : -mean - 2.0f * mean_slope / divisor;
            // What a bent rim adds lies at the inner end of the strip, and what it lacks grows towards that.
            const packet deeper = PIECE(7) * (eighth - 0.5f * width * width);
            const packet shorter = 0.5f * PIECE(7) * width * width;
            light = -part * ((width - shorter) * mean + deeper * cosine_lean);
            aside = part * (deeper * sine_lean + shorter * mean_slope);
            change = -0.5f * width * part * ((width - shorter) * mean_slope - deeper * sine_lean);
            change_aside = 0.5f * width * part * (deeper * cosine_lean + shorter * mean_bend);
        }} else {{
            // Shadows of a vane at both ends of the baseline take light, but the vane none where it is between them.
            const packet twice = 2.0f * lean;
            {_SINE_AND_COSINE.format(name="twice")}
            const packet none = {{}};
            const packet between = __builtin_elementwise_max(thick - 2.0f * width, none);
            light = -part * ((2.0f * cosine_twice - 1.0f) * thick - between);
            change = 2.0f * width * part * thick * sine_twice;
        }}
        {_SINE_AND_COSINE.format(name="phase")}
        const packet real = light * cosine_phase + aside * sine_phase;
        const packet imaginary = aside * cosine_phase - light * sine_phase;
        real_sum = real_sum + real;
        imaginary_sum = imaginary_sum + imaginary;
        if (slopes) {{
            // What the phase changes across a strip goes with that of its middle, and changes the mean.
            const packet half = (i < n_rim) ? 0.5f * width : packet{{}};
            float* out = parts.data + 4LL * n * frequency + i;
            *(packet*)out = imaginary;
            *(packet*)(out + n) = change * cosine_phase + change_aside * sine_phase + half * imaginary;
            *(packet*)(out + 2 * n) = -real;
            *(packet*)(out + 3 * n) = change_aside * cosine_phase - change * sine_phase - half * real;
        }}
    }}
    float real_part = 0.0f, imaginary_part = 0.0f;
    for (int i = 0; i < {LANES}; ++i) {{
        real_part += real_sum[i];
        imaginary_part += imaginary_sum[i];
    }}
    values.data[2 * frequency] = real_part;
    values.data[2 * frequency + 1] = imaginary_part;
"""


@wp.func_native(_STRIPS)
def add_strips(
    baseline: wp.array2d(dtype=wp.float32),
    wave: wp.array2d(dtype=wp.float32),
    pieces: wp.array2d(dtype=wp.float32),
    n_rim: wp.int32,
    frequency: wp.int32,
    values: wp.array2d(dtype=wp.float32),
    parts: wp.array3d(dtype=wp.float32),
):
    """Add the waves of all strips at one frequency, from contiguous arrays."""
    ...


@wp.kernel
def sum_strips(
    first: wp.int32,
    baseline: wp.array2d(dtype=wp.float32),
    wave: wp.array2d(dtype=wp.float32),
    pieces: wp.array2d(dtype=wp.float32),
    n_rim: wp.int32,
    values: wp.array2d(dtype=wp.float32),
    parts: wp.array3d(dtype=wp.float32),
):
    """Add the waves of the strips at one frequency, the item.

    Arguments: baseline, wave [frequency, 2]: baselines in the pupil [m] and wave vectors of the image [rad/m]; pieces
    [PIECE_NUMBERS, piece]: whole packets of rims, of which there are n_rim, then of vanes. Results: values
    [frequency, 2]: real and imaginary parts; parts [frequency, 2, 2 * piece], or empty: derivatives of the real and of
    the imaginary part by the phases of the pieces, and by halves of the changes of the phase per metre.
    """
    add_strips(baseline, wave, pieces, n_rim, first + wp.tid(), values, parts)
