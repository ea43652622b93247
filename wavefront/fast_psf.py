r"""The fast PSF engine: geometric optics for the long waves of the atmosphere, filters for everything else.

Each pair of a pupil point and a time step is a ray. Its angle is the gradient of the low screens where it crosses them;
the Jacobian of the star turns that into a displacement on its CCD, to which the traced transverse aberration of the
optics is added. All rays of a star are binned on a fine grid, at each wavelength from the same pass over the atmosphere.
What geometric optics leaves out multiplies the transform of that image: the ensemble average of the high modes
:math:`\exp(-D_{high}/2)` (the "second kick" of Peterson et al. 2015, as a filter), diffraction by the annular pupil,
charge diffusion, the pixel, and a phase ramp for atmospheric dispersion and the position within the pixel.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
import warp as wp

from ..models.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.launch import launch, thread_count
from ..raytrace.rays import field_direction
from .atmosphere import Atmosphere
from .fast_psf_kernels import LANES, combine_wavelengths, deposit_rays, sample_offsets, samples
from .image_plane import ImagePlane, focal_length
from .pupil_optics import PupilOptics, trace_pupils
from .turbulence import REFERENCE_WAVELENGTH, SPECTRUM_CONSTANT, diffraction_otf, high_structure_function, structure_function

#: Stars in one batch: memory does not grow with the number of stars beyond it.
BATCH = 32
#: Side of the fine periodic grid over that of the stamp, so that wings come back round from far outside it only.
GRID_MARGIN = 1.25
_TABLE_SIZE = 4096


@dataclass(frozen=True)
class RenderedStars:
    """Images of some stars, before they are put together.

    Attributes
    ----------
    image : ndarray of float64, shape [n_star, ny, nx]
        Light per pixel, as a fraction of what passes the pupil; the whole plane would hold 1.
    throughput : ndarray, shape [n_star, n_wave]
        Lit fraction of the pupil.
    jacobian : ndarray, shape [n_star, 2, 2]
        See :class:`~pachon.wavefront.pupil_optics.PupilOptics`.
    reference : ndarray, shape [n_star, 3]
        See :class:`~pachon.wavefront.pupil_optics.PupilOptics`.
    """

    image: np.ndarray
    throughput: np.ndarray
    jacobian: np.ndarray
    reference: np.ndarray


@dataclass(frozen=True)
class PupilLattice:
    """Points of a square lattice that lie in an annular pupil, symmetric about its centre.

    Attributes
    ----------
    spacing : float
        Distance of neighbouring points [m].
    column, row : ndarray of int
        Indices of the points from the first column and row, shape [n_pupil].
    origin : float
        Coordinate of the first column and row [m].
    """

    spacing: float
    column: np.ndarray
    row: np.ndarray
    origin: float

    @property
    def points(self) -> np.ndarray:
        """Pupil coordinates [m], shape [n_pupil, 2]."""
        return self.origin + self.spacing * np.stack([self.column, self.row], axis=-1)

    @classmethod
    def fill(cls, diameter: float, obscuration: float, spacing: float) -> PupilLattice:
        """Return the lattice of a given spacing [m] in an annulus of given diameter [m] and linear obscuration."""
        count = 2 * math.ceil(0.5 * diameter / spacing)
        origin = -0.5 * (count - 1) * spacing
        line = origin + spacing * np.arange(count)
        radius = np.hypot(line, line[:, None])
        row, column = np.nonzero((radius < 0.5 * diameter) & (radius >= 0.5 * obscuration * diameter))
        return cls(spacing, column, row, origin)


def low_slope_variance(r0: float, outer_scale: float, cutoff: float) -> float:
    """Return the variance of one component of the gradient of the modes below a cut-off wavenumber [rad^2].

    Half of the integral of ``(2 pi nu)^2 W(nu)`` over the disc of wavenumbers, in closed form.
    """
    low = outer_scale**-2
    high = low + (cutoff / (2.0 * math.pi)) ** 2
    integral = 6.0 * (high ** (1 / 6) - low ** (1 / 6)) + 1.2 * low * (high ** (-5 / 6) - low ** (-5 / 6))
    scale = SPECTRUM_CONSTANT * (REFERENCE_WAVELENGTH / (2.0 * math.pi)) ** 2 * r0 ** (-5 / 3)
    return 2.0 * math.pi**3 * scale * integral


class FastPsfEngine:
    def __init__(
        self,
        telescope: Telescope,
        wavelengths: np.ndarray,
        plane: ImagePlane,
        *,
        focal_plane: FocalPlane | None = None,
        atmosphere: Atmosphere | None = None,
        dispersion: np.ndarray | None = None,
        n_pupil: int = 334,
        oversampling: int = 4,
        projection: str = "zemax",
        threads: int | None = None,
        correct: bool = True,
    ) -> None:
        self.telescope = telescope
        self.wavelengths = wavelengths
        self.plane = plane
        self.focal_plane = focal_plane
        self.atmosphere = atmosphere
        self.dispersion = np.zeros((len(wavelengths), 2)) if dispersion is None else dispersion
        self.oversampling = oversampling
        self.projection = projection
        self.threads = threads
        self.correct = correct
        self.batch = BATCH
        diameter, obscuration = telescope.pupil_diameter, telescope.pupil_obscuration
        spacing = math.sqrt(0.25 * math.pi * diameter**2 * (1.0 - obscuration**2) / n_pupil)
        self.stride = 1
        if atmosphere is not None:
            self.stride = max(1, round(spacing / atmosphere.screen_pixel))
            spacing = self.stride * atmosphere.screen_pixel
        self.lattice = PupilLattice.fill(diameter, obscuration, spacing)
        self.cell = plane.pixel_size / oversampling
        self.grid_size = scipy.fft.next_fast_len(math.ceil(GRID_MARGIN * plane.stamp_size * oversampling), real=True)
        self.grid_size += self.grid_size % 2
        k = 2.0 * math.pi * scipy.fft.fftfreq(self.grid_size, self.cell)
        self.kx, self.ky = np.abs(k[: self.grid_size // 2 + 1]), k
        ky = self.ky[:, None]
        gridding = np.sinc(self.kx * (0.5 * self.cell / math.pi)) * np.sinc(ky * (0.5 * self.cell / math.pi))
        self.detector = (plane.transfer(self.kx, ky) / gridding).astype(np.float32)
        if atmosphere is None:
            self.screens = np.zeros((1, 1), dtype=np.float32)
        else:
            screens = atmosphere.low_gradient_screens(threads)
            self.screens = screens.reshape(len(screens), -1)
        self.focal = float(focal_length(trace_pupils(telescope, [(0.0, 0.0)], wavelengths, np.zeros((1, 2)), threads=threads).jacobian)[0])
        self.table_step, self.table = self._filters()

    def _filters(self):
        # 1.5: the diagonal of the grid, and room for a focal length that varies over the field
        longest = 1.5 * self.focal * float(self.wavelengths.max()) / (2.0 * self.cell)
        baseline = np.linspace(0.0, longest, _TABLE_SIZE)
        otf = diffraction_otf(baseline, self.telescope.pupil_diameter, self.telescope.pupil_obscuration)
        table = np.repeat(otf[None], len(self.wavelengths), axis=0)
        if self.atmosphere is not None:
            a = self.atmosphere
            structure = high_structure_function(baseline, a.r0, a.outer_scale, a.cutoff)
            if self.correct:
                geometric = baseline**2 * low_slope_variance(a.r0, a.outer_scale, a.cutoff)
                structure = np.maximum.accumulate(
                    np.maximum(structure_function(baseline, a.r0, a.outer_scale) - geometric, 0.0)
                )
            table *= np.exp(-0.5 * (2.0 * math.pi / self.wavelengths[:, None]) ** 2 * structure)
        return baseline[1], table.astype(np.float32)

    def _packets(self, values: np.ndarray, fill) -> np.ndarray:
        missing = -values.shape[-1] % LANES
        pad = [(0, 0)] * (values.ndim - 1) + [(0, missing)]
        values = np.pad(values, pad, constant_values=fill)
        return np.ascontiguousarray(values.reshape(*values.shape[:-1], -1, LANES))

    def render(self, fields: np.ndarray, offsets: np.ndarray) -> RenderedStars:
        optics = trace_pupils(
            self.telescope, fields, self.wavelengths, self.lattice.points, self.focal_plane, self.projection, self.threads
        )
        n_star, n_wave, n = len(fields), len(self.wavelengths), self.grid_size
        image = self._deposit(optics)
        spectra = np.empty((n_star, n_wave, n, n // 2 + 1), dtype=np.complex64)
        def transform(star: int) -> None:
            spectra[star] = scipy.fft.rfft2(image[star])
        with ThreadPoolExecutor(thread_count(self.threads)) as pool:
            list(pool.map(transform, range(n_star)))
        combined = self._combine(spectra, optics, offsets)
        size, step = self.plane.stamp_size, self.oversampling
        stamps = np.empty((n_star, size, size))
        def back(star: int) -> None:
            fine = scipy.fft.irfft2(combined[star], s=(n, n))
            stamps[star] = fine[: size * step : step, : size * step : step]
        with ThreadPoolExecutor(thread_count(self.threads)) as pool:
            list(pool.map(back, range(n_star)))
        lit = optics.lit.mean(axis=2)
        n_time = 1 if self.atmosphere is None else len(self.atmosphere.times)
        light = optics.lit.sum(axis=(1, 2)) * n_time
        stamps *= (step * step / np.where(light > 0, light, np.nan))[:, None, None]
        return RenderedStars(stamps, lit, optics.jacobian, optics.reference)

    def _deposit(self, optics: PupilOptics) -> np.ndarray:
        n_star, n_wave = optics.lit.shape[:2]
        atmosphere = self.atmosphere
        pixel, n_time, n_layer = 1.0, 1, 0
        start, step = np.zeros((n_star, 1, 2)), np.zeros((1, 2))
        screen_size = 1
        if atmosphere is not None:
            pixel, n_time, n_layer = atmosphere.screen_pixel, len(atmosphere.times), atmosphere.layer_count
            screen_size = atmosphere.screen_size
            direction = field_direction(*optics.fields.T, self.projection)
            slopes = direction[:, :2] / -direction[:, 2:]
            first = self.lattice.origin + atmosphere.offsets - atmosphere.velocities * atmosphere.times[0]
            start = (first - atmosphere.altitudes[:, None] * slopes[:, None, :]) / pixel
            step = -atmosphere.velocities * (atmosphere.exposure / n_time) / pixel
        column = self._packets(self.lattice.column * self.stride, 0).astype(np.int32)
        row = self._packets(self.lattice.row * self.stride, 0).astype(np.int32)
        weight = self._packets(optics.lit.astype(np.float32), 0.0)
        shift = np.where(optics.lit[..., None], optics.displacement, 0.0) / self.cell
        shift = self._packets(np.moveaxis(shift, -1, -2).astype(np.float32), 0.0)
        shift = np.ascontiguousarray(np.moveaxis(shift, 2, 3))
        cells = optics.jacobian.reshape(n_star, 4) / (pixel * self.cell)
        image = np.zeros((n_star, n_wave * self.grid_size**2), dtype=np.float32)
        launch(
            deposit_rays,
            n_star,
            [
                _array(self.screens, wp.float32),
                screen_size, n_layer, n_time,
                _array(start, wp.float64),
                _array(step, wp.float64),
                _array(row * screen_size + column, sample_offsets),
                int(max(column.max(), row.max())) + 1,
                _array(cells.astype(np.float32), wp.float32),
                _array(shift, samples),
                _array(weight, samples),
                self.grid_size,
                wp.empty((n_star, len(column), 2), dtype=samples, device="cpu"),
                _array(image, wp.float32),
            ],
            threads=self.threads,
        )
        return image.reshape(n_star, n_wave, self.grid_size, self.grid_size)

    def _combine(self, spectra: np.ndarray, optics: PupilOptics, offsets: np.ndarray) -> np.ndarray:
        n_star, n_wave, n_row, n_column = spectra.shape
        jj = optics.jacobian @ np.swapaxes(optics.jacobian, 1, 2)
        metric = np.stack([jj[:, 0, 0], jj[:, 0, 1], jj[:, 1, 1]], axis=-1)
        middle = self.plane.stamp_size // 2 * self.plane.pixel_size - self.grid_size // 2 * self.cell
        shift = np.einsum("sij,wj->swi", optics.jacobian, self.dispersion)
        shift = shift + (offsets * self.plane.pixel_size + middle)[:, None, :]
        ramp_x = np.exp(-1j * shift[..., :1] * self.kx).astype(np.complex64)
        ramp_y = np.exp(-1j * shift[..., 1:] * self.ky).astype(np.complex64)
        combined = np.empty((n_star, n_row, n_column), dtype=np.complex64)
        launch(
            combine_wavelengths,
            n_star * n_row,
            [
                _array(spectra.view(np.float32).reshape(*spectra.shape, 2), wp.vec2f),
                float(self.kx[1]),
                _array(metric.astype(np.float32), wp.float32),
                _array((self.wavelengths / (2.0 * math.pi)).astype(np.float32), wp.float32),
                _array(self.table, wp.float32),
                float(self.table_step),
                _array(self.detector, wp.float32),
                _array(ramp_x.view(np.float32).reshape(*ramp_x.shape, 2), wp.vec2f),
                _array(ramp_y.view(np.float32).reshape(*ramp_y.shape, 2), wp.vec2f),
                _array(combined.view(np.float32).reshape(*combined.shape, 2), wp.vec2f),
            ],
            threads=self.threads,
        )
        return combined


def _array(values: np.ndarray, dtype: Any) -> wp.array:
    """Wrap a contiguous array for Warp without a copy."""
    return wp.array(values, dtype=dtype, device="cpu", copy=False)
