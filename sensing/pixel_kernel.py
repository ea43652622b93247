r"""Light of sharp images on pixels: the integral of each cell's own image over each pixel, without a finer grid.

An evenly lit rectangle has on a pixel, after a Gaussian blur, a product over the axes of second differences of
:math:`F(z) = z\,\Phi(z / \sigma) + \sigma\,\varphi(z / \sigma)`, the second integral of the Gaussian; without blur it
is the area that the two share. The images of cells are quadratic B-splines, such rectangles blurred twice more by
themselves, so that cells whose spacing is not quite the mean one add up to even light; the second moment that this adds
is taken off again. The values are tabulated by the place of the cell within a pixel.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import warp as wp
from scipy.signal import fftconvolve
from scipy.special import ndtr

from ..core.launch import launch
from ..core.warp_arrays import warp_array
from .deposit_kernels import deposit_points

#: Places within a pixel at which kernels are tabulated; between them they are straight.
_PHASES = 256
#: Widths of the Gaussian beyond which its light is left out: 1e-4 of it.
_REACH = 3.7
#: Boxes that an evenly lit cell is convolved with: with two, cells whose images stand a few per cent nearer to each
#: other than the mean still add up to even light, to 1e-4; one box leaves that difference itself.
_MORE_BOXES = 2
#: Distance from a stamp at which all points have none of their light on it [pixels].
_FAR = 1e4
#: Narrowest Gaussian and cell [pixels]; narrower ones are as sharp.
_NARROW = 1e-6


class PixelKernel:
    """Light of a point of one axis on the pixels about it, and derivatives, by its place within a pixel.

    Parameters
    ----------
    cell : float
        Spacing of the images of the cells [pixels].
    width : float
        Width that a pixel integrates over [pixels].
    rms : float
        Rms of the Gaussian blur [pixels].
    """

    def __init__(self, cell: float, width: float, rms: float) -> None:
        cell, rms = max(cell, _NARROW), max(rms, _NARROW)
        # Second derivatives are those of a point that is divided in two.
        step = max(round(0.5 * cell * _PHASES), 1)
        half = math.ceil(0.5 * width + 0.5 * (2 + _MORE_BOXES) * cell + _REACH * rms - 1e-9)
        box = np.full(max(round(cell * _PHASES), 1), 1.0)
        smooth = box / box.sum()
        for _ in range(_MORE_BOXES - 1):
            smooth = np.convolve(smooth, box / box.sum())
        beyond = 2 * step + len(smooth) // 2 + 1
        # From the pixels about a point to it.
        away = (np.arange(2 * half * _PHASES + 2 * beyond) - beyond + 0.5) / _PHASES - half
        z = (away[:, None] + 0.5 * np.array([width + cell, width - cell, cell - width, -width - cell])) / rms
        steps = ndtr(z)
        integral = rms * (z * steps + np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))
        signs = np.array([1.0, -1.0, -1.0, 1.0]) / (cell * width)

        def bent(line: np.ndarray) -> np.ndarray:
            return (np.roll(line, step) - 2.0 * line + np.roll(line, -step)) * (_PHASES / step) ** 2

        # Less half of its second derivative for the second moment of the further boxes.
        excess = _MORE_BOXES * cell**2 / 12.0
        value, slope = (fftconvolve(v @ signs, smooth, mode="same") for v in (integral, steps))
        lines = [line - 0.5 * excess * bent(line) for line in (value, slope)]
        self._half = half
        tables = np.array([*lines, *map(bent, lines)])[:, beyond : beyond + 2 * half * _PHASES]
        self._tables = np.ascontiguousarray(tables.reshape(4, 2 * half, _PHASES)[:, ::-1], dtype=np.float32)

    def taps(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the kernel and its first three derivatives [4, n_tap, n] at places, and the first pixel of each."""
        low = np.floor(places)
        within = (places - low) * _PHASES
        phase = np.minimum(within.astype(np.int32), _PHASES - 1)
        taps = np.take(self._tables, phase, axis=2)
        # Rounding alone would make likelihoods as rough as their last steps.
        beyond = ((within - phase - 0.5) / _PHASES).astype(np.float32)
        taps[:2] += beyond * taps[1:3]
        return taps, low.astype(np.int32) - (self._half - 1)


class SharpCore:
    """Light on the pixels of a stamp under a Gaussian blur, from cells of the pupil.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the stamp.
    width : float
        Width that a pixel integrates over [pixels].
    rms : float
        Rms of the blur of the detector along each axis [pixels].
    footprint : ndarray, shape [2, 2]
        Sides of the image of a cell [pixels], columns of a matrix.
    """

    def __init__(self, shape: tuple[int, int], width: float, rms: float, footprint: np.ndarray) -> None:
        self._shape, self._width, self._rms = shape, width, rms
        # A rectangle along the axes with the second moments of the cell but for the mixed one, which is a spread.
        self._cell = np.hypot(*footprint.T)
        self._mixed = (footprint @ footprint.T)[0, 1] / 12.0 * np.array([[0.0, 1.0], [1.0, 0.0]])

    def deposit(self, points: np.ndarray, spread: np.ndarray, variance: float) -> Deposit:
        """Return what points add to the pixels of the stamp.

        Points are places (x, y) from the centre of the stamp, spreads their second moments beside the footprint, and
        the variance is that of a further Gaussian blur, all in pixels.
        """
        taps, indices = [], []
        for axis, kernel in enumerate(self._at(variance)):
            count = self._shape[1 - axis]
            # Points far beside the stamp have no light on it.
            values, first = kernel.taps(np.clip(points[:, axis] + 0.5 * (count - 1), -_FAR, count + _FAR))
            taps.append(values)
            index = first + np.arange(values.shape[1], dtype=np.int32)[:, None]
            index[index >= count] = -1
            indices.append(index)
        return Deposit((taps[0], taps[1]), (indices[0], indices[1]), self._shape, spread + self._mixed)

    def _at(self, variance: float) -> list[PixelKernel]:
        """Return the kernels along x and y under a further blur."""
        rms = math.hypot(self._rms, math.sqrt(variance))
        return [_kernel(float(cell), self._width, rms) for cell in self._cell]


@lru_cache(maxsize=16)
def _kernel(cell: float, width: float, rms: float) -> PixelKernel:
    """Return the kernel of one axis: several images in a row have the same."""
    return PixelKernel(cell, width, rms)


class Deposit:
    """What points add to the cells of a grid: products of kernels along x and y.

    Parameters
    ----------
    taps : two ndarray of float32, shape [4, n_tap, n]
        Kernel along x and along y with its first three derivatives.
    indices : two ndarray of int32, shape [n_tap, n]
        Columns and rows of the grid.
    size : tuple of int
        Rows and columns of the grid.
    spread : ndarray, shape [n, 2, 2]
        Second moments of the points beside those of the kernel, which change it by half its second derivatives.
    """

    def __init__(
        self,
        taps: tuple[np.ndarray, np.ndarray],
        indices: tuple[np.ndarray, np.ndarray],
        size: tuple[int, int],
        spread: np.ndarray,
    ) -> None:
        moments = (spread[:, [0, 0, 1], [0, 1, 1]] * [0.5, 1.0, 0.5]).T
        self._count, self._size = len(spread), size
        self._arguments = [
            *(warp_array(v, wp.float32) for v in taps),
            *(warp_array(v, wp.int32) for v in indices),
            size[1],
            warp_array(moments, wp.float32),
        ]

    def light(self, weights: np.ndarray) -> np.ndarray:
        """Return the light of weighted points [n] on the cells, shape [n_cell, 1]."""
        return self.derivatives(weights, np.zeros((2, self._count, 0)), np.zeros((self._count, 0)), 1.0, 1)

    def derivatives(
        self, weights: np.ndarray, response: np.ndarray, rates: np.ndarray, scale: float, head: int = 3
    ) -> np.ndarray:
        """Return the light of points on the cells and its derivatives.

        Parameters
        ----------
        weights : ndarray, shape [n]
            Weights of the points.
        response : ndarray, shape [2, n, k]
            Derivatives of their places by some unknowns.
        rates : ndarray, shape [n, j]
            Derivatives of their weights by others.
        scale : float
            Cells in a unit of the response.
        head : int
            Columns before those of the response.

        Returns
        -------
        ndarray of float32, shape [n_cell, head + k + j]
            The light, its derivatives along x and y, further columns, and the derivatives by the unknowns.
        """
        columns = head + response.shape[2] + rates.shape[1]
        cells = np.zeros((self._size[0] * self._size[1], columns), dtype=np.float32)
        values = (warp_array(v, wp.float32) for v in (weights, response, rates))
        arguments = [*self._arguments, *values, scale, head, warp_array(cells, wp.float32)]
        launch(deposit_points, 1, arguments, threads=1)
        return cells
