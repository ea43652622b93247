r"""Shear of whole images: peaks of the weighted flux, with the change of their detection by shear in the response.

Every pixel p is a candidate. Its functionals M0(p) to M5(p) are those of a galaxy at its centre, and its weight is a
smooth step in M0 times smooth steps in the differences to its four neighbours,

    v_d = M0(p) - M0(p + d),  d = (1, 0), (0, 1), (-1, 0), (0, -1)

over M0 + C, so that the pixels within one or two of each peak of M0 have weight. Under a shear about p, with
y = x - p, the weight of v_d becomes D_j [G(y) - G(y - d)], which gives

    dv_d/dg1 = M1(p + d) - M1(p) + (dx d/dx - dy d/dy) M0(p + d)
    dv_d/dg2 = M2(p + d) - M2(p) + (dy d/dx + dx d/dy) M0(p + d)

with the derivatives of the map M0 along its pixels. The sum over pixels of weight times ellipticity is, for places of
galaxies that are random to a pixel, an integral over p, which a shear of the image about any other point leaves as it
is. Blended galaxies are sheared together, and so belong to the response as single ones do (Sheldon et al. 2020; Li &
Mandelbaum 2023).
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.point_plots import draw_shapes
from ...core.random_streams import stream
from ...core.result import Result
from ...core.threads import one_blas_thread, thread_count
from ...core.units import positive_angle, real_array, require_positive, require_seed
from ..catalogue.pixel_checks import check_pixels
from .estimator import CONSTANT, LEAST_SIDE, checked_psfs, smooth_step
from .functionals import FUNCTIONALS, Frequencies, noise_covariance, psf_frequencies, renoising, weight_transforms
from .noise import CorrelatedNoise, noise_power
from .shear_shapes import ShearShapes
from .weight import weight_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Sides of the cells of an image, each with the PSF that is nearest to its middle [pixel].
CELL = 256
# Least pixels around a cell to which the weights divided by the PSF reach, and to half of which the covariance of the
# noise is summed.
_MARGIN = 32
# Neighbours (dx, dy) in the order of a rotation by 90 degrees.
_NEIGHBOURS = ((1, 0), (0, 1), (-1, 0), (0, -1))
# Half of the range of v/(M0 + C) in which the weight rises, times the square of the width of the weight [pixel^2]. Of a
# point v/M0 times this square is (1 - 2 t)/2 at t pixels from the peak towards the neighbour: the sum over pixels of a
# step as smooth as this depends by one per cent on where between pixels a peak is.
_PEAK_WIDTH = 0.75
# Standard errors by which added noise may lift a pixel over the limits.
_REACH = 5.0
# Distance of peaks from masked pixels and from the border, in widths of the weight.
_CLEARANCE = 4.0

# Farthest place of a PSF [pixel].
_FARTHEST = 1e9

_COUNT = FUNCTIONALS + 3 * len(_NEIGHBOURS)
_DIFFERENCES = np.arange(FUNCTIONALS, FUNCTIONALS + len(_NEIGHBOURS))
_MEASURED = np.concatenate([np.arange(3), _DIFFERENCES])
_DERIVATIVES = np.concatenate([np.arange(1, FUNCTIONALS), np.arange(_DIFFERENCES[-1] + 1, _COUNT)])


@dataclass(frozen=True, eq=False)
class PeakShapes(Result):
    """Pixels at peaks of an image, their ellipticities and responses.

    Parameters
    ----------
    x, y : array
        The pixel [pixel], [n].
    shapes : ShearShapes
        Ellipticities and responses, detection included. Neighbouring pixels share the weight of a peak.
    """

    _table = ("x", "y", "e1", "e2", "weight", "snr")

    x: np.ndarray
    y: np.ndarray
    shapes: ShearShapes

    def __len__(self) -> int:
        return len(self.x)

    @property
    def e1(self) -> np.ndarray:
        """Weight times ellipticity along x."""
        return self.shapes.e1

    @property
    def e2(self) -> np.ndarray:
        """Weight times ellipticity along x = y."""
        return self.shapes.e2

    @property
    def weight(self) -> np.ndarray:
        """Weight of the selection and of the peak, 0 to 1."""
        return self.shapes.weight

    @property
    def snr(self) -> np.ndarray:
        """M0 over its standard error."""
        return self.shapes.snr

    def at_objects(self, x: ArrayLike, y: ArrayLike) -> ShearShapes:
        """Return the sums over the peaks that are nearest to each object.

        Objects are places of the sums alone: their detection changes no sum over all of them.

        Parameters
        ----------
        x, y : array
            Places of the objects [pixel], [n], at least one.

        Raises
        ------
        DomainError
            If there is no peak.
        """
        if not len(self):
            raise DomainError("no peaks: expected some apart from masked pixels and the border")
        places = np.stack([real_array(v, f"{name}: expected real numbers") for v, name in ((x, "x"), (y, "y"))], axis=1)
        nearest = cKDTree(places).query(np.stack([self.x, self.y], axis=1))[1]
        columns = np.vstack([self.shapes.sums.T, self.weight, self.weight * self.snr])
        e1, e2, r11, r12, r22, weight, snr = (np.bincount(nearest, values, len(places)) for values in columns)
        mean_snr = np.divide(snr, weight, out=np.zeros_like(snr), where=weight > 0.0)
        return ShearShapes(e1, e2, r11, r12, r22, weight, mean_snr)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by S/N."""
        return draw_shapes(ax, self.e1, self.e2, self.snr, "S/N of M0")


@check_arguments
def detect_shear(
    image: ArrayLike,
    psf_images: ArrayLike,
    pixel_scale: ArrayLike,
    noise: float | CorrelatedNoise,
    *,
    psf_positions: ArrayLike | None = None,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
    sigma: ArrayLike | None = None,
    seed: int | None = None,
    min_snr: float = 10.0,
    threads: int | None = None,
) -> PeakShapes:
    """Detect peaks on an image, with ellipticities and responses that hold noise, detection and blends.

    Parameters
    ----------
    image : array
        [ny, nx], background subtracted.
    psf_images : array
        PSFs [n, m, m], or one [m, m]: unit sum, m odd, centred on a pixel, pixel included.
    pixel_scale : float or Quantity
        Side of a pixel [rad].
    noise : float or CorrelatedNoise
        White noise: rms of a pixel, in the unit of the image. Or noise with correlations of pixels.
    psf_positions : array, optional
        Places (x, y) of the PSFs [pixel], [n, 2]: squares of 256 pixels have that of the nearest.
    mask : array, optional
        [ny, nx], not zero for pixels without value; peaks within four widths of the weight are left out.
    sigma : float or Quantity, optional
        rms width of the weight before the PSF [rad]; by default as of :class:`ShearEstimator`.
    seed : int, optional
        Seed of the noise that is added to the functionals; by default none is, for images without noise. Images under
        a shear and its opposite take the same one.
    min_snr : float
        S/N of the weighted flux from which peaks have weight; four above it all of it.
    threads : int, optional
        All processors by default. No byte depends on it.

    Raises
    ------
    DomainError
        If shapes differ, the noise is not positive, places of several PSFs
        are missing, or a PSF is too wide for the weight.
    """
    pixels, _, ignored = check_pixels(image, 1.0, mask)
    psfs = checked_psfs(psf_images)
    scale = positive_angle(pixel_scale, "pixel_scale")
    width = weight_width(sigma, psfs, scale)
    if not isinstance(noise, CorrelatedNoise):
        require_positive(noise, "noise")
    limit = require_positive(min_snr, "min_snr")
    cells = list(_cells(pixels.shape))
    psf_rows = _nearest_psfs(pixels.shape, len(psfs), psf_positions)
    clear = _clear_pixels(ignored, int(np.ceil(_CLEARANCE * width)))
    used, index = np.unique(psf_rows, return_inverse=True)
    detector = _Detector.of(psfs[used], width, noise, limit)
    noise_seed = None if seed is None else require_seed(seed)
    measure = partial(_measure_cell, detector, np.where(ignored, 0.0, pixels), clear, noise_seed)
    with ThreadPoolExecutor(thread_count(threads)) as pool:
        parts = list(pool.map(measure, range(len(cells)), cells, index))
    x, y = (np.concatenate([np.zeros(0), *(part[k] for part in parts)]) for k in (0, 1))
    return PeakShapes(x, y, ShearShapes.joined([part[2] for part in parts]))


@dataclass(frozen=True, eq=False)
class _Detector:
    """Transforms on the grid of a cell, and noise, of each PSF."""

    frequencies: Frequencies
    weights: np.ndarray  #: transforms of the six weights [6, ny, nx]
    inverse: np.ndarray  #: inverse transforms of the PSFs [n, ny, nx]
    errors: np.ndarray  #: standard errors of the functionals [n, 18]
    noise: tuple[np.ndarray, np.ndarray]  #: matrices of :func:`renoising`
    min_snr: float
    margin: int  #: pixels around a cell
    peak_width: float  #: half of the range of v/(M0 + C) in which the weight rises

    @classmethod
    def of(cls, psfs: np.ndarray, sigma: float, noise: float | CorrelatedNoise, min_snr: float) -> _Detector:
        """Prepare the PSFs [n, m, m]."""
        margin = max(_MARGIN, int(np.ceil(0.5 * LEAST_SIDE * sigma)))
        grid, inverse = psf_frequencies(psfs, CELL + 2 * margin, sigma)
        small, small_inverse = psf_frequencies(psfs, 2 * margin, sigma)
        weights = _peak_transforms(small, sigma)
        power = noise_power(noise, len(psfs), small)
        covariance = noise_covariance(weights, small_inverse, power, small)
        # A rotation by 90 degrees changes signs of M1 and M2, and takes each neighbour to the one before it.
        turn = np.zeros((len(_MEASURED), len(_MEASURED)))
        turn[np.arange(3), np.arange(3)] = 1.0, -1.0, -1.0
        turn[3 + np.arange(4), 3 + (np.arange(4) - 1) % 4] = 1.0
        with one_blas_thread():
            noise_matrices = renoising(covariance, _MEASURED, _DERIVATIVES, turn)
        errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return cls(
            grid,
            weight_transforms(grid, sigma),
            inverse,
            errors,
            noise_matrices,
            min_snr,
            margin,
            _PEAK_WIDTH / sigma**2,
        )

    def maps(self, image: np.ndarray, psf: int) -> np.ndarray:
        """Return the maps M0 to M5, dM0/dx and dM0/dy of a square image, [8, side, side]."""
        grid = self.frequencies
        spectrum = grid.of(image[None])[0] * self.inverse[psf]
        products = [*(self.weights * spectrum), *(1j * k * self.weights[0] * spectrum for k in (grid.kx, grid.ky))]
        full = np.zeros((len(products), grid.side, grid.side // 2 + 1), dtype=np.complex128)
        full[:, : grid.most + 1, : grid.most + 1] = np.stack(products)[:, grid.most :]
        full[:, grid.side - grid.most :, : grid.most + 1] = np.stack(products)[:, : grid.most]
        return fft.irfft2(full, s=(grid.side, grid.side), workers=1)

    def functionals(self, maps: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the functionals at pixels, [n, 18]: M0 to M5, v, dv/dg1, dv/dg2."""
        at = maps[:, rows, columns]
        values = [*at[:FUNCTIONALS]]
        near = [maps[:, rows + dy, columns + dx] for dx, dy in _NEIGHBOURS]
        values += [at[0] - there[0] for there in near]
        for k, gradients in ((1, ((1, 0), (0, -1))), (2, ((0, 1), (1, 0)))):
            for (dx, dy), there in zip(_NEIGHBOURS, near, strict=True):
                along_x, along_y = (dx * a + dy * b for a, b in zip(*gradients, strict=True))
                values.append(there[k] - at[k] + along_x * there[6] + along_y * there[7])
        return np.stack(values, axis=1)

    def shapes(self, measured: np.ndarray, derivatives: np.ndarray, errors: np.ndarray) -> ShearShapes:
        """Return shapes from functionals T [n, 7] and the derivatives D [n, 13]."""
        denominator = measured[:, 0] + CONSTANT * errors[0]
        e = [measured[:, k] / denominator for k in (1, 2)]
        snr = measured[:, 0] / errors[0]
        weight, slope = smooth_step(snr, self.min_snr, 4.0)
        ratios = measured[:, 3:] / denominator[:, None]
        steps, step_slopes = smooth_step(ratios, -self.peak_width, 2.0 * self.peak_width)
        peak = steps.prod(axis=1)
        # Of the product of all but one, which may be zero.
        others = np.stack([np.delete(steps, k, axis=1).prod(axis=1) for k in range(steps.shape[1])], axis=1)
        changes = []
        for j in range(2):
            of_snr = -derivatives[:, j] / errors[0]
            # dM0/dg is -M1 along x, -M2 along x = y.
            ratio_changes = derivatives[:, 5 + 4 * j : 9 + 4 * j] + ratios * derivatives[:, j, None]
            of_peak = (others * step_slopes * ratio_changes).sum(axis=1) / denominator
            changes.append(slope * of_snr * peak + weight * of_peak)
        weight = weight * peak
        # Columns of D: M1 to M5. dM1/dg1, dM1/dg2, dM2/dg1, dM2/dg2 are M3, M5, M5, M4.
        r = {
            (i, j): weight * (derivatives[:, change] + e[i] * derivatives[:, j]) / denominator + e[i] * changes[j]
            for i, j, change in ((0, 0, 2), (0, 1, 4), (1, 0, 4), (1, 1, 3))
        }
        return ShearShapes(weight * e[0], weight * e[1], r[0, 0], 0.5 * (r[0, 1] + r[1, 0]), r[1, 1], weight, snr)


def _peak_transforms(frequencies: Frequencies, sigma: float) -> np.ndarray:
    """Return the transforms of the weights of all functionals of a peak, complex [18, ny, nx]."""
    weights = weight_transforms(frequencies, sigma).astype(np.complex128)
    kx, ky = frequencies.kx, frequencies.ky
    shifts = [np.exp(-1j * (kx * dx + ky * dy)) for dx, dy in _NEIGHBOURS]
    transforms = [*weights, *(weights[0] * (1.0 - shift) for shift in shifts)]
    for k, gradients in ((1, ((1, 0), (0, -1))), (2, ((0, 1), (1, 0)))):
        for (dx, dy), shift in zip(_NEIGHBOURS, shifts, strict=True):
            along_x, along_y = (dx * a + dy * b for a, b in zip(*gradients, strict=True))
            # The functional of dM0/dx at a place has the weight -dG/dx.
            gradient = -1j * (along_x * kx + along_y * ky) * weights[0]
            transforms.append(weights[k] * (shift - 1.0) + gradient * shift)
    return np.stack(transforms)


def _measure_cell(
    detector: _Detector,
    image: np.ndarray,
    clear: np.ndarray,
    seed: int | None,
    number: int,
    cell: tuple[int, int],
    psf: int,
) -> tuple[np.ndarray, np.ndarray, ShearShapes]:
    """Return places and shapes of the candidates of one cell, whose first pixel is (row, column)."""
    (first_row, first_column), margin = cell, detector.margin
    height, width = (min(CELL, n - first) for n, first in zip(image.shape, cell, strict=True))
    window = np.zeros((detector.frequencies.side,) * 2)
    low = [max(0, first - margin) for first in cell]
    high = [min(n, first + CELL + margin) for n, first in zip(image.shape, cell, strict=True)]
    start = [a - (first - margin) for a, first in zip(low, cell, strict=True)]
    rows, columns = (slice(s, s + b - a) for s, a, b in zip(start, low, high, strict=True))
    window[rows, columns] = image[low[0] : high[0], low[1] : high[1]]
    maps = detector.maps(window, psf)
    errors = detector.errors[psf]
    reach = 0.0 if seed is None else _REACH
    flux = maps[0, margin : margin + height, margin : margin + width] / errors[0]
    bright = (flux > detector.min_snr - reach) & clear[
        first_row : first_row + height, first_column : first_column + width
    ]
    rows_in, columns_in = np.nonzero(bright)
    values = detector.functionals(maps, rows_in + margin, columns_in + margin)
    lowest = detector.peak_width * (values[:, 0] + (CONSTANT + reach) * errors[0])
    differences = values[:, _DIFFERENCES] + reach * errors[_DIFFERENCES]
    candidates = (differences > -lowest[:, None]).all(axis=1)
    rows_in, columns_in, values = rows_in[candidates], columns_in[candidates], values[candidates]
    measured, derivatives = values[:, _MEASURED], values[:, _DERIVATIVES]
    if seed is None:
        shapes = detector.shapes(measured, derivatives, errors)
    else:
        # A number for every pixel of the cell, so that images under a shear and its opposite have the same noise.
        normal = stream(seed, "peaks", number).standard_normal((height, width, len(_MEASURED)), np.float32)
        normal = normal[rows_in, columns_in].astype(np.float64)
        added, subtracted = (np.einsum("ij,nj->ni", matrix[psf], normal) for matrix in detector.noise)
        pair = [
            detector.shapes(measured + sign * added, derivatives - sign * subtracted, errors) for sign in (1.0, -1.0)
        ]
        shapes = ShearShapes(*(0.5 * (getattr(pair[0], c) + getattr(pair[1], c)) for c in ShearShapes._table))
    selected = shapes.weight > 0.0
    x, y = columns_in[selected] + float(first_column), rows_in[selected] + float(first_row)
    return x, y, shapes.take(selected)


def cell_middles(shape: tuple[int, ...]) -> np.ndarray:
    """Return the middles (x, y) of the squares of an image that have one PSF each, [n, 2] pixel."""
    middles = np.array(list(_cells(shape)), dtype=np.float64)[:, ::-1] + 0.5 * (CELL - 1)
    return np.minimum(middles, np.array(shape[::-1]) - 1.0)


def _cells(shape: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Yield the first row and column of each cell of an image."""
    for row in range(0, shape[0], CELL):
        for column in range(0, shape[1], CELL):
            yield row, column


def _nearest_psfs(shape: tuple[int, ...], count: int, positions: ArrayLike | None) -> np.ndarray:
    """Return the PSF nearest to the middle of each cell."""
    if positions is None:
        if count > 1:
            raise DomainError(f"psf_positions: expected the places of {count} PSFs", key="psf_positions")
        return np.zeros(len(list(_cells(shape))), dtype=np.int64)
    places = real_array(positions, "psf_positions: expected real numbers [n, 2]")
    if places.shape != (count, 2) or not np.all(np.abs(places) < _FARTHEST):
        raise DomainError(f"psf_positions have shape {places.shape}: expected pixels [{count}, 2] below {_FARTHEST:g}")
    return np.asarray(cKDTree(places).query(cell_middles(shape))[1], dtype=np.int64)


def _clear_pixels(ignored: np.ndarray, clearance: int) -> np.ndarray:
    """Return pixels that are at least a clearance from masked ones and from the border."""
    blocked = ignored.copy()
    blocked[[0, -1]] = blocked[:, [0, -1]] = True
    return np.asarray(maximum_filter(blocked, size=2 * clearance + 1, mode="constant", cval=True) == 0)
