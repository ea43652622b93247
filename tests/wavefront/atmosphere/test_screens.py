"""Phase screens against von Karman theory, mode by mode and as random fields.

With ``fixed_modulus`` the modes carry their exact mean power, so what is measured on such a screen has no noise: it is
the expectation of what Gaussian screens show.
"""

import math
from functools import lru_cache

import numpy as np
import pytest
import scipy.fft
from scipy.optimize import brentq

from pachon.core.errors import DomainError, UnknownNameError
from pachon.core.random_streams import stream
from pachon.wavefront.atmosphere.screens import draw_modes, in_whole_blocks, phase_screen, slope_screen
from pachon.wavefront.atmosphere.spline import STENCILS, evaluate, stencil_gain
from pachon.wavefront.atmosphere.turbulence import long_exposure_fwhm, path_spectrum, path_variance, structure_function

R0, L0 = 0.16, 25.0
CUTOFF = 1.4 / R0
LOW, HIGH = (0.0, CUTOFF), (CUTOFF, math.inf)
SIZE, LENGTH = 2048, 327.68
PIXEL = LENGTH / SIZE
FINE_SIZE, FINE_PIXEL = 2048, 0.014
RADIANS_PER_METRE = 2.0 * math.pi / 500e-9


def screen(band, /, seed=1, threads=2, out=None, **options):
    grid = {"size": SIZE, "length": LENGTH} if band == LOW else {"size": FINE_SIZE, "length": FINE_SIZE * FINE_PIXEL}
    options = {"r0": R0, "outer_scale": L0, "band": band} | grid | options
    return phase_screen(draw_modes(stream(seed, "test"), **options), options["size"], threads=threads, out=out)


@lru_cache(maxsize=2)
def expected_power(band):
    """Power of each mode of a screen with the mean power of its modes, and its wavenumbers per pixel."""
    return power(screen(band, fixed_modulus=True))


def power(field):
    """Return the power of each mode [m^2] and its wavenumbers per pixel, brute force by SciPy's own FFT."""
    spectrum = scipy.fft.fft2(field.astype(np.float64), workers=2) / field.size
    k = 2.0 * math.pi * np.fft.fftfreq(field.shape[0])
    return spectrum.real**2 + spectrum.imag**2, k, k[:, np.newaxis]


def structure_along(modes, pixel, separations, direction):
    """Structure function at any separation from the modes alone: sum of 2 |a|^2 (1 - cos k b)."""
    mode_power, kx, ky = modes
    whole = mode_power.sum()
    values = []
    for b in separations:
        along_x, along_y = (
            np.exp(1j * k.ravel() * step * b / pixel) for k, step in zip((kx, ky), direction, strict=True)
        )
        # cos(x + y) is cos x cos y - sin x sin y, each a row times a matrix times a column.
        rows = mode_power @ along_x.real, mode_power @ along_x.imag
        values.append(2.0 * (whole - along_y.real @ rows[0] + along_y.imag @ rows[1]))
    return np.array(values)


@pytest.mark.long
@pytest.mark.parametrize(
    "direction", [(1.0, 0.0), pytest.param((0.0, 1.0), marks=pytest.mark.slow), (math.sqrt(0.5), math.sqrt(0.5))]
)
def test_expected_structure_function_of_both_scales(direction):
    """Low and high screens together follow theory from 4 cm to the outer scale."""
    b = np.array([0.04, 0.1, 0.16, 0.32, 0.64, 1.3, 2.6, 5.0, 10.0, 25.0])
    low = structure_along(expected_power(LOW), PIXEL, b, direction)
    high = structure_along(expected_power(HIGH), FINE_PIXEL, b, direction)
    ratio = (low + high) / structure_function(b, R0, L0)
    # The project's requirement is 2 %; beyond the fine Nyquist limit 1.5 % are missing at 4 cm, and at coarser
    # separations the sum over modes is the integral to 0.5 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)
    np.testing.assert_allclose(ratio[b >= 0.32], 1.0, atol=0.005)


@pytest.mark.long
def test_random_screens_follow_theory():
    """Gaussian screens, averaged: measured by differences of samples, from two pixels to the outer scale."""
    lags = np.array([2, 8, 32, 156])  # 0.32 m to 24.96 m
    count = 16
    measured = np.zeros((count, len(lags)))
    for seed in range(count):
        field = screen(LOW, seed=seed)
        for n, lag in enumerate(lags):
            # Every fourth row, and column: half the shortest wave.
            along_x = field[::4] - np.roll(field[::4], -lag, axis=1)
            along_y = field[:, ::4] - np.roll(field[:, ::4], -lag, axis=0)
            measured[seed, n] = 0.5 * (np.mean(along_x**2, dtype=np.float64) + np.mean(along_y**2, dtype=np.float64))
    high = structure_along(expected_power(HIGH), FINE_PIXEL, lags * PIXEL, (1.0, 0.0))
    ratio = (measured.mean(axis=0) + high) / structure_function(lags * PIXEL, R0, L0)
    scatter = measured.std(axis=0) / math.sqrt(count) / structure_function(lags * PIXEL, R0, L0)
    # The requirement is 3 %. The average's own scatter stays below a third of that.
    assert np.all(scatter < 0.01)
    np.testing.assert_allclose(ratio, 1.0, atol=0.03)


@pytest.mark.slow
def test_long_exposure_image_of_random_screens():
    """The mean of exp(i k dpsi) over Gaussian screens is exp(-D/2), and its image is as wide as theory says."""
    pixel, size, wavelength, count = 0.08, 2048, 600e-9, 8
    wavenumber = np.float32(2.0 * math.pi / wavelength)
    mean_low, mean_high = 0.0, 0.0
    for seed in range(count):
        low = screen(LOW, seed=seed, size=size, length=size * pixel)
        high = screen(HIGH, seed=seed, size=512, length=512 * 0.25 * pixel)
        mean_low = mean_low + coherence(wavenumber * low)[:21, :21] / count
        mean_high = mean_high + coherence(wavenumber * high)[:81:4, :81:4] / count
    otf = mean_low * mean_high  # the two scales are independent
    b = pixel * np.arange(21)
    baseline = np.hypot(b, b[:, np.newaxis])
    expected = np.exp(-0.5 * (2.0 * math.pi / wavelength) ** 2 * structure_function(baseline, R0, L0))
    # The mean of eight screens of 164 m scatters by 0.6 %.
    np.testing.assert_allclose(otf, expected, atol=0.008)
    # Image along x, summed over the four quadrants of baselines; their spacing repeats it every 1.5", where the wings
    # are some 1e-3 of the peak.
    quadrants = np.where(b > 0.0, 2.0, 1.0)
    line = (otf * quadrants[:, np.newaxis] * quadrants).sum(axis=0)

    def image(angle):
        return float(np.sum(line * np.cos(2.0 * math.pi * b * angle / wavelength)))

    half = brentq(lambda angle: image(angle) - 0.5 * image(0.0), 0.0, 5e-6)
    # The project's requirement: the long-exposure width within 2 % of theory.
    assert 2.0 * half == pytest.approx(long_exposure_fwhm(wavelength, R0, L0), rel=0.02)


def coherence(phase):
    """Mean of exp(i (phase(x + b) - phase(x))) over a periodic field, for every lag b: Wiener-Khinchin."""
    spectrum = np.abs(scipy.fft.fft2(np.exp(1j * phase))) ** 2
    return scipy.fft.ifft2(spectrum).real / phase.size


@pytest.mark.long
def test_power_is_split_without_loss_or_overlap():
    variance = path_variance(R0, L0)
    for cutoff in (0.6 * CUTOFF, 1.4 * CUTOFF):
        low = screen(LOW, band=(0.0, cutoff), fixed_modulus=True)
        high = screen(HIGH, band=(cutoff, math.inf), fixed_modulus=True)
        total = np.mean(low.astype(float) ** 2) + np.mean(high.astype(float) ** 2)
        # The screen of 328 m lacks its mean: 0.265 (L0/L)^2 = 0.15 % of the variance.
        assert total == pytest.approx(variance * (1.0 - 0.265 * (L0 / LENGTH) ** 2), rel=3e-4, abs=0.0)


@pytest.mark.long
@pytest.mark.parametrize("band", [LOW, HIGH])
def test_modes_stay_in_their_band_with_their_power(band):
    pixel = PIXEL if band == LOW else FINE_PIXEL
    mode_power, kx, ky = expected_power(band)
    wavenumber = np.hypot(kx, ky) / pixel
    edge = 1e-9
    inside = (wavenumber > band[0] + edge) & (wavenumber < band[1] - edge)
    inside &= (np.abs(kx) < math.pi - edge) & (np.abs(ky) < math.pi - edge)
    expected = path_spectrum(wavenumber / (2.0 * math.pi), R0, L0) / (len(mode_power) * pixel) ** 2
    # float32 rounding noise of the transform: 1e-6 of the largest amplitude, 1e-5 of most modes' own.
    floor = 1e-12 * mode_power.max()
    np.testing.assert_allclose(mode_power[inside], expected[inside], rtol=2e-3, atol=floor)
    assert mode_power[~inside].max() < floor


def test_gaussian_modes_have_the_exponential_distribution_of_power():
    mode_power, kx, ky = power(screen(LOW))
    wavenumber = np.hypot(kx, ky) / PIXEL
    chosen = (wavenumber > 0.5) & (wavenumber < 0.99 * CUTOFF) & (kx > 0)
    ratio = mode_power[chosen] / (path_spectrum(wavenumber[chosen] / (2.0 * math.pi), R0, L0) / LENGTH**2)
    # |a|^2 of a complex Gaussian: mean 1, mean square 2, exp(-1) beyond the mean; 160 000 modes give 0.3 to 1 %.
    assert ratio.mean() == pytest.approx(1.0, abs=0.01)
    assert np.mean(ratio**2) == pytest.approx(2.0, abs=0.05)
    assert np.mean(ratio > 1.0) == pytest.approx(math.exp(-1.0), abs=0.005)


def unpacked(slopes):
    return slopes.astype(np.int16).astype(np.float64), (slopes >> 16).astype(np.float64)


@pytest.mark.parametrize("size", [256, 250, 81])
@pytest.mark.parametrize("lag", [0.0, 0.3])
def test_slopes_are_the_gradient_of_the_screen_of_the_same_stream(size, lag):
    """Brute force: the modes of the screen by NumPy's own transform, times i k and the sinc of the lag."""
    length = 0.16 * size
    spectrum = np.fft.fft2(screen(LOW, size=size, length=length).astype(np.float64))
    k = 2.0 * math.pi * np.fft.fftfreq(size, 0.16)
    seen = np.sinc(np.hypot(k, k[:, None]) * lag / (2.0 * math.pi))
    exact = [np.fft.ifft2(1j * wavenumber * seen * spectrum).real for wavenumber in (k, k[:, None])]
    unit = 8.0 * np.std(exact) / 32767.0
    modes = draw_modes(stream(1, "test"), size=size, length=length, r0=R0, outer_scale=L0, band=LOW)
    packed = slope_screen(modes.copy(), size, length, unit, lag=lag, threads=1)
    for counts, slope in zip(unpacked(packed), exact, strict=True):
        # Rounding to whole counts, and single precision of a slope of 4000 counts.
        np.testing.assert_allclose(counts, slope / unit, atol=0.55)
    for threads in (2, 3):
        out = np.empty((size, size), dtype=np.int32)
        again = slope_screen(modes.copy(), size, length, unit, lag=lag, threads=threads, out=out)
        assert again is out
        assert out.tobytes() == packed.tobytes()


def test_rows_of_slopes_do_not_depend_on_the_others():
    size, length = 500, 80.0
    modes = draw_modes(stream(1, "test"), size=size, length=length, r0=R0, outer_scale=L0, band=LOW, threads=2)
    whole = slope_screen(modes.copy(), size, length, 1e-9)
    rows = np.zeros(size, dtype=bool)
    rows[[5, 130, 499]] = True
    some = slope_screen(modes.copy(), size, length, 1e-9, rows=rows, out=np.full((size, size), -7, dtype=np.int32))
    made = in_whole_blocks(rows)
    # Blocks of 128 rows: the first, the second and the shorter last one.
    np.testing.assert_array_equal(np.flatnonzero(~made), np.arange(256, 384))
    np.testing.assert_array_equal(some[made], whole[made])
    assert np.all(some[~made] == -7)


def test_slopes_beyond_the_counts_are_held():
    modes = draw_modes(stream(1, "test"), size=256, length=40.96, r0=R0, outer_scale=L0, band=LOW)
    x, y = unpacked(slope_screen(modes, 256, 40.96, unit=1e-11))
    assert x.max() == y.max() == 32767
    assert x.min() == y.min() == -32767


def test_spline_goes_through_the_samples_and_through_the_sum_of_modes_between():
    size, length = 256, 40.96
    options = {"size": size, "length": length}
    samples, spline = screen(LOW, **options), screen(LOW, stencil="spline", **options)
    pixel = length / size
    index = np.arange(size) * pixel
    at_samples = evaluate(spline, pixel, index, np.full(size, 7 * pixel))
    rms = samples.std()
    np.testing.assert_allclose(at_samples, samples[7], atol=2e-6 * rms)  # float32
    spectrum = np.fft.fft2(samples.astype(np.float64)) / size**2
    k = 2.0 * math.pi * np.fft.fftfreq(size, pixel)
    x, y = stream(7, "places").random((2, 200)) * length * 3.0 - length  # beyond the side too: periodic
    exact = np.einsum("ab,na,nb->n", spectrum, np.exp(1j * np.outer(y, k)), np.exp(1j * np.outer(x, k))).real
    # Modes reach 1 rad per pixel, where a cubic spline's error is 2e-3 of the mode; most power lies far below.
    assert np.sqrt(np.mean((evaluate(spline, pixel, x, y) - exact) ** 2)) < 2e-4 * rms


@pytest.mark.parametrize("band", [LOW, HIGH])
def test_stencils_share_their_modes(band):
    options = {"size": 256, "length": 40.96 if band == LOW else 5.12, "band": band}
    plain = np.fft.fft2(screen(LOW, **options).astype(np.float64))
    k = 2.0 * math.pi * np.fft.fftfreq(256)
    for stencil in STENCILS:
        amplified = np.fft.fft2(screen(LOW, stencil=stencil, **options).astype(np.float64))
        expected = plain * stencil_gain(k[np.newaxis, :], k[:, np.newaxis], stencil)
        # float32 noise of the transform.
        np.testing.assert_allclose(amplified, expected, atol=3e-6 * np.abs(amplified).max())


def test_number_of_samples_does_not_change_the_field():
    coarse, fine = screen(LOW, size=1024), screen(LOW, size=2048)
    # float32 rounding of two transforms.
    np.testing.assert_allclose(fine[::2, ::2], coarse, atol=3e-6 * coarse.std())


def test_threads_change_no_byte():
    reference = screen(LOW, threads=1).tobytes()
    for threads in (2, 3, 7):
        assert screen(LOW, threads=threads).tobytes() == reference


def test_streams_decide_the_screen():
    first = screen(LOW, seed=1, size=1024)
    np.testing.assert_array_equal(first, screen(LOW, seed=1, size=1024))
    other = screen(LOW, seed=2, size=1024)
    # 13 outer scales on a side: independent screens correlate by some 0.05.
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.2


def test_amplitude_goes_with_the_root_of_the_weight_and_the_power_of_r0():
    # Tolerances: float32.
    whole = screen(LOW, size=1024)
    np.testing.assert_allclose(screen(LOW, size=1024, weight=0.25), 0.5 * whole, rtol=1e-5, atol=1e-6 * whole.std())
    worse = screen(LOW, size=1024, r0=0.08)
    np.testing.assert_allclose(worse, 2.0 ** (5 / 6) * whole, rtol=1e-5, atol=5e-6 * whole.std())


def test_mean_is_zero_and_output_is_written_in_place():
    out = np.empty((512, 512), dtype=np.float32)
    field = screen(LOW, size=512, length=81.92, out=out)
    assert field is out
    assert abs(np.mean(field, dtype=np.float64)) < 1e-7 * field.std()  # float32


@pytest.mark.parametrize("size", [4, 5, 63, 100])
def test_any_number_of_samples(size):
    field = phase_screen(draw_modes(stream(1, "odd"), size=size, length=1.0, r0=R0, outer_scale=L0), size)
    assert field.shape == (size, size)
    assert np.all(np.isfinite(field))
    assert field.std() > 0.0


def test_bad_arguments_are_named():
    with pytest.raises(DomainError, match="size = 2"):
        screen(LOW, size=2)
    with pytest.raises(DomainError, match=r"length = -1\.0"):
        screen(LOW, length=-1.0)
    with pytest.raises(DomainError, match="r0 = 0"):
        screen(LOW, r0=0)
    with pytest.raises(UnknownNameError, match="unknown stencil 'splin': did you mean spline"):
        screen(LOW, stencil="splin")
