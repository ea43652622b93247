r"""Image of a star from landing points: spline deposit, transfer functions, exact derivatives.

Light lands at points :math:`x_n` with weights :math:`w_n`. Each point is deposited on a grid as a cubic B-spline; the
transform of the grid is divided by that of the spline, and multiplied by those of pixel, detector and atmosphere: the
image at the centres of the pixels, integrated over them. Columns of derivatives go the same way, with the gradient of
the spline and :math:`w_n\, \partial x_n / \partial a`: they are the derivatives of the image itself.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.sparse import csc_array

from ..wavefront.psf.image_plane import square_transfer
from ..wavefront.psf.pupil_rims import PupilRims
from .rim_light import RimLight, RimsAt
from .seeing import Seeing
from .stamps import Pixels

#: Unknowns of every star before those of its wavefront: flux [electrons], x and y of the chief ray from the centre of
#: the detector's stamp [its pixels], background there [electrons a pixel of these], strength of the turbulence [1/m],
#: slopes of the background along x and y [electrons a pixel, per pixel].
NUISANCES = ("flux", "x", "y", "background", "strength", "slope_x", "slope_y")
#: Further unknowns of each neighbour: its flux over that of the star, and its place from it [pixels].
NEIGHBOUR = ("ratio", "offset_x", "offset_y")
#: Most neighbours of a star.
MOST_NEIGHBOURS = 5
FLUX, X, Y, BACKGROUND, STRENGTH, SLOPE_X, SLOPE_Y, RATIO = range(8)


def neighbours_of(unknowns: np.ndarray) -> np.ndarray:
    """Return a view of the unknowns of the neighbours of a star, shape [n_neighbour, 3]."""
    return unknowns[RATIO:].reshape(-1, len(NEIGHBOUR))


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
    at_rims : RimsAt or None
        The rims of the pupil; None without diffraction.
    """

    landing: np.ndarray
    weights: np.ndarray
    spread: np.ndarray
    at_rims: RimsAt | None = None


class ImageGrid:
    """Grid and transfer functions of the images of one star on stamps of one size.

    Parameters
    ----------
    pixels : Pixels
        The stamp.
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
    rims : PupilRims or None
        Rims of the pupil, at which light is diffracted; None without diffraction.
    """

    def __init__(
        self,
        pixels: Pixels,
        side: float,
        seeing: Seeing,
        jacobian: np.ndarray,
        blur: float,
        footprint: np.ndarray,
        oversampling: int,
        reach: float,
        rims: PupilRims | None = None,
    ) -> None:
        shape, pixel = (pixels.image.shape[0], pixels.image.shape[1]), side * pixels.side
        self.shape, self.pixel, self.footprint = shape, pixel, footprint
        #: Pixels of the detector along one of the stamp, and the centre of its stamp from that of this one [pixels].
        self.scale, self.offset = float(pixels.side), np.array(pixels.offset)
        self.oversampling, self.reach = oversampling, reach
        margin = max(8, math.ceil(reach / pixel))
        self._size = tuple(fft.next_fast_len(oversampling * (n + margin), real=True) for n in shape)
        #: Place of the centre of the stamp on the grid, (y, x) cells.
        self._middle = [0.5 * (n - 1) * oversampling for n in shape]
        turns = [fft.fftfreq(self._size[0]), fft.rfftfreq(self._size[1])]  # cycles a cell
        y, x = np.meshgrid(*turns, indexing="ij", sparse=True)
        frequencies = np.stack(np.broadcast_arrays(x, y))
        self._phase = -2.0 * math.pi * oversampling / pixels.side * frequencies  # for shifts in detector pixels
        wave = 2.0 * math.pi * oversampling / pixel * frequencies  # rad/m
        baseline = np.tensordot(jacobian.T, wave, axes=1) * seeing.wavelength / (2.0 * math.pi)
        self._exponent = seeing.exponent(np.hypot(*baseline))
        spline = np.sinc(x) ** 4 * np.sinc(y) ** 4
        cell = np.prod(np.sinc(np.tensordot(footprint.T, wave, axes=1) / (2.0 * math.pi)), axis=0)
        columns, rows = (
            self.scale * (np.arange(n) - 0.5 * (n - 1) - shift)
            for n, shift in zip(shape[::-1], pixels.offset, strict=True)
        )
        #: Derivatives of the image by level and slopes of the background, over the area of a pixel.
        self._plane = np.stack(np.broadcast_arrays(1.0, columns, rows[:, None]), axis=-1).astype(np.float32)
        # A cell of the grid holds less light than a pixel.
        self._detector = (
            oversampling**2
            * square_transfer(wave[0, :1], wave[1, :, :1], side * pixels.width)
            * np.exp(-0.5 * blur**2 * wave[0, :1] ** 2)
            * np.exp(-0.5 * blur**2 * wave[1, :, :1] ** 2)
            * cell
            / spline
        )
        # The filter has the images of cells, and the spline, which light of rims has not.
        self.rim_light = None if rims is None else RimLight(rims, side, wave, baseline, cell / spline, self._filter)

    def with_rims(self, rims: PupilRims) -> ImageGrid:
        """Return the grid for other rims of the pupil."""
        grid = copy(self)
        grid.rim_light = None if self.rim_light is None else self.rim_light.of(rims)
        return grid

    def _filter(self, strength: float) -> np.ndarray:
        """Return the transfer function of air and detector."""
        return np.asarray(self._detector * np.exp(-self._exponent * strength ** (5.0 / 3.0)))

    def places(self, unknowns: np.ndarray, landing: np.ndarray) -> np.ndarray:
        """Return places (x, y) of light [n, 2] that lands about the chief ray [m], in pixels from the centre."""
        return landing / self.pixel + (unknowns[[X, Y]] / self.scale + self.offset)

    def _deposit(self, points: np.ndarray, spread: np.ndarray, derivatives: bool) -> list[csc_array]:
        """Return the spline at points [n, 2], and its derivatives along x and y [1/pixel], as sparse matrices.

        Spreads [n, 2, 2] of the points, in pixels as they are, change the spline by half its second derivatives.
        """
        values, indices = [], []
        for axis in (0, 1):
            place = self._middle[1 - axis] + self.oversampling * points[:, axis]
            low = np.floor(place)
            t = (place - low).astype(np.float32)
            powers = np.stack([np.ones_like(t), t, t * t, t * t * t])
            # The spline and its first three derivatives, per pixel, shape [4, n]: long rows are quick.
            values.append([(self.oversampling**k * _SPLINES[k]).T @ powers[: 4 - k] for k in range(4)])
            indices.append((low.astype(np.int32) + np.arange(-1, 3, dtype=np.int32)[:, None]) % self._size[1 - axis])
        cells = _by_point(indices[1][:, None] * np.int32(self._size[1]) + indices[0])
        starts = np.arange(0, cells.size + 1, 16, dtype=np.int32)
        shape = (self._size[0] * self._size[1], len(points))
        x, y = values
        half_xx, xy, half_yy = (spread[:, [0, 0, 1], [0, 1, 1]] * [0.5, 1.0, 0.5]).astype(np.float32).T

        def spline(i: int, j: int) -> csc_array:
            """Return the derivative of order i along x and j along y."""
            taps = (y[j] + half_yy * y[j + 2])[:, None] * (x[i] + half_xx * x[i + 2])
            taps += y[j + 1][:, None] * (xy * x[i + 1])
            return csc_array((_by_point(taps), cells, starts), shape=shape)

        return [spline(i, j) for i, j in (((0, 0), (1, 0), (0, 1)) if derivatives else ((0, 0),))]

    def _pixels(self, spectra: np.ndarray) -> np.ndarray:
        """Return the pixels of spectra [ky, kx, n], shape [ny, nx, n]."""
        images = fft.irfft2(spectra, s=self._size, axes=(0, 1))
        step = self.oversampling
        return np.asarray(images[: self.shape[0] * step : step, : self.shape[1] * step : step])

    def image(self, unknowns: np.ndarray, light: LandedLight) -> np.ndarray:
        """Return the image [electrons], shape [ny, nx]; arguments as in :meth:`derivatives`."""
        spectrum, shifts = self._spectra(unknowns, light)
        if len(shifts):
            spectrum *= _all_stars(unknowns, shifts)
        star = self._pixels(spectrum)[..., 0].astype(np.float64)
        return np.asarray(unknowns[FLUX] * star + self._background(unknowns))

    def _background(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the plane under the stars [electrons], shape [ny, nx]."""
        return np.asarray(self.scale**2 * (self._plane @ unknowns[[BACKGROUND, SLOPE_X, SLOPE_Y]]))

    def derivatives(
        self, unknowns: np.ndarray, light: LandedLight, response: np.ndarray, rates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the image and its derivatives.

        Parameters
        ----------
        unknowns : ndarray, shape [7 + 3 n_neighbour]
            Values of :data:`NUISANCES`, and of :data:`NEIGHBOUR` for each neighbour.
        light : LandedLight
            Landing points of the light.
        response : ndarray, shape [2, n, n_wave]
            Derivatives of the landing points with respect to the unknowns of the wavefront [m].
        rates : ndarray, shape [n, n_shift]
            Derivatives of the fractions of the light with respect to shifts of rims.

        Returns
        -------
        image : ndarray, shape [ny, nx]
            Electrons a pixel.
        columns : ndarray of float32, shape [ny, nx, n_unknown + n_wave + n_shift]
            Derivatives by the unknowns, then by those of the wavefront and the shifts, over their scales.
        scales : ndarray, shape [n_unknown + n_wave + n_shift]
            Scales of the columns.
        """
        flux, strength = unknowns[FLUX], unknowns[STRENGTH]
        spectra, shifts = self._spectra(unknowns, light, response, rates)
        star, moved = spectra[..., :1], spectra[..., 1:]
        extra = []
        for (ratio, *_), shift in zip(neighbours_of(unknowns), shifts, strict=True):
            neighbour = star * shift
            turns = [(1j * ratio * p).astype(np.complex64)[..., None] for p in self._phase]
            extra += [neighbour, *(turn * neighbour for turn in turns)]
        if extra:
            all_stars = _all_stars(unknowns, shifts)
            star, moved = star * all_stars, moved * all_stars
        growth = (-5.0 / 3.0 * self._exponent * strength ** (2.0 / 3.0)).astype(np.float32)[..., None]
        light_columns = self._pixels(
            np.concatenate([star, moved[..., :2], growth * star, *extra, moved[..., 2:]], axis=-1)
        )
        of_star, of_growth, others = np.split(light_columns, [BACKGROUND, BACKGROUND + 1], axis=-1)
        level, slopes = np.split(self._plane, [1], axis=-1)
        columns = np.concatenate([of_star, level, of_growth, slopes, others], axis=-1)
        scales = np.full(columns.shape[-1], flux)
        scales[FLUX] = 1.0
        scales[[BACKGROUND, SLOPE_X, SLOPE_Y]] = self.scale**2
        scales[[X, Y]] /= self.scale
        return flux * columns[..., FLUX].astype(np.float64) + self._background(unknowns), columns, scales

    def _spectra(
        self,
        unknowns: np.ndarray,
        light: LandedLight,
        response: np.ndarray | None = None,
        rates: np.ndarray | None = None,
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return spectra of a star of unit flux, its derivatives by x, y, wave and rims, and its neighbours' shifts."""
        points = self.places(unknowns, light.landing)
        splines = self._deposit(points, light.spread / self.pixel**2, response is not None)
        weights = light.weights.astype(np.float32)[:, None]
        deposits = [spline @ weights for spline in splines]
        if response is not None:
            _, along_x, along_y = splines
            moved = response.astype(np.float32, copy=False) * (weights / np.float32(self.pixel))
            deposits.append(along_x @ moved[0] + along_y @ moved[1])
        if rates is not None and rates.shape[1]:
            deposits.append(splines[0] @ rates.astype(np.float32))
        spectra = fft.rfft2(np.concatenate(deposits, axis=1).reshape(*self._size, -1), axes=(0, 1))
        if light.at_rims is not None:
            self._diffract(spectra, unknowns, light.at_rims)
        spectra *= self._filter(unknowns[STRENGTH]).astype(np.float32)[..., None]
        turns = [np.exp(1j * np.tensordot(offset, self._phase, axes=1)) for _, *offset in neighbours_of(unknowns)]
        return spectra, [turn.astype(np.complex64)[..., None] for turn in turns]

    def _diffract(self, spectra: np.ndarray, unknowns: np.ndarray, rims: RimsAt) -> None:
        """Add what is diffracted at the rims to the spectra of the star and of its derivatives by x, y and wave."""
        light = self.rim_light
        assert light is not None
        transfer = light.transfer(float(unknowns[STRENGTH]), rims)
        # Frequencies of the grid count from its first cell.
        middle = np.array(self._middle[::-1]) / self.oversampling
        place = self.places(unknowns, np.zeros(2)) + middle
        turn = np.exp(-1j * self.pixel * (light.wave @ place)).astype(np.complex64)
        diffracted = transfer * turn
        spectra[light.where, 0] += diffracted
        if spectra.shape[-1] == 1:
            return
        for axis in (0, 1):
            spectra[light.where, 1 + axis] -= 1j * (light.wave[:, axis] * self.pixel).astype(np.float32) * diffracted
        spectra[light.where, 3 : 3 + rims.response.shape[2]] += light.slopes(rims) * turn[:, None]


def _all_stars(unknowns: np.ndarray, shifts: list[np.ndarray]) -> np.ndarray:
    """Return the transfer function of a star and its neighbours over that of the star."""
    ratios = neighbours_of(unknowns)[:, 0].astype(np.float32)
    return np.asarray(1.0 + sum(ratio * shift for ratio, shift in zip(ratios, shifts, strict=True)))


def _by_point(taps: np.ndarray) -> np.ndarray:
    """Return values of the 4 x 4 cells of n points, shape [4, 4, n], point by point, flat."""
    return np.ascontiguousarray(taps.reshape(16, -1).T).ravel()


# Cubic B-spline at t - 1 ... t + 2 by powers of t, 0 <= t < 1, and its derivatives with respect to the point's place.
_SPLINES = [np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=np.float32) / np.float32(6.0)]
for _ in range(3):
    _SPLINES.append(_SPLINES[-1][1:] * np.arange(1, len(_SPLINES[-1]), dtype=np.float32)[:, None])
