r"""Elliptical Gaussians convolved with PSFs: the tables and transforms from which stamps are drawn.

A galaxy of unit flux is

.. math:: m(\mathbf{x}) = \frac{1}{N^2} \sum_\mathbf{k} P(\mathbf{k}) \,
          e^{-\mathbf{k}^T C \mathbf{k} / 2} \, e^{i \mathbf{k} (\mathbf{x} - \mathbf{x}_0)},

P being the discrete transform of the PSF image, padded to N x N pixels, so the PSF is the band-limited function through
its pixels, of which it holds the integral over a pixel. N is odd: no frequency stands for both its signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from scipy import fft

from ...core.launch import launch, load_kernels
from ...core.threads import thread_count
from ...core.warp_arrays import warp_array
from ..packet_kernels import LANES, packet
from .fit_kernels import SUMS, draw_models, sum_normal_equations

#: Parameters of a galaxy, in order.
PARAMETERS = ("flux", "x", "y", "Cxx", "Cxy", "Cyy")
#: Sides of stamps are multiples of this number of pixels.
SIDE_STEP = 2 * LANES
# Galaxies that share a work array; several blocks for each thread.
_MOST_IN_BLOCK = 16
_UPPER = np.triu_indices(len(PARAMETERS))


@dataclass(frozen=True)
class NormalEquations:
    """Chi-square of n galaxies with its derivatives.

    Parameters
    ----------
    chi2 : array
        Sum over pixels of weight (data - model)^2, [n].
    right : array
        Sums of weight (data - model) derivative, minus half the gradient of chi-square, [n, 6].
    matrix : array
        Sums of weight derivative derivative, the Fisher matrix, [n, 6, 6].
    """

    chi2: np.ndarray
    right: np.ndarray
    matrix: np.ndarray


class GaussianStamps:
    """Stamps of galaxies beside models of the same size.

    Parameters
    ----------
    psf_images : array
        [m, ny, nx] of unit sum, odd sides, centred on a pixel.
    templates : array of int
        Index of the PSF of each galaxy, [n].
    data, weight : array
        [n, side, side] pixels and their weights, the inverse of their variance; 0 for a pixel to ignore.
    threads : int, optional
        All processors by default; the results are the same for any number.
    """

    def __init__(
        self,
        psf_images: np.ndarray,
        templates: np.ndarray,
        data: np.ndarray,
        weight: np.ndarray,
        threads: int | None = None,
    ) -> None:
        load_kernels(sum_normal_equations)
        self.side = data.shape[-1]
        self.threads = thread_count(threads)
        self.templates = templates.astype(np.int32)
        reach = max(psf_images.shape[1:])
        # Light of the galaxy's part of a stamp that the PSF carries over its edge does not come in at the other one.
        self.period = max(self.side + reach // 2, reach) | 1
        self._step = 2.0 * np.pi / self.period
        self._psf = warp_array(_psf_transforms(psf_images, self.period, self.threads).view(np.float64), wp.vec4d)
        self._trigonometric_tables = [
            warp_array(table, packet) for table in _trigonometric_tables(self.period, self.side)
        ]
        self._data, self._weight = (warp_array(_stamp_packets(values), packet) for values in (data, weight))

    def normal_equations(self, params: np.ndarray, indices: np.ndarray) -> NormalEquations:
        """Return the normal equations of the galaxies `indices` [k] of given parameters [k, 6]."""
        count = len(indices)
        block = int(np.clip(count // (4 * self.threads), 1, _MOST_IN_BLOCK))
        blocks = -(-count // block)
        result = np.zeros((count, SUMS))
        launch(
            sum_normal_equations,
            blocks,
            [
                block,
                self._psf,
                warp_array(self.templates[indices], wp.int32),
                warp_array(indices, wp.int32),
                self._step,
                warp_array(params),
                *self._trigonometric_tables,
                self._data,
                self._weight,
                *self._work_arrays(blocks),
                warp_array(result),
            ],
            threads=self.threads,
        )
        matrix = np.zeros((count, len(PARAMETERS), len(PARAMETERS)))
        matrix[:, _UPPER[0], _UPPER[1]] = result[:, 1 + len(PARAMETERS) :]
        matrix[:, _UPPER[1], _UPPER[0]] = result[:, 1 + len(PARAMETERS) :]
        return NormalEquations(result[:, 0], result[:, 1 : 1 + len(PARAMETERS)], matrix)

    def derivatives(self, params: np.ndarray) -> np.ndarray:
        """Return the derivatives [n, 6, side, side] of all stamps with respect to :data:`PARAMETERS`.

        That with respect to the flux is the model of unit flux.
        """
        count, side = len(params), self.side
        images = np.zeros((count, len(PARAMETERS), side, side))
        launch(
            draw_models,
            count,
            [
                self._psf,
                warp_array(self.templates, wp.int32),
                self._step,
                warp_array(params),
                *self._trigonometric_tables,
                *self._work_arrays(count),
                warp_array(images.reshape(count, len(PARAMETERS), side, -1, LANES), packet),
            ],
            threads=self.threads,
        )
        natural = np.argsort(_rows_from_center(side))
        return images[:, :, natural[:, None], natural]

    def _work_arrays(self, count: int) -> list[wp.array]:
        """Return the work arrays of `count` items: spectrum, and columns as packets and as numbers."""
        rows = count * ((self.period + 1) // 2)
        columns = np.zeros((rows, len(PARAMETERS), self.side))
        as_packets = warp_array(columns.reshape(rows, len(PARAMETERS), -1, LANES), packet)
        return [warp_array(np.zeros((rows, 4)), wp.vec4d), as_packets, warp_array(columns)]


def _rows_from_center(side: int) -> np.ndarray:
    """Return the order of rows in the kernels: from the centre upwards, then from the centre downwards."""
    return np.r_[side // 2 : side, side // 2 - 1 : -1 : -1]


def _stamp_packets(stamps: np.ndarray) -> np.ndarray:
    """Return stamps [n, side, side] in the order of the kernels, [n, side, packet, LANES]."""
    order = _rows_from_center(stamps.shape[-1])
    return stamps[:, order[:, None], order].reshape(*stamps.shape[:2], -1, LANES)


@lru_cache(maxsize=8)
def _trigonometric_tables(period: int, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines at frequencies that are not negative and pixels above the centre, as packets."""
    phase = 2.0 * np.pi / period * np.arange((period + 1) // 2)[:, None] * (np.arange(side // 2) + 0.5)
    return tuple(np.ascontiguousarray(f(phase).reshape(len(phase), -1, LANES)) for f in (np.cos, np.sin))  # type: ignore[return-value]


def _psf_transforms(psf_images: np.ndarray, period: int, threads: int) -> np.ndarray:
    """Return the transforms of PSFs at (kx, ky) and (kx, -ky), [m, kx, ky, 2], weighted for a sum over all frequencies.

    The values at kx > 0 count twice, for kx < 0; those at ky = 0 stand in the first of two numbers alone.
    """
    count, ny, nx = psf_images.shape
    at_x, at_y = ((np.arange(n) - n // 2) % period for n in (nx, ny))
    padded = np.zeros((count, period, period))
    padded[:, at_x[:, None], at_y] = psf_images.transpose(0, 2, 1)
    values = fft.rfft2(padded, workers=threads)
    half = values.shape[2]
    result = np.empty((count, half, half, 2), dtype=np.complex128)
    result[..., 0] = values[:, :half]
    np.conjugate(values[:, -np.arange(half)], out=result[..., 1])  # the PSF is real
    result *= (np.where(np.arange(half) > 0, 2.0, 1.0) / period**2)[:, None, None]
    result[:, :, 0, 1] = 0.0
    return result
