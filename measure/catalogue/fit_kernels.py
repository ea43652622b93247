"""Kernel of the galaxy fits: PSF-convolved elliptical Gaussians, their derivatives, and normal equations.

The model of unit flux is a sum over frequencies k of the PSF's transform P(k) times exp(-k C k / 2) exp(-i k x0), with
the covariance C and the centre x0. Its derivatives with respect to x0 and C are products with -i k and -k k / 2 in
Fourier space. The sums over ky and kx are matrix products with cosines and sines of positive frequencies and distances
from the centre of the stamp alone; ``LANES`` pixels are computed side by side.
"""

from __future__ import annotations

import warp as wp

from ...core.launch import CPU_COMPILER_FLAGS, FORWARD_OPTIONS
from ..packet_kernels import LANES, lane_sum, packet

# Products and sums fused take a fifth less time.
wp.set_module_options(FORWARD_OPTIONS | {"cpu_compiler_flags": CPU_COMPILER_FLAGS + " -ffp-contract=fast"})

#: Numbers in a row of normal equations: chi-square, 6 of the right-hand side, 21 of the upper triangle of the matrix.
SUMS = 28


@wp.func
def transform_columns(
    psf: wp.array3d(dtype=wp.vec4d),
    template: wp.int32,
    step: wp.float64,
    params: wp.array2d(dtype=wp.float64),
    galaxy: wp.int32,
    cosine: wp.array2d(dtype=packet),
    sine: wp.array2d(dtype=packet),
    row: wp.int32,
    spectrum: wp.array(dtype=wp.vec4d),
    columns: wp.array3d(dtype=packet),
):
    """Sum the model and its first two derivatives along y over ky, for every kx and y.

    Results: spectrum [row + ky] of the last kx: sum and difference of the values at ky and -ky, real and imaginary;
    columns [row + kx, 6, packet of y]: real and imaginary part of model, d/dy and d2/dy2; rows above the centre of the
    stamp first.
    """
    half = wp.float64(0.5)
    count = cosine.shape[0]
    packets = cosine.shape[1]
    xx = params[galaxy, 3]
    xy = params[galaxy, 4]
    yy = params[galaxy, 5]
    turn_x = wp.cos(step * params[galaxy, 1])
    lean_x = -wp.sin(step * params[galaxy, 1])
    turn_y = wp.cos(step * params[galaxy, 2])
    lean_y = -wp.sin(step * params[galaxy, 2])
    # exp(-k C k / 2) along ky is a Gaussian: its ratios of neighbours have a constant ratio.
    ratio = wp.exp(-yy * step * step)
    phase_x = wp.float64(1.0)
    phase_xi = wp.float64(0.0)
    for i in range(count):
        kx = step * wp.float64(i)
        above = wp.exp(-half * xx * kx * kx)
        below = above
        rise = wp.exp(-half * yy * step * step - xy * kx * step)
        fall = wp.exp(-half * yy * step * step + xy * kx * step)
        phase = wp.float64(1.0)
        phase_i = wp.float64(0.0)
        for j in range(count):
            value = psf[template, i, j]
            ar = above * (value[0] * phase - value[1] * phase_i)
            ai = above * (value[0] * phase_i + value[1] * phase)
            br = below * (value[2] * phase + value[3] * phase_i)
            bi = below * (value[3] * phase - value[2] * phase_i)
            spectrum[row + j] = wp.vec4d(ar + br, ai + bi, ar - br, ai - bi)
            above = above * rise
            below = below * fall
            rise = rise * ratio
            fall = fall * ratio
            turned = phase * turn_y - phase_i * lean_y
            phase_i = phase * lean_y + phase_i * turn_y
            phase = turned
        for p in range(packets):
            even_r = packet()
            even_i = packet()
            odd_r = packet()
            odd_i = packet()
            even1_r = packet()
            even1_i = packet()
            odd1_r = packet()
            odd1_i = packet()
            even2_r = packet()
            even2_i = packet()
            odd2_r = packet()
            odd2_i = packet()
            for j in range(count):
                ky = step * wp.float64(j)
                value = spectrum[row + j]
                sr = value[0]
                si = value[1]
                dr = value[2]
                di = value[3]
                c = cosine[j, p]
                s = sine[j, p]
                even_r += sr * c
                even_i += si * c
                odd_r -= di * s
                odd_i += dr * s
                even1_r -= (ky * di) * c
                even1_i += (ky * dr) * c
                odd1_r -= (ky * sr) * s
                odd1_i -= (ky * si) * s
                even2_r -= (ky * ky * sr) * c
                even2_i -= (ky * ky * si) * c
                odd2_r += (ky * ky * di) * s
                odd2_i -= (ky * ky * dr) * s
            at = row + i
            store(columns, at, 0, p, packets, phase_x, phase_xi, even_r, even_i, odd_r, odd_i)
            store(columns, at, 2, p, packets, phase_x, phase_xi, even1_r, even1_i, odd1_r, odd1_i)
            store(columns, at, 4, p, packets, phase_x, phase_xi, even2_r, even2_i, odd2_r, odd2_i)
        turned = phase_x * turn_x - phase_xi * lean_x
        phase_xi = phase_x * lean_x + phase_xi * turn_x
        phase_x = turned


@wp.func
def store(
    columns: wp.array3d(dtype=packet),
    at: wp.int32,
    channel: wp.int32,
    p: wp.int32,
    packets: wp.int32,
    phase: wp.float64,
    phase_i: wp.float64,
    even_r: packet,
    even_i: packet,
    odd_r: packet,
    odd_i: packet,
):
    """Write a transform at a packet of rows above the centre and at their mirror images, shifted along x."""
    real = even_r + odd_r
    imaginary = even_i + odd_i
    columns[at, channel, p] = phase * real - phase_i * imaginary
    columns[at, channel + 1, p] = phase * imaginary + phase_i * real
    real = even_r - odd_r
    imaginary = even_i - odd_i
    columns[at, channel, packets + p] = phase * real - phase_i * imaginary
    columns[at, channel + 1, packets + p] = phase * imaginary + phase_i * real


@wp.func
def transform_row(
    columns: wp.array3d(dtype=wp.float64),
    row: wp.int32,
    step: wp.float64,
    y: wp.int32,
    cosine: wp.array2d(dtype=packet),
    sine: wp.array2d(dtype=packet),
    p: wp.int32,
):
    """Even and odd parts of model, d/dx, d/dy, d2/dx2, d2/dxdy and d2/dy2 along a packet of a row."""
    even = packet()
    odd = packet()
    even_x = packet()
    odd_x = packet()
    even_y = packet()
    odd_y = packet()
    even_xx = packet()
    odd_xx = packet()
    even_xy = packet()
    odd_xy = packet()
    even_yy = packet()
    odd_yy = packet()
    for i in range(cosine.shape[0]):
        kx = step * wp.float64(i)
        c = cosine[i, p]
        s = sine[i, p]
        at = row + i
        fr = columns[at, 0, y]
        fi = columns[at, 1, y]
        gr = columns[at, 2, y]
        gi = columns[at, 3, y]
        even += fr * c
        odd -= fi * s
        even_x -= (kx * fi) * c
        odd_x -= (kx * fr) * s
        even_y += gr * c
        odd_y -= gi * s
        even_xx -= (kx * kx * fr) * c
        odd_xx += (kx * kx * fi) * s
        even_xy -= (kx * gi) * c
        odd_xy -= (kx * gr) * s
        even_yy += columns[at, 4, y] * c
        odd_yy -= columns[at, 5, y] * s
    return even, odd, even_x, odd_x, even_y, odd_y, even_xx, odd_xx, even_xy, odd_xy, even_yy, odd_yy


@wp.kernel
def draw_models(
    first: wp.int32,
    psf: wp.array3d(dtype=wp.vec4d),
    templates: wp.array(dtype=wp.int32),
    step: wp.float64,
    params: wp.array2d(dtype=wp.float64),
    cosine: wp.array2d(dtype=packet),
    sine: wp.array2d(dtype=packet),
    spectrum: wp.array(dtype=wp.vec4d),
    columns: wp.array3d(dtype=packet),
    column_values: wp.array3d(dtype=wp.float64),
    images: wp.array4d(dtype=packet),
):
    """Draw one galaxy and its derivatives.

    Arguments as of ``sum_normal_equations``, with columns of every galaxy on its own. Results: images [galaxy, 6, y,
    packet of x]: d/dflux, d/dx, d/dy, d/dCxx, d/dCxy, d/dCyy; rows and columns above the centre first.
    """
    galaxy = first + wp.tid()
    count = cosine.shape[0]
    packets = cosine.shape[1]
    half = wp.float64(0.5)
    flux = params[galaxy, 0]
    row = galaxy * count
    transform_columns(psf, templates[galaxy], step, params, galaxy, cosine, sine, row, spectrum, columns)
    for y in range(2 * packets * LANES):
        for p in range(packets):
            e0, o0, ex, ox, ey, oy, exx, oxx, exy, oxy, eyy, oyy = transform_row(
                column_values, row, step, y, cosine, sine, p
            )
            images[galaxy, 0, y, p] = e0 + o0
            images[galaxy, 0, y, packets + p] = e0 - o0
            images[galaxy, 1, y, p] = -flux * (ex + ox)
            images[galaxy, 1, y, packets + p] = -flux * (ex - ox)
            images[galaxy, 2, y, p] = -flux * (ey + oy)
            images[galaxy, 2, y, packets + p] = -flux * (ey - oy)
            images[galaxy, 3, y, p] = half * flux * (exx + oxx)
            images[galaxy, 3, y, packets + p] = half * flux * (exx - oxx)
            images[galaxy, 4, y, p] = flux * (exy + oxy)
            images[galaxy, 4, y, packets + p] = flux * (exy - oxy)
            images[galaxy, 5, y, p] = half * flux * (eyy + oyy)
            images[galaxy, 5, y, packets + p] = half * flux * (eyy - oyy)


@wp.kernel
def sum_normal_equations(
    first: wp.int32,
    block: wp.int32,
    psf: wp.array3d(dtype=wp.vec4d),
    templates: wp.array(dtype=wp.int32),
    stamps: wp.array(dtype=wp.int32),
    step: wp.float64,
    params: wp.array2d(dtype=wp.float64),
    cosine: wp.array2d(dtype=packet),
    sine: wp.array2d(dtype=packet),
    data: wp.array3d(dtype=packet),
    weight: wp.array3d(dtype=packet),
    spectrum: wp.array(dtype=wp.vec4d),
    columns: wp.array3d(dtype=packet),
    column_values: wp.array3d(dtype=wp.float64),
    result: wp.array2d(dtype=wp.float64),
):
    """Sum the normal equations of a block of galaxies, one after the other so that their work array stays in cache.

    Arguments: psf [template, kx, ky]: transforms at (kx, ky) and (kx, -ky), weighted for the sum over kx >= 0;
    templates, stamps [galaxy]: index of the PSF and of the stamp; step of the frequencies [1/pixel]; params [galaxy,
    6]: flux, x, y, Cxx, Cxy, Cyy from the centre of the stamp [pixel]; cosine, sine [frequency, packet]; data, weight
    [stamp, y, packet of x], rows and columns above the centre first; work arrays: spectrum [block * frequency], and
    columns [block * frequency, 6, y], the same memory as packets and as numbers. Results: [galaxy] chi-square, sums of
    weight residual derivative (6) and of weight derivative derivative (21), the derivatives being those with respect
    to flux, x, y, Cxx, Cxy, Cyy.
    """
    item = first + wp.tid()
    count = cosine.shape[0]
    packets = cosine.shape[1]
    half = wp.float64(0.5)
    row = item * count
    for galaxy in range(item * block, wp.min((item + 1) * block, params.shape[0])):
        transform_columns(psf, templates[galaxy], step, params, galaxy, cosine, sine, row, spectrum, columns)
        flux = params[galaxy, 0]
        stamp = stamps[galaxy]
        chi2 = packet()
        right0 = packet()
        right1 = packet()
        right2 = packet()
        right3 = packet()
        right4 = packet()
        right5 = packet()
        m00 = packet()
        m01 = packet()
        m02 = packet()
        m03 = packet()
        m04 = packet()
        m05 = packet()
        m11 = packet()
        m12 = packet()
        m13 = packet()
        m14 = packet()
        m15 = packet()
        m22 = packet()
        m23 = packet()
        m24 = packet()
        m25 = packet()
        m33 = packet()
        m34 = packet()
        m35 = packet()
        m44 = packet()
        m45 = packet()
        m55 = packet()
        for y in range(2 * packets * LANES):
            for p in range(packets):
                e0, o0, ex, ox, ey, oy, exx, oxx, exy, oxy, eyy, oyy = transform_row(
                    column_values, row, step, y, cosine, sine, p
                )
                for side in range(2):
                    sign = wp.float64(1 - 2 * side)
                    at = side * packets + p
                    w = weight[stamp, y, at]
                    b0 = e0 + sign * o0
                    b1 = -flux * (ex + sign * ox)
                    b2 = -flux * (ey + sign * oy)
                    b3 = (half * flux) * (exx + sign * oxx)
                    b4 = flux * (exy + sign * oxy)
                    b5 = (half * flux) * (eyy + sign * oyy)
                    r = data[stamp, y, at] - flux * b0
                    w0 = wp.cw_mul(w, b0)
                    w1 = wp.cw_mul(w, b1)
                    w2 = wp.cw_mul(w, b2)
                    w3 = wp.cw_mul(w, b3)
                    w4 = wp.cw_mul(w, b4)
                    w5 = wp.cw_mul(w, b5)
                    chi2 += wp.cw_mul(wp.cw_mul(w, r), r)
                    right0 += wp.cw_mul(w0, r)
                    right1 += wp.cw_mul(w1, r)
                    right2 += wp.cw_mul(w2, r)
                    right3 += wp.cw_mul(w3, r)
                    right4 += wp.cw_mul(w4, r)
                    right5 += wp.cw_mul(w5, r)
                    m00 += wp.cw_mul(w0, b0)
                    m01 += wp.cw_mul(w0, b1)
                    m02 += wp.cw_mul(w0, b2)
                    m03 += wp.cw_mul(w0, b3)
                    m04 += wp.cw_mul(w0, b4)
                    m05 += wp.cw_mul(w0, b5)
                    m11 += wp.cw_mul(w1, b1)
                    m12 += wp.cw_mul(w1, b2)
                    m13 += wp.cw_mul(w1, b3)
                    m14 += wp.cw_mul(w1, b4)
                    m15 += wp.cw_mul(w1, b5)
                    m22 += wp.cw_mul(w2, b2)
                    m23 += wp.cw_mul(w2, b3)
                    m24 += wp.cw_mul(w2, b4)
                    m25 += wp.cw_mul(w2, b5)
                    m33 += wp.cw_mul(w3, b3)
                    m34 += wp.cw_mul(w3, b4)
                    m35 += wp.cw_mul(w3, b5)
                    m44 += wp.cw_mul(w4, b4)
                    m45 += wp.cw_mul(w4, b5)
                    m55 += wp.cw_mul(w5, b5)
        result[galaxy, 0] = lane_sum(chi2)
        result[galaxy, 1] = lane_sum(right0)
        result[galaxy, 2] = lane_sum(right1)
        result[galaxy, 3] = lane_sum(right2)
        result[galaxy, 4] = lane_sum(right3)
        result[galaxy, 5] = lane_sum(right4)
        result[galaxy, 6] = lane_sum(right5)
        result[galaxy, 7] = lane_sum(m00)
        result[galaxy, 8] = lane_sum(m01)
        result[galaxy, 9] = lane_sum(m02)
        result[galaxy, 10] = lane_sum(m03)
        result[galaxy, 11] = lane_sum(m04)
        result[galaxy, 12] = lane_sum(m05)
        result[galaxy, 13] = lane_sum(m11)
        result[galaxy, 14] = lane_sum(m12)
        result[galaxy, 15] = lane_sum(m13)
        result[galaxy, 16] = lane_sum(m14)
        result[galaxy, 17] = lane_sum(m15)
        result[galaxy, 18] = lane_sum(m22)
        result[galaxy, 19] = lane_sum(m23)
        result[galaxy, 20] = lane_sum(m24)
        result[galaxy, 21] = lane_sum(m25)
        result[galaxy, 22] = lane_sum(m33)
        result[galaxy, 23] = lane_sum(m34)
        result[galaxy, 24] = lane_sum(m35)
        result[galaxy, 25] = lane_sum(m44)
        result[galaxy, 26] = lane_sum(m45)
        result[galaxy, 27] = lane_sum(m55)
