r"""Light of sharp images on pixels: the integral of each cell's own image over each pixel, without a finer grid.

An evenly lit rectangle has on a pixel, after a Gaussian blur, a product over the axes of second differences of
:math:`F(z) = z\,\Phi(z / \sigma) + \sigma\,\varphi(z / \sigma)`, the second integral of the Gaussian; without blur it
is the area that the two share. The images of cells are quadratic B-splines, such rectangles blurred twice more by
themselves, so that cells whose spacing is not quite the mean one add up to even light; the second moment that this adds
is taken off again. The values are tabulated by the place of the cell within a pixel.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import fftconvolve
from scipy.sparse import csc_array
from scipy.special import ndtr

#: Places within a pixel at which kernels are tabulated: rounding moves a cell by 3e-4 pixels rms.
_PHASES = 1024
#: Widths of the Gaussian beyond which its light is left out: 1e-4 of it.
_REACH = 3.7
#: Boxes that an evenly lit cell is convolved with: with two, cells whose images stand a few per cent nearer to each
#: other than the mean still add up to even light, to 1e-4; one box leaves that difference itself.
_MORE_BOXES = 2
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
        #: Second moment of the kernel beyond that of an evenly lit cell, pixel and blur [pixels^2].
        self.excess = _MORE_BOXES * cell**2 / 12.0
        # Second derivatives are those of a point that is divided in two.
        step = max(round(0.5 * cell * _PHASES), 1)
        half = math.ceil(0.5 * width + 0.5 * (1 + _MORE_BOXES) * cell + _REACH * rms - 1e-9)
        box = np.full(max(round(cell * _PHASES), 1), 1.0)
        smooth = box / box.sum()
        for _ in range(_MORE_BOXES - 1):
            smooth = np.convolve(smooth, box / box.sum())
        beyond = step + len(smooth) // 2 + 1
        # From the pixels about a point to it.
        away = (np.arange(2 * half * _PHASES + 2 * beyond) - beyond + 0.5 * (1 + len(smooth) % 2)) / _PHASES - half
        z = (away[:, None] + 0.5 * np.array([width + cell, width - cell, cell - width, -width - cell])) / rms
        steps = ndtr(z)
        integral = rms * (z * steps + np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))
        signs = np.array([1.0, -1.0, -1.0, 1.0]) / (cell * width)
        inside = slice(beyond, beyond + 2 * half * _PHASES)
        value, slope = (fftconvolve(v @ signs, smooth, mode="same") for v in (integral, steps))
        bends = [
            (v[beyond + step :][: 2 * half * _PHASES] - 2.0 * v[inside] + v[beyond - step :][: 2 * half * _PHASES])
            * (_PHASES / step) ** 2
            for v in (value, slope)
        ]
        self._half = half
        self._tables = [
            v.reshape(2 * half, _PHASES)[::-1].astype(np.float32) for v in (value[inside], slope[inside], *bends)
        ]

    @property
    def margin(self) -> int:
        """Pixels that a point just inside of a stamp reaches beyond it."""
        return self._half

    def taps(self, places: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the kernel and its first three derivatives [n_tap, n] at places, and the first pixel of each [n]."""
        low = np.floor(places)
        phase = np.minimum(((places - low) * _PHASES).astype(np.int32), _PHASES - 1)
        return [table[:, phase] for table in self._tables], low.astype(np.int32) - (self._half - 1)


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
        self._variance, self._kernels = -1.0, [PixelKernel(c, width, rms) for c in self._cell]

    def deposit(self, points: np.ndarray, spread: np.ndarray, variance: float) -> Deposit:
        """Return what points add to the pixels of the stamp and of a margin.

        Points are places (x, y) from the centre of the stamp, spreads their second moments beside the footprint, and
        the variance is that of a further Gaussian blur, all in pixels.
        """
        if variance != self._variance:
            rms = math.hypot(self._rms, math.sqrt(variance))
            self._variance, self._kernels = variance, [PixelKernel(c, self._width, rms) for c in self._cell]
        taps, indices = [], []
        for axis, kernel in enumerate(self._kernels):
            margin, count = self._margins[1 - axis], self._size[1 - axis]
            place = np.clip(points[:, axis] + (0.5 * (self._shape[1 - axis] - 1) + margin), -1.0, count)
            values, first = kernel.taps(place)
            taps.append(values)
            # Light beside the stamp stays in its margin.
            index = first + np.arange(len(values[0]), dtype=np.int32)[:, None]
            indices.append(np.clip(index, 0, count - 1))
        return Deposit((taps[0], taps[1]), (indices[0], indices[1]), self._size, spread + self._moments)

    def pixels(self, deposited: np.ndarray) -> np.ndarray:
        """Return the pixels of the stamp [ny, nx, k] of sums of deposits [n_cell, k]."""
        rows, columns = (slice(m, m + n) for m, n in zip(self._margins, self._shape, strict=True))
        return deposited.reshape(*self._size, -1)[rows, columns]

    @property
    def _moments(self) -> np.ndarray:
        return np.asarray(self._mixed - np.diag([kernel.excess for kernel in self._kernels]))

    @property
    def _margins(self) -> tuple[int, int]:
        return self._kernels[1].margin, self._kernels[0].margin

    @property
    def _size(self) -> tuple[int, int]:
        down, across = self._margins
        return self._shape[0] + 2 * down, self._shape[1] + 2 * across


class Deposit:
    """What points add to the cells of a grid: products of kernels along x and y.

    Parameters
    ----------
    taps : two lists of four ndarray, shape [n_tap, n]
        Kernel along x and along y with its first three derivatives.
    indices : two ndarray of int, shape [n_tap, n]
        Columns and rows of the grid.
    size : tuple of int
        Rows and columns of the grid.
    spread : ndarray, shape [n, 2, 2]
        Second moments of the points beside those of the kernel, which change it by half its second derivatives.
    """

    def __init__(
        self,
        taps: tuple[list[np.ndarray], list[np.ndarray]],
        indices: tuple[np.ndarray, np.ndarray],
        size: tuple[int, int],
        spread: np.ndarray,
    ) -> None:
        (self._x, self._y), self._cell_count, self._count = taps, size[0] * size[1], len(spread)
        self._cells = _by_point(indices[1][:, None] * np.int32(size[1]) + indices[0])
        self._taps = len(indices[0]) * len(indices[1])
        self._spread = (spread[:, [0, 0, 1], [0, 1, 1]] * [0.5, 1.0, 0.5]).astype(np.float32).T

    def matrix(self, i: int, j: int) -> csc_array:
        """Return the derivative of order i along x and j along y, 0 or 1, as a sparse matrix [n_cell, n]."""
        return self._matrix(self._values(i, j, 1))

    def gradient(self, weights: np.ndarray) -> csc_array:
        """Return the derivatives along x and then along y of weighted points, shape [n_cell, 2 * n]."""
        return self._matrix(self._values(1, 0, weights), self._values(0, 1, weights))

    def laplacian(self) -> csc_array:
        """Return the sum of the second derivatives, without the spreads, shape [n_cell, n]."""
        return self._matrix(_by_point(self._y[0][:, None] * self._x[2] + self._y[2][:, None] * self._x[0]))

    def _values(self, i: int, j: int, weights: np.ndarray | int) -> np.ndarray:
        x, y, (half_xx, xy, half_yy) = self._x, self._y, self._spread
        values = ((y[j] + half_yy * y[j + 2]) * weights)[:, None] * (x[i] + half_xx * x[i + 2])
        values += (y[j + 1] * (xy * weights))[:, None] * x[i + 1]
        return _by_point(values)

    def _matrix(self, *parts: np.ndarray) -> csc_array:
        n = len(parts) * self._count
        starts = np.arange(n + 1, dtype=np.int32) * np.int32(self._taps)
        values, cells = (v[0] if len(parts) == 1 else np.concatenate(v) for v in (parts, len(parts) * (self._cells,)))
        return csc_array((values, cells, starts), shape=(self._cell_count, n))


def _by_point(taps: np.ndarray) -> np.ndarray:
    """Return values of the cells of n points, shape [rows, columns, n], point by point, flat."""
    return np.ascontiguousarray(taps.reshape(-1, taps.shape[-1]).T).ravel()
