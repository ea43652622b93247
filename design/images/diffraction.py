r"""Diffraction images (PSFs) of the telescope alone, by Fourier sums over the pupil and by Huygens' wavelets.

Both sum the same plane waves (:mod:`~.wavelets`). :func:`fft_psf` has the direction cosines of its rays on
a square lattice, so that the image is a Fourier sum, which is done as two products with matrices of phases (Soummer et
al. 2007, Opt. Express 15, 15935). Its pixels need not be those of a fast Fourier transform: all wavelengths share one
grid. The image repeats itself after wavelength / spacing. :func:`huygens_psf` sums over rays through any points of the
entrance pupil, as they are traced, and repeats itself nowhere; it is the slower and the plainer of the two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError
from ...core.units import metres
from ...models.telescope import Telescope
from ...wavefront.pupil_sampling import PupilSampling, square_annulus
from ...wavefront.request import field_points, relative_weights, wavelength_points
from ..metrics.principal_rays import principal_rays
from ..metrics.spots import REFERENCES, spots
from .diffraction_psf import DiffractionPsf, pixel_axis
from .wavelets import (
    WaveletLattice,
    Wavelets,
    lattice_wavelets,
    range_of_cosines,
    spot_reach,
    traced_wavelets,
)

#: Pixels on a side where none are asked for, and pixels across wavelength times focal ratio.
_PIXELS, _PER_AIRY = 128, 5.0
#: Smallest, and largest number of lattice points across the pupil that is chosen unasked.
_FEWEST, _MOST = 128, 2048
#: The pattern comes round after so many sides of the image.
_PERIODS = 2.0
#: Rays across the pupil for sums of Huygens' wavelets.
_HUYGENS_ACROSS = 160
#: Wavelets summed at once: two complex numbers for each and each column of the image.
_AT_ONCE = 4096
#: The peak is looked for at so many places across wavelength times focal ratio, at most so many in all along an axis,
#: and at finer steps about the highest.
_PEAK, _MOST_PLACES, _FINE = 3.0, 192, 33


def fft_psf(
    telescope: Telescope,
    fields: Any = None,
    wavelengths: Any = None,
    *,
    wavelength_weights: Any = None,
    pixel: Any = None,
    pixels: int = _PIXELS,
    pupil_points: int | None = None,
    reference: str = "centroid",
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DiffractionPsf:
    """Make diffraction images by Fourier sums over a square lattice of direction cosines at the image.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; five from the axis to the edge by default.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]; the telescope's own by default.
    wavelength_weights : array_like, shape [n_wave], optional
        Relative amounts of light in front of the telescope; equal by default.
    pixel : float or Quantity, optional
        Distance of pixel centres on the detector [m]; by default a fifth of the smallest wavelength times focal
        ratio, or more where the spots are larger than the image would be.
    pixels : int
        Pixels on a side.
    pupil_points : int, optional
        Lattice points across the pupil; by default at least 128, and so many that the pattern comes round only after
        twice the side of the image.
    reference : {"centroid", "chief"}
        What the images are centred on: the centroid of the rays, or the chief ray of the middle wavelength.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads for tracing; all processors by default.
    progress : callable, optional
        Called with the number of images finished since the last call.

    Raises
    ------
    ConfigError
        If reference or projection is unknown.
    DomainError
        If something is out of range, no light passes, or the lattice is too coarse for the spots or the image.
    """
    plan = _Plan(telescope, fields, wavelengths, wavelength_weights, pixel, pixels, reference, projection, threads)
    side = plan.pixel * plan.pixels
    across = pupil_points
    if across is None:
        # The pattern's period is so many times wavelength / (range of cosines).
        needed = int(np.ceil(max(_PERIODS * side, side + plan.spread) / plan.wave_over_range))
        across = max(_FEWEST, needed)
        if across > _MOST:
            raise DomainError(
                f"pixel = {plan.pixel * 1e6:.4g} um, pixels = {pixels}: the image would need {across} points "
                f"across the pupil; expected at most {_MOST} (a smaller image, or pupil_points)"
            )
    elif int(across) != across or across < 8:
        raise DomainError(f"pupil_points = {across!r}: expected a whole number of at least 8")
    period = across * plan.wave_over_range
    if period < side or period < plan.spread:
        what = f"an image of {side * 1e6:.4g} um and spots of {plan.spread * 1e6:.4g} um"
        raise DomainError(
            f"pupil_points = {across}: the pattern comes round after {period * 1e6:.4g} um; "
            f"expected more points for {what}"
        )

    def lattice(field: np.ndarray, wavelength: float, center: np.ndarray) -> WaveletLattice:
        return lattice_wavelets(
            telescope, field, wavelength, center, plan.range_of_cosines / across, projection=projection, threads=threads
        )

    def waves(field: np.ndarray, wavelength: float, center: np.ndarray) -> tuple[Wavelets, _Sum]:
        found = lattice(field, wavelength, center)
        return found.wavelets, lambda x, y: lattice_sum(found, x, y)

    return plan.image("fft", waves, int(across), progress)


def huygens_psf(
    telescope: Telescope,
    fields: Any = None,
    wavelengths: Any = None,
    *,
    wavelength_weights: Any = None,
    pixel: Any = None,
    pixels: int = _PIXELS,
    sampling: PupilSampling | None = None,
    reference: str = "centroid",
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DiffractionPsf:
    """Make diffraction images by summing the plane wave of every ray at every pixel.

    Parameters are those of :func:`fft_psf`, but for `sampling`, the points of the entrance pupil: by default the cells
    of a square lattice, 160 across. Gauss quadrature (``gauss_annulus``) needs far fewer where nothing is vignetted.

    Raises
    ------
    ConfigError
        If reference or projection is unknown.
    DomainError
        If something is out of range, or no light passes.
    """
    plan = _Plan(telescope, fields, wavelengths, wavelength_weights, pixel, pixels, reference, projection, threads)
    points = sampling or square_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, _HUYGENS_ACROSS)

    def waves(field: np.ndarray, wavelength: float, center: np.ndarray) -> tuple[Wavelets, _Sum]:
        found = traced_wavelets(telescope, field, wavelength, center, points, projection, threads)
        return found, lambda x, y: wavelet_sum(found, x, y)

    return plan.image("huygens", waves, round(2.0 * np.sqrt(len(points) / np.pi)), progress)


_Sum = Callable[[np.ndarray, np.ndarray], np.ndarray]


def lattice_sum(lattice: WaveletLattice, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the irradiance on a grid of places by a Fourier sum, part of the light per area [1/m^2].

    Parameters
    ----------
    lattice : WaveletLattice
        Wavelets on a lattice along the axes of the detector.
    x, y : ndarray, shape [nx], [ny]
        Coordinates of the columns and rows from the reference point [m].

    Returns
    -------
    ndarray, shape [ny, nx]
    """
    turn = 2j * np.pi / lattice.wavelets.wavelength
    field = lattice.wavelets.field
    amplitude = np.exp(turn * np.outer(y, lattice.steps)) @ field @ np.exp(turn * np.outer(lattice.steps, x))
    return amplitude.real**2 + amplitude.imag**2


def wavelet_sum(wavelets: Wavelets, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the irradiance on a grid of places by a sum over wavelets of any directions [1/m^2], shape [ny, nx].

    The phase of a wavelet is a sum of one of the column and one of the row, so that the sum over the wavelets is a
    product of two matrices.
    """
    turn = 2j * np.pi / wavelets.wavelength
    lit = wavelets.amplitude > 0
    field, cosine = wavelets.field[lit], wavelets.cosine[lit]
    amplitude = np.zeros((len(y), len(x)), dtype=np.complex128)
    for first in range(0, len(field), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        rows = np.exp(turn * np.outer(y, cosine[some, 1])) * field[some]
        amplitude += rows @ np.exp(turn * np.outer(cosine[some, 0], x))
    return amplitude.real**2 + amplitude.imag**2


class _Plan:
    """What both kinds of sums need to know beforehand, and the way from irradiances to images."""

    def __init__(
        self,
        telescope: Telescope,
        fields: Any,
        wavelengths: Any,
        weights: Any,
        pixel: Any,
        pixels: int,
        reference: str,
        projection: str,
        threads: int | None,
    ) -> None:
        if reference not in REFERENCES:
            raise ConfigError(f"reference = {reference!r}: expected one of {', '.join(REFERENCES)}")
        if int(pixels) != pixels or not 3 <= pixels <= 4096:
            raise DomainError(f"pixels = {pixels!r}: expected a whole number from 3 to 4096")
        self.telescope, self.pixels = telescope, int(pixels)
        self.fields, self.waves = field_points(telescope, fields), wavelength_points(telescope, wavelengths)
        self.shares = relative_weights(weights, len(self.waves))
        self.spots = spots(
            telescope, self.fields, self.waves, reference=reference, projection=projection, threads=threads
        )
        if not (self.spots.lit_fraction > 0).all():
            dark = np.rad2deg(self.fields[self.spots.lit_fraction <= 0][0])
            raise DomainError(f"field = ({dark[0]:.6g}, {dark[1]:.6g}) deg: no light passes; expected a lit pupil")
        principal = principal_rays(
            telescope, self.fields, self.waves[len(self.waves) // 2], projection=projection, threads=threads
        )
        self.plate_scale = principal.mean_plate_scale
        self.airy_radius = 1.22 * self.waves[len(self.waves) // 2] * principal.mean_f_number
        #: Range of direction cosines across the pupil: the largest of all fields and directions.
        self.range_of_cosines = range_of_cosines(telescope, principal)
        self.wave_over_range = float(self.waves.min()) / self.range_of_cosines
        #: Extent of the spots about the middle of the images [m].
        self.spread = 2.0 * spot_reach(self.spots)
        if pixel is None:
            # Where the spots are far larger than an Airy disc, they set the scale.
            self.pixel = max(self.wave_over_range / _PER_AIRY, 1.25 * self.spread / self.pixels)
        else:
            self.pixel = float(metres(pixel, "pixel"))
            if not (np.isfinite(self.pixel) and self.pixel > 0):
                raise DomainError(f"pixel = {pixel!r}: expected a positive length in metres")

    def image(
        self,
        method: str,
        waves: Callable[[np.ndarray, float, np.ndarray], tuple[Wavelets, _Sum]],
        pupil_points: int,
        progress: Callable[[int], None] | None,
    ) -> DiffractionPsf:
        axis = pixel_axis(self.pixel, self.pixels)
        images, light, strehl = [], [], []
        for field, center in zip(self.fields, self.spots.reference, strict=True):
            found: list[tuple[float, Wavelets, _Sum]] = []
            total = np.zeros((self.pixels, self.pixels))
            for wavelength, share in zip(self.waves, self.shares, strict=True):
                wavelets, irradiance = waves(field, float(wavelength), center)
                found.append((float(share), wavelets, irradiance))
                total += share * irradiance(axis, axis)
                if progress is not None:
                    progress(1)
            whole = sum(share * wavelets.light for share, wavelets, _ in found)
            perfect = sum(share * wavelets.perfect_peak for share, wavelets, _ in found)
            images.append(total * self.pixel**2 / whole)
            light.append(whole)
            strehl.append(self._peak(found, total) / perfect)
        return DiffractionPsf(
            telescope=self.telescope.name,
            method=method,
            fields=self.fields,
            wavelengths=self.waves,
            image=np.stack(images),
            pixel=self.pixel,
            reference=self.spots.reference,
            light=np.array(light),
            strehl=np.array(strehl),
            airy_radius=self.airy_radius,
            plate_scale=self.plate_scale,
            pupil_points=pupil_points,
        )

    def _peak(self, found: Sequence[tuple[float, Wavelets, _Sum]], image: np.ndarray) -> float:
        """Return the highest irradiance of the image [1/m^2]."""

        def irradiance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.asarray(sum(share * at(x, y) for share, _, at in found))

        axis, step = pixel_axis(self.pixel, self.pixels), self.pixel
        if step > self.wave_over_range / _PEAK:
            # Pixels too coarse to show it: look at more places.
            half = 0.5 * self.pixel * self.pixels
            axis = np.linspace(-half, half, min(int(2.0 * half / self.wave_over_range * _PEAK) + 2, _MOST_PLACES))
            step, image = float(axis[1] - axis[0]), irradiance(axis, axis)
        row, column = np.unravel_index(int(np.argmax(image)), image.shape)
        fine = step * np.linspace(-1.0, 1.0, _FINE)
        return float(irradiance(axis[column] + fine, axis[row] + fine).max())
