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

#: Places within a pixel at which kernels are tabulated; between them they are straight.
_PHASES = 256
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
        self._tables = [
            line[beyond : beyond + 2 * half * _PHASES].reshape(2 * half, _PHASES)[::-1].astype(np.float32)
            for line in (*lines, *map(bent, lines))
        ]

    @property
    def margin(self) -> int:
        """Pixels that a point just inside of a stamp reaches beyond it."""
        return self._half

    def taps(self, places: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the kernel and its first three derivatives [n_tap, n] at places, and the first pixel of each [n]."""
        low = np.floor(places)
        within = (places - low) * _PHASES
        phase = np.minimum(within.astype(np.int32), _PHASES - 1)
        value, slope, bend, twist = (table[:, phase] for table in self._tables)
        # Rounding alone would make likelihoods as rough as their last steps.
        beyond = ((within - phase - 0.5) / _PHASES).astype(np.float32)
        value += beyond * slope
        slope += beyond * bend
        return [value, slope, bend, twist], low.astype(np.int32) - (self._half - 1)


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
    widest : float
        Largest variance of a further Gaussian blur [pixels^2].
    """

    def __init__(self, shape: tuple[int, int], width: float, rms: float, footprint: np.ndarray, widest: float) -> None:
        self._shape, self._width, self._rms = shape, width, rms
        # A rectangle along the axes with the second moments of the cell but for the mixed one, which is a spread.
        self._cell = np.hypot(*footprint.T)
        self._mixed = (footprint @ footprint.T)[0, 1] / 12.0 * np.array([[0.0, 1.0], [1.0, 0.0]])
        self._margin = max(kernel.margin for kernel in self._at(widest))
        self._size = (shape[0] + 2 * self._margin, shape[1] + 2 * self._margin)

    def deposit(self, points: np.ndarray, spread: np.ndarray, variance: float) -> Deposit:
        """Return what points add to the pixels of the stamp and of a margin.

        Points are places (x, y) from the centre of the stamp, spreads their second moments beside the footprint, and
        the variance is that of a further Gaussian blur, all in pixels.
        """
        taps, indices = [], []
        for axis, kernel in enumerate(self._at(variance)):
            count = self._size[1 - axis]
            values, first = kernel.taps(np.clip(points[:, axis] + 0.5 * (count - 1), -1.0, count))
            taps.append(values)
            # Light beside the stamp stays in its margin.
            index = first + np.arange(len(values[0]), dtype=np.int32)[:, None]
            indices.append(np.clip(index, 0, count - 1))
        return Deposit((taps[0], taps[1]), (indices[0], indices[1]), self._size, spread + self._mixed)

    def pixels(self, deposited: np.ndarray) -> np.ndarray:
        """Return the pixels of the stamp [ny, nx, k] of sums of deposits [n_cell, k]."""
        rows, columns = (slice(self._margin, self._margin + n) for n in self._shape)
        return np.asarray(deposited.reshape(*self._size, -1)[rows, columns])

    def _at(self, variance: float) -> list[PixelKernel]:
        """Return the kernels along x and y under a further blur."""
        rms = math.hypot(self._rms, math.sqrt(variance))
        return [PixelKernel(cell, self._width, rms) for cell in self._cell]


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
