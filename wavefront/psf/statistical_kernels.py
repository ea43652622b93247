"""Kernel of the statistical engine: Gaussian kernels of stars, applied to their transfer functions."""

from __future__ import annotations

import math

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .long_exposure_kernels import lane_numbers
from .sample_packets import LANES, samples

wp.set_module_options(FORWARD_OPTIONS)

#: Largest factor: where a kernel of negative variance would raise what little the long exposure has left.
LARGEST_FACTOR = math.e

# In C with vectors of the compiler. Factors of a row follow from those of the row before.
_ROW_LOOP = f"""
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const packet largest = {LARGEST_FACTOR}f - packet{{}};
    const packet leaning = *(const packet*)&slant;
    const int stride = spectrum.shape[2];
    for (int below = 0; below < 2; ++below) {{
        packet* re = (packet*)spectrum.data + 2 * below * spectrum.shape[1] * stride + column;
        packet* im = re + spectrum.shape[1] * stride;
        const packet tilt = below ? 1.0f / leaning : leaning;
        packet weight = *(const packet*)&along;
        float fall = 1.0f, ratio = first_ratio;
        for (int row = 0; row < n_row; ++row) {{
            const packet factor = __builtin_elementwise_min(fall * weight, largest);
            re[row * stride] *= factor;
            im[row * stride] *= factor;
            weight *= tilt;
            fall *= ratio;
            ratio *= first_ratio * first_ratio;
        }}
    }}
"""


@wp.func_native(_ROW_LOOP)
def blur_rows(
    spectrum: wp.array3d(dtype=samples),
    column: wp.int32,
    n_row: wp.int32,
    along: samples,
    slant: samples,
    first_ratio: wp.float32,
):
    """Multiply the rows of a packet of columns of a contiguous spectrum [4, row, packet] by a Gaussian.

    Arguments: along: the Gaussian in row 0, and slant: its factor from one row to the next, but for what depends on the
    row alone, whose ratio from row 0 to row 1 is first_ratio.
    """
    ...


@wp.kernel
def blur_spectra(
    first: wp.int32,
    moments: wp.array2d(dtype=wp.float32),
    rows: wp.array(dtype=wp.int32),
    spectrum: wp.array4d(dtype=samples),
):
    """Multiply the transfer function of one star by that of a Gaussian kernel.

    Arguments: moments [star, 3]: xx, yy, xy of the kernel, times half the square of the step of frequency; rows
    [packet]: rows of each packet of columns; spectrum [star, 4, row, packet]: real and imaginary parts at +row, and at
    -row.
    """
    star = first + wp.tid()
    for packet in range(rows.shape[0]):
        number = lane_numbers(packet)
        along = samples()
        slant = samples()
        for i in range(LANES):
            along[i] = wp.exp(-moments[star, 0] * number[i] * number[i])
            slant[i] = wp.exp(wp.float32(-2.0) * moments[star, 2] * number[i])
        blur_rows(spectrum[star], packet, rows[packet], along, slant, wp.exp(-moments[star, 1]))
