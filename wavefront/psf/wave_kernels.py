"""Kernels of the wave PSF engine: the path of the atmosphere at every pupil point, the field of each wavelength."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet_functions import unit_circle
from .sample_packets import LANES, indices, samples

wp.set_module_options(FORWARD_OPTIONS)


@wp.struct
class Screens:
    """Path of all layers at one scale [m], as coefficients of periodic cubic B-splines.

    ``values`` [layer, y * size + x]; a row of the pupil spans ``run`` packets of a row.
    """

    values: wp.array2d(dtype=wp.float32)
    size: wp.int32
    run: wp.int32


@wp.struct
class Taps:
    """Samples about the lattice points at one time on all screens, counted layer by layer, low before high.

    ``column`` [screen]: first column of the run; ``row`` and ``row_weight`` [screen, item]: second of the four rows
    about a row of the pupil, and their weights; ``sample`` [screen, packet]: first of the four columns about a point,
    counted along the run; ``column_weight`` [screen, 4, packet].
    """

    column: wp.array(dtype=wp.int32)
    row: wp.array2d(dtype=wp.int32)
    row_weight: wp.array2d(dtype=wp.vec4f)
    sample: wp.array2d(dtype=indices)
    column_weight: wp.array3d(dtype=samples)


@wp.func
def blend(screens: Screens, layer: wp.int32, weight: wp.vec4f, rows: wp.vec4i, column: wp.int32):
    """Weighted sum of one column of four rows, each given by its first sample."""
    return (
        weight[0] * screens.values[layer, rows[0] + column]
        + weight[1] * screens.values[layer, rows[1] + column]
        + weight[2] * screens.values[layer, rows[2] + column]
        + weight[3] * screens.values[layer, rows[3] + column]
    )


@wp.func
def blend_rows(
    screens: Screens,
    layer: wp.int32,
    row: wp.int32,
    weight: wp.vec4f,
    column: wp.int32,
    item: wp.int32,
    blended: wp.array2d(dtype=wp.float32),
):
    """Interpolate a screen in y along a run of columns.

    ``row`` is the second of the four rows that ``weight`` belongs to, ``column`` the first of the run.
    """
    size = screens.size
    rows = wp.vec4i(((row + size - 1) % size) * size, row * size, ((row + 1) % size) * size, ((row + 2) % size) * size)
    for packet in range(screens.run):
        values = samples()
        start = column + packet * LANES
        # Two loops in place of one with a choice inside: the compiler vectorizes the first.
        if start + LANES <= size:
            for i in range(LANES):
                values[i] = blend(screens, layer, weight, rows, start + i)
        else:
            for i in range(LANES):
                values[i] = blend(screens, layer, weight, rows, (start + i) % size)
        for i in range(LANES):
            blended[item, packet * LANES + i] = values[i]


@wp.func
def add_screen(
    screens: Screens,
    layer: wp.int32,
    screen: wp.int32,
    item: wp.int32,
    taps: Taps,
    lit: wp.array2d(dtype=wp.int32),
    blended: wp.array2d(dtype=wp.float32),
    path: wp.array2d(dtype=samples),
):
    """Add one screen to the path along one row of the pupil; ``screen`` counts the screens of both scales."""
    blend_rows(
        screens, layer, taps.row[screen, item], taps.row_weight[screen, item], taps.column[screen], item, blended
    )
    for packet in range(path.shape[1]):
        if lit[item, packet] == 1:
            at = taps.sample[screen, packet]
            before = taps.column_weight[screen, 0, packet]
            first = taps.column_weight[screen, 1, packet]
            second = taps.column_weight[screen, 2, packet]
            after = taps.column_weight[screen, 3, packet]
            screen_path = samples()
            for i in range(LANES):
                k = at[i]
                screen_path[i] = (
                    before[i] * blended[item, k]
                    + first[i] * blended[item, k + 1]
                    + second[i] * blended[item, k + 2]
                    + after[i] * blended[item, k + 3]
                )
            path[item, packet] = path[item, packet] + screen_path


@wp.kernel
def pupil_fields(
    first: wp.int32,
    low: Screens,
    high: Screens,
    n_layer: wp.int32,
    taps: Taps,
    lit: wp.array2d(dtype=wp.int32),
    turns_per_meter: wp.array(dtype=wp.float32),
    channel: wp.array(dtype=wp.int32),
    optics: wp.array3d(dtype=samples),
    amplitude: wp.array3d(dtype=samples),
    blended: wp.array2d(dtype=wp.float32),
    path: wp.array2d(dtype=samples),
    field: wp.array3d(dtype=wp.vec2f),
):
    """Write the complex field of every wavelength along one row of the pupil, at one time.

    The pupil is a square lattice along the axes of the screens, so interpolation is done row by row: first between the
    rows of a screen, then along the row so gained.

    Arguments: lit [item, packet]: 1 where a packet holds light; turns_per_meter [wave]; channel [wave]: that of the
    moment; optics [channel, item, packet]: phase [turns]; amplitude [wave, item, packet]; blended [item, column], path
    [item, packet]: room for a row of a screen and for the path [m]; field [wave, y, x], of which the pupil fills the
    first corner.
    """
    item = first + wp.tid()
    for packet in range(path.shape[1]):
        path[item, packet] = samples()
    for layer in range(n_layer):
        add_screen(low, layer, 2 * layer, item, taps, lit, blended, path)
        add_screen(high, layer, 2 * layer + 1, item, taps, lit, blended, path)
    for packet in range(path.shape[1]):
        if lit[item, packet] == 1:
            for wave in range(turns_per_meter.shape[0]):
                cosine, sine = unit_circle(
                    path[item, packet] * turns_per_meter[wave] + optics[channel[wave], item, packet]
                )
                light = amplitude[wave, item, packet]
                for i in range(LANES):
                    field[wave, item, packet * LANES + i] = wp.vec2f(light[i] * cosine[i], light[i] * sine[i])


@wp.kernel
def add_squares(first: wp.int32, parts: wp.array(dtype=samples), squares: wp.array(dtype=samples)):
    """Add the squares of real and imaginary parts, side by side as a field holds them, to their sums over time."""
    item = first + wp.tid()
    squares[item] = squares[item] + wp.cw_mul(parts[item], parts[item])
