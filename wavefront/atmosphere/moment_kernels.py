"""Kernel of the statistics of exposures: products of slope covariances."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Baselines in one packet.
LANES = 16
baselines = wp.types.vector(LANES, wp.float32)
#: Products of a slope covariance: those of the second order, and of the fourth.
product_sums = wp.types.vector(9, wp.float64)


@wp.func
def square(values: baselines):
    """Squares of the lanes."""
    return wp.cw_mul(values, values)


@wp.func
def lane_sum(values: baselines):
    """Sum over the lanes."""
    total = wp.float32(0.0)
    for i in range(LANES):
        total = total + values[i]
    return total


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
    farthest: wp.float64,
    common: wp.array2d(dtype=wp.float64),
    ground: wp.array2d(dtype=baselines),
    place: wp.array3d(dtype=wp.float32),
    squares: wp.array2d(dtype=wp.float64),
    terms: wp.array3d(dtype=wp.float64),
):
    """Average products of slope covariances of two stars over pupil and delays, for one lag.

    Arguments: lag [lag, 2] of the stars' field slopes [rad]; delay [s] and its weight [delay]; packet_start [delay + 1]
    of the packets of each delay; baseline [packet, 3] of the pupil: x, y [m], weight of sum 1; altitude, velocity,
    weight of the layers; table: the slopes' covariance, isotropic and directed, zero at the end; per_step: one over its
    step [1/m]; farthest: distance of a layer's centre from which on none of its baselines is within the table [m];
    common [delay, 12]: the terms of layers on the ground alone; where it is empty, these are computed too; ground
    [packet, 3]: covariances a, b, c of these layers, which are computed with the terms, and zero before; place [lag,
    layer, 3]: room; squares [lag, 9]: averages of pp, qq, ss, pq, ps, qs, and of fourth powers: a^4 + c^4 - 2 b^4, the
    same at 45 degrees, (a + c)^4 / 16; terms [lag, delay, 3 or 12]: averages of a, b, c over the baselines, and where
    there is room what the delay adds to the squares. p = xx - yy, q = 2 xy, s = xx + yy.
    """
    item = first + wp.tid()
    n_layer = altitude.shape[0]
    last = table.shape[0] - 1
    two = wp.float32(2.0)
    half = wp.float32(0.5)
    total = product_sums()
    for t in range(delay.shape[0]):
        active = wp.int32(0)
        for n in range(n_layer):
            apart = altitude[n] > wp.float64(0.0) or common.shape[0] == 0
            center_x = altitude[n] * lag[item, 0] + velocity[n, 0] * delay[t]
            center_y = altitude[n] * lag[item, 1] + velocity[n, 1] * delay[t]
            if apart and center_x * center_x + center_y * center_y < farthest * farthest:
                place[item, active, 0] = wp.float32(center_x)
                place[item, active, 1] = wp.float32(center_y)
                place[item, active, 2] = weight[n]
                active = active + 1
        if active == 0 and common.shape[0] > 0:
            for k in range(9):
                total[k] = total[k] + common[t, 3 + k]
            for k in range(3):
                terms[item, t, k] = common[t, k]
        elif active > 0:
            pp = baselines()
            qq = baselines()
            ss = baselines()
            pq = baselines()
            ps = baselines()
            qs = baselines()
            along = baselines()
            across = baselines()
            round = baselines()
            mean_a = baselines()
            mean_b = baselines()
            mean_c = baselines()
            for packet in range(packet_start[t], packet_start[t + 1]):
                # Sums, since a load alone would be an alias of the array.
                a = baselines() + ground[packet, 0]
                b = baselines() + ground[packet, 1]
                c = baselines() + ground[packet, 2]
                for n in range(active):
                    x = baseline[packet, 0] - baselines(place[item, n, 0])
                    y = baseline[packet, 1] - baselines(place[item, n, 1])
                    layer = place[item, n, 2]
                    xx = square(x)
                    yy = square(y)
                    separation = xx + yy
                    same = baselines()
                    other = baselines()
                    for i in range(LANES):
                        knot = wp.min(wp.int32(wp.sqrt(separation[i]) * per_step + wp.float32(0.5)), last)
                        entry = table[knot]
                        same[i] = entry[0]
                        other[i] = entry[1]
                    same = layer * same
                    other = layer * other
                    difference = wp.cw_mul(other, xx - yy)
                    a = a + same + difference
                    c = c + same - difference
                    b = b + two * wp.cw_mul(other, wp.cw_mul(x, y))
                if common.shape[0] == 0:
                    ground[packet, 0] = a
                    ground[packet, 1] = b
                    ground[packet, 2] = c
                w = baseline[packet, 2]
                aa = square(a)
                bb = square(b)
                cc = square(c)
                wb = wp.cw_mul(w, b)
                pp = pp + wp.cw_mul(w, aa + cc - two * bb)
                qq = qq + wp.cw_mul(w, wp.cw_mul(a, c) + bb)
                ss = ss + wp.cw_mul(w, aa + two * bb + cc)
                pq = pq + wp.cw_mul(wb, a - c)
                ps = ps + wp.cw_mul(w, aa - cc)
                qs = qs + wp.cw_mul(wb, a + c)
                middle = half * (a + c)
                turned = half * (c - a)
                along = along + wp.cw_mul(w, square(aa) + square(cc) - two * square(bb))
                across = across + wp.cw_mul(
                    w, square(square(middle + b)) + square(square(middle - b)) - two * square(square(turned))
                )
                round = round + wp.cw_mul(w, square(square(middle)))
                mean_a = mean_a + wp.cw_mul(w, a)
                mean_b = mean_b + wb
                mean_c = mean_c + wp.cw_mul(w, c)
            sums = product_sums(
                wp.float64(two * lane_sum(pp)),
                wp.float64(two * two * lane_sum(qq)),
                wp.float64(two * lane_sum(ss)),
                wp.float64(two * two * lane_sum(pq)),
                wp.float64(two * lane_sum(ps)),
                wp.float64(two * two * lane_sum(qs)),
                wp.float64(lane_sum(along)),
                wp.float64(lane_sum(across)),
                wp.float64(lane_sum(round)),
            )
            total = total + delay_weight[t] * sums
            if terms.shape[2] > 3:
                for k in range(9):
                    terms[item, t, 3 + k] = delay_weight[t] * sums[k]
            terms[item, t, 0] = wp.float64(lane_sum(mean_a))
            terms[item, t, 1] = wp.float64(lane_sum(mean_b))
            terms[item, t, 2] = wp.float64(lane_sum(mean_c))
    for k in range(9):
        squares[item, k] = total[k]
