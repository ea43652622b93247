"""Kernels of the long-exposure engine: points over the clear pupil of each star, their transform, and the pixels."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .clear_pupil import MOST_RINGS
from .packet_functions import squared_baseline, tabulated_packet, unit_circle
from .sample_packets import LANES, samples
from .spoke_sums import add_inner_points, add_rims, lay_waves

wp.set_module_options(FORWARD_OPTIONS)

# Packets of eight rings.
MOST_PACKETS = -(-MOST_RINGS // 8)

# In C with vectors of the compiler, over the polynomials of the rings.
_SPOKE_LOOP = f"""
    const int n_ring = radius.shape[0], n_wave = displacement.shape[0];
    typedef double packet __attribute__((vector_size(64), aligned(8)));
    typedef long long lanes __attribute__((vector_size(64), aligned(8)));
    const int n_packet = (n_ring + 7) / 8;
    packet scale[{MOST_PACKETS}], values[{MOST_PACKETS}], slopes[{MOST_PACKETS}];
    lanes number = {{0, 1, 2, 3, 4, 5, 6, 7}};
    for (int p = 0; p < n_packet; ++p)
        for (int i = 0; i < 8; ++i) {{
            const int k = 8 * p + i;
            double product = k < n_ring ? landed.data[k * n_spoke + spoke] : 0.0;
            for (int ring = 0; ring < n_ring; ++ring)
                if (product != 0.0 && ring != k && landed.data[ring * n_spoke + spoke] > 0.0)
                    product *= inverse.data[k * n_ring + ring];
            scale[p][i] = product;
        }}
    for (int ring = 0; ring < n_ring; ++ring) {{
        const double at = __builtin_sqrt(start + span * fraction.data[ring]);
        for (int p = 0; p < n_packet; ++p) {{
            packet value = scale[p], slope = {{}};
            for (int other = 0; other < n_ring; ++other)
                if (landed.data[other * n_spoke + spoke] > 0.0) {{
                    const lanes apart = number + 8 * p != other;
                    const double distance = at - radius.data[other];
                    slope = apart ? slope * distance + value : slope;
                    value = apart ? value * distance : value;
                }}
            values[p] = value;
            slopes[p] = slope;
        }}
        for (int wave = 0; wave < n_wave; ++wave) {{
            const float* rays = displacement.data + 2 * (wave * displacement.shape[1] + spoke);
            double x = 0.0, y = 0.0, slope_x = 0.0, slope_y = 0.0;
            for (int k = 0; k < n_ring; ++k, rays += 2 * n_spoke)
                if (landed.data[k * n_spoke + spoke] > 0.0) {{
                    x += values[k / 8][k % 8] * rays[0];
                    y += values[k / 8][k % 8] * rays[1];
                    slope_x += slopes[k / 8][k % 8] * rays[0];
                    slope_y += slopes[k / 8][k % 8] * rays[1];
                }}
            landings.data[ring * n_wave + wave] = wp::vec_t<4, wp::float64>(x, y, slope_x, slope_y);
        }}
    }}
"""


@wp.func_native(_SPOKE_LOOP)
def interpolate_spoke(
    radius: wp.array(dtype=wp.float64),
    inverse: wp.array2d(dtype=wp.float64),
    fraction: wp.array(dtype=wp.float64),
    start: wp.float64,
    span: wp.float64,
    n_spoke: wp.int32,
    spoke: wp.int32,
    landed: wp.array(dtype=wp.float64),
    displacement: wp.array3d(dtype=wp.float32),
    landings: wp.array2d(dtype=wp.vec4d),
):
    """Interpolate landing points between the rings of one spoke by the polynomial through those that landed.

    Arguments, beside those of ``place_points`` of one star: squares of the radii at the inner end, start [m^2], and
    span from there to the outer one; landings [ring, wave]: x, y [m] and their slopes along the spoke at each point.
    """
    ...


@wp.func
def rim_vector(
    edges: wp.array3d(dtype=wp.float64), unit: wp.array(dtype=wp.vec2d), star: wp.int32, spoke: wp.int32, end: wp.int32
):
    """Piece of the inner (0) or outer (1) rim that belongs to a spoke, as a vector along it [m]."""
    n_spoke = unit.shape[0]
    ahead = (spoke + 1) % n_spoke
    behind = (spoke + n_spoke - 1) % n_spoke
    angle = wp.float64(wp.TAU) / wp.float64(n_spoke)
    # The chord over two spokes is half as long as the two arcs of a circle that belong to one, but for this factor.
    scale = wp.float64(0.5) * angle / wp.sin(angle)
    return scale * (edges[star, ahead, end] * unit[ahead] - edges[star, behind, end] * unit[behind])


@wp.kernel
def place_points(
    first: wp.int32,
    radius: wp.array(dtype=wp.float64),
    inverse: wp.array2d(dtype=wp.float64),
    fraction: wp.array(dtype=wp.float64),
    quadrature: wp.array(dtype=wp.float64),
    unit: wp.array(dtype=wp.vec2d),
    edges: wp.array3d(dtype=wp.float64),
    displacement: wp.array4d(dtype=wp.float32),
    landed: wp.array2d(dtype=wp.float64),
    jacobian: wp.array(dtype=wp.mat22d),
    cosines: wp.array(dtype=wp.vec2d),
    dispersion: wp.array(dtype=wp.vec2d),
    shift: wp.array2d(dtype=wp.float64),
    mean_shift: wp.array(dtype=wp.float64),
    period: wp.float64,
    area: wp.array(dtype=wp.float64),
    landings: wp.array4d(dtype=wp.vec4d),
    place: wp.array4d(dtype=wp.float32),
    light: wp.array2d(dtype=wp.float32),
    cut: wp.array3d(dtype=wp.float32),
    lean: wp.array4d(dtype=wp.float32),
):
    """Lay the points of one spoke over the clear pupil of one star, and find the strips cut off its ends.

    Arguments: radius [ring] of the traced points [m]; inverse [ring, ring] of the differences of radii [1/m]; fraction
    [ring] of the clear area of the spoke within a point; quadrature [ring]: weights, of sum 1; unit [spoke]: direction;
    edges [star, spoke, 2] [m]; displacement [star, wave, ring * n_spoke + spoke, 2] of the traced points [m]; landed
    [star, ring * n_spoke + spoke]: 1, or 0 for a ray that was lost; jacobian [star] [m/rad]; cosines [star] of the
    chief ray along the detector; dispersion [wave] [rad]; shift [wave, depth]: path in silicon over its index, and its
    mean_shift [wave] [m]; period of the images [m]; area [star]: the clear pupil [m^2]; landings [star, spoke, ring,
    wave]: room for what ``interpolate_spoke`` finds. Results, with points in the
    order of the traced ones and rims as [2, n_spoke]: place [star, wave * n_depth + depth, 2, point] [periods]; light
    [star, point]: part of the pupil; cut [star, rim, 3]: part of the pupil per metre of wavelength and step of
    frequency, along x and y, and that of both strips of the spoke, at most, over its light; lean [star, wave, rim, 2]:
    phase half-way through the part cut off, against the rim, over that part, per step of frequency [rad].
    """
    item = first + wp.tid()
    n_spoke = unit.shape[0]
    n_ring = radius.shape[0]
    star = item // n_spoke
    spoke = item % n_spoke
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    tau = wp.float64(wp.TAU)
    angle = tau / wp.float64(n_spoke)
    start = edges[star, spoke, 0] * edges[star, spoke, 0]
    span = edges[star, spoke, 1] * edges[star, spoke, 1] - start
    landed_rays = zero
    for ring in range(n_ring):
        landed_rays = landed_rays + landed[star, ring * n_spoke + spoke]
    clear = span > zero and landed_rays > zero
    # Direction cosines of the light at the image change along the spoke by this per metre.
    turn = -wp.transpose(wp.inverse(jacobian[star])) * unit[spoke]
    spoke_light = half * span * angle / area[star]
    swept = zero
    interpolate_spoke(
        radius,
        inverse,
        fraction,
        start,
        span,
        n_spoke,
        spoke,
        landed[star],
        displacement[star],
        landings[star, spoke],
    )
    for ring in range(n_ring):
        point = ring * n_spoke + spoke
        light[star, point] = wp.float32(0.0)
        if clear:
            light[star, point] = wp.float32(spoke_light * quadrature[ring])
        at = wp.sqrt(start + span * fraction[ring])
        end = wp.where(ring == 0, 0, 1)
        rim = end * n_spoke + spoke
        outermost = ring == 0 or ring == n_ring - 1
        # b x t / 2 is the area that half a baseline b sweeps over a piece t of the rim.
        across = wp.vec2d(zero, zero)
        depth = zero
        if outermost and clear:
            along = rim_vector(edges, unit, star, spoke, end)
            j = jacobian[star]
            across = wp.vec2d(j[0, 0] * along[1] - j[0, 1] * along[0], j[1, 0] * along[1] - j[1, 1] * along[0])
            across = across * (half / (period * area[star]))
            if at > zero:
                depth = wp.where(end == 0, -half, half) * area[star] / (at * angle)
        steepness = cosines[star] + at * turn
        for wave in range(displacement.shape[1]):
            ray = landings[star, spoke, ring, wave]
            landing = jacobian[star] * dispersion[wave] + wp.vec2d(ray[0], ray[1])
            for d in range(shift.shape[1]):
                deep = landing + shift[wave, d] * steepness
                light_channel = wave * shift.shape[1] + d
                place[star, light_channel, 0, point] = wp.float32(deep[0] / period)
                place[star, light_channel, 1, point] = wp.float32(deep[1] / period)
            if outermost:
                slope = wp.vec2d(ray[2], ray[3]) + mean_shift[wave] * turn
                lean[star, wave, rim, 0] = wp.float32(depth * tau / period * slope[0])
                lean[star, wave, rim, 1] = wp.float32(depth * tau / period * slope[1])
        if outermost:
            cut[star, rim, 0] = wp.float32(across[0])
            cut[star, rim, 1] = wp.float32(across[1])
            swept = swept + wp.length(across)
    for end in range(2):
        cut[star, end * n_spoke + spoke, 2] = wp.float32(wp.where(clear, swept / spoke_light, zero))


@wp.func
def lane_numbers(packet: wp.int32):
    """Numbers of the lanes of a packet, counted over all packets."""
    number = samples()
    for i in range(LANES):
        number[i] = wp.float32(packet * LANES + i)
    return number


@wp.func
def filtered(
    table: wp.array2d(dtype=wp.float32),
    wave: wp.int32,
    per_step: wp.float32,
    metric: wp.array2d(dtype=wp.float32),
    star: wp.int32,
    column: samples,
    row: wp.float32,
):
    """Value of the filter of a wavelength at the baselines of a row of frequencies, by linear interpolation."""
    place = samples()
    for i in range(LANES):
        place[i] = wp.sqrt(squared_baseline(metric, star, column[i], row)) * per_step
    return tabulated_packet(table[wave], wp.float32(table.shape[1]) - wp.float32(1.001), place)


@wp.kernel
def transform_pupils(
    first: wp.int32,
    n_spoke: wp.int32,
    n_depth: wp.int32,
    place: wp.array4d(dtype=wp.float32),
    light: wp.array2d(dtype=wp.float32),
    cut: wp.array3d(dtype=wp.float32),
    lean: wp.array4d(dtype=wp.float32),
    fade_x: wp.array2d(dtype=samples),
    fade_y: wp.array2d(dtype=samples),
    wavelength: wp.array(dtype=wp.float32),
    rows: wp.array(dtype=wp.int32),
    metric: wp.array2d(dtype=wp.float32),
    table: wp.array2d(dtype=wp.float32),
    per_step: wp.array(dtype=wp.float32),
    photons: wp.array2d(dtype=wp.float32),
    along_x: wp.array4d(dtype=samples),
    along_y: wp.array4d(dtype=samples),
    rims: wp.array3d(dtype=wp.float32),
    meeting: wp.array2d(dtype=wp.int32),
    sums: wp.array2d(dtype=samples),
    spectrum: wp.array4d(dtype=samples),
):
    """Add up the transfer functions of one star's wavelengths, over columns m and rows +n and -n of frequencies.

    A wavelength has ``n_depth`` channels, with the light of the same points at other places.

    Arguments: place, light, cut, lean as ``place_points`` leaves them; fade_x, fade_y [channel, packet]: filters along
    x, with their weights, and along y; wavelength [wave] [m]; rows [packet of columns]: their number; metric [star, 3]:
    xx, xy, yy of jacobian @ jacobian.T; table [wave, sample]: filter against the baseline; per_step [wave]: samples of
    the table per step of frequency, for a unit Jacobian; photons [star, wave], of mean 1; along_x and
    along_y [star, packet, depth * n_point + point, 2]: room for cosines and sines of columns and rows; rims, meeting
    and sums [star, ...]: room for those of ``add_rims``; spectrum [star, 4, row, packet]: real and imaginary parts at
    +n, and at -n.
    """
    star = first + wp.tid()
    n_wave = wavelength.shape[0]
    n_point = place.shape[3]
    n_packet = rows.shape[0]
    inner_end = n_spoke
    outer_start = n_point - n_spoke
    # One over the part of a spoke's light in its outermost points, of Lobatto's rule.
    n_ring = n_point // n_spoke
    n_sample = n_depth * n_point
    whole_spoke = wp.float32(n_ring * (n_ring - 1))
    for packet in range(n_packet):
        for row in range(rows[packet]):
            for component in range(4):
                spectrum[star, component, row, packet] = samples()
    for wave in range(n_wave):
        # Dark is the middle one of spectral rules.
        if photons[star, wave] == wp.float32(0.0):
            continue
        for depth in range(n_depth):
            light_channel = wave * n_depth + depth
            for point in range(n_point):
                x = place[star, light_channel, 0, point]
                y = place[star, light_channel, 1, point]
                scale = light[star, point]
                if point < inner_end or point >= outer_start:
                    scale = wp.float32(1.0)
                sample = depth * n_point + point
                cosine, sine = unit_circle(-x * lane_numbers(0))
                lay_waves(cosine, sine, scale, fade_x[light_channel], sample, n_sample, n_packet, along_x[star])
                cosine, sine = unit_circle(-y * lane_numbers(0))
                full = wp.float32(1.0)
                lay_waves(cosine, sine, full, fade_y[light_channel], sample, n_sample, n_packet, along_y[star])
        for rim in range(2 * n_spoke):
            point = rim
            if rim >= n_spoke:
                point = rim + outer_start - n_spoke
            rims[star, rim, 0] = wavelength[wave] * cut[star, rim, 0]
            rims[star, rim, 1] = wavelength[wave] * cut[star, rim, 1]
            rims[star, rim, 2] = lean[star, wave, rim, 0]
            rims[star, rim, 3] = lean[star, wave, rim, 1]
            rims[star, rim, 4] = light[star, point]
            meeting[star, rim] = wp.where(
                wavelength[wave] * cut[star, rim, 2] * wp.float32(rows[0]) > wp.float32(1.0), 1, 0
            )
        for packet in range(n_packet):
            number = lane_numbers(packet)
            for row in range(rows[packet]):
                ky = wp.float32(row)
                columns = along_x[star, packet]
                lines = along_y[star, row // LANES]
                total = sums[star]
                add_inner_points(columns, lines, row, n_point, n_spoke, n_depth, total)
                add_rims(
                    columns,
                    lines,
                    rims[star],
                    meeting[star],
                    packet * LANES,
                    row,
                    whole_spoke,
                    n_point,
                    n_spoke,
                    n_depth,
                    total,
                )
                value = photons[star, wave] * filtered(table, wave, per_step[wave], metric, star, number, ky)
                spectrum[star, 0, row, packet] = spectrum[star, 0, row, packet] + wp.cw_mul(value, sums[star, 0])
                spectrum[star, 1, row, packet] = spectrum[star, 1, row, packet] + wp.cw_mul(value, sums[star, 1])
                value = photons[star, wave] * filtered(table, wave, per_step[wave], metric, star, number, -ky)
                spectrum[star, 2, row, packet] = spectrum[star, 2, row, packet] + wp.cw_mul(value, sums[star, 2])
                spectrum[star, 3, row, packet] = spectrum[star, 3, row, packet] + wp.cw_mul(value, sums[star, 3])


# In C with vectors of the compiler. Rows of pixels at y and -y have the same cosines along y and opposite sines.
_PIXEL_LOOP = f"""
    #pragma clang fp contract(fast)
    typedef float packet __attribute__((vector_size({4 * LANES}), aligned(4)));
    const int n_packet = rows.shape[0], n_row = pixel_rows.shape[1], size = pixel_rows.shape[0];
    const int n_column = pixel_columns.shape[1], across = pixel_columns.shape[2];
    const packet* wave = (const packet*)waves.data;
    const packet* turn_x = (const packet*)pixel_columns.data;
    packet* line = (packet*)lines.data;
    packet* pixel = (packet*)image.data;
    // The middle pixel of an even number has one more below than above.
    const int middle = size / 2;
    for (int y = 0; y <= middle; ++y) {{
        const int opposite = 2 * middle - y;
        const float* turn_y = (const float*)pixel_rows.data + 2 * y * n_row;
        for (int column = 0; column < n_packet; ++column) {{
            packet even_re = {{}}, odd_re = {{}}, even_im = {{}}, odd_im = {{}};
            for (int row = 0; row < rows.data[column]; ++row) {{
                const packet* at = wave + row * n_packet + column;
                even_re += turn_y[2 * row] * at[0];
                even_im += turn_y[2 * row] * at[n_row * n_packet];
                odd_re += turn_y[2 * row + 1] * at[2 * n_row * n_packet];
                odd_im += turn_y[2 * row + 1] * at[3 * n_row * n_packet];
            }}
            line[4 * column] = even_re + odd_re;
            line[4 * column + 1] = even_im + odd_im;
            line[4 * column + 2] = even_re - odd_re;
            line[4 * column + 3] = even_im - odd_im;
        }}
        for (int x = 0; x < across; ++x) {{
            packet total = {{}}, total_opposite = {{}};
            for (int column = 0; column < n_column; ++column) {{
                const float* value = lines.data + 4 * {LANES} * (column / {LANES}) + column % {LANES};
                const packet cosine = turn_x[column * across + x];
                const packet sine = turn_x[(n_column + column) * across + x];
                total += value[0] * cosine - value[{LANES}] * sine;
                total_opposite += value[{2 * LANES}] * cosine - value[{3 * LANES}] * sine;
            }}
            pixel[y * across + x] = total;
            if (opposite < size)
                pixel[opposite * across + x] = total_opposite;
        }}
    }}
"""


@wp.func_native(_PIXEL_LOOP)
def add_rows(
    waves: wp.array3d(dtype=samples),
    rows: wp.array(dtype=wp.int32),
    pixel_rows: wp.array2d(dtype=wp.vec2f),
    pixel_columns: wp.array3d(dtype=samples),
    lines: wp.array(dtype=wp.float32),
    image: wp.array2d(dtype=samples),
):
    """Add up the waves of one star at all pixels, with the arguments of ``sample_pixels``, contiguous, of that star."""
    ...


@wp.kernel
def sample_pixels(
    first: wp.int32,
    spectrum: wp.array4d(dtype=samples),
    detector: wp.array3d(dtype=samples),
    rows: wp.array(dtype=wp.int32),
    offset: wp.array2d(dtype=wp.float32),
    pixel_rows: wp.array2d(dtype=wp.vec2f),
    pixel_columns: wp.array3d(dtype=samples),
    waves: wp.array4d(dtype=samples),
    lines: wp.array2d(dtype=wp.float32),
    image: wp.array3d(dtype=samples),
):
    """Sample the image of one star at the centres of its pixels.

    Arguments: spectrum as ``transform_pupils`` leaves it; detector [2, row, packet]: its transfer function at +n and
    -n, with the scale of the sum, columns m > 0 twice and row 0 half; offset [star, 2] of the image [periods];
    pixel_rows [y, row]: cosine and sine, evenly about the middle one; pixel_columns [2, column, packet
    of x]: cosines and sines; waves [star, 4, row, packet]: room for what goes with the cosine along y, and with the
    sine; lines [star, ...]: room for two lines of pixels, transformed along y; image [star, y, packet of x].
    """
    star = first + wp.tid()
    n_packet = rows.shape[0]
    for packet in range(n_packet):
        cosine, sine = unit_circle(-offset[star, 0] * lane_numbers(packet))
        for row in range(rows[packet]):
            turn = wp.float32(wp.TAU) * offset[star, 1] * wp.float32(row)
            cosine_y = wp.cos(turn)
            sine_y = -wp.sin(turn)
            plus = detector[0, row, packet]
            minus = detector[1, row, packet]
            re = wp.cw_mul(plus, cosine_y * cosine - sine_y * sine)
            im = wp.cw_mul(plus, cosine_y * sine + sine_y * cosine)
            a = spectrum[star, 0, row, packet]
            b = spectrum[star, 1, row, packet]
            re_plus = wp.cw_mul(a, re) - wp.cw_mul(b, im)
            im_plus = wp.cw_mul(a, im) + wp.cw_mul(b, re)
            re = wp.cw_mul(minus, cosine_y * cosine + sine_y * sine)
            im = wp.cw_mul(minus, cosine_y * sine - sine_y * cosine)
            a = spectrum[star, 2, row, packet]
            b = spectrum[star, 3, row, packet]
            re_minus = wp.cw_mul(a, re) - wp.cw_mul(b, im)
            im_minus = wp.cw_mul(a, im) + wp.cw_mul(b, re)
            waves[star, 0, row, packet] = re_plus + re_minus
            waves[star, 1, row, packet] = im_plus + im_minus
            waves[star, 2, row, packet] = im_minus - im_plus
            waves[star, 3, row, packet] = re_plus - re_minus
    add_rows(waves[star], rows, pixel_rows, pixel_columns, lines[star], image[star])
