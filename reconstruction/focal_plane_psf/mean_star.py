"""The mean star of an exposure, without the noise of frequencies that the PSF does not reach."""

from __future__ import annotations

import numpy as np

from ...core.statistics import signal_share
from ...measure.star_flux import with_unit_flux

# Pixels at each edge of a stamp that are taken for sky, of its side.
_EDGE = 6


def mean_star(stamps: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of stars [n, ny, nx] with weights [n], [ny, nx] of unit sum, and what is passed of frequencies.

    Images of smaller PSFs are made of it by a convolution of negative width, which enlarges what it has of high
    frequencies: there it is taken as far as its power in the ring of such frequencies is above that of its noise, which
    is the second result, of the shape of :func:`numpy.fft.rfft2`. The mean is zero if no star has light.
    """
    unit = with_unit_flux(stamps)[0]
    lit = np.isfinite(unit[:, 0, 0])
    ny, nx = stamps.shape[1:]
    cycles = np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.rfftfreq(nx))
    if not lit.any():
        return np.zeros((ny, nx)), np.ones(cycles.shape)
    unit, share = unit[lit], weight[lit] / weight[lit].sum()
    mean = np.einsum("n,nyx->yx", share, unit)
    noise = float(share**2 @ (unit - mean)[:, edge_of((ny, nx))].var(axis=1))
    spectrum = np.fft.rfft2(mean)
    ring = np.rint(cycles * max(ny, nx)).astype(int)
    count = np.bincount(ring.ravel())
    power = np.bincount(ring.ravel(), (np.abs(spectrum) ** 2).ravel()) / count
    signal = signal_share(power, noise * mean.size, 1.0 / np.sqrt(count))
    signal[0] = 1.0
    # Beyond the first ring that is noise the PSF does not come back.
    passed = np.where(np.minimum.accumulate(signal) > 0.0, signal, 0.0)[ring]
    mean = limited(mean, passed)
    return mean / mean.sum(), passed


def edge_of(shape: tuple[int, int]) -> np.ndarray:
    """Return the pixels at the edges of a stamp of a shape (ny, nx), which are taken for sky, bool [ny, nx]."""
    ny, nx = shape
    edge = np.ones(shape, dtype=bool)
    edge[ny // _EDGE : -(ny // _EDGE), nx // _EDGE : -(nx // _EDGE)] = False
    return edge


def limited(images: np.ndarray, passed: np.ndarray) -> np.ndarray:
    """Return images [..., ny, nx] with what is passed of their frequencies."""
    return np.asarray(np.fft.irfft2(np.fft.rfft2(images) * passed, s=images.shape[-2:]))
