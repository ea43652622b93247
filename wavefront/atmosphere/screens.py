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
from ...core.units import require_positive
from .spline import stencil_gain
from .turbulence import path_spectrum

# Blocks of the two Fourier passes: fixed, so that no byte depends on the number of threads, and small enough for the
# cache of one core.
_COLUMN_BLOCK = 64
_ROW_BLOCK = 128


def working_bytes(size: int, length: float, band: tuple[float, float]) -> int:
    """Return the approximate working memory for one screen, beside the screen itself [bytes]."""
    reach = _largest_mode(size, length, band)
    modes = (reach + 1) * (2 * reach + 1)
    # First the modes in complex64 with their amplitudes, twice, and which are in the band; then the modes and their
    # columns, of which slopes have the most.
    return max(17 * modes, 9 * modes + 8 * (2 * reach + 1) * size)


def _largest_mode(size: int, length: float, band: tuple[float, float]) -> int:
    """Return the largest index along an axis of the modes of a band."""
    nyquist = (size - 1) // 2
    return min(nyquist, math.floor(band[1] / (2.0 * math.pi / length))) if math.isfinite(band[1]) else nyquist


def _random_modes(
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


def draw_modes(
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
) -> np.ndarray:
    """Draw the modes [m] of a screen, complex64, shape [reach + 1, 2 reach + 1], index ``[i, reach + j]``.

    The random numbers depend on the generator and on the modes of the band only, so screens drawn from the same stream
    with other stencils or other numbers of samples hold the same modes.

    Modes with ``band[0] < |k| <= band[1]`` [rad/m] are drawn for a square of side ``length`` [m], from the Fried
    parameter of the whole atmosphere at 500 nm [m] and the outer scale [m]. ``weight`` is the fraction of the
    turbulence that this screen holds, ``stencil`` one of :data:`~.spline.STENCILS`. With ``fixed_modulus`` every mode
    has its rms modulus and a random phase only (Jee & Tyson 2011, eq. 2) in place of a Gaussian complex amplitude; such
    a field is not Gaussian. Modes at and beyond the Nyquist limit of an axis are zero, and so is the mean.
    """
    length = require_positive(length, "length", "metres")
    if size < 4:
        raise DomainError(f"size = {size!r}: expected at least 4 samples on a side")
    reach = _largest_mode(size, length, band)
    j = np.arange(-reach, reach + 1, dtype=np.float64)
    amplitude = np.empty((reach + 1, 2 * reach + 1), dtype=np.float32)
    inside = np.empty(amplitude.shape, dtype=bool)
    per_index, pixel_phase = 2.0 * math.pi / length, 2.0 * math.pi / size

    def amplitudes(first: int) -> None:
        rows = slice(first, min(first + _COLUMN_BLOCK, reach + 1))
        i = np.arange(rows.start, rows.stop, dtype=np.float64)[:, np.newaxis]
        square = i * i + j * j
        inside[rows] = (square > (band[0] / per_index) ** 2) & (square <= (band[1] / per_index) ** 2)
        spectrum = path_spectrum(np.hypot(i, j) / length, r0, outer_scale) * weight
        amplitude[rows] = np.sqrt(spectrum) * stencil_gain(i * pixel_phase, j * pixel_phase, stencil) / length

    with ThreadPoolExecutor(thread_count(threads)) as pool:
        list(pool.map(amplitudes, range(0, reach + 1, _COLUMN_BLOCK)))
    # Of the column i = 0, the modes with j < 0 are the complex conjugates of those with j > 0.
    inside[0, : reach + 1] = False
    return _random_modes(generator, amplitude, inside, fixed_modulus)


def _in_fft_order(modes: np.ndarray, size: int) -> np.ndarray:
    """Return rows of modes of index -reach to reach as a transform of so many samples takes them, zeros between."""
    reach = modes.shape[1] // 2
    padded = np.zeros((len(modes), size), dtype=np.complex64)
    padded[:, : reach + 1] = modes[:, reach:]
    padded[:, size - reach :] = modes[:, :reach]
    return padded


def phase_screen(
    modes: np.ndarray, size: int, *, threads: int | None = None, out: np.ndarray | None = None
) -> np.ndarray:
    """Return the optical path [m] of modes, float32, shape [size, size], ``[y, x]``; of mean zero.

    Only columns and rows that hold modes are transformed. The path is written to ``out`` where that is given.
    """
    count = len(modes)
    columns = np.empty((count, size), dtype=np.complex64)
    field = np.empty((size, size), dtype=np.float32) if out is None else out

    def along_y(first: int) -> None:
        block = modes[first : first + _COLUMN_BLOCK]
        padded = _in_fft_order(block, size)
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


def in_whole_blocks(rows: np.ndarray) -> np.ndarray:
    """Return which rows lie in a block of rows of which at least one is set, bool [size]."""
    starts = np.arange(0, len(rows), _ROW_BLOCK)
    lengths = np.diff(np.append(starts, len(rows)))
    return np.repeat(np.logical_or.reduceat(rows, starts), lengths)


def slope_screen(
    modes: np.ndarray,
    size: int,
    length: float,
    unit: float,
    *,
    lag: float = 0.0,
    threads: int | None = None,
    out: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """Return the slopes of modes over a square of side ``length`` [m]: both gradients, packed. Overwrites the modes.

    The result, int32, shape [size, size], ``[y, x]``, holds the slope along x in its lower 16 bits and that along y in
    its upper 16, as signed counts of ``unit`` [rad], at most 32767. Each mode of wavenumber k is multiplied by the sinc
    ``sin(k lag / 2) / (k lag / 2)``, which makes a gradient the mean slope over a baseline ``lag`` [m].
    Of ``rows``, bool [size], at least those that are set are computed, and the rest of the blocks of rows in which they
    lie (:func:`in_whole_blocks`); no other row is touched. Their bytes do not depend on the other rows.
    """
    reach = len(modes) - 1
    step = 2.0 * math.pi / length
    i = np.arange(reach + 1, dtype=np.float32)[:, np.newaxis] * np.float32(step)
    j = np.arange(-reach, reach + 1, dtype=np.float32) * np.float32(step)
    needed_rows = np.ones(size, dtype=bool) if rows is None else in_whole_blocks(rows)
    # Where a row stands among those that are computed.
    place = np.concatenate([[0], np.cumsum(needed_rows)])
    row_index = slice(None) if needed_rows.all() else np.flatnonzero(needed_rows)
    columns = np.empty((2 * reach + 1, place[-1]), dtype=np.complex64)
    packed = np.empty((size, size), dtype=np.int32) if out is None else out

    def along_y(first: int) -> None:
        block = slice(first, min(first + _COLUMN_BLOCK, reach + 1))
        # NumPy's sinc is sin(pi x)/(pi x).
        modes[block] *= np.sinc(np.hypot(i[block], j) * (0.5 * lag / math.pi)) / unit
        # The gradient along x and i times that along y, of the modes with i and of their conjugates with -i.
        for sign in (1, -1):
            signed_modes = modes[block] if sign == 1 else np.conj(modes[block, ::-1])
            padded = _in_fft_order((1j * sign) * i[block] * signed_modes - j * signed_modes, size)
            lines = reach + np.arange(block.start, block.stop) * sign
            if sign == -1 and block.start == 0:
                padded, lines = padded[1:], lines[1:]
            columns[lines] = scipy.fft.ifft(padded, axis=1, norm="forward", overwrite_x=True)[:, row_index]

    def along_x(first: int) -> None:
        rows = slice(first, min(first + _ROW_BLOCK, size))
        padded = _in_fft_order(columns[:, place[rows.start] : place[rows.stop]].T, size)
        counts = scipy.fft.ifft(padded, axis=1, norm="forward", overwrite_x=True).view(np.float32)
        np.rint(counts, out=counts)
        np.clip(counts, -32767.0, 32767.0, out=counts)
        packed[rows] = counts.astype("<i2").view("<i4")

    with ThreadPoolExecutor(thread_count(threads)) as pool:
        list(pool.map(along_y, range(0, reach + 1, _COLUMN_BLOCK)))
        list(pool.map(along_x, (first for first in range(0, size, _ROW_BLOCK) if needed_rows[first])))
    return packed
