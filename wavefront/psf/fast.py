r"""The fast PSF engine: geometric optics for the long waves of the atmosphere, filters for everything else.

Each pair of a pupil point and a time step is a ray. Its angle is the gradient of the low screens where it crosses them;
the Jacobian of the star turns that into a displacement on its CCD, to which the traced transverse aberration of the
optics is added. All rays of a star are binned on a fine grid, at every wavelength from one pass over the atmosphere.
Filters multiply the transform of that image: the ensemble average of the high modes (the
"second kick" of Peterson et al. 2015, as a filter), diffraction by the annular pupil, charge diffusion, the pixel, and
a phase ramp for atmospheric dispersion and the place within the pixel. In silicon each depth has an image of its own,
and rays take turns at the depths.

The filter of the atmosphere is chosen so that the mean over many exposures is right. With the structure function
:math:`D(b)` of the whole atmosphere and the variance :math:`g` of one component of the low gradient, rays alone give
:math:`\exp(-g b^2 / 2)` (both in radians of phase), so the rest is :math:`\exp(-D_{rest}/2)` with
:math:`D_{rest} = D - g b^2`. It starts as the structure function of the high modes does, and falls below that where low
modes are curved over a baseline, which makes plain geometric optics blur too much. Beyond its maximum, where the
rays have left little light, :math:`D_{rest}` would fall without end; it is held there. That leaves the mean FWHM in
the r band 0.1 % too wide for a cut-off of 1/r0 and 0.5 % for 1.4/r0 (plain high modes as the filter: 1.0 and 2.1 %).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
import warp as wp

from ...core.arguments import check_arguments
from ...core.buffers import empty
from ...core.errors import DomainError
from ...core.launch import launch
from ...core.statistics import FWHM_PER_RMS
from ...core.units import require_count
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ..atmosphere.layer_screens import SLOPE_LAG
from ..atmosphere.turbulence import (
    coherence,
    diffraction_otf,
    long_exposure_fwhm,
    slope_variance,
    structure_function,
)
from ..pupil_optics import PupilOptics
from .clear_pupil import lit_fractions
from .engine import ExposedStars, PsfEngine, PsfInputs, PsfRenderer, Stars, expose_by_kind, metric_of
from .far_from_focus import blur_radii, sampling_refinement
from .fast_kernels import combine_wavelengths, deposit_rays
from .image_plane import square_transfer
from .inner_rim import clipped_by_apertures, traced_obscuration
from .pupil_lattice import PupilLattice
from .sample_packets import LANES, indices, samples, to_packets

#: Pupil points by default, with an atmosphere, which smears the pattern of the points.
PUPIL_POINTS = 334
#: Largest distance of these points [m], so that large pupils have more: 334 points in a pupil of 39 m would make as
#: much scatter of e as turbulence of 15 s does. Pupils up to 8.6 m have 334 whatever their obscuration.
LARGEST_SPACING = 0.42
#: Pupil points by default, without an atmosphere.
PUPIL_POINTS_STILL = 5000
#: Side of the fine periodic grid over that of the stamp, with an atmosphere, whose wings wrap around. With 1.25 they
#: would make the edge of a stamp of 6 arcsec 1.5 times and its corners 2.2 times as bright as they are, at 1e-4 of the
#: peak; with 2 they leave 1.1 and 1.2 times.
GRID_MARGIN = 2.0
#: The same without an atmosphere.
GRID_MARGIN_STILL = 1.25
#: Fewest samples of a screen across the pupil, on which its points lie.
LEAST_SAMPLES = 4
#: Cells per pixel by default, with an atmosphere. A ray counts as spread over its cell, which is right on the mean over
#: many rays.
OVERSAMPLING = 2
#: Cells per pixel by default, without an atmosphere: an undisturbed spot may be no larger than a quarter of a pixel.
OVERSAMPLING_STILL = 12
#: Largest cell over the width of an image: pixels as wide as the seeing need more cells. Cells of half of the width
#: would make the brightest pixel 5 % too bright, of 1.5 widths 44 %; of 0.33, 0.25 %.
LARGEST_CELL = 0.3
#: The same over the width without charge diffusion: rays that share one cell are taken for its middle.
LARGEST_CELL_OF_RAYS = 0.5
#: Most cells per pixel.
MOST_CELLS = 32
#: Distance on the CCD of the rays of neighbouring pupil points [pixels], with an atmosphere, beyond which a star counts
#: as far from focus and is drawn with more points, and the largest that it then has.
RAY_DISTANCE = (1.0, 0.25)
#: The same without an atmosphere [pixels].
RAY_DISTANCE_STILL = (0.25, 0.125)
# Most stars of one batch, which are traced by one call.
_BATCH = 256
# Largest memory of the rays and spectra of a batch [bytes], which then has fewer stars.
_BATCH_BYTES = 1 << 26
# Memory of a ray: place, path and status as they are traced, and copies [bytes].
_RAY_BYTES = 80
# Largest memory of the fine grids of the stars of a batch that are drawn together [bytes].
_GRID_BYTES = 1 << 25
# Samples of the filter against the baseline: linear interpolation is then good to 3e-6.
_TABLE_SIZE = 4096


def filter_structure_function(separation: np.ndarray, r0: float, outer_scale: float, cutoff: float) -> np.ndarray:
    """Return the structure function of the filter for all but the low modes [m^2]; it never decreases.

    Separations are rising baselines in the pupil [m]; the low modes are those up to the cut-off [rad/m].
    """
    filter_structure = structure_function(separation, r0, outer_scale)
    filter_structure = filter_structure - slope_variance(r0, outer_scale, cutoff, SLOPE_LAG) * separation**2
    return np.maximum.accumulate(np.maximum(filter_structure, 0.0))


def least_screen_size(diameter: float, screen_length: float) -> int:
    """Return the fewest samples of a screen [m] of which a pupil [m] has :data:`LEAST_SAMPLES` across."""
    return math.ceil(LEAST_SAMPLES * screen_length / diameter)


def largest_screen_length(diameter: float, screen_size: int) -> float:
    """Return the length [m] up to which a screen of so many samples is fine enough for a pupil [m], in full tenths."""
    return math.floor(10.0 * screen_size * diameter / LEAST_SAMPLES) / 10.0


@check_arguments
@dataclass(frozen=True)
class FastEngine(PsfEngine):
    """Geometric optics for the long waves of the atmosphere, with filters for everything else.

    In exposures that freeze the air, images of pupils below half a metre move too little: rms by 4 % at 0.5 m, 8 % at
    0.35 m, 17 % at 0.2 m with a Fried parameter of 0.16 m. Their mean width is right, and :class:`WaveEngine` has all.

    Attributes
    ----------
    n_pupil : int, optional
        Approximate number of pupil points, at least 10: the lattice is a whole number of screen pixels wide. By default
        334, points at most 0.42 m apart, and 5000 without an atmosphere; more for stars far from focus.
    oversampling : int, optional
        Cells of the fine grid per pixel, 1 to 32; by default 2, 12 without an atmosphere, and up to 32 where images
        are narrower than 3.3 of these cells.

    Raises
    ------
    DomainError
        If an option is outside its range.
    """

    name = "fast"
    screens = ("slopes",)

    n_pupil: int | None = None
    oversampling: int | None = None

    def __post_init__(self) -> None:
        if self.n_pupil is not None:
            require_count(self.n_pupil, "n_pupil", 10)
        if self.oversampling is not None:
            require_count(self.oversampling, "oversampling", 1, MOST_CELLS)

    @classmethod
    def default_points(cls, telescope: Telescope) -> int:
        """Return the points by default, with an atmosphere."""
        ring = 0.25 * math.pi * telescope.pupil_diameter**2 * (1.0 - telescope.pupil_obscuration**2)
        return max(PUPIL_POINTS, math.ceil(ring / LARGEST_SPACING**2))

    def _renderer(self, inputs: PsfInputs) -> FastRenderer:
        return FastRenderer(inputs, self)


class FastRenderer(PsfRenderer):
    """Renderer of :class:`FastEngine`; `refinement` divides the spacing of its pupil points."""

    depths = 2

    def __init__(
        self,
        inputs: PsfInputs,
        options: FastEngine,
        refinement: int = 1,
        far_from_focus: bool = False,
        oversampling: int | None = None,
    ) -> None:
        super().__init__(inputs)
        self._options, self._refinement = options, refinement
        #: Inner radius of the points over the outer one.
        self._inner = traced_obscuration(self._obscuration) if far_from_focus else self._obscuration
        still, n_pupil = inputs.atmosphere is None, options.n_pupil
        if n_pupil is None:
            n_pupil = PUPIL_POINTS_STILL if still else options.default_points(inputs.telescope)
        self._usual_cells = OVERSAMPLING_STILL if still else OVERSAMPLING
        self._oversampling = options.oversampling or oversampling or self._usual_cells
        self._place_pupil(n_pupil)
        self._make_grid()
        self._filter_step, self._filter = self._filter_table()
        n_time = 1 if inputs.atmosphere is None else len(inputs.atmosphere.times)
        self._schedule = self._channels.depth_schedule(n_time, -(-len(self._points) // LANES))
        if inputs.atmosphere is None:
            self._units = np.zeros(1, dtype=np.float32)
        else:
            layers = range(inputs.atmosphere.layer_count)
            self._units = np.array([inputs.atmosphere.slope_unit(n) for n in layers], dtype=np.float32)
        grid_bytes = 4 * len(self._channels.wave) * self._grid_size**2
        self._grid_batch = max(1, _GRID_BYTES // grid_bytes)
        # Besides its spectrum, on the finest of grids that stars may need, each star of a batch has rays.
        finest = self._grid_size
        if options.oversampling is None and oversampling is None:
            finest = self._grid_side(int(self._cells_needed(np.zeros(1))[0]))
        star_bytes = 4 * finest**2 + _RAY_BYTES * len(self._wavelengths) * len(self._points)
        self.batch = max(1, min(_BATCH, _BATCH_BYTES // star_bytes))

    def _place_pupil(self, n_pupil: int) -> None:
        diameter, obscuration = self._diameter, self._inner
        spacing = 0.5 * diameter * math.sqrt(math.pi * (1.0 - obscuration**2) / n_pupil)
        self._stride = 1
        if self._atmosphere is not None:
            pixel = self._atmosphere.screen_pixel
            self._stride = max(1, round(spacing / pixel))
            spacing = self._stride * pixel
            if self._atmosphere.screen_length < diameter + 2.0 * pixel:
                raise DomainError(
                    f"screen_length = {self._atmosphere.screen_length!r}: expected screens wider than the pupil,"
                    f" {diameter} m"
                )
            least = least_screen_size(diameter, self._atmosphere.screen_length)
            if self._atmosphere.screen_size < least:
                raise DomainError(
                    f"screen_size = {self._atmosphere.screen_size}: expected at least {least}, so that a pupil of"
                    f" {diameter:g} m has {LEAST_SAMPLES} samples across, or a screen_length of at most"
                    f" {largest_screen_length(diameter, self._atmosphere.screen_size):g} m"
                )
        self._lattice = PupilLattice.fill(diameter, obscuration, spacing / self._refinement)
        self._points = self._lattice.points
        self._weights = self._lattice.weights(diameter, obscuration)

    def _make_grid(self) -> None:
        """Lay out the fine grid and its frequencies."""
        self._cell = self._plane.pixel_size / self._oversampling
        self._grid_size = self._grid_side(self._oversampling)
        self._ky = 2.0 * math.pi * scipy.fft.fftfreq(self._grid_size, self._cell)
        self._kx = 2.0 * math.pi * scipy.fft.rfftfreq(self._grid_size, self._cell)
        ky = self._ky[:, None]
        # Binning has averaged over a cell already: the filter undoes that.
        detector = self._plane.transfer(self._kx, ky) / square_transfer(self._kx, ky, self._cell)
        self._detector = detector.astype(np.float32)

    def _grid_side(self, oversampling: int) -> int:
        """Return the cells on a side of the fine grid with so many cells per pixel."""
        margin = GRID_MARGIN_STILL if self._atmosphere is None else GRID_MARGIN
        size = math.ceil(margin * self._plane.size * oversampling)
        # even, for the half plane of frequencies of a real transform
        return 2 * scipy.fft.next_fast_len(-(-size // 2), real=True)

    def _cells_needed(self, blur: np.ndarray) -> np.ndarray:
        """Return the cells per pixel, the usual ones times a power of two, of stars whose optics blur by so much.

        The blurs are rms radii [m], [n_star].
        """
        usual = self._usual_cells
        rays = np.hypot(self._least_width, FWHM_PER_RMS * math.sqrt(0.5) * blur)
        gauss = FWHM_PER_RMS * math.hypot(self._plane.diffusion, self._plane.jitter)
        largest = LARGEST_CELL * np.hypot(rays, gauss)
        if self._atmosphere is not None:
            largest = np.minimum(largest, LARGEST_CELL_OF_RAYS * rays)
        power = np.ceil(np.log2(np.maximum(self._plane.pixel_size / (largest * usual), 1.0)))
        return np.minimum(usual * 2 ** power.astype(np.int64), MOST_CELLS)

    @cached_property
    def _least_width(self) -> float:
        """Width at half maximum of stars of ideal optics, by air and diffraction alone [m]."""
        ends = (float(self._wavelengths.min()), float(self._wavelengths.max()))
        air = self._atmosphere
        if air is None:
            return ends[0] / self._diameter * self.focal_length
        angles = (
            long_exposure_fwhm(wave, air.r0, air.outer_scale, diameter=self._diameter, obscuration=self._obscuration)
            for wave in ends
        )
        return self.focal_length * min(angles)

    def _filter_table(self) -> tuple[float, np.ndarray]:
        """Return the step of the baselines [m] and the filter at them, shape [n_wave, n]."""
        # 1.5: to the corner of the grid of frequencies, and some room for a scale that changes over the field
        longest = 1.5 * self.focal_length * float(self._wavelengths.max()) / (2.0 * self._cell)
        baseline = np.linspace(0.0, longest, _TABLE_SIZE)
        table = np.repeat(self._diffraction(baseline)[None], len(self._wavelengths), axis=0)
        structure = self._filter_structure(baseline)
        if structure is not None:
            table *= coherence(structure, self._wavelengths[:, None])
        return float(baseline[1]), table.astype(np.float32)

    def _diffraction(self, baseline: np.ndarray) -> np.ndarray:
        """Return the transfer function of diffraction, common to all rays, at baselines [m]."""
        return diffraction_otf(baseline, self._diameter, self._obscuration)

    def _filter_structure(self, baseline: np.ndarray) -> np.ndarray | None:
        """Return the structure function of the filter [m^2] at baselines [m]; None without an atmosphere."""
        air = self._atmosphere
        return None if air is None else filter_structure_function(baseline, air.r0, air.outer_scale, air.cutoff)

    def prepare(self, fields: np.ndarray) -> None:
        """Make the rows of the screens that the light of stars crosses."""
        self._slopes(fields)

    def _slopes(self, fields: np.ndarray) -> np.ndarray:
        """Return the slopes [n_layer, samples] of the screens, at least of the rows that the light of stars crosses."""
        air = self._atmosphere
        if air is None:
            return np.zeros((1, 1), dtype=np.int32)
        # The kernel moves the lattice by up to a sample.
        rows = air.rows_under(self._direction(fields), 0.5 * self._diameter + air.screen_pixel)
        return air.screens("slopes", self._threads, rows).reshape(air.layer_count, -1)

    def _expose(self, stars: Stars) -> ExposedStars:
        optics = self._trace(stars.fields, self._points, self._threads)
        refinement = np.ones(len(stars), dtype=np.int64)
        cells = np.full(len(stars), self._oversampling)
        if self._options.n_pupil is None:
            pixel = self._plane.pixel_size
            largest, refined = RAY_DISTANCE_STILL if self._atmosphere is None else RAY_DISTANCE
            neighbour = 2.0 * self._lattice.spacing / self._diameter
            refinement = sampling_refinement(optics, neighbour, largest * pixel, refined * pixel)
        if self._options.oversampling is None:
            cells = self._cells_needed(blur_radii(optics))
        if (refinement == 1).all() and (cells == self._oversampling).all():
            return self._expose_traced(optics, stars)
        samplings, kinds = np.unique(np.stack([refinement, cells], axis=1), axis=0, return_inverse=True)

        def expose(kind: int, stars: Stars) -> ExposedStars:
            points, oversampling = map(int, samplings[kind])
            renderer = FastRenderer(self._inputs, self._options, points, points > 1, oversampling)
            return renderer.expose_without_refinement(stars)

        return expose_by_kind(kinds.reshape(-1), expose, stars)

    def expose_without_refinement(self, stars: Stars) -> ExposedStars:
        """Expose stars with the pupil points of this renderer, however far from focus they are."""
        return self._expose_traced(self._trace(stars.fields, self._points, self._threads), stars)

    def _expose_traced(self, optics: PupilOptics, stars: Stars) -> ExposedStars:
        if self._inner < self._obscuration:
            optics = clipped_by_apertures(optics, self._points, 0.5 * self._diameter * self._obscuration)
        light = optics.lit * self._weights
        if stars.photons is not None:
            light = light * stars.photons[:, :, None]
        combined = np.empty((len(light), self._grid_size, len(self._kx)), dtype=np.complex64)
        for first in range(0, len(light), self._grid_batch):
            part = slice(first, first + self._grid_batch)
            part_optics = optics.stars(part)
            spectra = self._transforms(self._deposit(part_optics, light[part]), part_optics, light[part])
            self._combine(spectra, part_optics, stars.offsets[part], combined[part])
        # A dark star has no light to divide by.
        total = np.where(optics.lit.any(axis=(1, 2)), light.sum(axis=(1, 2)), 1.0) * len(self._schedule.time)

        def draw(shift: np.ndarray | None) -> np.ndarray:
            return self._stamps(combined, total, shift)

        return ExposedStars(draw, self._lit_fraction(optics, stars), optics.reference_points)

    def _lit_fraction(self, optics: PupilOptics, stars: Stars) -> np.ndarray:
        """Return the lit fractions of the pupil, [n_star, n_wave]; the points of an image are too few for them."""
        directions = self._direction(stars.fields)
        fraction = lit_fractions(self._telescope, directions, self._cut_wavelength, self._threads)
        return np.where(optics.lit.any(axis=2), fraction[:, None], 0.0)

    def _transforms(self, deposit: np.ndarray, optics: PupilOptics, light: np.ndarray) -> np.ndarray:
        """Return the transforms of the binned rays, shape [n_star, n_channel, ky, kx]."""
        shape = (*deposit.shape[:3], len(self._kx))
        # The kernel that combines them may read a packet on.
        spectra = empty((math.prod(shape) + LANES,), np.complex64)[:-LANES].reshape(shape)

        def transform(star: int) -> None:
            # One transform a star, so that its bytes do not depend on its neighbours.
            spectra[star] = scipy.fft.rfft2(deposit[star])

        self._map(transform, range(len(deposit)))
        return spectra

    def _stamps(self, combined: np.ndarray, light: np.ndarray, shift: np.ndarray | None = None) -> np.ndarray:
        """Return the stamps of transforms of the fine grid as fractions of each star's light, [n_star, side, side].

        Stars are moved back by a shift [pixels], shape [n_star, 2], where there is one.
        """
        size, step = self._grid_size, self._oversampling
        span = slice(0, self._plane.size * step, step)
        stamps = np.empty((len(combined), self._plane.size, self._plane.size))
        # The transform gave light per cell; a pixel, averaged over already, holds so many cells.
        scale = self._oversampling**2 / light

        def sample(star: int) -> None:
            spectrum = combined[star]
            if shift is not None:
                # A move of the whole star is a ramp of phase; the rays need not be traced nor binned again.
                ramp = 1j * self._plane.pixel_size * shift[star, :, None]
                spectrum = spectrum * np.exp(ramp[1] * self._ky).astype(np.complex64)[:, None]
                spectrum *= np.exp(ramp[0] * self._kx).astype(np.complex64)
            # As irfft2, of which only the rows of pixels are needed: its factor is applied at the end.
            rows = scipy.fft.ifft(spectrum, axis=0, norm="forward")[span]
            image = scipy.fft.irfft(rows, size, norm="forward")[:, span]
            stamps[star] = (image * np.float32(1.0 / size**2)).astype(np.float64) * scale[star]

        self._map(sample, range(len(combined)))
        return stamps

    def _deposit(self, optics: PupilOptics, light: np.ndarray) -> np.ndarray:
        """Return the rays of each star, with their light, on the fine grid, [n_star, n_channel, size, size]."""
        n_star, n_channel = len(optics.lit), len(self._channels.wave)
        atmosphere = self._atmosphere
        if atmosphere is None:
            pixel, screen_size, n_layer = 1.0, 1, 0
            start, step = np.zeros((n_star, 1, 2)), np.zeros((1, 2))
            column = row = np.zeros(len(self._points), dtype=np.int64)
        else:
            pixel, screen_size = atmosphere.screen_pixel, atmosphere.screen_size
            n_layer = atmosphere.layer_count
            start = (
                atmosphere.pupil_centers(self._direction(optics.fields), atmosphere.times[0]) + self._lattice.origin
            ) / pixel
            # Points that share a sample of the screens stand around it.
            start += 0.5 * (1.0 - math.gcd(self._stride, self._refinement) / self._refinement)
            step = -atmosphere.velocities * (atmosphere.exposure / len(atmosphere.times)) / pixel
            column, row = (
                line * self._stride // self._refinement for line in (self._lattice.column, self._lattice.row)
            )
        lattice = to_packets(row * screen_size + column, np.int32)
        # Rays that were lost have no place to land; they carry no light either.
        lit = optics.lit[:, self._channels.wave, :, None]
        landed = np.where(lit, self._channels.displacement(optics), 0.0) / self._cell
        displacement = np.stack([to_packets(landed[..., axis], np.float32) for axis in (0, 1)], axis=-2)
        cells_per_slope = optics.jacobian.reshape(n_star, 4) / self._cell
        image = empty((n_star, n_channel * self._grid_size**2), np.float32)
        image[:] = 0.0
        launch(
            deposit_rays.plain if self._channels.depths == 1 else deposit_rays.special,
            n_star,
            [
                warp_array(self._slopes(optics.fields), wp.int32),
                warp_array(self._units, wp.float32),
                screen_size,
                n_layer,
                len(self._schedule.time),
                warp_array(start, wp.float64),
                warp_array(step, wp.float64),
                warp_array(self._schedule.time.astype(np.int32), wp.int32),
                warp_array(self._schedule.channel, wp.int32),
                warp_array(lattice, indices),
                int(max(column.max(), row.max())) + 1,
                warp_array(cells_per_slope.astype(np.float32), wp.float32),
                warp_array(displacement, samples),
                warp_array(to_packets(light, np.float32, fill="constant"), samples),
                self._grid_size,
                wp.empty((n_star, len(lattice), 2), dtype=samples, device="cpu"),
                warp_array(image, wp.float32),
            ],
            threads=self._threads,
        )
        return image.reshape(n_star, n_channel, self._grid_size, self._grid_size)

    def _combine(self, spectra: np.ndarray, optics: PupilOptics, offsets: np.ndarray, combined: np.ndarray) -> None:
        """Store the filtered sum over channels of the transforms of each star in an array [n_star, ky, kx]."""
        n_star, _, n_row, _ = spectra.shape
        channels, wave = self._channels, self._channels.wave
        shift = np.einsum("sij,wj->swi", optics.jacobian, self._dispersion)[:, wave]
        # The deposit has its origin in the middle cell; the first pixel of the stamp belongs in the first.
        middle = self._plane.middle * self._plane.pixel_size - self._grid_size // 2 * self._cell
        shift = shift + (offsets * self._plane.pixel_size + middle)[:, None, :]
        # Rays of a channel stand for its light; the further diffusion is a product of Gaussians along x and y.
        across = (channels.weight / self._schedule.fraction)[:, None] * channels.spread(self._kx)
        along = channels.spread(self._ky)
        ramp_x = across * np.exp(-1j * shift[..., :1] * self._kx)
        launch(
            combine_wavelengths,
            n_star * n_row,
            [
                warp_array(spectra.view(np.float32), wp.float32),
                float(self._kx[1]),
                warp_array(metric_of(optics.jacobian), wp.float32),
                warp_array((self._wavelengths / (2.0 * math.pi)).astype(np.float32), wp.float32),
                warp_array(self._filter, wp.float32),
                self._filter_step,
                warp_array(to_packets(self._detector, np.float32), samples),
                warp_array(to_packets(np.stack([ramp_x.real, ramp_x.imag], axis=2), np.float32), samples),
                warp_array((along * np.exp(-1j * shift[..., 1:] * self._ky)).astype(np.complex64), wp.vec2f),
                warp_array(combined.view(np.float32), wp.float32),
            ],
            threads=self._threads,
        )
