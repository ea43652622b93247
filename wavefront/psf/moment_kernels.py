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


# In C with vectors of the compiler, which stay in the processor's registers. Factors of a row follow from those of the
# row before.
_ROW_LOOP = f"""
    #pragma clang fp contract(fast)
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const packet kx = *(const packet*)&numbers;
    const packet leaning = *(const packet*)&slant;
    const packet zero = {{}};
    const packet one = 1.0f - zero;
    const int stride = spectrum.shape[2];
    packet total = zero, x = zero, y = zero, square_x = zero, square_y = zero, product = zero;
    for (int below = 0; below < 2; ++below) {{
        const float sign = 1.0f - 2.0f * below;
        const packet* re = (const packet*)spectrum.data + 2 * below * spectrum.shape[1] * stride + column;
        const packet* im = re + spectrum.shape[1] * stride;
        const packet* transfer = (const packet*)detector.data + below * detector.shape[1] * stride + column;
        const packet tilt = below ? one / leaning : leaning;
        const float turn = sign * turn_sine;
        packet weight = *(const packet*)&along;
        packet cosine = *(const packet*)&first_cosine;
        packet sine = *(const packet*)&first_sine;
        // Weight along y, and its ratio from one row to the next.
        float fall = 1.0f, ratio = first_ratio;
        for (int row = 0; row < n_row; ++row) {{
            const float ky = sign * row;
            const packet light = fall * weight * transfer[row * stride];
            const packet even = light * (re[row * stride] * cosine - im[row * stride] * sine);
            const packet odd = light * (re[row * stride] * sine + im[row * stride] * cosine);
            // The weight's moments times the frequency.
            const packet moved_x = xx * kx + xy * ky;
            const packet moved_y = xy * kx + yy * ky;
            total += even;
            x -= odd * moved_x;
            y -= odd * moved_y;
            square_x += even * (xx - moved_x * moved_x);
            square_y += even * (yy - moved_y * moved_y);
            product += even * (xy - moved_x * moved_y);
            weight *= tilt;
            fall *= ratio;
            ratio *= first_ratio * first_ratio;
            const packet turned = turn_cosine * cosine - turn * sine;
            sine = turn_cosine * sine + turn * cosine;
            cosine = turned;
        }}
    }}
    wp::vec_t<6, wp::float64> sums;
    for (int i = 0; i < {LANES}; ++i) {{
        sums.c[0] += total[i];
        sums.c[1] += x[i];
        sums.c[2] += y[i];
        sums.c[3] += square_x[i];
        sums.c[4] += square_y[i];
        sums.c[5] += product[i];
    }}
    return sums;
"""


@wp.func_native(_ROW_LOOP)
def sum_rows(
    spectrum: wp.array3d(dtype=samples),
    detector: wp.array3d(dtype=samples),
    column: wp.int32,
    n_row: wp.int32,
    numbers: samples,
    along: samples,
    slant: samples,
    first_cosine: samples,
    first_sine: samples,
    turn_cosine: wp.float32,
    turn_sine: wp.float32,
    first_ratio: wp.float32,
    xx: wp.float32,
    yy: wp.float32,
    xy: wp.float32,
) -> weighted_sums:
    """Weighted sums over the rows of a packet of columns, contiguous spectrum [4, row, packet] times detector.

    Arguments: numbers of the columns; along: weight in row 0, and slant: its factor from one row to the next, but for
    what depends on the row alone, whose ratio from row 0 to row 1 is first_ratio; cosines and sines of the centre in
    row 0, and of its turn from one row to the next; moments xx, yy, xy of the weight.
    """
    ...


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
    """Weighted sums about a centre, in radians a step of frequency, under a weight of moments xx, yy, xy."""
    half = wp.float32(0.5)
    sums = weighted_sums()
    for packet in range(rows.shape[0]):
        kx = lane_numbers(packet)
        along = samples()
        slant = samples()
        for i in range(LANES):
            along[i] = wp.exp(-half * xx * kx[i] * kx[i])
            slant[i] = wp.exp(-xy * kx[i])
        cosine, sine = unit_circle((center_x / wp.float32(wp.TAU)) * kx)
        sums = sums + sum_rows(
            spectrum[star],
            detector,
            packet,
            rows[packet],
            kx,
            along,
            slant,
            cosine,
            sine,
            wp.cos(center_y),
            wp.sin(center_y),
            wp.exp(-half * yy),
            xx,
            yy,
            xy,
        )
    return sums


@wp.kernel
def measure_spectra(
    first: wp.int32,
    spectrum: wp.array4d(dtype=samples),
    detector: wp.array3d(dtype=samples),
    rows: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=wp.float64),
    background: wp.float64,
    adaptive: bool,
    most_steps: wp.int32,
    tolerance: wp.float64,
    ellipse: wp.array2d(dtype=wp.float64),
    flags: wp.array(dtype=wp.int32),
):
    """Measure moments of one star under a Gaussian weight about its centroid, round or as elliptical as the image.

    Lengths are in units of the period over 2 pi. Arguments: spectrum and detector as those of ``sample_pixels``; start
    [star, 5]: centroid of the first weight, and its moments xx, yy, xy; background, even light under the image [light a
    pixel], to be subtracted; most_steps, tolerance of the centroid and of
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
            # A weight of volume one has these sums on even light.
            total = sums[0] - background
            if not (total > zero):
                flag = wp.int32(8)
            else:
                mean_x = sums[1] / total
                mean_y = sums[2] / total
                image_xx = (sums[3] - background * xx) / total - mean_x * mean_x
                image_yy = (sums[4] - background * yy) / total - mean_y * mean_y
                image_xy = (sums[5] - background * xy) / total - mean_x * mean_y
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
                    ellipse[star, 5] = total
    ellipse[star, 0] = x
    ellipse[star, 1] = y
    flags[star] = flag
