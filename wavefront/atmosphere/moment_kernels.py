"""Kernel of the statistics of exposures: products of slope covariances.

The loop over baselines is written in C with vectors of the compiler, whose sums stay in the processor's registers.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Baselines in one packet.
LANES = 16
baselines = wp.types.vector(LANES, wp.float32)
#: Averages of one delay: slope covariances a, b, c, and their products of the second, fourth, sixth and third order.
TERMS = 18
delay_terms = wp.types.vector(TERMS, wp.float64)
#: Number of slope covariances among them.
SLOPES = wp.constant(3)
#: Products pp, qq, ss, pq, ps, qs.
pair_products = wp.types.vector(6, wp.float64)

_BASELINE_LOOP = f"""
    #pragma clang fp contract(fast)
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const int last = table.shape[0] - 1;
    const float* knots = (const float*)table.data;
    packet sum[{TERMS}] = {{}};
    for (int k = start; k < end; ++k) {{
        const packet* point = (const packet*)baseline.data + 4 * k;
        packet* shared = (packet*)ground.data + 3 * k;
        packet a = shared[0] + distant.c[0];
        packet b = shared[1] + distant.c[1];
        packet c = shared[2] + distant.c[2];
        for (int n = 0; n < active; ++n) {{
            const float* center = place.data + 3 * n;
            const packet x = point[0] - center[0];
            const packet y = point[1] - center[1];
            const packet xx = x * x;
            const packet yy = y * y;
            const packet separation = xx + yy;
            float squares[{LANES}], from_isotropic[{LANES}], from_directed[{LANES}];
            *(packet*)squares = separation;
            for (int i = 0; i < {LANES}; ++i) {{
                const int nearest = (int)(__builtin_sqrtf(squares[i]) * per_step + 0.5f);
                const int knot = nearest < last ? nearest : last;
                from_isotropic[i] = knots[2 * knot];
                from_directed[i] = knots[2 * knot + 1];
            }}
            packet same = *(packet*)from_isotropic, other = *(packet*)from_directed;
            same = center[2] * same;
            other = center[2] * other;
            const packet difference = other * (xx - yy);
            a = a + same + difference;
            c = c + same - difference;
            b = b + 2.0f * other * x * y;
        }}
        if (of_ground) {{
            shared[0] = a;
            shared[1] = b;
            shared[2] = c;
        }}
        const packet w = point[2];
        const packet aa = a * a, bb = b * b, cc = c * c, wb = w * b;
        // Squares of the mean of the eigenvalues, and of half their difference along axes, diagonals, and both.
        const packet mean = 0.25f * (a + c) * (a + c), axes = 0.25f * (a - c) * (a - c), apart = axes + bb;
        const packet same_way = mean * mean, product = mean * apart, across = apart * apart;
        const packet fourth = w * (same_way - across), of_fourth = 2.0f * w * (apart + 3.0f * mean);
        const packet sixth = w * (mean - apart) * (same_way + 3.0f * product + across);
        const packet of_sixth = 2.0f * w * (across + 8.0f * product + 6.0f * same_way);
        sum[0] += w * a;
        sum[1] += wb;
        sum[2] += w * c;
        sum[3] += 2.0f * w * (aa + cc - 2.0f * bb);
        sum[4] += 4.0f * w * (a * c + bb);
        sum[5] += 2.0f * w * (aa + 2.0f * bb + cc);
        sum[6] += 4.0f * wb * (a - c);
        sum[7] += 2.0f * w * (aa - cc);
        sum[8] += 4.0f * wb * (a + c);
        sum[9] += fourth + axes * of_fourth;
        sum[10] += fourth + bb * of_fourth;
        sum[11] += w * (same_way + 4.0f * product + across);
        sum[12] += sixth + axes * of_sixth;
        sum[13] += sixth + bb * of_sixth;
        sum[14] += w * (mean + apart) * (same_way + 8.0f * product + across);
        const packet third = 0.5f * point[3] * (a + c);
        sum[15] += third * (mean + 3.0f * axes);
        sum[16] += third * (mean + 3.0f * bb);
        sum[17] += third * (mean + 2.0f * apart);
    }}
    wp::vec_t<{TERMS}, wp::float64> averages;
    for (int k = 0; k < {TERMS}; ++k) {{
        float total = 0.0f;
        for (int i = 0; i < {LANES}; ++i)
            total += sum[k][i];
        averages.c[k] = total;
    }}
    return averages;
"""


@wp.func_native(_BASELINE_LOOP)
def average_over_baselines(
    baseline: wp.array2d(dtype=baselines),
    start: wp.int32,
    end: wp.int32,
    ground: wp.array2d(dtype=baselines),
    of_ground: bool,
    place: wp.array2d(dtype=wp.float32),
    active: wp.int32,
    distant: wp.vec3f,
    table: wp.array(dtype=wp.vec2f),
    per_step: wp.float32,
) -> delay_terms:
    """Average slope covariances and their products over the baselines of one delay, packets start to end.

    Arguments, beside those of :func:`average_products`: whether to store the covariances as those of the ground; place
    [layer, 3] of the first, active layers: x, y of their centres [m], and weights; distant: a, b, c of the others.
    """
    ...


@wp.func
def slopes_apart(x: wp.float32, y: wp.float32, table: wp.array(dtype=wp.vec2f), per_step: wp.float32):
    """Covariances a, b, c of the slopes of points x, y [m] apart."""
    knot = wp.min(wp.int32(wp.sqrt(x * x + y * y) * per_step + wp.float32(0.5)), table.shape[0] - 1)
    same = table[knot][0]
    other = table[knot][1]
    difference = other * (x * x - y * y)
    return wp.vec3f(same + difference, wp.float32(2.0) * other * x * y, same - difference)


@wp.kernel
def average_products(
    first: wp.int32,
    lag: wp.array2d(dtype=wp.float64),
    delay: wp.array(dtype=wp.float64),
    delay_weight: wp.array(dtype=wp.float64),
    packet_start: wp.array(dtype=wp.int32),
    baseline: wp.array2d(dtype=baselines),
    altitude: wp.array(dtype=wp.float64),
    velocity: wp.array2d(dtype=wp.float64),
    weight: wp.array(dtype=wp.float32),
    table: wp.array(dtype=wp.vec2f),
    per_step: wp.float32,
    distant: wp.float64,
    farthest: wp.float64,
    common: wp.array2d(dtype=wp.float64),
    ground: wp.array2d(dtype=baselines),
    place: wp.array3d(dtype=wp.float32),
    squares: wp.array2d(dtype=wp.float64),
    terms: wp.array3d(dtype=wp.float64),
):
    """Average products of slope covariances of two stars over pupil and delays, for one lag.

    Arguments: lag [lag, 2] of the stars' field slopes [rad]; delay [s] and its weight [delay]; packet_start [delay + 1]
    of the packets of each delay; baseline [packet, 4] of the pupil: x, y [m], weight of sum 1, and that times the
    covariance of the optics' aberrations; altitude, velocity, weight of the layers; table of the slopes'
    covariance, isotropic and directed, zero at the end; per_step: one over its step [1/m]; distant: distance of a
    layer's centre from which on the covariance there stands for all baselines [m]; farthest: that from which on none
    of its baselines is within the table; common [delay, 18]: the terms of layers on the ground
    alone; where it is empty, these are computed too; ground [packet, 3]: covariances a, b, c of these layers, which are
    computed with the terms, and zero before; place [lag, layer, 3]: room; squares [lag, 15]: averages of pp, qq, ss,
    pq, ps, qs, and of the products of the fourth, the sixth and the third order that act as p, q and s; terms [lag,
    delay, 3 or 18]: averages of a, b, c over the baselines, and where there is room of the products that make the
    squares. p = xx - yy, q = 2 xy, s = xx + yy.
    """
    item = first + wp.tid()
    of_ground = common.shape[0] == 0
    averages = delay_terms()
    total = delay_terms()
    for t in range(delay.shape[0]):
        active = wp.int32(0)
        within = wp.int32(0)
        of_distant = wp.vec3f()
        for n in range(altitude.shape[0]):
            center_x = altitude[n] * lag[item, 0] + velocity[n, 0] * delay[t]
            center_y = altitude[n] * lag[item, 1] + velocity[n, 1] * delay[t]
            squared = center_x * center_x + center_y * center_y
            if (altitude[n] > wp.float64(0.0) or of_ground) and squared < farthest * farthest:
                within = within + 1
                if squared < distant * distant:
                    place[item, active, 0] = wp.float32(center_x)
                    place[item, active, 1] = wp.float32(center_y)
                    place[item, active, 2] = weight[n]
                    active = active + 1
                else:
                    of_distant = of_distant + weight[n] * slopes_apart(
                        wp.float32(center_x), wp.float32(center_y), table, per_step
                    )
        if within == 0 and not of_ground:
            for k in range(TERMS):
                averages[k] = common[t, k]
        else:
            averages = average_over_baselines(
                baseline,
                packet_start[t],
                packet_start[t + 1],
                ground,
                of_ground,
                place[item],
                active,
                of_distant,
                table,
                per_step,
            )
        total = total + delay_weight[t] * averages
        for k in range(terms.shape[2]):
            terms[item, t, k] = averages[k]
    for k in range(squares.shape[1]):
        squares[item, k] = total[SLOPES + k]


@wp.func
def wick_products(slopes: wp.vec3d):
    """Wick's products of covariances a, b, c of slopes."""
    two = wp.float64(2.0)
    four = wp.float64(4.0)
    a = slopes[0]
    b = slopes[1]
    c = slopes[2]
    return pair_products(
        two * (a * a + c * c - two * b * b),
        four * (a * c + b * b),
        two * (a * a + two * b * b + c * c),
        four * b * (a - c),
        two * (a * a - c * c),
        four * b * (a + c),
    )


@wp.kernel
def products_with_mean_slope(
    first: wp.int32,
    slopes: wp.array2d(dtype=wp.vec3d),
    width: wp.array(dtype=wp.float64),
    start: wp.array(dtype=wp.int32),
    part: wp.array(dtype=wp.float64),
    exposure: wp.float64,
    products: wp.array2d(dtype=wp.float64),
):
    """Average the products that the moments' covariances lose by the mean slope, for one lag.

    Arguments: slopes [lag, delay]: covariances a, b, c of slopes a delay apart, which are overwritten by their sums
    over delays; width [delay] of their intervals [s]; start, part [moment]: interval that holds the delay from the end
    of the exposure to a moment, and the part of it before that; exposure [s]; products [lag, 6].
    """
    item = first + wp.tid()
    count = width.shape[0] / 2
    half = wp.float64(0.5)
    total = wp.vec3d()
    for t in range(2 * count):
        total = total + width[t] * slopes[item, t]
        slopes[item, t] = total
    mean = wp.vec3d()
    last = wp.vec3d()
    average = pair_products()
    for moment in range(count + 1):
        before = wp.vec3d()
        if start[moment] > 0:
            before = before + slopes[item, start[moment] - 1]
        before = before + part[moment] * (slopes[item, start[moment]] - before)
        # Of a moment t with the mean slope: delays from t - T to t.
        with_mean = (slopes[item, count + moment - 1] - before) / exposure
        if moment > 0:
            middle = half * (last + with_mean)
            fraction = width[count + moment - 1] / exposure
            average = average + fraction * wick_products(middle)
            mean = mean + fraction * middle
        last = with_mean
    average = wp.float64(2.0) * average - wick_products(mean)
    for k in range(6):
        products[item, k] = average[k]
