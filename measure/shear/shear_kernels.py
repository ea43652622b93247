"""Kernel of the six functionals of deconvolved stamps."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

functionals = wp.types.vector(6, wp.float64)
weight_values = wp.types.vector(6, wp.float32)


@wp.func
def complex_product(a: wp.vec2, b: wp.vec2):
    """Product of two complex numbers."""
    return wp.vec2(a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


@wp.kernel
def deconvolved_functionals(
    first: wp.int32,
    spectra: wp.array3d(dtype=wp.vec2),
    phases_x: wp.array2d(dtype=wp.vec2),
    phases_y: wp.array2d(dtype=wp.vec2),
    inverse: wp.array3d(dtype=wp.vec2),
    psf_index: wp.array(dtype=wp.int32),
    weights: wp.array2d(dtype=weight_values),
    moments: wp.array2d(dtype=wp.float64),
):
    """Sum stamp, moved to its centre, over PSF times the six weights over the frequencies."""
    i = first + wp.tid()
    p = psf_index[i]
    total = functionals()
    for row in range(spectra.shape[1]):
        row_sum = weight_values()
        phase_y = phases_y[i, row]
        for column in range(spectra.shape[2]):
            factor = complex_product(phases_x[i, column], inverse[p, row, column])
            value = complex_product(spectra[i, row, column], phase_y)
            row_sum += (value[0] * factor[0] - value[1] * factor[1]) * weights[row, column]
        for k in range(6):
            total[k] += wp.float64(row_sum[k])
    for k in range(6):
        moments[i, k] = total[k]
