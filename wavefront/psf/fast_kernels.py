"""Kernels of the fast PSF engine: rays through the frozen layers onto a fine grid, and the filters in frequency."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...raytrace.kernels.kernel_pair import kernel_pair
from .packet_functions import every_second, squared_baseline, store_complex, tabulated_packet
from .sample_packets import LANES, indices, samples

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def nearest_sample(position: wp.float64, size: wp.int32):
    """Take a screen coordinate [pixels] modulo the screen and return the nearest sample."""
    # float64: a fraction of a pixel after a kilometre of wind would lose its digits in float32.
    shifted = position + wp.float64(0.5)
    wrapped = shifted - wp.float64(size) * wp.floor(shifted / wp.float64(size))
    return wp.int32(wrapped) % size


@wp.func
def unpack(counts: indices, unit: wp.float32):
    """Slopes along x and y [rad] from the lower and the upper 16 bits."""
    x = samples()
    y = samples()
    for i in range(LANES):
        x[i] = unit * wp.float32((counts[i] << 16) >> 16)
        y[i] = unit * wp.float32(counts[i] >> 16)
    return x, y


@wp.func
def single_channel(channel: wp.array3d(dtype=wp.int32), wave: wp.int32, t: wp.int32, packet: wp.int32):
    """Channel of a wavelength that has a single one."""
    return wave


@wp.func
def scheduled_channel(channel: wp.array3d(dtype=wp.int32), wave: wp.int32, t: wp.int32, packet: wp.int32):
    """Channel of a wavelength that the schedule gives to a packet."""
    return channel[wave, t, packet]


@kernel_pair
def deposit_rays(special: bool, module: wp.Module) -> wp.Kernel:
    """Return the kernel that deposits rays; the special one is that of wavelengths with several channels."""
    channel_of = scheduled_channel if special else single_channel

    @wp.kernel(module=module)
    def deposit_rays(
        first: wp.int32,
        screens: wp.array2d(dtype=wp.int32),
        unit: wp.array(dtype=wp.float32),
        screen_size: wp.int32,
        n_layer: wp.int32,
        n_time: wp.int32,
        start: wp.array3d(dtype=wp.float64),
        step: wp.array2d(dtype=wp.float64),
        moment: wp.array(dtype=wp.int32),
        channel: wp.array3d(dtype=wp.int32),
        lattice: wp.array(dtype=indices),
        reach: wp.int32,
        cells_per_slope: wp.array2d(dtype=wp.float32),
        displacement: wp.array4d(dtype=samples),
        weight: wp.array3d(dtype=samples),
        grid_size: wp.int32,
        slope: wp.array3d(dtype=samples),
        image: wp.array2d(dtype=wp.float32),
    ):
        """Deposit all rays of one star, at every wavelength, on its fine grid.

        The pupil points lie on the lattice of the screens, and the slopes are read at the nearest sample: that
        displaces a layer as a whole by part of a pixel, another at every time, and is lost in the mean over the
        exposure.

        Arguments: screens [layer, y * size + x]: packed slopes; unit [layer] of their counts [rad]; start [star, layer,
        2]: screen coordinates of the first lattice point at the first time [pixels]; step [layer, 2] [pixels per
        moment]; moment [time]; channel [wave, time, packet] of the rays; lattice [packet]: row * size + column of the
        pupil points [pixels]; reach: the largest row or column, plus one; cells_per_slope [star, 4]: Jacobian, row by
        row, over the cell of the grid; displacement [star, channel, packet, 2] by the optics [cells]; weight [star,
        wave, packet] of the light; slope [star, packet, 2]: room for the slopes of all layers [rad]; image [star,
        (channel * size + y) * size + x], with the origin in the cell size // 2.
        """
        star = first + wp.tid()
        n_packet = lattice.shape[0]
        n_wave = weight.shape[1]
        xx = cells_per_slope[star, 0]
        xy = cells_per_slope[star, 1]
        yx = cells_per_slope[star, 2]
        yy = cells_per_slope[star, 3]
        origin = wp.float32(grid_size // 2) + wp.float32(0.5)
        for t in range(n_time):
            for packet in range(n_packet):
                slope[star, packet, 0] = samples()
                slope[star, packet, 1] = samples()
            for layer in range(n_layer):
                time = wp.float64(moment[t])
                corner_x = nearest_sample(start[star, layer, 0] + time * step[layer, 0], screen_size)
                corner_y = nearest_sample(start[star, layer, 1] + time * step[layer, 1], screen_size)
                corner = corner_y * screen_size + corner_x
                counts = indices()
                # Two loops, each to its end: with a choice or a shared function inside, the compiler makes slower code.
                if corner_x + reach <= screen_size and corner_y + reach <= screen_size:
                    for packet in range(n_packet):
                        offset = lattice[packet]
                        for i in range(LANES):
                            counts[i] = screens[layer, corner + offset[i]]
                        slope_x, slope_y = unpack(counts, unit[layer])
                        slope[star, packet, 0] = slope[star, packet, 0] + slope_x
                        slope[star, packet, 1] = slope[star, packet, 1] + slope_y
                else:
                    for packet in range(n_packet):
                        offset = lattice[packet]
                        for i in range(LANES):
                            # Columns and rows are added apart: a column past the border must not run on into the next
                            # row.
                            x = (corner_x + offset[i] % screen_size) % screen_size
                            y = (corner_y + offset[i] // screen_size) % screen_size
                            counts[i] = screens[layer, y * screen_size + x]
                        slope_x, slope_y = unpack(counts, unit[layer])
                        slope[star, packet, 0] = slope[star, packet, 0] + slope_x
                        slope[star, packet, 1] = slope[star, packet, 1] + slope_y
            for packet in range(n_packet):
                angle_x = slope[star, packet, 0]
                angle_y = slope[star, packet, 1]
                moved_x = angle_x * xx + angle_y * xy
                moved_y = angle_x * yx + angle_y * yy
                for wave in range(n_wave):
                    light_channel = channel_of(channel, wave, t, packet)
                    cell_x = moved_x + displacement[star, light_channel, packet, 0]
                    cell_y = moved_y + displacement[star, light_channel, packet, 1]
                    light = weight[star, wave, packet]
                    for i in range(LANES):
                        # No branch, so that the lanes stay together; light beyond the grid is left out.
                        column = wp.int32(cell_x[i] + origin)
                        row = wp.int32(cell_y[i] + origin)
                        near_column = wp.clamp(column, 0, grid_size - 1)
                        near_row = wp.clamp(row, 0, grid_size - 1)
                        caught = wp.where(column == near_column and row == near_row, light[i], wp.float32(0.0))
                        cell = (light_channel * grid_size + near_row) * grid_size + near_column
                        image[star, cell] = image[star, cell] + caught

    return deposit_rays


@wp.kernel
def combine_wavelengths(
    first: wp.int32,
    spectra: wp.array4d(dtype=wp.float32),
    frequency: wp.float32,
    metric: wp.array2d(dtype=wp.float32),
    baseline: wp.array(dtype=wp.float32),
    table: wp.array2d(dtype=wp.float32),
    table_step: wp.float32,
    detector: wp.array2d(dtype=samples),
    ramp_x: wp.array4d(dtype=samples),
    ramp_y: wp.array3d(dtype=wp.vec2f),
    combined: wp.array3d(dtype=wp.float32),
):
    """Filter the transforms of one star's channels and add them up, one row of frequencies an item.

    Channels are the depths of each wavelength, as many of each. Columns of frequencies go in packets; the last one may
    read on into the next row, or up to a packet beyond the end of the spectra, and drops that.

    Arguments: spectra [star, channel, ky, 2 kx]: real and imaginary parts side by side; frequency: step of the
    frequencies [rad/m]; metric [star, 3]: xx, xy, yy of jacobian @ jacobian.T [m^2/rad^2]; baseline [wave]: wavelength
    / 2 pi [m]; table [wave, sample]: filter against the baseline in the pupil, at steps of table_step [m]; detector
    [ky, packet]: real filter of all channels; ramp_x [star, channel, 2, packet]: real and imaginary parts of phase
    factors and weights, and ramp_y [star, channel, ky]; combined [star, ky, 2 kx]: the sum.
    """
    item = first + wp.tid()
    n_row = spectra.shape[2]
    n_column = combined.shape[2] // 2
    n_depth = spectra.shape[1] // table.shape[0]
    star = item // n_row
    row = item % n_row
    ky = wp.float32(wp.where(2 * row > n_row, row - n_row, row)) * frequency
    last = wp.float32(table.shape[1]) - wp.float32(1.001)
    for packet in range(detector.shape[1]):
        start = packet * LANES
        separation = samples()
        for i in range(LANES):
            kx = wp.float32(start + i) * frequency
            separation[i] = wp.sqrt(squared_baseline(metric, star, kx, ky)) / table_step
        total_re = samples()
        total_im = samples()
        for wave in range(table.shape[0]):
            value = tabulated_packet(table[wave], last, separation * baseline[wave])
            for light_channel in range(wave * n_depth, (wave + 1) * n_depth):
                px = ramp_x[star, light_channel, 0, packet]
                py = ramp_x[star, light_channel, 1, packet]
                along = ramp_y[star, light_channel, row]
                line = spectra[star, light_channel, row]
                re = every_second(line, 2 * start)
                im = every_second(line, 2 * start + 1)
                factor_re = px * along[0] - py * along[1]
                factor_im = px * along[1] + py * along[0]
                total_re = total_re + wp.cw_mul(wp.cw_mul(re, factor_re) - wp.cw_mul(im, factor_im), value)
                total_im = total_im + wp.cw_mul(wp.cw_mul(re, factor_im) + wp.cw_mul(im, factor_re), value)
        total_re = wp.cw_mul(total_re, detector[row, packet])
        total_im = wp.cw_mul(total_im, detector[row, packet])
        store_complex(combined[star, row], 2 * start, n_column - start, total_re, total_im)
