r"""Image of a star from landing points: spline deposit, transfer functions, exact derivatives.

Light lands at points :math:`x_n` with weights :math:`w_n`. Each point is deposited on a grid as a cubic B-spline; the
transform of the grid is divided by that of the spline, and multiplied by those of pixel, detector and atmosphere: the
image at the centres of the pixels, integrated over them. Columns of derivatives go the same way, with the gradient of
the spline and :math:`w_n\, \partial x_n / \partial a`: they are the derivatives of the image itself.

Images sharper than their pixels resolve have a core, a Gaussian with the transfer of the air at Nyquist's frequency,
whose light is integrated over the pixels themselves (:mod:`.pixel_kernel`); what it leaves of the air is smooth.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import fft

from ..wavefront.psf.image_plane import square_transfer
from ..wavefront.psf.pupil_rims import PupilRims
from .pixel_kernel import Deposit, SharpCore
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
#: Power of the strength of the turbulence that the exponent of its transfer function goes by.
EXPONENT_GROWTH = 5.0 / 3.0
#: Least margin of the grid beside the stamp, in which blurred light does not wrap around [pixels of the fit].
_LEAST_MARGIN = 8
#: Step of the difference that the core follows its variance by, over it, and the least one [pixels^2].
_WIDER = 2e-2
_LEAST_WIDER = 1e-3
#: Exponent of the air at Nyquist's frequency beyond which an image has no core.
_SMOOTH = 6.0
#: Exponent of the air at Nyquist's frequency below which a Gaussian is all of it.
_NO_AIR = 6e-4
#: The same below which air is no blur.
_NO_BLUR = 1e-2
#: The same below which that of the wavefront's derivatives is: 3 % of the light, wide and smooth, stays where it is.
_THIN_AIR = 0.2


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
    sharp : bool
        Whether the image may have more detail than its pixels resolve.
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
        sharp: bool = False,
        reach: float = 0.0,
        rims: PupilRims | None = None,
    ) -> None:
        self._arguments = (pixels, side, seeing, jacobian, blur, footprint, sharp, reach)
        shape, pixel = (pixels.image.shape[0], pixels.image.shape[1]), side * pixels.side
        self.shape, self.pixel, self.footprint = shape, pixel, footprint
        #: Pixels of the detector along one of the stamp, and the centre of its stamp from that of this one [pixels].
        self.scale, self.offset = float(pixels.side), np.array(pixels.offset)
        self.sharp, self.coarse = sharp, pixels.blur > 0.0
        margin = max(_LEAST_MARGIN, math.ceil(reach / pixel))
        #: Distance from the stamp within which light does not wrap around [m].
        self.reach = margin * pixel
        self._size = tuple(fft.next_fast_len(n + margin, real=True) for n in shape)
        #: Place of the centre of the stamp on the grid, (y, x) cells.
        self._middle = [0.5 * (n - 1) for n in shape]
        turns = [fft.fftfreq(self._size[0]), fft.rfftfreq(self._size[1])]  # cycles a pixel
        y, x = np.meshgrid(*turns, indexing="ij", sparse=True)
        frequencies = np.stack(np.broadcast_arrays(x, y))
        self._phase = -2.0 * math.pi / pixels.side * frequencies  # for shifts in detector pixels
        wave = 2.0 * math.pi / pixel * frequencies  # rad/m
        scale = seeing.wavelength / (2.0 * math.pi)
        baseline = np.tensordot(jacobian.T, wave, axes=1) * scale
        self._exponent = seeing.exponent(np.hypot(*baseline))
        spline = np.sinc(x) ** 4 * np.sinc(y) ** 4
        cell = np.prod(np.sinc(np.tensordot(footprint.T, wave, axes=1) / (2.0 * math.pi)), axis=0)
        columns, rows = (
            self.scale * (np.arange(n) - 0.5 * (n - 1) - shift)
            for n, shift in zip(shape[::-1], pixels.offset, strict=True)
        )
        #: Derivatives of the image by level and slopes of the background, over the area of a pixel.
        self._plane = np.stack(np.broadcast_arrays(1.0, columns, rows[:, None]), axis=-1).astype(np.float32)
        self._detector = (
            square_transfer(wave[0, :1], wave[1, :, :1], side * pixels.width)
            * np.exp(-0.5 * blur**2 * wave[0, :1] ** 2)
            * np.exp(-0.5 * blur**2 * wave[1, :, :1] ** 2)
            * cell
            / spline
        )
        #: Transfer function of air and detector at a strength of the turbulence [1/m], which rims have without a grid
        #: that has them: rings of objects, and their arrays, would stay until Python looks for such garbage.
        self._filter = partial(_air_and_detector, self._detector, self._exponent)
        # The filter has the images of cells, and the spline, which light of rims has not.
        self.rim_light = None if rims is None else RimLight(rims, side, wave, baseline, cell / spline, self._filter)
        # Squared frequencies over that of Nyquist, and the exponent of the air there.
        self._square = 4.0 * (x * x + y * y)
        edge = math.sqrt(abs(float(np.linalg.det(jacobian)))) * math.pi / pixel * scale
        self._edge_exponent = float(seeing.exponent(np.array([edge]))[0])
        #: Derivatives of the image at the point where they were computed last.
        self.last: object = None
        #: Linear model of a stamp at the last point.
        self.point: object = None
        self._core: SharpCore | None = None
        if sharp:
            core = pixels.width / pixels.side, blur / pixel, footprint / pixel
            self._core = SharpCore(shape, *core)

    def diffracting(self, rims: PupilRims) -> ImageGrid:
        """Return the grid of a model of rays with diffraction at rims of the pupil."""
        return ImageGrid(*self._arguments, rims)

    def of_rays_alone(self) -> ImageGrid:
        """Return the grid without diffraction."""
        grid = copy(self)
        grid.last, grid.point, grid.rim_light = None, None, None
        return grid

    def with_rims(self, rims: PupilRims) -> ImageGrid:
        """Return the grid for other rims of the pupil."""
        grid = copy(self)
        grid.last, grid.point = None, None
        grid.rim_light = None if self.rim_light is None else self.rim_light.of(rims)
        return grid

    def _edge(self, strength: float) -> float:
        """Return the exponent of the air at Nyquist's frequency."""
        return float(self._edge_exponent * strength ** (5.0 / 3.0))

    def unblurred(self, strength: float) -> bool:
        """Return whether turbulence of a strength, or less of it, does not change the image."""
        return self._edge(strength) < _NO_BLUR

    def _has_core(self, strength: float) -> bool:
        """Return whether some of the image is sharper than the grid."""
        return self._core is not None and self._edge(strength) < _SMOOTH

    def _gaussian(self, strength: float) -> tuple[np.float32, float]:
        """Return the light of the core of the air's image, and its variance [pixels^2]."""
        edge = self._edge(strength)
        return np.float32(math.exp(-edge / 6.0) if edge > _NO_AIR else 1.0), _variance(edge)

    def _gaussian_growth(self, strength: float) -> tuple[float, float]:
        """Return the derivatives by the strength of the logarithm of the light of the core, and of its variance."""
        edge = self._edge(strength)
        growth = EXPONENT_GROWTH * edge / max(strength, 1e-12)
        return -growth / 6.0 if edge > _NO_AIR else 0.0, _variance(growth)

    def _on_grid(self, strength: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the transfer function of what the grid holds, and its derivative by the strength of the turbulence.

        Of sharp images that is what a Gaussian with the air's transfer and slope at Nyquist's frequency, the core,
        leaves: it is smooth.
        """
        transfer = self._filter(strength)
        growth = -5.0 / 3.0 * self._exponent * strength ** (2.0 / 3.0) * transfer
        if self._has_core(strength):
            amplitude, fading = self._gaussian(strength)[0], self._gaussian_growth(strength)[0]
            exponent = 5.0 / 6.0 * self._edge(strength) * self._square
            core = self._detector * (amplitude * np.exp(-exponent))
            transfer = transfer - core
            growth += (EXPONENT_GROWTH / max(strength, 1e-12) * exponent - fading) * core
        return transfer, growth

    def places(self, unknowns: np.ndarray, landing: np.ndarray) -> np.ndarray:
        """Return places (x, y) of light [n, 2] that lands about the chief ray [m], in pixels from the centre."""
        return landing / self.pixel + (unknowns[[X, Y]] / self.scale + self.offset)

    def _splines(self, points: np.ndarray, spread: np.ndarray) -> Deposit:
        """Return the cubic B-spline at points [n, 2] on the grid, and derivatives [1/pixel]."""
        taps, indices = [], []
        for axis in (0, 1):
            place = self._middle[1 - axis] + points[:, axis]
            low = np.floor(place)
            t = (place - low).astype(np.float32)
            powers = np.stack([np.ones_like(t), t, t * t, t * t * t])
            # The spline and its first three derivatives.
            taps.append(np.stack([_SPLINES[k].T @ powers[: 4 - k] for k in range(4)]))
            indices.append((low.astype(np.int32) + np.arange(-1, 3, dtype=np.int32)[:, None]) % self._size[1 - axis])
        return Deposit((taps[0], taps[1]), (indices[0], indices[1]), self._size, spread)

    def _pixels(self, spectra: np.ndarray) -> np.ndarray:
        """Return the pixels of spectra [ky, kx, n], shape [ny, nx, n]."""
        images = fft.irfft2(spectra, s=self._size, axes=(0, 1))
        return np.asarray(images[: self.shape[0], : self.shape[1]])

    def image(self, unknowns: np.ndarray, light: LandedLight) -> np.ndarray:
        """Return the image [electrons], shape [ny, nx]; arguments as in :meth:`derivatives`."""
        columns = self._columns(unknowns, light)
        star = columns[..., 0].astype(np.float64)
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
        columns = self._columns(unknowns, light, response, rates)
        columns[..., [BACKGROUND, SLOPE_X, SLOPE_Y]] = self._plane
        image = unknowns[FLUX] * columns[..., FLUX].astype(np.float64) + self._background(unknowns)
        return image, columns, self.scales(unknowns, columns.shape[-1])

    def scales(self, unknowns: np.ndarray, count: int) -> np.ndarray:
        """Return the scales of so many columns; see :meth:`derivatives`."""
        scales = np.full(count, unknowns[FLUX])
        scales[FLUX] = 1.0
        scales[[BACKGROUND, SLOPE_X, SLOPE_Y]] = self.scale**2
        scales[[X, Y]] /= self.scale
        return scales

    def _columns(
        self,
        unknowns: np.ndarray,
        light: LandedLight,
        response: np.ndarray | None = None,
        rates: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the image of a star of unit flux and, with a response, its derivatives over their scales."""
        strength = float(unknowns[STRENGTH])
        parts, sharp = [], self._has_core(strength)
        if not sharp or self._edge(strength) > _NO_AIR or light.at_rims is not None:
            thin = sharp and self._edge(strength) < _THIN_AIR and light.at_rims is None
            smooth_response = response[..., :0] if thin and response is not None else response
            parts.append(self._smooth_columns(unknowns, light, smooth_response, rates))
        if sharp:
            parts.append(self._core_columns(unknowns, light, response, rates))
        if len(parts) == 1:
            return parts[0]
        if parts[0].shape == parts[1].shape:
            return parts[0] + parts[1]
        smooth, columns = parts
        n = len(unknowns)
        columns[..., :n] += smooth[..., :n]
        columns[..., columns.shape[-1] - (smooth.shape[-1] - n) :] += smooth[..., n:]
        return columns

    def _smooth_columns(
        self, unknowns: np.ndarray, light: LandedLight, response: np.ndarray | None, rates: np.ndarray | None
    ) -> np.ndarray:
        """Return :meth:`_columns` without the core of a sharp image."""
        if response is None or rates is None:
            return self._pixels(self._spectra(unknowns, light, response, rates)[0])
        images, beside = (self._pixels(spectra) for spectra in self._spectra(unknowns, light, response, rates))
        n = len(unknowns)
        columns = np.zeros((*self.shape, n + images.shape[-1] - 3), dtype=np.float32)
        columns[..., [FLUX, X, Y]], columns[..., n:] = images[..., :3], images[..., 3:]
        columns[..., STRENGTH], columns[..., RATIO:n] = beside[..., 0], beside[..., 1:]
        return columns

    def _core_columns(
        self, unknowns: np.ndarray, light: LandedLight, response: np.ndarray | None, rates: np.ndarray | None
    ) -> np.ndarray:
        """Return what the core adds to :meth:`_columns`."""
        core, strength = self._core, float(unknowns[STRENGTH])
        assert core is not None
        points, spread = self.places(unknowns, light.landing), light.spread / self.pixel**2
        amplitude, variance = self._gaussian(strength)
        fading, widening = self._gaussian_growth(strength)
        weights = amplitude * light.weights.astype(np.float32)

        first = len(unknowns)

        def of_one_star(places: np.ndarray) -> np.ndarray:
            """Return the light of one star and, with a response, its derivatives."""
            deposit = core.deposit(places, spread, variance)
            if response is None or rates is None:
                return deposit.light(weights)
            pixels = deposit.derivatives(weights, response, amplitude * rates, 1.0 / self.pixel, first)
            if strength > 0.0:
                step = max(_WIDER * variance, _LEAST_WIDER)
                wider = core.deposit(places, spread, variance + step).light(weights)[:, 0]
                pixels[:, STRENGTH] = np.float32(widening / step) * (wider - pixels[:, FLUX])
                pixels[:, STRENGTH] += np.float32(fading) * pixels[:, FLUX]
            return pixels

        stars = of_one_star(points)
        for k, (flux_ratio, *offset) in enumerate(neighbours_of(unknowns)):
            ratio = np.float32(flux_ratio)
            neighbour = of_one_star(points + np.array(offset) / self.scale)
            stars += ratio * neighbour
            if response is not None:
                column = RATIO + k * len(NEIGHBOUR)
                stars[:, column] = neighbour[:, FLUX]
                stars[:, column + 1 : column + 3] = ratio / np.float32(self.scale) * neighbour[:, [X, Y]]
        return stars.reshape(*self.shape, -1)

    def _spectra(
        self,
        unknowns: np.ndarray,
        light: LandedLight,
        response: np.ndarray | None,
        rates: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return spectra of the star, its derivatives by place, wavefront and rims, and of those by all else."""
        splines = self._splines(self.places(unknowns, light.landing), light.spread / self.pixel**2)
        if response is None or rates is None:
            deposits = splines.light(light.weights)
        else:
            deposits = splines.derivatives(light.weights, response, rates, 1.0 / self.pixel)
        spectra = fft.rfft2(deposits.reshape(*self._size, -1), axes=(0, 1))
        transfer, growth = (v.astype(np.float32)[..., None] for v in self._on_grid(float(unknowns[STRENGTH])))
        grown = growth * spectra[..., :1]
        spectra *= transfer
        if light.at_rims is not None:
            air_and_detector = transfer[..., 0] if self._core is None else self._filter(float(unknowns[STRENGTH]))
            self._diffract(spectra, grown, unknowns, light.at_rims, air_and_detector)
        extra, all_stars = [], None
        for ratio, *offset in neighbours_of(unknowns):
            shift = np.exp(1j * np.tensordot(offset, self._phase, axes=1)).astype(np.complex64)[..., None]
            neighbour = spectra[..., :1] * shift
            turns = [(1j * ratio * p).astype(np.complex64)[..., None] for p in self._phase]
            extra += [neighbour, *(turn * neighbour for turn in turns)]
            all_stars = (1.0 if all_stars is None else all_stars) + np.float32(ratio) * shift
        if all_stars is not None:
            spectra, grown = spectra * all_stars, grown * all_stars
        return spectra, np.concatenate([grown, *extra], axis=-1)

    def _diffract(
        self, spectra: np.ndarray, grown: np.ndarray, unknowns: np.ndarray, rims: RimsAt, air_and_detector: np.ndarray
    ) -> None:
        """Add what is diffracted at the rims to the spectra of the star and of its derivatives."""
        light = self.rim_light
        assert light is not None
        strength = float(unknowns[STRENGTH])
        transfer, slopes = light.transfer(strength, rims)
        # Frequencies of the grid count from its first cell.
        place = self.places(unknowns, np.zeros(2)) + np.array(self._middle[::-1])
        turn = np.exp(-1j * self.pixel * (light.wave @ place)).astype(np.complex64)
        turn *= air_and_detector[light.where].astype(np.float32)
        diffracted = transfer * turn
        spectra[light.where, 0] += diffracted
        grown[light.where, 0] += (
            -5.0 / 3.0 * self._exponent[light.where] * strength ** (2.0 / 3.0) * diffracted
        ).astype(np.complex64)
        if spectra.shape[-1] == 1:
            return
        for axis in (0, 1):
            spectra[light.where, 1 + axis] -= 1j * (light.wave[:, axis] * self.pixel).astype(np.float32) * diffracted
        spectra[light.where, 3 : 3 + rims.response.shape[2]] += slopes * turn[:, None]


def _air_and_detector(detector: np.ndarray, exponent: np.ndarray, strength: float) -> np.ndarray:
    """Return the transfer function of air and detector."""
    return np.asarray(detector * np.exp(-exponent * strength ** (5.0 / 3.0)))


def _variance(edge: float) -> float:
    """Return the variance [pixels^2] of the core of an image, from the exponent of the air at Nyquist's frequency."""
    return 5.0 / 3.0 * edge / math.pi**2


# Cubic B-spline at t - 1 ... t + 2 by powers of t, 0 <= t < 1, and its derivatives with respect to the point's place.
_SPLINES = [np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=np.float32) / np.float32(6.0)]
for _ in range(3):
    _SPLINES.append(_SPLINES[-1][1:] * np.arange(1, len(_SPLINES[-1]), dtype=np.float32)[:, None])
