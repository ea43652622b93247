"""Kernels of random fields over the field of view: covariances on their grid, and transforms of the mean wavefront."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)

#: Covariances of the components of the moments.
pairs = wp.types.vector(6, wp.float32)
#: Zernikes of the mean wavefront.
TERMS = 12
zernikes = wp.types.vector(TERMS, wp.float32)
#: Cosines and sines of multiples of an angle, from 0 to 4 times it.
turned = wp.types.vector(10, wp.float32)


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


@wp.func
def at_lag(x: wp.float32, y: wp.float32, polar: wp.array2d(dtype=pairs), step: wp.float32):
    """Covariances at a lag between rings and spokes [ring, spoke], see :func:`spread_over_grid`."""
    n_ring = polar.shape[0]
    n_spoke = polar.shape[1]
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
    return value


@wp.func
def cell_mean(turns: wp.float32):
    """Factor of a covariance at a lag, in sides of a grid, by the mean of its spectrum over a cell of frequencies."""
    phase = wp.float32(wp.PI) * turns
    return wp.where(wp.abs(turns) < wp.float32(1e-4), wp.float32(1.0), wp.sin(phase) / phase)


@wp.func
def with_images(x: wp.float32, y: wp.float32, side: wp.float32, polar: wp.array2d(dtype=pairs), step: wp.float32):
    """Covariances at a lag of a process that repeats with a side: means of its spectrum over cells of frequencies.

    Of the images of the lag those beyond one side and a half are left out.
    """
    value = pairs()
    for i in range(3):
        for j in range(3):
            along = x + wp.float32(i - 1) * side
            across = y + wp.float32(j - 1) * side
            value = value + cell_mean(along / side) * cell_mean(across / side) * at_lag(along, across, polar, step)
    return value


@wp.kernel
def spread_over_grid(
    first: wp.int32,
    polar: wp.array2d(dtype=pairs),
    per_spacing: wp.float32,
    step: wp.float32,
    images: wp.bool,
    grid: wp.array3d(dtype=wp.float32),
):
    """Interpolate covariances from rings and spokes of lags to one row of a periodic grid.

    Arguments: polar [ring, spoke]: rings at exp(step k) - 1 in units of the first scale, spokes evenly over half a
    turn, after which the covariances are the same; per_spacing: spacing of the grid in that unit; images: whether lags
    beyond the grid count, see :func:`with_images`; grid [pair, row, column] of rows 0 to n/2, to whose opposites the
    others are equal.
    """
    row = first + wp.tid()
    size = grid.shape[2]
    y = per_spacing * wp.float32(row)
    for column in range(size):
        signed = wp.where(column > size / 2, column - size, column)
        x = per_spacing * wp.float32(signed)
        value = pairs()
        if images:  # noqa: SIM108 - a conditional expression of Warp computes both
            value = with_images(x, y, per_spacing * wp.float32(size), polar, step)
        else:
            value = at_lag(x, y, polar, step)
        for pair in range(6):
            grid[pair, row, column] = value[pair]


@wp.kernel
def read_lags(
    first: wp.int32,
    lags: wp.array(dtype=wp.vec2f),
    polar: wp.array2d(dtype=pairs),
    step: wp.float32,
    values: wp.array2d(dtype=wp.float32),
):
    """Interpolate covariances from rings and spokes to lags in their unit; values [pair, lag]."""
    n = first + wp.tid()
    lag = lags[n]
    value = at_lag(lag[0], lag[1], polar, step)
    for pair in range(6):
        values[pair, n] = value[pair]


@wp.func
def root(values: wp.float32):
    """Square root, zero of what is negative."""
    return wp.sqrt(wp.max(values, wp.float32(0.0)))


@wp.func
def bounded_quotient(value: wp.float32, divisor: wp.float32, bound: wp.float32):
    """Quotient within a bound of either sign; zero where the divisor is."""
    quotient = wp.float32(0.0)
    if divisor > wp.float32(0.0):
        quotient = wp.clamp(value / divisor, -bound, bound)
    return quotient


@wp.kernel
def factor_spectra(
    first: wp.int32,
    gain: wp.array(dtype=wp.float32),
    spectra: wp.array3d(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.float64),
):
    """Replace spectra in one row of frequencies by their lower Cholesky factors; negative remainders count as zero.

    Arguments: gain [row]: of splines along either axis; spectra [pair, row, column]: pp, qq, ss, pq, ps, qs, and the
    factors p, q by p, q, s by p, s by q, s; sums [row, 2]: of the variances, and of those that the factors have without
    the gain, at frequencies of both signs.
    """
    row = first + wp.tid()
    last = spectra.shape[2] - 1
    wanted = wp.float64(0.0)
    drawn = wp.float64(0.0)
    for column in range(spectra.shape[2]):
        pp = spectra[0, row, column]
        qq = spectra[1, row, column]
        ss = spectra[2, row, column]
        of_p = root(pp)
        q_by_p = bounded_quotient(spectra[3, row, column], of_p, root(qq))
        s_by_p = bounded_quotient(spectra[4, row, column], of_p, root(ss))
        of_q = root(qq - q_by_p * q_by_p)
        remainder = ss - s_by_p * s_by_p
        s_by_q = bounded_quotient(spectra[5, row, column] - q_by_p * s_by_p, of_q, root(remainder))
        of_s = root(remainder - s_by_q * s_by_q)
        signs = wp.where(column == 0 or column == last, wp.float64(1.0), wp.float64(2.0))
        squares = of_p * of_p + q_by_p * q_by_p + of_q * of_q + s_by_p * s_by_p + s_by_q * s_by_q + of_s * of_s
        wanted = wanted + signs * wp.float64(pp + qq + ss)
        drawn = drawn + signs * wp.float64(squares)
        scale = gain[row] * gain[column]
        spectra[0, row, column] = scale * of_p
        spectra[1, row, column] = scale * q_by_p
        spectra[2, row, column] = scale * of_q
        spectra[3, row, column] = scale * s_by_p
        spectra[4, row, column] = scale * s_by_q
        spectra[5, row, column] = scale * of_s
    sums[row, 0] = wanted
    sums[row, 1] = drawn


@wp.func
def multiple_angles(direction: wp.vec2f):
    """Cosine and sine of multiples of the angle of a unit vector: of 0 to 4 times it."""
    cosine = direction[0]
    sine = direction[1]
    cosine_two = cosine * cosine - sine * sine
    sine_two = wp.float32(2.0) * sine * cosine
    return turned(
        wp.float32(1.0),
        wp.float32(0.0),
        cosine,
        sine,
        cosine_two,
        sine_two,
        cosine_two * cosine - sine_two * sine,
        sine_two * cosine + cosine_two * sine,
        cosine_two * cosine_two - sine_two * sine_two,
        wp.float32(2.0) * sine_two * cosine_two,
    )


@wp.kernel
def add_wavefronts(
    first: wp.int32,
    noise: wp.array(dtype=wp.vec2f),
    start: wp.array(dtype=wp.int32),
    reach: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float32),
    drift: wp.array2d(dtype=wp.float32),
    strength: wp.array(dtype=zernikes),
    frequency_step: wp.float32,
    radial: wp.array(dtype=zernikes),
    per_frequency: wp.float32,
    order: wp.array(dtype=wp.int32),
    gain: wp.array(dtype=wp.float32),
    unit: wp.float32,
    spectrum: wp.array3d(dtype=wp.vec2f),
):
    """Sum over layers the transforms of Zernikes of the mean wavefront, for one row of frequencies of the field.

    Arguments: noise: transforms of white noise, from start [layer] on those of a layer, rows -reach to reach and
    columns 0 to reach [layer]; distance [layer] along the line of sight [m]; drift [layer, 2] in the exposure [m];
    strength [layer]: amplitudes of a mode but for the power of its frequency; frequency_step of the field [cycles/rad];
    radial [k]: mean over the pupil of a term's radial part times a wave, with the root of the power of the frequency,
    against the frequency, whose table has per_frequency steps a cycle/m; order [term] m of the Zernikes, -4 to 4,
    negative for sines; gain [row] of splines along either axis; unit of the strength in that of the results; spectrum
    [term, row, column].
    """
    row = first + wp.tid()
    size = spectrum.shape[1]
    last = wp.float32(radial.shape[0] - 2)
    signed = wp.where(row > size / 2, row - size, row)
    for column in range(spectrum.shape[2]):
        re = zernikes()
        im = zernikes()
        if row > 0 or column > 0:
            across = frequency_step * wp.float32(column)
            up = frequency_step * wp.float32(signed)
            length = wp.sqrt(across * across + up * up)
            for layer in range(distance.shape[0]):
                at = length / distance[layer] * per_frequency
                bound = reach[layer]
                if at < last and column * column + signed * signed <= bound * bound:
                    nu_x = across / distance[layer]
                    nu_y = up / distance[layer]
                    turns = wp.float32(wp.PI) * (nu_x * drift[layer, 0] + nu_y * drift[layer, 1])
                    smear = wp.float32(1.0)
                    if wp.abs(turns) > wp.float32(1e-3):
                        smear = wp.sin(turns) / turns
                    mode = smear * noise[start[layer] + (signed + bound) * (bound + 1) + column]
                    knot = wp.int32(at)
                    transform = radial[knot] + (at - wp.float32(knot)) * (radial[knot + 1] - radial[knot])
                    transform = wp.cw_mul(strength[layer], transform)
                    re = re + mode[0] * transform
                    im = im + mode[1] * transform
            angles = multiple_angles(wp.vec2f(across / length, up / length))
            scale = unit * gain[row] * gain[column]
            for term in range(TERMS):
                around = scale * angles[2 * wp.abs(order[term]) + wp.where(order[term] < 0, 1, 0)]
                re[term] = around * re[term]
                im[term] = around * im[term]
        for term in range(TERMS):
            value = wp.vec2f(re[term], im[term])
            # A layer's place runs against the field: the conjugate of i^m.
            turn = wp.abs(order[term]) % 4
            if turn == 1:
                value = wp.vec2f(value[1], -value[0])
            elif turn == 2:
                value = -value
            elif turn == 3:
                value = wp.vec2f(-value[1], value[0])
            spectrum[term, row, column] = value


@wp.func
def spline_weight(number: wp.int32, part: wp.float64):
    """Weight of one of the four coefficients around a place between the second and the third, of a cubic B-spline."""
    one = wp.float64(1.0)
    three = wp.float64(3.0)
    four = wp.float64(4.0)
    six = wp.float64(6.0)
    rest = one - part
    weight = rest * rest * rest
    if number == 1:
        weight = four + part * part * (three * part - six)
    elif number == 2:
        weight = four + rest * rest * (three * rest - six)
    elif number == 3:
        weight = part * part * part
    return weight / six


# In C: each value is a sum over 16 coefficients, and stays in a register. Each operation is a statement, so that none
# is contracted.
@wp.func_native("""
    const int n_field = coefficients.shape[0], size = coefficients.shape[1];
    const float* field = coefficients.data;
    for (int f = 0; f < n_field; ++f, field += (long long)size * size) {
        double total = 0.0;
        for (int j = 0; j < 4; ++j) {
            const float* row = field + (long long)((((knot_y + j - 1) % size) + size) % size) * size;
            for (int i = 0; i < 4; ++i) {
                const double weight = along_y.c[j] * along_x.c[i];
                const double part = weight * (double)row[columns.c[i]];
                total = total + part;
            }
        }
        values.data[f] = total;
    }
""")
def add_coefficients(
    coefficients: wp.array3d(dtype=wp.float32),
    knot_y: wp.int32,
    columns: wp.vec4i,
    along_x: wp.vec4d,
    along_y: wp.vec4d,
    values: wp.array(dtype=wp.float64),
):
    """Add up the 16 coefficients [field, row, column] around a place, with their weights, for all fields."""
    ...


@wp.kernel
def read_splines(
    first: wp.int32,
    place: wp.array2d(dtype=wp.float64),
    coefficients: wp.array3d(dtype=wp.float32),
    values: wp.array2d(dtype=wp.float64),
):
    """Read periodic fields of cubic B-splines at one place.

    Arguments: place [place, 2]: x and y in samples; coefficients [field, row, column]; values [place, field].
    """
    item = first + wp.tid()
    size = coefficients.shape[1]
    knot_x = wp.int32(wp.floor(place[item, 0]))
    knot_y = wp.int32(wp.floor(place[item, 1]))
    part_x = place[item, 0] - wp.float64(knot_x)
    part_y = place[item, 1] - wp.float64(knot_y)
    columns = wp.vec4i()
    along_x = wp.vec4d()
    along_y = wp.vec4d()
    for i in range(4):
        columns[i] = (((knot_x + i - 1) % size) + size) % size
        along_x[i] = spline_weight(i, part_x)
        along_y[i] = spline_weight(i, part_y)
    add_coefficients(coefficients, knot_y, columns, along_x, along_y, values[item])
