"""Kernels of :mod:`.pixel_sums`: columns, most often pixels, in packets."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from ...core.row_sum_kernels import LANES, columns

wp.set_module_options(FORWARD_OPTIONS)

# Axes whose variances are multiplied before a division: each is at most 4^12 times 300 stars, so that the product stays
# below 1e100.
_TOGETHER = 10
# Least power of a pixel.
_LEAST_POWER = 1e-150
# Columns whose sums stay in the processor's registers together.
_COLUMNS = 8
#: Mantissa and exponent of the product of powers, and those of the product of variances.
products = wp.types.vector(4, wp.float64)

# The logarithm of a product of thousands of numbers is that of the product of their mantissas, from 1 to 2, and their
# exponents: 300 stars have 30 products of each of 32 columns, whose mantissas stay below 2^960.
_ADD = f"""
    typedef double part __attribute__((vector_size({8 * _COLUMNS}), aligned(8)));
    typedef long long whole __attribute__((vector_size({8 * _COLUMNS}), aligned(8)));
    const int count = spectrum.shape[0];
    const part one = 1.0 - part{{}};
    part power_mantissas = one, variance_mantissas = one;
    whole power_exponents = {{}}, variance_exponents = {{}};
    const auto multiply = [](part numbers, part& mantissas, whole& exponents) {{
        const whole bits = (whole)numbers;
        exponents += (bits >> 52) - 1023;
        mantissas *= (part)((bits & 0xfffffffffffffLL) | 0x3ff0000000000000LL);
    }};
    for (int from = 0; from < {LANES}; from += {_COLUMNS}) {{
        const double* square = (const double*)squares.data + from;
        const part scale = *(const part*)(scales.c + from);
        part power = {{}};
        for (int start = 0; start < count; start += {_TOGETHER}) {{
            const int end = start + {_TOGETHER} < count ? start + {_TOGETHER} : count;
            // A sum of fractions over their common denominator: one division for all of them.
            part product = one, sum = {{}};
            for (int axis = start; axis < end; ++axis) {{
                const part variance = one + scale * spectrum.data[axis];
                sum = sum * variance + *(const part*)(square + {LANES} * axis) * product;
                product = product * variance;
            }}
            multiply(product, variance_mantissas, variance_exponents);
            power += sum / product;
        }}
        const part least = {_LEAST_POWER} - part{{}};
        multiply(power > 0.0 ? (power > least ? power : least) : one, power_mantissas, power_exponents);
    }}
    wp::vec_t<4, wp::float64> result{{1.0, 0.0, 1.0, 0.0}};
    for (int i = 0; i < {_COLUMNS}; ++i) {{
        result.c[0] *= power_mantissas[i];
        result.c[1] += power_exponents[i];
        result.c[2] *= variance_mantissas[i];
        result.c[3] += variance_exponents[i];
    }}
    return result;
"""


# In C with vectors of the compiler: in the loops that Warp writes sums would leave the registers after every operation.
@wp.func_native(_ADD)
def multiply_powers(
    squares: wp.array(dtype=columns), spectrum: wp.array(dtype=wp.float64), scales: columns
) -> products:
    """Multiply the powers of columns: sums of squares [axis] over variances, 1 plus spectrum [axis] times scales.

    The variances of all axes and columns are multiplied too. Powers of zero count as one.
    """
    ...


@wp.kernel
def add_powers(
    first: wp.int32,
    squares: wp.array2d(dtype=columns),
    spectrum: wp.array(dtype=wp.float64),
    relative: wp.array(dtype=columns),
    factors: wp.array(dtype=wp.float64),
    log_powers: wp.array2d(dtype=wp.float64),
    log_variances: wp.array2d(dtype=wp.float64),
):
    """Add up squares over variances for one packet of pixels; the logarithms of these powers and of all variances.

    Arguments: squares [packet, axis] of values in units of their noise; spectrum [axis], relative [packet]: variances
    of the signal are their product times one of the factors [factor]; log_powers, log_variances [packet, factor]: sums
    over the pixels of the packet and, of variances, the axes.
    """
    packet = first + wp.tid()
    log_two = wp.log(wp.float64(2.0))
    for i in range(factors.shape[0]):
        result = multiply_powers(squares[packet], spectrum, relative[packet] * factors[i])
        log_powers[packet, i] = wp.log(result[0]) + log_two * result[1]
        log_variances[packet, i] = wp.log(result[2]) + log_two * result[3]
