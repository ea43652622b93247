"""Kernel of the statistical engine: Gaussian kernels of stars, applied to their transfer functions."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .long_exposure_kernels import lane_numbers
from .sample_packets import LANES, samples

wp.set_module_options(FORWARD_OPTIONS)

#: Largest exponent: where a kernel of negative variance would raise what little the long exposure has left.
LARGEST_EXPONENT = 1.0


@wp.func
def exponentials(exponent: samples):
    """Exponentials of lanes, at most of LARGEST_EXPONENT."""
    out = samples()
    for i in range(LANES):
        out[i] = wp.exp(wp.min(exponent[i], wp.float32(LARGEST_EXPONENT)))
    return out


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
        along_x = -moments[star, 0] * wp.cw_mul(number, number)
        for row in range(rows[packet]):
            ky = wp.float32(row)
            even = along_x - samples(moments[star, 1] * ky * ky)
            odd = (wp.float32(-2.0) * moments[star, 2] * ky) * number
            plus = exponentials(even + odd)
            minus = exponentials(even - odd)
            for part in range(2):
                spectrum[star, part, row, packet] = wp.cw_mul(plus, spectrum[star, part, row, packet])
                spectrum[star, 2 + part, row, packet] = wp.cw_mul(minus, spectrum[star, 2 + part, row, packet])
