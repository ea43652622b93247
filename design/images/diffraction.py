r"""Diffraction images (PSFs) of the telescope alone, by Fourier sums over the pupil and by Huygens' wavelets.

Both sum the same plane waves (:mod:`~.wavelets`). In :func:`fft_psf` the direction cosines of the rays lie on a square
lattice, so that the image is a Fourier sum: two products with matrices of phases (Soummer et al. 2007, Opt. Express 15,
15935). Its pixels need not be those of a fast Fourier transform; all wavelengths share one grid. The image repeats
itself after wavelength / spacing. :func:`huygens_psf` sums over rays through any points of the entrance pupil and
repeats itself nowhere; it is slower and simpler.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.memory import require_bytes
from ...core.threads import one_blas_thread
from ...core.units import length, require_count, require_within
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...wavefront.pupil_sampling import PupilSampling, SamplingName, pupil_sampling
from ...wavefront.request import Request, relative_weights
from ..metrics.principal_rays import principal_rays_of
from ..metrics.spots import SpotReference, spot_diagram
from .diffraction_psf import DiffractionMethod, DiffractionPsf, pixel_axis
from .wavelets import (
    WaveletLattice,
    Wavelets,
    lattice_wavelets,
    range_of_cosines,
    require_light,
    spot_reach,
    traced_wavelets,
)

#: What replaces arguments that a request has.
_REQUEST = "telescope=Request.of(telescope, fields, wavelengths, {}=...)"
#: Sides of pixels [m]: from a hundredth of an atom to a metre.
_PIXEL_SIDES = (1e-12, 1.0)
#: Bytes for each sample of the irradiance: of a complex number, of its square and of one more of both.
_BYTES_OF_SAMPLE = 48
#: Default number of pixels on a side.
_PIXELS = 128
#: Default number of pixels across wavelength times focal ratio.
_PER_AIRY = 5.0
#: Smallest default number of lattice points across the pupil.
_FEWEST = 256
#: Largest number of lattice points across the pupil.
_MOST = 2048
#: Period of the pattern in sides of the image.
_PERIODS = 2.0
#: Smallest and largest default number of rays across the pupil for sums of Huygens' wavelets.
_HUYGENS_ACROSS = 160
_HUYGENS_MOST = 512
#: Wavelets summed at once: two complex numbers for each and each column of the image.
_AT_ONCE = 4096
#: Steps of the search for the peak across wavelength times focal ratio.
_PEAK = 3.0
#: Largest number of points of that search along an axis.
_MOST_PLACES = 192
#: Highest samples that the search begins at in larger images.
_CANDIDATES = 8
#: Finer points along an axis about the highest of them.
_FINE = 33


@removed_arguments(wavelength_weights=_REQUEST.format("wavelength_weights"), projection=_REQUEST.format("projection"))
@check_arguments
def fft_psf(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    pixel: ArrayLike | None = None,
    pixels: int = _PIXELS,
    n_pupil: int | None = None,
    reference: SpotReference = "centroid",
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DiffractionPsf:
    """Make diffraction images by Fourier sums over a lattice of direction cosines.

    Parameters
    ----------
    telescope, fields, wavelengths, threads
        As in :meth:`pachon.Request.of`; a request has a projection and weights of the wavelengths too.
    pixel : float or Quantity, optional
        Distance of pixel centres on the detector [m]; by default a fifth of the smallest wavelength times focal
        ratio, or more where the spots are larger than the image would be.
    pixels : int
        Pixels on a side.
    n_pupil : int, optional
        Lattice points across the pupil; by default at least 256, and enough for a period of the pattern of twice the
        side of the image.
    reference : {"centroid", "chief"}
        Middle of the images: the centroid of the rays, or the chief ray of the middle wavelength.
    focal_plane : FocalPlane, optional
        CCD surfaces, as in :meth:`pachon.Request.on`; the nominal detector surface without it.
    progress : callable, optional
        Called with the number of pairs of field and wavelength done since the last call.

    Raises
    ------
    ConfigError
        If the reference is unknown.
    DomainError
        If a number is out of range, no light passes, or the lattice is too coarse for the spots or the image.
    """
    request = Request.of(telescope, fields, wavelengths, threads=threads).on(focal_plane)
    plan = _Plan(request, pixel, pixels, reference)
    across = n_pupil
    if across is None:
        # The period of the pattern is this number times wavelength / (range of cosines).
        across = max(_FEWEST, plan.points_for(max(_PERIODS * plan.side, plan.side + plan.spread)))
        plan.require_few(across, _MOST, "n_pupil")
    else:
        across = require_count(across, "n_pupil", 8, _MOST)
    plan.require_points(across)

    def waves(field_request: Request, wavelength: float, center: np.ndarray) -> tuple[Wavelets, _Sum]:
        lattice = lattice_wavelets(field_request, wavelength, center, plan.range_of_cosines / across)
        return lattice.wavelets, lambda x, y: lattice_sum(lattice, x, y)

    return plan.image("fft", waves, int(across), progress)


def image_pixel(request: Request, pixels: int, reference: SpotReference) -> float:
    """Return the pixel that images of a request have by default [m]."""
    return _Plan(request, None, pixels, reference).pixel


@removed_arguments(wavelength_weights=_REQUEST.format("wavelength_weights"), projection=_REQUEST.format("projection"))
@check_arguments
def huygens_psf(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    pixel: ArrayLike | None = None,
    pixels: int = _PIXELS,
    sampling: SamplingName | PupilSampling = "square",
    n_pupil: int | None = None,
    reference: SpotReference = "centroid",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> DiffractionPsf:
    """Make diffraction images by summing the plane wave of every ray at every pixel.

    Parameters and errors are those of :func:`fft_psf`, but for `focal_plane`, which a request holds, and for
    `sampling` and `n_pupil`, which are those of :meth:`pachon.Request.of`: by default a square lattice, 160 to 512
    across. Gauss quadrature needs far fewer points where nothing is vignetted.
    """
    request = Request.of(telescope, fields, wavelengths, threads=threads)
    plan = _Plan(request, pixel, pixels, reference)
    plan.require_memory()
    if n_pupil is None and sampling == "square":
        n_pupil = max(_HUYGENS_ACROSS, plan.points_for(max(plan.side, plan.spread)))
        plan.require_few(n_pupil, _HUYGENS_MOST, "fft_psf")
    plan.request = request = Request.of(request, sampling=sampling, n_pupil=n_pupil)
    clear = 1.0 - request.telescope.pupil_obscuration**2
    across = round(2.0 * np.sqrt(len(request.pupil) / (np.pi * clear)))
    plan.require_points(across)

    def waves(field_request: Request, wavelength: float, center: np.ndarray) -> tuple[Wavelets, _Sum]:
        wavelets = traced_wavelets(field_request, wavelength, center)
        return wavelets, lambda x, y: wavelet_sum(wavelets, x, y)

    return plan.image("huygens", waves, across, progress)


_Sum = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: Weight, wavelets and sum of a wavelength.
_Waves = tuple[float, Wavelets, _Sum]


def lattice_sum(lattice: WaveletLattice, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the irradiance by a Fourier sum, fraction of the light per area [1/m^2], shape [ny, nx].

    Coordinates x and y of columns and rows count from the reference point [m]; the lattice lies along the axes of the
    detector.
    """
    turn = 2j * np.pi / lattice.wavelets.wavelength
    field = lattice.wavelets.field
    amplitude = np.exp(turn * np.outer(y, lattice.steps)) @ field @ np.exp(turn * np.outer(lattice.steps, x))
    return amplitude.real**2 + amplitude.imag**2


def wavelet_sum(wavelets: Wavelets, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the irradiance on a grid of points by a sum over wavelets of any directions [1/m^2], shape [ny, nx].

    The phase of a wavelet is the sum of a phase of the column and one of the row, so the sum over the wavelets is a
    product of two matrices.
    """
    turn = 2j * np.pi / wavelets.wavelength
    lit = wavelets.amplitude > 0
    field, cosine = wavelets.field[lit], wavelets.cosine[lit]
    amplitude = np.zeros((len(y), len(x)), dtype=np.complex128)
    for first in range(0, len(field), _AT_ONCE):
        batch = slice(first, first + _AT_ONCE)
        rows = np.exp(turn * np.outer(y, cosine[batch, 1])) * field[batch]
        amplitude += rows @ np.exp(turn * np.outer(cosine[batch, 0], x))
    return amplitude.real**2 + amplitude.imag**2


class _Plan:
    """Common inputs of both sums, and the reduction of irradiances to images."""

    def __init__(self, request: Request, pixel: ArrayLike | None, pixels: int, reference: SpotReference) -> None:
        self.request, self.pixels = request, require_count(pixels, "pixels", 3, 4096)
        # The middle of the images weighs all wavelengths alike.
        alike, pupil = relative_weights(None, len(request.wavelengths)), pupil_sampling(request.telescope)
        self.spots = spot_diagram(replace(request, weights=alike, pupil=pupil), reference)
        require_light(self.spots)
        #: Range of direction cosines across the pupil: the largest of all fields and directions.
        self.range_of_cosines = range_of_cosines(principal_rays_of(request))
        self.wave_over_range = float(request.wavelengths.min()) / self.range_of_cosines
        #: Extent of the spots about the middle of the images [m].
        self.spread = 2.0 * spot_reach(self.spots)
        if pixel is None:
            # Where the spots are far larger than an Airy disc, they set the scale.
            self.pixel = max(self.wave_over_range / _PER_AIRY, 1.25 * self.spread / self.pixels)
        else:
            self.pixel = require_within(length(pixel, "pixel"), "pixel", *_PIXEL_SIDES, "m")
        self.side = self.pixel * self.pixels
        self._unit = "urad" if request.telescope.design_data.afocal else "um"

    def points_for(self, period: float) -> int:
        """Return the number of points across the pupil whose pattern repeats after a length [m]."""
        return int(np.ceil(period / self.wave_over_range))

    def require_few(self, across: int, most: int, instead: str) -> None:
        """Raise a DomainError where a default number of points across the pupil is too large; it says what serves."""
        if across > most:
            raise DomainError(
                f"pixel = {self.pixel * 1e6:.4g} {self._unit}, pixels = {self.pixels}: the image would need {across} "
                f"points across the pupil; expected at most {most} (a smaller image, {instead}, or rays alone)",
                key="n_pupil",
            )

    def require_points(self, across: int) -> None:
        """Raise a DomainError where so many points across the pupil are too few for the image or the spots."""
        period = across * self.wave_over_range
        if period < self.side or period < self.spread:
            unit = self._unit
            raise DomainError(
                f"n_pupil = {across}: the pattern repeats after {period * 1e6:.4g} {unit}; expected more points for "
                f"an image of {self.side * 1e6:.4g} {unit} and spots of {self.spread * 1e6:.4g} {unit}",
                key="n_pupil",
            )

    def require_memory(self) -> None:
        """Raise a DomainError where the samples of an image are too many."""
        across = self.pixels * self._samples_across()
        require_bytes(_BYTES_OF_SAMPLE * across**2, f"pixel = {self.pixel:g} m: {across} samples across the image")

    @one_blas_thread()
    def image(
        self,
        method: DiffractionMethod,
        waves: Callable[[Request, float, np.ndarray], tuple[Wavelets, _Sum]],
        n_pupil: int,
        progress: Callable[[int], None] | None,
    ) -> DiffractionPsf:
        """Return the images of all field points from a function that returns wavelets and their sum."""
        self.require_memory()
        finer = self._samples()
        images, lit, strehl = [], [], []
        for i, center in enumerate(self.spots.reference_point):
            field_request = self.request.at_fields(slice(i, i + 1))
            by_wavelength: list[_Waves] = []
            total, samples = np.zeros((self.pixels, self.pixels)), np.zeros((len(finer), len(finer)))
            for wavelength, weight in zip(self.request.wavelengths, self.request.weights, strict=True):
                wavelets, irradiance = waves(field_request, float(wavelength), center)
                by_wavelength.append((float(weight), wavelets, irradiance))
                sampled = irradiance(finer, finer)
                total += weight * self._on_pixels(sampled)
                samples += weight * sampled
                if progress is not None:
                    progress(1)
            lit_fraction = sum(weight * wavelets.lit_fraction for weight, wavelets, _ in by_wavelength)
            perfect = sum(weight * wavelets.perfect_peak for weight, wavelets, _ in by_wavelength)
            images.append(total * self.pixel**2 / lit_fraction)
            lit.append(lit_fraction)
            strehl.append(self._peak(by_wavelength, finer, samples) / perfect)
        return DiffractionPsf(
            request=self.request,
            method=method,
            image=np.stack(images),
            pixel=self.pixel,
            reference_point=self.spots.reference_point,
            lit_fraction=np.array(lit),
            strehl=np.array(strehl),
            airy_radius=self.spots.airy_radius,
            plate_scale=self.spots.plate_scale,
            n_pupil=n_pupil,
        )

    def _samples(self) -> np.ndarray:
        """Return the coordinates of samples of the irradiance [m], a whole number of them across each pixel.

        The pattern has no period below wavelength times focal ratio: samples at that distance sum to the light.
        """
        across = self._samples_across()
        offsets = (np.arange(across) + 0.5) / across - 0.5
        return (pixel_axis(self.pixel, self.pixels)[:, None] + self.pixel * offsets).ravel()

    def _samples_across(self) -> int:
        return max(1, int(np.ceil(self.pixel / self.wave_over_range - 1e-9)))

    def _on_pixels(self, irradiance: np.ndarray) -> np.ndarray:
        """Return the mean of the samples of each pixel."""
        across = len(irradiance) // self.pixels
        return irradiance.reshape(self.pixels, across, self.pixels, across).mean(axis=(1, 3))

    def _peak(self, by_wavelength: Sequence[_Waves], axis: np.ndarray, image: np.ndarray) -> float:
        """Return the highest irradiance [1/m^2] from that at samples along an axis [m]."""

        def irradiance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.asarray(sum(weight * at(x, y) for weight, _, at in by_wavelength))

        half = 0.5 * self.pixel * self.pixels
        places = int(2.0 * half / self.wave_over_range * _PEAK) + 2
        if len(axis) < places <= _MOST_PLACES:
            # The samples are too coarse for the peak.
            axis = np.linspace(-half, half, places)
            image = irradiance(axis, axis)
        step = float(axis[1] - axis[0])
        fine = step * np.linspace(-1.0, 1.0, _FINE)
        # In larger images samples may miss a narrow peak, as that of spherical aberration in the middle.
        large = places > _MOST_PLACES
        highest = np.argsort(image, axis=None)[: -1 - (_CANDIDATES if large else 1) : -1]
        rows, columns = np.unravel_index(highest, image.shape)
        beginnings = [*zip(axis[columns], axis[rows], strict=True), *([(0.0, 0.0)] if large else [])]
        return max(float(irradiance(x + fine, y + fine).max()) for x, y in beginnings)
