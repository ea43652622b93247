r"""Periodic phase screens: random von Karman optical path over a band of wavenumbers, in metres.

A screen is :math:`\psi(x) = \sum_k a_k e^{i k \cdot x}` over the modes of a periodic square, with
:math:`\langle|a_k|^2\rangle = W(\nu) / L^2` (spectrum :math:`W` of the path, side :math:`L`). A wave gains the phase
:math:`2 \pi \psi / \lambda`; a ray through the screen is deflected by the gradient of :math:`\psi`, with the plus
sign, in the slopes of its travel; :func:`slope_screen` gives that gradient. Sample ``[j, i]`` lies at
``x = i * pixel``, ``y = j * pixel``.

Only the modes of the band are drawn, and the Fourier transform skips what they leave empty, so a screen of 8192 x 8192
samples with modes up to a third of Nyquist costs little more than its own memory.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.fft

from ...core.errors import DomainError
from ...core.threads import thread_count
from .spline import stencil_gain
from .turbulence import path_spectrum, require_positive

# Blocks of the two Fourier passes: fixed, so that no byte depends on the number of threads, and small enough for the
# cache of one core.
_COLUMN_BLOCK = 64
_ROW_BLOCK = 128


def band_modes(size: int, length: float, band: tuple[float, float]) -> tuple[int, np.ndarray]:
    """Return the modes of a screen that lie in a band.

    Parameters
    ----------
    size : int
        Samples on a side.
    length : float
        Side [m].
    band : tuple of float
        Wavenumbers ``(low, high)`` [rad/m]: modes with ``low < |k| <= high`` are in it. Modes at and beyond the
        Nyquist limit of an axis never are, nor is the mean.

    Returns
    -------
    reach : int
        Largest index of a mode along an axis.
    inside : ndarray of bool
        Shape [reach + 1, 2 reach + 1]: the modes of index ``(i, j)``, i from 0, j from -reach; in the column
        ``i = 0`` only those with j > 0, of which those with j < 0 are the complex conjugates.
    """
    per_index = 2.0 * math.pi / length
    reach = _reach(size, length, band)
    i = np.arange(reach + 1, dtype=np.float64)[:, np.newaxis]
    j = np.arange(-reach, reach + 1, dtype=np.float64)
    square = i * i + j * j
    inside = (square > (band[0] / per_index) ** 2) & (square <= (band[1] / per_index) ** 2)
    inside[0, : reach + 1] = False
    return reach, inside


def working_bytes(size: int, length: float, band: tuple[float, float]) -> int:
    """Return the approximate working memory for one screen, beside the screen itself [bytes].

    Arguments are those of :func:`band_modes`.
    """
    reach = _reach(size, length, band)
    modes = (reach + 1) * (2 * reach + 1)
    # First the modes in complex64 with their amplitudes, twice, and which are in the band; then the modes and their
    # columns, of which slopes have the most.
    return max(17 * modes, 9 * modes + 8 * (2 * reach + 1) * size)


def _reach(size: int, length: float, band: tuple[float, float]) -> int:
    nyquist = (size - 1) // 2
    return min(nyquist, math.floor(band[1] / (2.0 * math.pi / length))) if math.isfinite(band[1]) else nyquist


def _draw_modes(
    generator: np.random.Generator, amplitude: np.ndarray, inside: np.ndarray, fixed_modulus: bool
) -> np.ndarray:
    """Return random complex modes [m] with the given rms amplitudes, Hermitian in the column i = 0."""
    shape = inside.shape
    if fixed_modulus:
        angle = generator.random(shape, dtype=np.float32) * np.float32(2.0 * math.pi)
        modes = np.empty(shape, dtype=np.complex64)
        modes.real, modes.imag = np.cos(angle), np.sin(angle)
        modes *= amplitude
    else:
        modes = generator.standard_normal((*shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
        modes *= amplitude * np.float32(math.sqrt(0.5))
    modes[~inside] = 0.0
    middle = shape[1] // 2
    modes[0, :middle] = np.conj(modes[0, :middle:-1])
    return modes


def phase_screen(
    generator: np.random.Generator,
    *,
    size: int,
    length: float,
    r0: float,
    outer_scale: float,
    band: tuple[float, float] = (0.0, math.inf),
    weight: float = 1.0,
    stencil: str = "samples",
    fixed_modulus: bool = False,
    threads: int | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Draw one periodic screen of optical path.

    The random numbers depend on the generator and on the modes of the band only, so screens drawn from the same
    stream with other stencils or other numbers of samples hold the same modes, whatever the threads.

    Parameters
    ----------
    generator : numpy.random.Generator
        Stream of this screen.
    size : int
        Samples on a side.
    length : float
        Side [m].
    r0 : float
        Fried parameter of the whole atmosphere at 500 nm [m].
    outer_scale : float
        Outer scale [m].
    band : tuple of float
        Wavenumbers ``(low, high)`` [rad/m]; modes with ``low < |k| <= high`` are drawn.
    weight : float
        Fraction of the turbulence that this screen holds; its amplitude goes with the square root.
    stencil : str
        Interpolation that the samples are made for, one of :data:`~.spline.STENCILS`.
    fixed_modulus : bool
        Give every mode its rms modulus and a random phase only, after Jee & Tyson 2011, eq. 2, in place of a Gaussian
        complex amplitude. Such a field is not Gaussian.
    threads : int, optional
        Number of threads; all processors by default.
    out : ndarray, optional
        Array for the screen: float32, shape [size, size].

    Returns
    -------
    ndarray
        Path [m], float32, shape [size, size], ``[y, x]``; of mean zero.

    Raises
    ------
    DomainError
        If a size, a length or the band is outside its range.
    """
    modes = _modes(generator, size, length, r0, outer_scale, band, weight, stencil, fixed_modulus)
    return _transform(modes, size, threads, out)


def slope_screen(
    generator: np.random.Generator,
    *,
    size: int,
    length: float,
    r0: float,
    outer_scale: float,
    band: tuple[float, float],
    unit: float,
    lag: float = 0.0,
    weight: float = 1.0,
    fixed_modulus: bool = False,
    threads: int | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Draw the slopes of the screen that :func:`phase_screen` draws from the same stream: both gradients, packed.

    Parameters
    ----------
    generator, size, length, r0, outer_scale, band, weight, fixed_modulus, threads
        As for :func:`phase_screen`.
    unit : float
        Slope of one count [rad]; slopes beyond 32767 counts are held there.
    lag : float
        Baseline of the slopes [m]: each mode of wavenumber k is multiplied by
        ``sin(k lag / 2) / (k lag / 2)``, which makes a gradient the mean slope over so long a baseline.
    out : ndarray, optional
        Array for the slopes: int32, shape [size, size].

    Returns
    -------
    ndarray
        Slopes at the samples, int32, shape [size, size], ``[y, x]``: the lower 16 bits hold the slope along x, the
        upper 16 that along y, as signed counts.
    """
    modes = _modes(generator, size, length, r0, outer_scale, band, weight, "samples", fixed_modulus)
    reach = len(modes) - 1
    step = 2.0 * math.pi / length
    i = np.arange(reach + 1, dtype=np.float32)[:, np.newaxis] * np.float32(step)
    j = np.arange(-reach, reach + 1, dtype=np.float32) * np.float32(step)
    for first in range(0, reach + 1, _COLUMN_BLOCK):
        # NumPy's sinc is sin(pi x)/(pi x).
        part = slice(first, first + _COLUMN_BLOCK)
        modes[part] *= np.sinc(np.hypot(i[part], j) * (0.5 * lag / math.pi)) / unit
    columns = np.empty((2 * reach + 1, size), dtype=np.complex64)
    packed = np.empty((size, size), dtype=np.int32) if out is None else out

    def along_y(first: int) -> None:
        part = slice(first, min(first + _COLUMN_BLOCK, reach + 1))
        # The gradient along x and i times that along y, of the modes with i and of their conjugates with -i.
        for sign in (1, -1):
            here = modes[part] if sign == 1 else np.conj(modes[part, ::-1])
            padded = _in_fft_order((1j * sign) * i[part] * here - j * here, size)
            rows = reach + np.arange(part.start, part.stop) * sign
            if sign == -1 and part.start == 0:
                padded, rows = padded[1:], rows[1:]
            columns[rows] = scipy.fft.ifft(padded, axis=1, norm="forward", overwrite_x=True)

    def along_x(first: int) -> None:
        rows = slice(first, min(first + _ROW_BLOCK, size))
        padded = _in_fft_order(columns[:, rows].T, size)
        counts = scipy.fft.ifft(padded, axis=1, norm="forward", overwrite_x=True).view(np.float32)
        np.rint(counts, out=counts)
        np.clip(counts, -32767.0, 32767.0, out=counts)
        packed[rows] = counts.astype("<i2").view("<i4")

    with ThreadPoolExecutor(thread_count(threads)) as pool:
        list(pool.map(along_y, range(0, reach + 1, _COLUMN_BLOCK)))
        list(pool.map(along_x, range(0, size, _ROW_BLOCK)))
    return packed


def _modes(
    generator: np.random.Generator,
    size: int,
    length: float,
    r0: float,
    outer_scale: float,
    band: tuple[float, float],
    weight: float,
    stencil: str,
    fixed_modulus: bool,
) -> np.ndarray:
    """Draw the modes [m] of a screen, complex64, shape [reach + 1, 2 reach + 1], index ``[i, reach + j]``."""
    length = require_positive(length, "length", "metres")
    if size < 4:
        raise DomainError(f"size = {size!r}: expected at least 4 samples on a side")
    reach, inside = band_modes(size, length, band)
    i = np.arange(reach + 1, dtype=np.float64)[:, np.newaxis]
    j = np.arange(-reach, reach + 1, dtype=np.float64)
    amplitude = np.empty(inside.shape, dtype=np.float32)
    pixel_phase = 2.0 * math.pi / size
    for first in range(0, reach + 1, _COLUMN_BLOCK):
        part = i[first : first + _COLUMN_BLOCK]
        spectrum = path_spectrum(np.hypot(part, j) / length, r0, outer_scale) * weight
        gain = stencil_gain(part * pixel_phase, j * pixel_phase, stencil)
        amplitude[first : first + _COLUMN_BLOCK] = np.sqrt(spectrum) * gain / length
    return _draw_modes(generator, amplitude, inside, fixed_modulus)


def _in_fft_order(modes: np.ndarray, size: int) -> np.ndarray:
    """Return rows of modes of index -reach to reach as a transform of so many samples takes them, zeros between."""
    reach = modes.shape[1] // 2
    padded = np.zeros((len(modes), size), dtype=np.complex64)
    padded[:, : reach + 1] = modes[:, reach:]
    padded[:, size - reach :] = modes[:, :reach]
    return padded


def _transform(modes: np.ndarray, size: int, threads: int | None, out: np.ndarray | None) -> np.ndarray:
    """Return the real field of the modes ``[i, reach + j]``, transforming only columns and rows that hold any."""
    count = len(modes)
    columns = np.empty((count, size), dtype=np.complex64)
    field = np.empty((size, size), dtype=np.float32) if out is None else out

    def along_y(first: int) -> None:
        part = modes[first : first + _COLUMN_BLOCK]
        padded = _in_fft_order(part, size)
        columns[first : first + _COLUMN_BLOCK] = scipy.fft.ifft(padded, axis=1, norm="forward", overwrite_x=True)

    def along_x(first: int) -> None:
        rows = slice(first, min(first + _ROW_BLOCK, size))
        padded = np.zeros((rows.stop - first, size // 2 + 1), dtype=np.complex64)
        padded[:, :count] = columns[:, rows].T
        field[rows] = scipy.fft.irfft(padded, size, axis=1, norm="forward", overwrite_x=True)

    with ThreadPoolExecutor(thread_count(threads)) as pool:
        list(pool.map(along_y, range(0, count, _COLUMN_BLOCK)))
        list(pool.map(along_x, range(0, size, _ROW_BLOCK)))
    return field
