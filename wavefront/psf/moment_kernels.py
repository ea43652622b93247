"""Kernel of moments without images: weighted sums over the transfer function of a star."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .long_exposure_kernels import lane_numbers
from .packet_functions import unit_circle
from .sample_packets import LANES, samples

wp.set_module_options(FORWARD_OPTIONS)

#: Sums of a weighted image: total, x, y, xx, yy, xy.
weighted_sums = wp.types.vector(6, wp.float64)
#: Numbers of an ellipse that :func:`measure_spectra` returns: x, y, xx, yy, xy, and total of the image.
ELLIPSE = 6


@wp.func
def lane_total(values: samples):
    """Sum over the lanes."""
    total = wp.float32(0.0)
    for i in range(LANES):
        total = total + values[i]
    return wp.float64(total)


@wp.func
def weighted_moments(
    star: wp.int32,
    spectrum: wp.array4d(dtype=samples),
    detector: wp.array3d(dtype=samples),
    rows: wp.array(dtype=wp.int32),
    center_x: wp.float32,
    center_y: wp.float32,
    xx: wp.float32,
    yy: wp.float32,
    xy: wp.float32,
):
    """Weighted sums about a centre, in radians a step of frequency, under a weight of moments xx, yy, xy.

    Factors of a row follow from those of the row before.
    """
    half = wp.float32(0.5)
    turn_c = wp.cos(center_y)
    turn_s = wp.sin(center_y)
    zeroth = samples()
    first_x = samples()
    first_y = samples()
    second_xx = samples()
    second_yy = samples()
    second_xy = samples()
    for packet in range(rows.shape[0]):
        kx = lane_numbers(packet)
        along = samples()
        slant = samples()
        slant_back = samples()
        for i in range(LANES):
            along[i] = wp.exp(-half * xx * kx[i] * kx[i])
            slant[i] = wp.exp(-xy * kx[i])
            slant_back[i] = wp.exp(xy * kx[i])
        start_c, start_s = unit_circle((center_x / wp.float32(wp.TAU)) * kx)
        for below in range(2):
            sign = wp.float32(1 - 2 * below)
            turn = turn_s * sign
            tilt = slant
            if below == 1:
                tilt = slant_back
            weight = along
            cosine = start_c
            sine = start_s
            for row in range(rows[packet]):
                ky = sign * wp.float32(row)
                light = wp.exp(-half * yy * ky * ky) * wp.cw_mul(weight, detector[below, row, packet])
                re = spectrum[star, 2 * below, row, packet]
                im = spectrum[star, 2 * below + 1, row, packet]
                even = wp.cw_mul(light, wp.cw_mul(re, cosine) - wp.cw_mul(im, sine))
                odd = wp.cw_mul(light, wp.cw_mul(re, sine) + wp.cw_mul(im, cosine))
                # The weight's moments times the frequency.
                moved_x = xx * kx + samples(xy * ky)
                moved_y = xy * kx + samples(yy * ky)
                zeroth = zeroth + even
                first_x = first_x - wp.cw_mul(odd, moved_x)
                first_y = first_y - wp.cw_mul(odd, moved_y)
                second_xx = second_xx + wp.cw_mul(even, samples(xx) - wp.cw_mul(moved_x, moved_x))
                second_yy = second_yy + wp.cw_mul(even, samples(yy) - wp.cw_mul(moved_y, moved_y))
                second_xy = second_xy + wp.cw_mul(even, samples(xy) - wp.cw_mul(moved_x, moved_y))
                weight = wp.cw_mul(weight, tilt)
                turned = turn_c * cosine - turn * sine
                sine = turn_c * sine + turn * cosine
                cosine = turned
    return weighted_sums(
        lane_total(zeroth),
        lane_total(first_x),
        lane_total(first_y),
        lane_total(second_xx),
        lane_total(second_yy),
        lane_total(second_xy),
    )


@wp.kernel
def measure_spectra(
    first: wp.int32,
    spectrum: wp.array4d(dtype=samples),
    detector: wp.array3d(dtype=samples),
    rows: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=wp.float64),
    adaptive: bool,
    most_steps: wp.int32,
    tolerance: wp.float64,
    ellipse: wp.array2d(dtype=wp.float64),
    flags: wp.array(dtype=wp.int32),
):
    """Measure moments of one star under a Gaussian weight about its centroid, round or as elliptical as the image.

    Lengths are in units of the period over 2 pi. Arguments: spectrum and detector as those of ``sample_pixels``; start
    [star, 5]: centroid of the first weight, and its moments xx, yy, xy; most_steps, tolerance of the centroid and of
    the moments' square root, as a part of the weight's width; ellipse [star, ELLIPSE]: centroid, central moments xx,
    yy, xy under the weight or, where it is adaptive, of the weight itself, and the weighted total; flags [star]: 1
    where the iteration has not converged, 2 where moments are not positive, 8 where there is no light.
    """
    star = first + wp.tid()
    zero = wp.float64(0.0)
    x = start[star, 0]
    y = start[star, 1]
    xx = start[star, 2]
    yy = start[star, 3]
    xy = start[star, 4]
    flag = wp.int32(1)
    for _ in range(most_steps):
        if flag == 1:
            sums = weighted_moments(
                star,
                spectrum,
                detector,
                rows,
                wp.float32(x),
                wp.float32(y),
                wp.float32(xx),
                wp.float32(yy),
                wp.float32(xy),
            )
            if not (sums[0] > zero):
                flag = wp.int32(8)
            else:
                mean_x = sums[1] / sums[0]
                mean_y = sums[2] / sums[0]
                image_xx = sums[3] / sums[0] - mean_x * mean_x
                image_yy = sums[4] / sums[0] - mean_y * mean_y
                image_xy = sums[5] / sums[0] - mean_x * mean_y
                image_det = image_xx * image_yy - image_xy * image_xy
                weight_det = xx * yy - xy * xy
                # Q^-1 - W^-1, of the image that the weight has narrowed.
                narrow_xx = image_yy / image_det - yy / weight_det
                narrow_yy = image_xx / image_det - xx / weight_det
                narrow_xy = -image_xy / image_det + xy / weight_det
                narrow_det = narrow_xx * narrow_yy - narrow_xy * narrow_xy
                if not (image_det > zero and image_xx > zero and narrow_det > zero and narrow_xx > zero):
                    flag = wp.int32(2)
                else:
                    wide_xx = narrow_yy / narrow_det
                    wide_yy = narrow_xx / narrow_det
                    wide_xy = -narrow_xy / narrow_det
                    # The centroid of an image of moments "wide": (I - Q W^-1)^-1 m = wide Q^-1 m.
                    a = (image_yy * mean_x - image_xy * mean_y) / image_det
                    b = (image_xx * mean_y - image_xy * mean_x) / image_det
                    step_x = wide_xx * a + wide_xy * b
                    step_y = wide_xy * a + wide_yy * b
                    x = x + step_x
                    y = y + step_y
                    scale = wp.sqrt(weight_det)
                    change = (step_x * step_x + step_y * step_y) / scale
                    if adaptive:
                        moved = wp.abs(wide_xx - xx) + wp.abs(wide_yy - yy) + wp.abs(wide_xy - xy)
                        change = wp.max(change, moved * moved / (scale * scale))
                        xx = wide_xx
                        yy = wide_yy
                        xy = wide_xy
                    ellipse[star, 2] = wp.where(adaptive, wide_xx, image_xx)
                    ellipse[star, 3] = wp.where(adaptive, wide_yy, image_yy)
                    ellipse[star, 4] = wp.where(adaptive, wide_xy, image_xy)
                    if change < tolerance * tolerance:
                        flag = wp.int32(0)
                    ellipse[star, 5] = sums[0]
    ellipse[star, 0] = x
    ellipse[star, 1] = y
    flags[star] = flag
