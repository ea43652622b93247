r"""Image of a star from landing points: spline deposit, transfer functions, exact derivatives.

Light lands at points :math:`x_n` with weights :math:`w_n`. Each point is deposited on a grid as a cubic B-spline; the
transform of the grid is divided by that of the spline, and multiplied by those of pixel, detector and atmosphere: the
image at the centres of the pixels, integrated over them. Columns of derivatives go the same way, with the gradient of
the spline and :math:`w_n\, \partial x_n / \partial a`: they are the derivatives of the image itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.sparse import csc_array

from ...wavefront.psf.image_plane import square_transfer
from .seeing import Seeing

#: Unknowns of every star before those of its wavefront: flux [electrons], x and y of the chief ray from the centre of
#: the stamp [pixels], background [electrons a pixel], strength of the turbulence [1/m].
NUISANCES = ("flux", "x", "y", "background", "strength")
#: Further unknowns where there is a second star: its flux over that of the first, and its offset [pixels].
COMPANION = ("ratio", "offset_x", "offset_y")
FLUX, X, Y, BACKGROUND, STRENGTH, RATIO = range(6)


@dataclass(frozen=True)
class LandedLight:
    """Light of a star on its detector.

    Attributes
    ----------
    landing : ndarray, shape [n, 2]
        Landing points from that of the chief ray [m].
    weights : ndarray, shape [n]
        Fractions of the light.
    spread : ndarray, shape [n, 2, 2]
        Second moments of the image of each point, beside the footprint [m^2].
    """

    landing: np.ndarray
    weights: np.ndarray
    spread: np.ndarray


class ImageGrid:
    """Grid and transfer functions of the images of one star on stamps of one size.

    Parameters
    ----------
    shape : tuple of int
        Pixels of the stamp, (ny, nx).
    pixel : float
        Distance between the pixels of the stamp [m].
    side : float
        Side of a pixel of the detector [m].
    seeing : Seeing
        The long exposure.
    jacobian : ndarray, shape [2, 2]
        Detector position by direction cosines [m].
    blur : float
        Rms of a Gaussian blur along each axis [m].
    footprint : ndarray, shape [2, 2]
        Sides of the image of a cell of the pupil [m], columns of a matrix.
    oversampling : int
        Cells of the grid along a pixel.
    reach : float
        Distance from the stamp within which light is kept from wrapping around [m].
    """

    def __init__(
        self,
        shape: tuple[int, int],
        pixel: float,
        side: float,
        seeing: Seeing,
        jacobian: np.ndarray,
        blur: float,
        footprint: np.ndarray,
        oversampling: int,
        reach: float,
    ) -> None:
        self.shape, self.pixel, self.footprint = shape, pixel, footprint
        self.oversampling, self.reach = oversampling, reach
        margin = max(8, math.ceil(reach / pixel))
        self._size = tuple(fft.next_fast_len(oversampling * (n + margin), real=True) for n in shape)
        #: Place of the centre of the stamp on the grid, (y, x) cells.
        self._middle = [0.5 * (n - 1) * oversampling for n in shape]
        turns = [fft.fftfreq(self._size[0]), fft.rfftfreq(self._size[1])]  # cycles a cell
        y, x = np.meshgrid(*turns, indexing="ij")
        self._phase = -2.0 * math.pi * oversampling * np.stack([x, y])  # for shifts in pixels
        wave = 2.0 * math.pi * oversampling / pixel * np.stack([x, y])  # rad/m
        baseline = np.hypot(*np.tensordot(jacobian.T, wave, axes=1)) * seeing.wavelength / (2.0 * math.pi)
        self._exponent = seeing.exponent(baseline)
        spline = (np.sinc(x) * np.sinc(y)) ** 4
        cell = np.prod(np.sinc(np.tensordot(footprint.T, wave, axes=1) / (2.0 * math.pi)), axis=0)
        # A cell of the grid holds less light than a pixel.
        self._detector = (
            oversampling**2
            * square_transfer(wave[0], wave[1], side)
            * np.exp(-0.5 * blur**2 * (wave**2).sum(axis=0))
            * cell
            / spline
        )

    def _deposit(self, points: np.ndarray, spread: np.ndarray) -> tuple[csc_array, csc_array, csc_array]:
        """Return the spline and its derivatives along x and y [1/pixel] at points [n, 2] as sparse matrices.

        Spreads [n, 2, 2] of the points, in pixels as they are, change the spline by half its second derivatives.
        """
        values, indices = [], []
        for axis in (0, 1):
            place = self._middle[1 - axis] + self.oversampling * points[:, axis]
            low = np.floor(place)
            t = (place - low)[:, None]
            powers = np.concatenate([np.ones_like(t), t, t * t, t**3], axis=1)
            # The spline and its first three derivatives, per pixel.
            values.append([self.oversampling**k * (powers[:, : 4 - k] @ _SPLINES[k]) for k in range(4)])
            indices.append((low.astype(np.int64)[:, None] + np.arange(-1, 3)) % self._size[1 - axis])
        cells = (indices[1][:, :, None] * self._size[1] + indices[0][:, None, :]).reshape(-1).astype(np.int32)
        starts = np.arange(0, cells.size + 1, 16, dtype=np.int32)
        shape = (self._size[0] * self._size[1], len(points))

        def taps(along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
            return np.asarray(along_y[:, :, None] * along_x[:, None, :])

        def matrix(values: np.ndarray) -> csc_array:
            return csc_array((values.astype(np.float32).ravel(), cells, starts), shape=shape)

        x, y = values
        (xx, xy), (_, yy) = np.moveaxis(spread, 0, -1)[..., None]

        def spline(i: int, j: int) -> csc_array:
            """Return the derivative of order i along x and j along y."""
            wide_x = x[i] + 0.5 * xx * x[i + 2]
            return matrix(taps(wide_x, y[j]) + taps(x[i], 0.5 * yy * y[j + 2]) + taps(xy * x[i + 1], y[j + 1]))

        return spline(0, 0), spline(1, 0), spline(0, 1)

    def _pixels(self, spectra: np.ndarray) -> np.ndarray:
        """Return the pixels of spectra [ky, kx, n], shape [ny, nx, n]."""
        images = fft.irfft2(spectra, s=self._size, axes=(0, 1))
        step = self.oversampling
        return np.asarray(images[: self.shape[0] * step : step, : self.shape[1] * step : step])

    def image(self, unknowns: np.ndarray, light: LandedLight) -> np.ndarray:
        """Return the image [electrons], shape [ny, nx]; arguments as in :meth:`derivatives`."""
        spectrum, shift = self._spectra(unknowns, light, None)
        if shift is not None:
            spectrum *= 1.0 + unknowns[RATIO] * shift
        return np.asarray(unknowns[FLUX] * self._pixels(spectrum)[..., 0].astype(np.float64) + unknowns[BACKGROUND])

    def derivatives(
        self, unknowns: np.ndarray, light: LandedLight, response: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the image and its derivatives.

        Parameters
        ----------
        unknowns : ndarray, shape [5] or [8]
            Values of :data:`NUISANCES`, and of :data:`COMPANION` where there is a second star.
        light : LandedLight
            Landing points of the light.
        response : ndarray, shape [2, n, n_wave]
            Derivatives of the landing points with respect to the unknowns of the wavefront [m].

        Returns
        -------
        image : ndarray, shape [ny, nx]
            Electrons a pixel.
        columns : ndarray of float32, shape [ny, nx, n_unknown + n_wave]
            Derivatives by the unknowns, then by those of the wavefront, over their scales.
        scales : ndarray, shape [n_unknown + n_wave]
            Scales of the columns.
        """
        flux, strength = unknowns[FLUX], unknowns[STRENGTH]
        spectra, shift = self._spectra(unknowns, light, response)
        star, moved = spectra[..., :1], spectra[..., 1:]
        extra = []
        if shift is not None:
            second = star * shift
            turns = [(1j * unknowns[RATIO] * p).astype(np.complex64)[..., None] for p in self._phase]
            extra = [second, *(turn * second for turn in turns)]
            both = 1.0 + np.float32(unknowns[RATIO]) * shift
            star, moved = star * both, moved * both
        level = np.zeros_like(star)
        level[0, 0] = self._size[0] * self._size[1]
        growth = (-5.0 / 3.0 * self._exponent * strength ** (2.0 / 3.0)).astype(np.float32)[..., None]
        columns = self._pixels(
            np.concatenate([star, moved[..., :2], level, growth * star, *extra, moved[..., 2:]], axis=-1)
        )
        scales = np.full(columns.shape[-1], flux)
        scales[[FLUX, BACKGROUND]] = 1.0
        return flux * columns[..., FLUX].astype(np.float64) + unknowns[BACKGROUND], columns, scales

    def _spectra(
        self, unknowns: np.ndarray, light: LandedLight, response: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return spectra of a star of unit flux and its derivatives by x, y and wave, and the shift of a second one."""
        points = light.landing / self.pixel + unknowns[[X, Y]]
        value, along_x, along_y = self._deposit(points, light.spread / self.pixel**2)
        weights = light.weights.astype(np.float32)[:, None]
        deposits = [value @ weights]
        if response is not None:
            moved = (response / self.pixel * light.weights[:, None]).astype(np.float32)
            deposits += [along_x @ weights, along_y @ weights, along_x @ moved[0] + along_y @ moved[1]]
        spectra = fft.rfft2(np.concatenate(deposits, axis=1).reshape(*self._size, -1), axes=(0, 1))
        turbulence = np.exp(-self._exponent * unknowns[STRENGTH] ** (5.0 / 3.0))
        spectra *= (self._detector * turbulence).astype(np.float32)[..., None]
        if len(unknowns) <= RATIO:
            return spectra, None
        turn = np.exp(1j * np.tensordot(unknowns[RATIO + 1 :], self._phase, axes=1))
        return spectra, turn.astype(np.complex64)[..., None]


# Cubic B-spline at t - 1 ... t + 2 by powers of t, 0 <= t < 1, and its derivatives with respect to the point's place.
_SPLINES = [np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0]
for _ in range(3):
    _SPLINES.append(_SPLINES[-1][1:] * np.arange(1, len(_SPLINES[-1]))[:, None])
