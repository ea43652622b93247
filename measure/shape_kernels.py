"""Kernels of shapes: weighted moments about the centroid, and areas above a level.

Columns of images stand in packets, which are summed up at once; no sum depends on the number of images.
"""

from __future__ import annotations

import warp as wp

from ..core.launch import FORWARD_OPTIONS
from .adaptive_kernels import CENTROID_LEFT_STAMP, NEGATIVE_MOMENTS, NO_FLUX, NOT_CONVERGED
from .packet_kernels import LANES, lane_sum, packet

wp.set_module_options(FORWARD_OPTIONS)

#: Numbers of an image: centre x, y [pixel]; e1, e2; size [pixel].
SHAPE = 5
#: Rows of work space: the weight along x, times x and times its square.
WEIGHT_ROWS = 3

NO_SOURCE = wp.constant(wp.int32(32))
#: Least eigenvalue of the derivative of the first moment by the centre, of 1 without a source.
LEAST_SLOPE = wp.constant(wp.float64(0.1))

#: Size under the weight, in units of that of the weight, from which on light does not fall off: 22 times as wide.
WIDEST = wp.constant(wp.float64(0.999))


@wp.struct
class WeightedMoments:
    """Sum of weight times image, and its means about the centre [pixel]."""

    total: wp.float64
    x: wp.float64
    y: wp.float64
    xx: wp.float64
    yy: wp.float64
    xy: wp.float64


@wp.func
def weigh_image(
    image: wp.array2d(dtype=packet),
    weights: wp.array2d(dtype=packet),
    x0: wp.float64,
    y0: wp.float64,
    half_y: wp.float64,
    half_x: wp.float64,
    sigma: wp.float64,
) -> WeightedMoments:
    """Sum one image under the Gaussian about (x0, y0), whose factors along x go to `weights` [power of x, packet]."""
    packets = image.shape[1]
    slope = wp.float64(-0.5) / (sigma * sigma)
    for p in range(packets):
        weight = packet()
        weight_x = packet()
        weight_xx = packet()
        for lane in range(LANES):
            x = wp.float64(p * LANES + lane) - half_x - x0
            value = wp.exp(slope * x * x)
            weight[lane] = value
            weight_x[lane] = value * x
            weight_xx[lane] = value * x * x
        weights[0, p] = weight
        weights[1, p] = weight_x
        weights[2, p] = weight_xx
    total = packet()
    sum_x = packet()
    sum_y = packet()
    sum_xx = packet()
    sum_yy = packet()
    sum_xy = packet()
    for j in range(image.shape[0]):
        y = wp.float64(j) - half_y - y0
        weight_y = wp.exp(slope * y * y)
        row = packet()
        row_x = packet()
        row_xx = packet()
        for p in range(packets):
            pixels = image[j, p]
            row = row + wp.cw_mul(pixels, weights[0, p])
            row_x = row_x + wp.cw_mul(pixels, weights[1, p])
            row_xx = row_xx + wp.cw_mul(pixels, weights[2, p])
        total = total + weight_y * row
        sum_x = sum_x + weight_y * row_x
        sum_y = sum_y + (weight_y * y) * row
        sum_xx = sum_xx + weight_y * row_xx
        sum_yy = sum_yy + (weight_y * y * y) * row
        sum_xy = sum_xy + (weight_y * y) * row_x
    result = WeightedMoments()
    result.total = lane_sum(total)
    result.x = lane_sum(sum_x) / result.total
    result.y = lane_sum(sum_y) / result.total
    result.xx = lane_sum(sum_xx) / result.total
    result.yy = lane_sum(sum_yy) / result.total
    result.xy = lane_sum(sum_xy) / result.total
    return result


@wp.func
def newton_step(moments: WeightedMoments, sigma: wp.float64) -> wp.vec2d:
    """Step that brings the weighted first moment to zero.

    The derivative of sum(W I (x - c)) with respect to -c is sum(W I) (1 - M/sigma^2), M being the second moments
    about c; for a Gaussian image that gives the exact centroid at once. Where the image is too broad or too noisy for
    it (an eigenvalue under 0.1) that eigenvalue is raised to 0.1, and no step is longer than the weight is wide.
    """
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    square = sigma * sigma
    a = one - moments.xx / square
    b = one - moments.yy / square
    c = -moments.xy / square
    mean = half * (a + b)
    difference = half * (a - b)
    radius = wp.sqrt(difference * difference + c * c)
    low = wp.max(mean - radius, LEAST_SLOPE)
    high = wp.max(mean + radius, LEAST_SLOPE)
    # The inverse of the matrix with eigenvalues (high, low), as (trace part) + (trace-free part along the old axes).
    even = half * (one / high + one / low)
    odd = half * (one / high - one / low)
    cosine = zero
    sine = zero
    if radius > zero:
        cosine = difference / radius
        sine = c / radius
    step = wp.vec2d(
        (even + odd * cosine) * moments.x + odd * sine * moments.y,
        odd * sine * moments.x + (even - odd * cosine) * moments.y,
    )
    return step * (sigma / wp.max(wp.length(step), sigma))


@wp.kernel
def measure_shape(
    first: wp.int32,
    images: wp.array3d(dtype=packet),
    half_x: wp.float64,
    half_y: wp.float64,
    sigma: wp.float64,
    max_iterations: wp.int32,
    tolerance: wp.float64,
    weights: wp.array3d(dtype=packet),
    results: wp.array2d(dtype=wp.float64),
    flags: wp.array(dtype=wp.int32),
):
    """Iterate the centre of the weight of one image whose flag is zero, from that in `results`, and measure its shape.

    Arguments: images [n, ny, packet] with zeros beyond their columns; half of (nx - 1) and (ny - 1); rms width of the
    weight [pixel]; work space [n, 3, packet]; results [n, SHAPE], of which those stay as they are that fail.
    """
    item = first + wp.tid()
    if flags[item] != wp.int32(0):
        return
    # Nearer to the edge, the weight would be cut.
    farthest_x = half_x - wp.min(sigma, wp.float64(0.5) * half_x)
    farthest_y = half_y - wp.min(sigma, wp.float64(0.5) * half_y)
    x0 = results[item, 0]
    y0 = results[item, 1]
    flag = NOT_CONVERGED
    iteration = wp.int32(0)
    while iteration < max_iterations and flag == NOT_CONVERGED:
        moments = weigh_image(images[item], weights[item], x0, y0, half_y, half_x, sigma)
        if not moments.total > wp.float64(0.0):
            flag = NO_FLUX
        else:
            step = newton_step(moments, sigma)
            x0 = x0 + step[0]
            y0 = y0 + step[1]
            if wp.abs(x0) > farthest_x or wp.abs(y0) > farthest_y:
                flag = CENTROID_LEFT_STAMP
            elif wp.length(step) < tolerance:
                flag = wp.int32(0)
        iteration = iteration + wp.int32(1)
    if flag == wp.int32(0):
        results[item, 0] = x0
        results[item, 1] = y0
        # Once more about the final centre: the moments of the last pass belong to the centre before its step.
        moments = weigh_image(images[item], weights[item], x0, y0, half_y, half_x, sigma)
        q11 = moments.xx - moments.x * moments.x
        q22 = moments.yy - moments.y * moments.y
        q12 = moments.xy - moments.x * moments.y
        determinant = q11 * q22 - q12 * q12
        widest = WIDEST * sigma
        if not (determinant > wp.float64(0.0) and q11 > wp.float64(0.0)):
            flag = NEGATIVE_MOMENTS
        elif determinant > widest * widest * widest * widest:
            flag = NO_SOURCE
        else:
            root = wp.sqrt(determinant)
            trace = q11 + q22 + wp.float64(2.0) * root
            results[item, 2] = (q11 - q22) / trace
            results[item, 3] = wp.float64(2.0) * q12 / trace
            results[item, 4] = wp.sqrt(root)
    flags[item] = flag


@wp.func
def difference(before: wp.float64, here: wp.float64, after: wp.float64, place: wp.int32, last: wp.int32) -> wp.float64:
    """Differentiate along a line of pixels, one-sided at its ends."""
    if place == 0:
        return after - here
    if place == last:
        return here - before
    return wp.float64(0.5) * (after - before)


@wp.kernel
def add_areas(
    first: wp.int32,
    images: wp.array3d(dtype=wp.float64),
    levels: wp.array(dtype=wp.float64),
    areas: wp.array(dtype=wp.float64),
):
    """Add up the pixels of one image above its level; border pixels count in part, as if the image were a plane."""
    item = first + wp.tid()
    half = wp.float64(0.5)
    last_row = images.shape[1] - 1
    last_column = images.shape[2] - 1
    level = levels[item]
    area = wp.float64(0.0)
    for j in range(images.shape[1]):
        below = wp.max(j - 1, 0)
        above = wp.min(j + 1, last_row)
        for i in range(images.shape[2]):
            here = images[item, j, i]
            left = images[item, j, wp.max(i - 1, 0)]
            right = images[item, j, wp.min(i + 1, last_column)]
            gx = difference(left, here, right, i, last_column)
            gy = difference(images[item, below, i], here, images[item, above, i], j, last_row)
            height = here - level
            square = gx * gx + gy * gy
            if height * height < wp.float64(0.25) * square:
                area = area + half + height / wp.sqrt(square)
            elif height > wp.float64(0.0):
                area = area + wp.float64(1.0)
    areas[item] = area
