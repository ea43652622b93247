"""Kernel of the adaptive moments: an elliptical Gaussian that follows each image.

With rho^2 = (x - x0)^T M^-1 (x - x0) and the weight G = exp(-rho^2/2), the ellipse M and its centre x0 are those under
which sum(G I (x - x0)) = 0 and 2 sum(G I (x - x0)(x - x0)^T) = M sum(G I) (Bernstein & Jarvis 2002, sec. 3.1.2).
"""

from __future__ import annotations

import warp as wp

from ..core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Numbers of an ellipse: x, y from the centre of the stamp, Mxx, Mxy, Myy [pixel]; sum of weight times image; rho4; the
#: masked part of the squared weight.
ELLIPSE = 8
#: Weighted sums over a stamp: of 1, x, y, xx, xy, yy and rho^4.
SUMS = 7

NOT_CONVERGED = wp.constant(wp.int32(1))
NEGATIVE_MOMENTS = wp.constant(wp.int32(2))
CENTROID_LEFT_STAMP = wp.constant(wp.int32(4))
NO_FLUX = wp.constant(wp.int32(8))
TOO_WIDE = wp.constant(wp.int32(16))

#: Weights end at rho^2 = 36, where G is 2e-8: numbers are those of endless weights to 1e-7, in half the time.
LARGEST_RHO2 = wp.constant(wp.float64(36.0))
#: Longest step of centre and moments, in units of the minor axis and of its square (HSM's bound_correct_wt).
LONGEST_STEP = wp.constant(wp.float64(0.25))
#: Step of the centre, or root of that of the moments, in the same units, from which on steps shrink steadily.
NEAR = wp.constant(wp.float64(0.3))

sums = wp.types.vector(SUMS, wp.float64)
# Pixels of a row side by side.
LANES = 4
# Powers of x in the sums of a row, from 0.
POWERS = 5
powers = wp.types.vector(POWERS, wp.float64)
ratio_powers = wp.types.vector(6, wp.float64)


@wp.struct
class Ellipse:
    """Centre from that of the stamp, and moments [pixel]."""

    x: wp.float64
    y: wp.float64
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64


@wp.struct
class StampSums:
    """Weighted sums over the pixels of a stamp."""

    light: sums  # weight times image, over the pixels that are not masked
    masked: sums  # squared weight, over the masked pixels
    squared_weight: wp.float64  # over the pixels that are not masked


@wp.func
def products(x: wp.float64, y: wp.float64, rho2: wp.float64) -> sums:
    """Factors of the sums at a place from the centre of the ellipse."""
    return sums(wp.float64(1.0), x, y, x * x, x * y, y * y, rho2 * rho2)


@wp.func
def first_pixel(low: wp.float64, count: wp.int32) -> wp.int32:
    """First pixel at or beyond a coordinate from the first pixel of the stamp."""
    return wp.int32(wp.ceil(wp.clamp(low, wp.float64(0.0), wp.float64(count))))


@wp.func
def last_pixel(high: wp.float64, count: wp.int32) -> wp.int32:
    """Last pixel at or before a coordinate from the first pixel of the stamp."""
    return wp.int32(wp.floor(wp.clamp(high, wp.float64(-1.0), wp.float64(count - 1))))


_ADD = f"""
        for (int n = 0; n < {POWERS}; ++n) {{
            sum[n] += values;
            values *= x;
        }}
"""
# Vectors of the compiler, which stay in the processor's registers.
_ROW_LOOP = f"""
    typedef double packet __attribute__((vector_size({8 * LANES}), aligned(8)));
    typedef long long lanes __attribute__((vector_size({8 * LANES}), aligned(8)));
    const double* image = row.data;
    const lanes lane = {{0, 1, 2, 3}};
    const double square = step * step;
    const double second = weight * step;
    packet weights = {{weight, second, weight * (square * ratio), second * (square * ratios.c[0])}};
    packet steps = {{1.0, ratios.c[2], ratios.c[3], ratios.c[4]}};
    steps *= square * square * ratios.c[1];
    packet x = {{first_x, first_x + 1.0, first_x + 2.0, first_x + 3.0}};
    packet sum[{POWERS}] = {{}};
    int i = start;
    for (; i + {LANES} <= end; i += {LANES}) {{
        packet values = weights * *(const packet*)(image + i);
        {_ADD}
        weights *= steps;
        steps *= ratios.c[5];
        x += (double){LANES};
    }}
    if (i < end) {{
        packet values = {{}};
        if (i + {LANES} <= row.shape[0])
            values = *(const packet*)(image + i);
        else
            for (int k = 0; k < row.shape[0] - i; ++k)
                values[k] = image[i + k];
        values = weights * (lane < end - i ? values : packet{{}});
        {_ADD}
    }}
    wp::vec_t<{POWERS}, wp::float64> sums;
    for (int n = 0; n < {POWERS}; ++n)
        sums.c[n] = (sum[n][0] + sum[n][1]) + (sum[n][2] + sum[n][3]);
    return sums;
"""


@wp.func_native(_ROW_LOOP)
def sum_row(
    row: wp.array(dtype=wp.float64),
    start: wp.int32,
    end: wp.int32,
    first_x: wp.float64,
    weight: wp.float64,
    step: wp.float64,
    ratio: wp.float64,
    ratios: ratio_powers,
) -> powers:
    """Sum weight times pixel times powers of x over the pixels from the start to the end of a row.

    Arguments: x of the first pixel, its weight, the ratio of the next one's to that, the ratio of such ratios, and that
    to the powers 3, 6, 4, 8, 12 and 16: along a packet, and from one to the next.
    """
    ...


@wp.struct
class Gaussian:
    """The weight of an ellipse on a stamp: rho^2 = a x^2 + 2 b x y + c y^2 from its middle."""

    a: wp.float64
    b: wp.float64
    c: wp.float64
    ratio: wp.float64  # of the ratios of neighbours along a row, which is constant
    middle_x: wp.float64  # from the first pixel of the stamp
    middle_y: wp.float64
    yy: wp.float64


@wp.struct
class RowSpan:
    """Pixels of a row within the ellipse: from the first, at x from the middle, with its weight, to the end."""

    start: wp.int32
    end: wp.int32
    x: wp.float64
    weight: wp.float64
    step: wp.float64  # ratio of the next weight to the first


@wp.func
def gaussian_of(ellipse: Ellipse, ny: wp.int32, nx: wp.int32) -> Gaussian:
    """Weight of an ellipse on a stamp of ny by nx pixels."""
    half = wp.float64(0.5)
    det = ellipse.xx * ellipse.yy - ellipse.xy * ellipse.xy
    gaussian = Gaussian()
    gaussian.a = ellipse.yy / det
    gaussian.b = -ellipse.xy / det
    gaussian.c = ellipse.xx / det
    gaussian.ratio = wp.exp(-gaussian.a)
    gaussian.middle_y = half * wp.float64(ny - 1) + ellipse.y
    gaussian.middle_x = half * wp.float64(nx - 1) + ellipse.x
    gaussian.yy = ellipse.yy
    return gaussian


@wp.func
def first_row(gaussian: Gaussian, ny: wp.int32) -> wp.int32:
    """First row within the ellipse."""
    return first_pixel(gaussian.middle_y - wp.sqrt(LARGEST_RHO2 * gaussian.yy), ny)


@wp.func
def last_row(gaussian: Gaussian, ny: wp.int32) -> wp.int32:
    """Last row within the ellipse."""
    return last_pixel(gaussian.middle_y + wp.sqrt(LARGEST_RHO2 * gaussian.yy), ny)


@wp.func
def row_span(gaussian: Gaussian, y: wp.float64, nx: wp.int32) -> RowSpan:
    """Pixels of the row at y from the middle that lie within the ellipse; none where it ends before."""
    half = wp.float64(0.5)
    two = wp.float64(2.0)
    a = gaussian.a
    b = gaussian.b
    span = RowSpan()
    room = (LARGEST_RHO2 - y * y / gaussian.yy) / a
    if room > wp.float64(0.0):
        axis = -b * y / a
        width = wp.sqrt(room)
        span.start = first_pixel(gaussian.middle_x + axis - width, nx)
        span.end = last_pixel(gaussian.middle_x + axis + width, nx) + 1
        span.x = wp.float64(span.start) - gaussian.middle_x
        span.weight = wp.exp(-half * (a * span.x * span.x + two * b * span.x * y + gaussian.c * y * y))
        span.step = wp.exp(-half * a * (two * span.x + wp.float64(1.0)) - b * y)
    return span


@wp.func
def sum_light(image: wp.array2d(dtype=wp.float64), ellipse: Ellipse) -> sums:
    """Sum weight times image over the pixels within the ellipse, where none is masked."""
    total = sums()
    two = wp.float64(2.0)
    ny = image.shape[0]
    gaussian = gaussian_of(ellipse, ny, image.shape[1])
    a = gaussian.a
    ratio = gaussian.ratio
    cube = ratio * ratio * ratio
    fourth = cube * ratio
    eighth = fourth * fourth
    ratios = ratio_powers(cube, cube * cube, fourth, eighth, eighth * fourth, eighth * eighth)
    for j in range(first_row(gaussian, ny), last_row(gaussian, ny) + 1):
        y = wp.float64(j) - gaussian.middle_y
        span = row_span(gaussian, y, image.shape[1])
        if span.end > span.start:
            row = sum_row(image[j], span.start, span.end, span.x, span.weight, span.step, ratio, ratios)
            # rho^2 = a x^2 + p x + q
            p = two * gaussian.b * y
            q = gaussian.c * y * y
            rho4 = a * a * row[4] + two * a * p * row[3] + (p * p + two * a * q) * row[2]
            rho4 += q * (two * p * row[1] + q * row[0])
            total += sums(row[0], row[1], row[0] * y, row[2], row[1] * y, row[0] * y * y, rho4)
    return total


@wp.func
def sum_stamp(image: wp.array2d(dtype=wp.float64), mask: wp.array2d(dtype=wp.uint8), ellipse: Ellipse) -> StampSums:
    """Sum weight times image, and squares of the weight, over the pixels within the ellipse, masked ones apart."""
    result = StampSums()
    ny = image.shape[0]
    gaussian = gaussian_of(ellipse, ny, image.shape[1])
    a = gaussian.a
    b = gaussian.b
    c = gaussian.c
    for j in range(first_row(gaussian, ny), last_row(gaussian, ny) + 1):
        y = wp.float64(j) - gaussian.middle_y
        span = row_span(gaussian, y, image.shape[1])
        x = span.x
        weight = span.weight
        step = span.step
        for i in range(span.start, span.end):
            rho2 = a * x * x + wp.float64(2.0) * b * x * y + c * y * y
            factors = products(x, y, rho2)
            if mask[j, i] != wp.uint8(0):
                result.masked += weight * weight * factors
            else:
                result.light += weight * image[j, i] * factors
                result.squared_weight += weight * weight
            weight = weight * step
            step = step * gaussian.ratio
            x = x + wp.float64(1.0)
    return result


@wp.func
def bounded(step: wp.float64) -> wp.float64:
    """Limit a step of the iteration."""
    return wp.clamp(step, -LONGEST_STEP, LONGEST_STEP)


@wp.func
def shared_part(x: wp.float64, y: wp.float64, last_x: wp.float64, last_y: wp.float64) -> wp.float64:
    """Part of the last place in the next one that would end steps which shrink by a constant ratio."""
    change_x = x - last_x
    change_y = y - last_y
    square = change_x * change_x + change_y * change_y
    part = wp.float64(0.0)
    if square > wp.float64(0.0):
        part = (x * change_x + y * change_y) / square
    return wp.where(wp.abs(part) < wp.float64(1.0), part, wp.float64(0.0))


@wp.func
def extrapolated(plain: Ellipse, last_plain: Ellipse, step: Ellipse, last_step: Ellipse) -> Ellipse:
    """Ellipse beyond that after a step, by the step before it (Anderson 1965, of order 1).

    Centre, size and elongation, whose steps shrink at different rates, go each their own way.
    """
    half = wp.float64(0.5)
    zero = wp.float64(0.0)
    centre = shared_part(step.x, step.y, last_step.x, last_step.y)
    size = half * shared_part(step.xx + step.yy, zero, last_step.xx + last_step.yy, zero)
    stretch = shared_part(half * (step.xx - step.yy), step.xy, half * (last_step.xx - last_step.yy), last_step.xy)
    even = size * (plain.xx + plain.yy - last_plain.xx - last_plain.yy)
    odd = half * stretch * (plain.xx - plain.yy - last_plain.xx + last_plain.yy)
    result = Ellipse()
    result.x = plain.x - centre * (plain.x - last_plain.x)
    result.y = plain.y - centre * (plain.y - last_plain.y)
    result.xx = plain.xx - even - odd
    result.xy = plain.xy - stretch * (plain.xy - last_plain.xy)
    result.yy = plain.yy - even + odd
    return result


@wp.kernel
def fit_ellipses(
    first: wp.int32,
    images: wp.array3d(dtype=wp.float64),
    mask: wp.array3d(dtype=wp.uint8),
    masked: wp.array(dtype=wp.uint8),
    fill: wp.bool,
    start_sigma: wp.float64,
    max_iterations: wp.int32,
    tolerance: wp.float64,
    ellipses: wp.array2d(dtype=wp.float64),
    flags: wp.array(dtype=wp.int32),
):
    """Find the ellipse of one image (Hirata & Seljak 2003): that of GalSim's FindAdaptiveMom, in fewer steps.

    With `fill` a masked pixel holds what the Gaussian that fits the others best has there, else nothing. `masked`
    [image] tells whether one has such pixels; the mask has one image where none has.
    """
    item = first + wp.tid()
    image = images[item]
    masks = masked[item] != wp.uint8(0)
    half_x = wp.float64(0.5) * wp.float64(image.shape[1] - 1)
    half_y = wp.float64(0.5) * wp.float64(image.shape[0] - 1)
    widest = wp.float64(image.shape[0] * image.shape[0] + image.shape[1] * image.shape[1])
    ellipse = Ellipse()
    ellipse.xx = start_sigma * start_sigma
    ellipse.yy = ellipse.xx
    zero = wp.float64(0.0)
    two = wp.float64(2.0)
    four = wp.float64(4.0)
    half = wp.float64(0.5)
    last_plain = Ellipse()
    last_step = Ellipse()
    flag = NOT_CONVERGED
    first_axis = zero
    total = sums()
    masked_part = zero
    iteration = wp.int32(0)
    while iteration < max_iterations and flag == NOT_CONVERGED:
        stamp_sums = StampSums()
        if masks:
            stamp_sums = sum_stamp(image, mask[item], ellipse)
        else:
            stamp_sums.light = sum_light(image, ellipse)
            stamp_sums.squared_weight = wp.float64(1.0)
        total = stamp_sums.light
        if fill and stamp_sums.masked[0] > zero and stamp_sums.squared_weight > zero:
            total = total + (stamp_sums.light[0] / stamp_sums.squared_weight) * stamp_sums.masked
        masked_part = stamp_sums.masked[0] / wp.max(
            stamp_sums.masked[0] + stamp_sums.squared_weight, wp.float64(1e-300)
        )
        difference = wp.sqrt((ellipse.xx - ellipse.yy) * (ellipse.xx - ellipse.yy) + four * ellipse.xy * ellipse.xy)
        minor = half * (ellipse.xx + ellipse.yy - difference)  # square of the minor axis
        axis = wp.sqrt(wp.max(minor, zero))
        if iteration == 0:
            first_axis = axis
        amplitude = total[0]
        if not amplitude > zero:
            flag = NO_FLUX
        else:
            dx = bounded(two * total[1] / (amplitude * axis))
            dy = bounded(two * total[2] / (amplitude * axis))
            dxx = bounded(four * (total[3] / amplitude - half * ellipse.xx) / minor)
            dxy = bounded(four * (total[4] / amplitude - half * ellipse.xy) / minor)
            dyy = bounded(four * (total[5] / amplitude - half * ellipse.yy) / minor)
            shift = wp.max(wp.abs(dx), wp.abs(dy))
            change = wp.sqrt(wp.max(shift * shift, wp.max(wp.abs(dxx), wp.max(wp.abs(dxy), wp.abs(dyy)))))
            if axis < first_axis:
                change = change * first_axis / axis
            step = Ellipse()
            step.x = dx * axis
            step.y = dy * axis
            step.xx = dxx * minor
            step.xy = dxy * minor
            step.yy = dyy * minor
            plain = Ellipse()
            plain.x = ellipse.x + step.x
            plain.y = ellipse.y + step.y
            plain.xx = ellipse.xx + step.xx
            plain.xy = ellipse.xy + step.xy
            plain.yy = ellipse.yy + step.yy
            ellipse = plain
            if iteration > 0 and change < NEAR:
                ellipse = extrapolated(plain, last_plain, step, last_step)
            last_plain = plain
            last_step = step
            if wp.abs(ellipse.x) > half_x or wp.abs(ellipse.y) > half_y:
                flag = CENTROID_LEFT_STAMP
            elif not (ellipse.xx > zero and ellipse.yy > zero and ellipse.xx * ellipse.yy > ellipse.xy * ellipse.xy):
                flag = NEGATIVE_MOMENTS
            elif ellipse.xx > widest or ellipse.yy > widest:
                flag = TOO_WIDE
            elif change < tolerance:
                flag = wp.int32(0)
        iteration = iteration + wp.int32(1)
    flags[item] = flag
    ellipses[item, 0] = ellipse.x
    ellipses[item, 1] = ellipse.y
    ellipses[item, 2] = ellipse.xx
    ellipses[item, 3] = ellipse.xy
    ellipses[item, 4] = ellipse.yy
    ellipses[item, 5] = total[0]
    ellipses[item, 6] = total[6] / total[0]
    ellipses[item, 7] = masked_part
