"""Kernels of random fields over the field of view: covariances on their grid, and transforms of the mean wavefront."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Covariances of the components of the moments.
pairs = wp.types.vector(6, wp.float32)


@wp.func
def cubic_weights(part: wp.float32):
    """Weights of the four values around a place between the second and the third, of Lagrange's cubic."""
    one = wp.float32(1.0)
    two = wp.float32(2.0)
    before = part * (part - one) * (two - part) / wp.float32(6.0)
    first = (part + one) * (part - one) * (part - two) / two
    second = part * (part + one) * (two - part) / two
    after = part * (part + one) * (part - one) / wp.float32(6.0)
    return wp.vec4f(before, first, second, after)


@wp.kernel
def spread_over_grid(
    first: wp.int32,
    polar: wp.array2d(dtype=pairs),
    per_spacing: wp.float32,
    step: wp.float32,
    grid: wp.array3d(dtype=wp.float32),
):
    """Interpolate covariances from rings and spokes of lags to one row of a periodic grid, and to its opposite.

    Arguments: polar [ring, spoke]: rings at exp(step k) - 1 in units of the first scale, spokes evenly over half a
    turn, after which the covariances are the same; per_spacing: spacing of the grid in that unit; grid [pair, row,
    column], whose rows 0 to n/2 are the items.
    """
    row = first + wp.tid()
    size = grid.shape[1]
    n_ring = polar.shape[0]
    n_spoke = polar.shape[1]
    y = per_spacing * wp.float32(row)
    for column in range(size):
        signed = wp.where(column > size / 2, column - size, column)
        x = per_spacing * wp.float32(signed)
        ring = wp.log(wp.float32(1.0) + wp.sqrt(x * x + y * y)) / step
        spoke = wp.atan2(y, x) / wp.float32(wp.PI) * wp.float32(n_spoke)
        before_ring = wp.min(wp.int32(ring), n_ring - 3)
        before_spoke = wp.int32(wp.floor(spoke))
        along = cubic_weights(ring - wp.float32(before_ring))
        around = cubic_weights(spoke - wp.float32(before_spoke))
        value = pairs()
        for i in range(4):
            # On the other side of the centre the rings come in reverse, with the same values.
            k = wp.abs(before_ring + i - 1)
            for j in range(4):
                m = (before_spoke + j - 1 + n_spoke) % n_spoke
                value = value + along[i] * around[j] * polar[k, m]
        for pair in range(6):
            grid[pair, row, column] = value[pair]
            grid[pair, (size - row) % size, (size - column) % size] = value[pair]


@wp.kernel
def add_wavefronts(
    first: wp.int32,
    noise: wp.array3d(dtype=wp.vec2f),
    distance: wp.array(dtype=wp.float32),
    drift: wp.array2d(dtype=wp.float32),
    strength: wp.array(dtype=wp.float32),
    outer_frequency: wp.float32,
    frequency_step: wp.float32,
    radial: wp.array2d(dtype=wp.float32),
    per_frequency: wp.float32,
    order: wp.array(dtype=wp.int32),
    spectrum: wp.array3d(dtype=wp.vec2f),
):
    """Sum over layers the transforms of Zernikes of the mean wavefront, for one row of frequencies of the field.

    Arguments: noise [layer, row, column]: transform of white noise; distance [layer] along the line of sight [m];
    drift [layer, 2] in the exposure [m]; strength [layer]: amplitude of a mode but for the power of its frequency;
    outer_frequency: one over the outer scale [1/m]; frequency_step of the field [cycles/rad]; radial [term, k]: mean
    over the pupil of a term's radial part times a wave, against the frequency, whose table has per_frequency steps a
    cycle/m; order [term] m of the Zernikes, negative for sines; spectrum [term, row, column].
    """
    row = first + wp.tid()
    size = spectrum.shape[1]
    last = wp.float32(radial.shape[1] - 2)
    signed = wp.where(row > size / 2, row - size, row)
    for column in range(spectrum.shape[2]):
        for term in range(order.shape[0]):
            spectrum[term, row, column] = wp.vec2f(wp.float32(0.0), wp.float32(0.0))
        if (row > 0 or column > 0) and 2 * column < size and 2 * row != size:
            across = frequency_step * wp.float32(column)
            up = frequency_step * wp.float32(signed)
            angle = wp.atan2(up, across)
            for layer in range(distance.shape[0]):
                nu_x = across / distance[layer]
                nu_y = up / distance[layer]
                squared = nu_x * nu_x + nu_y * nu_y
                turns = wp.float32(wp.PI) * (nu_x * drift[layer, 0] + nu_y * drift[layer, 1])
                smear = wp.float32(1.0)
                if wp.abs(turns) > wp.float32(1e-3):
                    smear = wp.sin(turns) / turns
                power = wp.pow(squared + outer_frequency * outer_frequency, wp.float32(-11.0 / 12.0))
                mode = strength[layer] * power * smear * noise[layer, row, column]
                at = wp.sqrt(squared) * per_frequency
                if at < last:
                    knot = wp.int32(at)
                    part = at - wp.float32(knot)
                    for term in range(order.shape[0]):
                        m = wp.abs(order[term])
                        around = wp.cos(wp.float32(m) * angle)
                        if order[term] < 0:
                            around = wp.sin(wp.float32(m) * angle)
                        gain = around * (radial[term, knot] + part * (radial[term, knot + 1] - radial[term, knot]))
                        value = gain * mode
                        # A layer's place runs against the field: the conjugate of i^m.
                        turn = m % 4
                        if turn == 1:
                            value = wp.vec2f(value[1], -value[0])
                        elif turn == 2:
                            value = -value
                        elif turn == 3:
                            value = wp.vec2f(-value[1], value[0])
                        spectrum[term, row, column] = spectrum[term, row, column] + value
