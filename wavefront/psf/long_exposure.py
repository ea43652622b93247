r"""The long-exposure PSF engine: the mean over all turbulence of PSFs of the optics, without random numbers.

The mean transfer function over all turbulence is a product (Roddier 1981, sec. 4): of :math:`e^{-D(b)/2}` with the
von Karman structure function of the whole atmosphere, of the detector, and of the optics,

.. math:: \frac{1}{A} \int P(p + b/2) \, P(p - b/2) \, e^{i k [W(p + b/2) - W(p - b/2)]} \, dp.

The atmosphere leaves nothing of baselines b beyond some 0.6 m, over which the path W of the optics is straight but for
its third derivative. So the phase is that of where the ray through p lands, and the integral is one over the clear
pupil, less the strips along its rims where one of the two points has left it. The rays there land farther out than
others do: to multiply the image of all rays by the transfer function of diffraction, as if those strips were spread
evenly, would make e wrong by 1e-3 and the FWHM by 0.5 %.

Rays are traced on rings and spokes. The distance of rays from the rims of the apertures gives the rims of the clear
pupil on each spoke; the points of a Gauss-Lobatto rule in the square of the radius, two of which lie on the rims,
are put between them, and landing points interpolated along the spoke. Unlike a count of rays that pass, this moves
smoothly when the telescope is perturbed. A strip along a rim is as wide as half the baseline across the rim; its phase
is that of its middle, to first order.

In silicon the rays of a wavelength land at several depths, and their waves are added up before the strips are cut off.

Where anything but discs and rings stops light, much of the pupil is vignetted or long baselines matter, the exact
autocorrelation over a lattice of rays takes the place of spokes and strips (:mod:`.lattice_pupil`), at some thirty
times the cost.

Stars far from focus (donuts) are drawn by the dense rays of :mod:`.mean_rays`, less the same strips. Pupils whose long
baselines matter have no strips: they keep the lattice, or are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np
import warp as wp

from ...core.arguments import check_arguments
from ...core.buffers import empty
from ...core.errors import DomainError
from ...core.launch import launch
from ...core.units import field_label, require_count
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ..atmosphere.turbulence import coherence, structure_function
from ..pupil_optics import PupilOptics
from .clear_pupil import SpokePupil, clear_areas, clear_edges, has_only_annuli
from .engine import ExposedStars, PsfEngine, PsfInputs, PsfRenderer, Stars, expose_by_kind, metric_of
from .far_from_focus import bent_across_strips, stopped_rays_astray
from .lattice_pupil import (
    LATTICE_POINTS,
    MOST_ACROSS,
    MOST_ACROSS_ALONE,
    RINGS_POINTS,
    LatticeRays,
    LatticeTransfer,
    laid_out,
)
from .long_exposure_kernels import place_points, sample_pixels, transform_pupils
from .mean_rays import MeanRaysRenderer, drawing_ray_counts, ray_counts
from .pupil_rims import strip_overlap
from .sample_packets import LANES, samples
from .spoke_sums import RIM_NUMBERS

#: Pupil points by default: 16 spokes of 5 rings.
PUPIL_POINTS = 80
#: Side of the periodic image over that of the stamp: wings that wrap around make the edge of a stamp of 6 arcsec 1.4
#: times as bright as it should be, and change ellipticities by 1e-6, the FWHM by 1e-5 and the rms size by 7e-5.
GRID_MARGIN = 1.25
# Largest coherence at a baseline half as long as the pupil's ring is wide, where the strips along its rims are a half
# of it: on AuxTel, where 0.04 are left, they are wrong by 1e-3 in e.
_LARGEST_LEFT = 1e-3
# Kinds of stars beside those of so many rays: near focus; then each of the denser pupils, from -1 downwards; and by the
# lattice, after the last of them.
_NEAR = 0
# Bytes of a point of the lattice and a wavelength.
_LATTICE_BYTES = 24
# Most stars of one batch.
_BATCH = 1024
# Largest memory of the waves of a batch [bytes], which then has fewer stars.
_BATCH_BYTES = 1 << 26
# Samples of the filter against the baseline: linear interpolation is then good to 1e-6.
_TABLE_SIZE = 2048


@check_arguments
@dataclass(frozen=True)
class LongExposureEngine(PsfEngine):
    """Mean over all turbulence, the quickest engine for many stars per call.

    It needs an atmosphere, of which it uses the Fried parameter and the outer scale only; screens are not made.

    Attributes
    ----------
    n_pupil : int, optional
        Approximate number of pupil points, at least 10; at least 500, of a lattice in a disc, where anything but discs
        and rings stops light. By default 80 and 30000; stars far from focus are drawn by more rays.

    Raises
    ------
    DomainError
        If there are too few points.
    """

    name = "long_exposure"
    needs_atmosphere = True
    has_turbulence = False
    #: Points on spokes by default.
    spoke_points: ClassVar[int] = PUPIL_POINTS
    #: The same of a lattice in a disc, where anything but discs and rings stops light.
    lattice_points: ClassVar[int] = LATTICE_POINTS

    n_pupil: int | None = None

    def __post_init__(self) -> None:
        if self.n_pupil is not None:
            require_count(self.n_pupil, "n_pupil", 10)

    @classmethod
    def default_points(cls, telescope: Telescope) -> int:
        """Return the points by default: on spokes where only discs and rings stop light, else of a lattice."""
        return cls.spoke_points if has_only_annuli(telescope) else cls.lattice_points

    def _renderer(self, inputs: PsfInputs) -> LongExposureRenderer:
        return LongExposureRenderer(inputs, self)


class LongExposureRenderer(PsfRenderer):
    """Renderer of :class:`LongExposureEngine`."""

    depths = 2
    #: Largest transfer function of atmosphere and detector at a frequency that is left out; with pixels of 10 um all
    #: make 2e-6 of the peak of the image.
    negligible: ClassVar[float] = 1e-5
    #: Part of the ring that is lit from which on rims cross few spokes. At 8 um of defocus e of the LSST is wrong by
    #: 1e-4 at 0.8, by 1e-3 at 0.61.
    least_lit: ClassVar[float] = 0.75
    #: Denser pupils of stars that are lit less than :attr:`least_lit`: from which part on, spokes and rings. e of the
    #: LSST is wrong by 1e-4 above 0.6, by 2e-4 with M2 10 um out of focus, its size by 1e-4; with the most spokes e by
    #: 5e-5 and its size by 1e-4. The lattice stands for them below.
    dense: ClassVar[tuple[tuple[float, int, int], ...]] = ((0.6, 64, 5), (0.5, 128, 6))

    def __init__(self, inputs: PsfInputs, options: LongExposureEngine) -> None:
        super().__init__(inputs)
        self._options = options
        #: Side of the periodic image [m].
        self.period = self._period()
        # Baseline of one step of frequency at each wavelength [m].
        self._step = self._wavelengths * self.focal_length / self.period
        # Width of the pupil's ring.
        self._width = 0.5 * self._diameter * (1.0 - self._obscuration)
        rings = has_only_annuli(self._telescope)
        # Whether every star needs the lattice in place of strips along the rims.
        self._strips = self._strips_suffice()
        self._general = not rings or not self._strips
        count = options.n_pupil or options.lattice_points
        if rings:
            count = options.lattice_points if self._general else RINGS_POINTS
        self._lattice = LatticeTransfer.fill(self._diameter, self._obscuration, count, self._wavelengths)
        self._choose_frequencies()
        self._tabulate_pixels()
        if self._general:
            star_bytes = _LATTICE_BYTES * len(self._wavelengths) * len(self._lattice.points)
        else:
            self._tabulate_filter()
            n_pupil = options.spoke_points if options.n_pupil is None else options.n_pupil
            self._pupil = SpokePupil.fill(self._diameter, self._obscuration, n_pupil)
            star_bytes = 2 * 2 * 4 * LANES * self._detector.shape[2] * len(self._pupil.points) * self._channels.depths
        self.batch = max(1, min(_BATCH, _BATCH_BYTES // star_bytes))

    def _period(self) -> float:
        """Return the side of the periodic image [m]."""
        plane = self._plane
        return max(GRID_MARGIN * (plane.size - plane.room), plane.size) * plane.pixel_size

    def _turbulence(self, baseline: np.ndarray) -> np.ndarray:
        """Return the mean transfer function of the atmosphere at baselines [m] of all wavelengths, or of each.

        Baselines have the shape [n] or [n_wave, n], the result has [n_wave, n].
        """
        air = self._atmosphere
        assert air is not None, "the engine needs one"
        return coherence(structure_function(baseline, air.r0, air.outer_scale), self._wavelengths[:, None])

    def _transfer_bounds(self, longest: float) -> np.ndarray:
        """Return the largest transfer of atmosphere and detector at each frequency up to a baseline [m], [n_wave, n].

        It is the larger one of those along the axes and the diagonal.
        """
        step = self._step
        count = np.arange(1, math.ceil(longest / step.min()) + 1)
        k = 2.0 * math.pi / self.period * count
        diagonal = math.sqrt(0.5) * k
        detector = [self._plane.transfer(*along) for along in ((k, 0 * k), (0 * k, k), (diagonal, diagonal))]
        air = self._turbulence(step[:, None] * count)
        transfer = air * np.max(np.abs(detector), axis=0)
        return np.asarray(transfer * self._channels.of_wavelength(self._channels.spread(k)))

    def _strips_suffice(self) -> bool:
        """Return whether the transfer is negligible at baselines of half the width of the pupil's annulus."""
        half = 0.5 * self._width
        transfer = self._transfer_bounds(half)
        last = np.minimum(np.ceil(half / self._step).astype(int), transfer.shape[1]) - 1
        return bool(transfer[np.arange(len(transfer)), last].max() <= _LARGEST_LEFT)

    def _choose_frequencies(self) -> None:
        """Choose the largest frequency of the sums."""
        longest = self._diameter if self._general else self._width
        strong = np.flatnonzero((self._transfer_bounds(longest) > self.negligible).any(axis=0))
        #: Largest frequency along either axis, in steps of one over the period.
        self._reach = int(strong[-1]) + 1 if strong.size else 1

    def _tabulate_filter(self) -> None:
        """Tabulate the filter of the points and strips of the pupil: the atmosphere, and the overlap of strips."""
        baseline = self._baselines()
        overlap = strip_overlap(baseline, self._diameter, self._obscuration)
        table = self._turbulence(baseline) * overlap / len(self._wavelengths)
        # The baseline of frequency k is wavelength / 2 pi |J^T k|.
        self._filter = np.ascontiguousarray(table, dtype=np.float32)
        self._filter_steps = (self._wavelengths / (self.period * baseline[1])).astype(np.float32)

    def _baselines(self) -> np.ndarray:
        """Return the baselines of tables [m], [_TABLE_SIZE]."""
        # 1.5: to the corner of the grid of frequencies, and some room for a scale that changes over the field
        return np.linspace(0.0, 1.5 * self._reach * self._step.max(), _TABLE_SIZE)

    def _tabulate_pixels(self) -> None:
        """Tabulate the detector over the frequencies, and the waves over the pixels."""
        reach, plane = self._reach, self._plane
        n_row, n_packet = reach + 1, -(-(reach + 1) // LANES)
        row, column = np.arange(n_row), np.arange(n_packet * LANES)
        # Rows 0 to n of a disc of frequencies, for each packet of columns.
        self._rows = (np.sqrt(reach**2 - column[::LANES] ** 2).astype(int) + 1).astype(np.int32)
        k = 2.0 * math.pi / self.period
        inside = column**2 + row[:, None] ** 2 <= reach**2
        # Only one half of the plane is added up: columns m > 0 stand for -m too, and row 0 is added for +0 and -0.
        scale = np.where(column > 0, 2.0, 1.0) * np.where(row > 0, 1.0, 0.5)[:, None]
        scale = np.where(inside, (plane.pixel_size / self.period) ** 2 * scale, 0.0)
        detector = [scale * plane.transfer(k * column, sign * k * row[:, None]) for sign in (1.0, -1.0)]
        self._detector = np.stack(detector).reshape(2, n_row, n_packet, LANES).astype(np.float32)
        angle = k * np.outer(plane.pixel_centers, row)
        self._pixel_rows = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
        across = -(-plane.size // LANES)
        columns = np.zeros((2, n_row, across * LANES), dtype=np.float32)
        columns[:, :, : plane.size] = np.stack([np.cos(angle.T), np.sin(angle.T)])
        self._pixel_columns = columns.reshape(2, n_row, across, LANES)
        spread = self._channels.spread(k * column).reshape(-1, n_packet, LANES)
        self._fade_x = (self._channels.weight[:, None, None] * spread).astype(np.float32)
        self._fade_y = spread.astype(np.float32)

    def _order(self, fields: np.ndarray) -> np.ndarray:
        # From the centre outwards, so that stars that lose much light share a few batches.
        return np.argsort(np.hypot(*fields.T), kind="stable")

    def _expose(self, stars: Stars) -> ExposedStars:
        if self._general:
            return self._expose_lattice(stars)
        optics, edges = self._near_optics(stars, self._pupil)
        lit = self._lit_fraction(edges)
        bounds = np.array([self.least_lit, *(least for least, _, _ in self.dense)])
        kinds = _NEAR - (lit[:, None] < bounds).sum(axis=1)
        if self._options.n_pupil is None:
            rays, air = self._ray_counts(optics), self._atmosphere
            bent = air is not None and bent_across_strips(optics, self.focal_length, self._diameter, air.r0)
            astray = stopped_rays_astray(optics, self._pupil.radius, self.focal_length)
            kinds = np.where(bent | (astray & (rays == 0)), -1 - len(self.dense), np.where(rays > 0, rays, kinds))
        if (kinds == _NEAR).all():
            return self._expose_spokes(optics, edges, stars, self._pupil)
        near = np.flatnonzero(kinds == _NEAR)

        def expose(kind: int, stars: Stars) -> ExposedStars:
            """Expose stars of a kind: by strips, by a lattice or, far from focus, by a number of rays."""
            if kind == _NEAR:
                return self._expose_spokes(optics.stars(near), edges[near], stars, self._pupil)
            if kind == -1 - len(self.dense):
                return self._expose_lattice(stars)
            if kind < _NEAR:
                _, n_spoke, n_ring = self.dense[-1 - kind]
                return self._expose_dense(stars, n_spoke, n_ring)
            return self._expose_rays(kind, stars)

        return expose_by_kind(kinds, expose, stars)

    def _near_optics(self, stars: Stars, pupil: SpokePupil) -> tuple[PupilOptics, np.ndarray]:
        """Return the optics of stars through points on spokes, and the edges of their clear pupils."""
        return self._trace(stars.fields, pupil.points, self._threads), self._edges(stars.fields, pupil)

    def _expose_dense(self, stars: Stars, n_spoke: int, n_ring: int) -> ExposedStars:
        """Expose stars by strips along so many spokes."""
        pupil = SpokePupil.fill(self._diameter, self._obscuration, n_spoke * n_ring, n_ring)
        step = max(1, self.batch * len(self._pupil.points) // len(pupil.points))
        parts = []
        for first in range(0, len(stars), step):
            some = stars[first : first + step]
            optics, edges = self._near_optics(some, pupil)
            lit = self._lit_fraction(edges)
            spectrum = self._exposed_spectra(self._transform(optics, edges, some.photons, pupil), optics, lit)
            parts.append((spectrum, lit, optics.reference_points))
        spectrum, lit, points = (np.concatenate(values) for values in zip(*parts, strict=True))
        return self._sampled(spectrum, stars.offsets, np.repeat(lit[:, None], len(self._wavelengths), axis=1), points)

    def _ray_counts(self, optics: PupilOptics) -> np.ndarray:
        """Return the number of rays of each star far from focus, 0 near it, shape [n_star] int."""
        return ray_counts(optics, self._plane.pixel_size, self.focal_length)

    def _expose_rays(self, rays: int, stars: Stars) -> ExposedStars:
        """Expose stars far from focus by a number of rays."""
        return MeanRaysRenderer(self._inputs, rays).expose_without_refinement(stars)

    def _exposed_spectra(self, spectrum: np.ndarray, optics: PupilOptics, lit: np.ndarray) -> np.ndarray:
        """Return the transfer functions of stars in one exposure, of lit fractions [n_star]; here the mean ones."""
        return spectrum

    def _expose_lattice(self, stars: Stars) -> ExposedStars:
        """Expose stars by lattices as fine as each needs, or by rays where that is too fine and strips suffice."""
        rays = self._lattice_rays(self._lattice, stars)
        refinement = self._lattice.refinement(rays)
        if (refinement == 1).all():
            return self._expose_autocorrelation([(self._lattice, rays, stars)])
        finest = (MOST_ACROSS if self._strips else MOST_ACROSS_ALONE) // self._lattice.lattice.size
        if not self._strips:
            self._check_refinement(refinement, finest, stars)
        kinds = np.where(refinement > finest, -drawing_ray_counts(rays.optics, self._plane.pixel_size), refinement)

        def expose(kind: int, stars: Stars) -> ExposedStars:
            if kind < 0:
                return self._expose_rays(-kind, stars)
            lattice = self._lattice.refined(kind)
            step = max(1, self.batch // kind**2)
            parts = (stars[first : first + step] for first in range(0, len(stars), step))
            return self._expose_autocorrelation(
                (lattice, self._lattice_rays(lattice, star_batch), star_batch) for star_batch in parts
            )

        return expose_by_kind(kinds, expose, stars)

    def _check_refinement(self, refinement: np.ndarray, finest: int, stars: Stars) -> None:
        """Raise a DomainError for a star whose lattice would be finer than the finest one."""
        star = int(np.argmax(refinement))
        if refinement[star] > finest:
            raise DomainError(
                f"{field_label(stars.fields[star])}: the star is too far from focus for a pupil of"
                f" {self._diameter:g} m, by {refinement[star] / finest:.2g} times; expected a telescope nearer to focus"
                f" with engine = {self._options.name!r} ('wave' draws others)"
            )

    def _lattice_rays(self, lattice: LatticeTransfer, stars: Stars) -> LatticeRays:
        def traced(wavelengths: np.ndarray, points: np.ndarray) -> PupilOptics:
            return self._trace(stars.fields, points, self._threads, wavelengths, exit_pupil=True)

        return lattice.trace(traced)

    def _expose_autocorrelation(self, parts: Iterable[tuple[LatticeTransfer, LatticeRays, Stars]]) -> ExposedStars:
        """Expose stars by the autocorrelation of their lattices, batch by batch."""
        spectra, lit, points, offsets = [], [], [], []
        for lattice, rays, stars in parts:
            transfers = self._map(
                partial(self._autocorrelation_transfer, lattice, rays, stars.photons), range(len(stars))
            )
            fractions = rays.optics.lit.mean(axis=2)
            spectra.append(self._exposed_spectra(np.stack(transfers), rays.optics, fractions[:, 0]))
            lit.append(np.repeat(fractions, len(self._wavelengths), axis=1))
            points.append(rays.optics.reference_points)
            offsets.append(stars.offsets)
        together = (np.concatenate(values) for values in (offsets, lit, points))
        return self._sampled(np.concatenate(spectra), *together)

    def _autocorrelation_transfer(
        self, lattice: LatticeTransfer, rays: LatticeRays, photons: np.ndarray | None, star: int
    ) -> np.ndarray:
        """Return the transfer function of a star without the detector, as :func:`transform_pupils` lays it out."""
        n_row = self._detector.shape[1]
        row, column = np.nonzero(self._detector[0].reshape(n_row, -1))
        # Columns m and rows +n, then rows -n.
        k = 2.0 * math.pi / self.period * np.stack([np.tile(column, 2), np.concatenate([row, -row])], axis=1)
        along = k @ rays.optics.jacobian[star]
        baseline = np.hypot(*along.T) / (2.0 * math.pi)
        table, channels = self._atmosphere_table, self._channels
        air = np.array([np.interp(w * baseline, *table[[0, n]]) for n, w in enumerate(self._wavelengths, 1)])
        filters = (air * np.exp(-1j * (self._dispersion @ along.T)))[channels.wave]
        filters *= channels.weight[:, None] * channels.spread(np.hypot(*k.T))
        if photons is not None:
            filters *= photons[star, channels.wave, None]
        total = np.sum(lattice.at(rays, star, channels, k) * filters, axis=0)
        return laid_out(total, row, column, self._detector.shape[1:])

    @cached_property
    def _atmosphere_table(self) -> np.ndarray:
        """Baselines [m], and the mean transfer functions of the atmosphere there over the number of wavelengths."""
        baseline = self._baselines()
        return np.concatenate([baseline[None], self._turbulence(baseline) / len(self._wavelengths)])

    def _edges(self, fields: np.ndarray, pupil: SpokePupil) -> np.ndarray:
        return clear_edges(self._telescope, self._direction(fields), pupil.unit, self._cut_wavelength, self._threads)

    def _lit_fraction(self, edges: np.ndarray) -> np.ndarray:
        return clear_areas(edges) / self._pupil.area

    def _expose_spokes(self, optics: PupilOptics, edges: np.ndarray, stars: Stars, pupil: SpokePupil) -> ExposedStars:
        lit = self._lit_fraction(edges)
        spectrum = self._exposed_spectra(self._transform(optics, edges, stars.photons, pupil), optics, lit)
        lit_fraction = np.repeat(lit[:, None], len(self._wavelengths), axis=1)
        return self._sampled(spectrum, stars.offsets, lit_fraction, optics.reference_points)

    def _transform(
        self, optics: PupilOptics, edges: np.ndarray, photons: np.ndarray | None, pupil: SpokePupil
    ) -> np.ndarray:
        """Return the transfer functions of stars without the detector, as the kernel lays them out."""
        (n_star, _, n_point), (n_row, n_packet) = optics.lit.shape, self._detector.shape[1:3]
        # Pairs as complex numbers: a tenth of the time.
        places = np.ascontiguousarray(optics.displacement, dtype=np.float32).view(np.complex64)[..., 0]
        landed = np.isfinite(places).all(axis=1).astype(np.float64)
        channels = self._channels
        n_wave, depths = len(self._wavelengths), channels.depths
        # Place and light of the points, cut and lean of the strips along the rims.
        shapes = (n_wave * depths, 2, n_point), (n_point,), (2 * pupil.n_spoke, 3), (n_wave, 2 * pupil.n_spoke, 2)
        points = [warp_array(empty((n_star, *shape), np.float32), wp.float32) for shape in shapes]
        launch(
            place_points,
            n_star * pupil.n_spoke,
            [
                *(warp_array(rule) for rule in (pupil.radius, pupil.inverse, pupil.fraction, pupil.quadrature)),
                warp_array(pupil.unit, wp.vec2d),
                warp_array(edges, wp.float64),
                warp_array(optics.displacement, wp.float32),
                warp_array(landed, wp.float64),
                warp_array(optics.jacobian, wp.mat22d),
                warp_array(optics.reference_cosines, wp.vec2d),
                warp_array(self._dispersion, wp.vec2d),
                warp_array(channels.shift.reshape(n_wave, depths), wp.float64),
                warp_array(channels.of_wavelength(channels.shift), wp.float64),
                self.period,
                warp_array(clear_areas(edges), wp.float64),
                wp.empty((n_star, pupil.n_spoke, len(pupil.radius), n_wave), dtype=wp.vec4d, device="cpu"),
                *points,
            ],
            threads=self._threads,
        )
        along_x, along_y = (empty((n_star, n_packet, depths * n_point, 2, LANES), np.float32) for _ in range(2))
        spectrum = empty((n_star, 4, n_row, n_packet, LANES), np.float32)
        launch(
            transform_pupils,
            n_star,
            [
                pupil.n_spoke,
                depths,
                *points,
                warp_array(self._fade_x, samples),
                warp_array(self._fade_y, samples),
                warp_array(self._wavelengths.astype(np.float32), wp.float32),
                warp_array(self._rows, wp.int32),
                warp_array(metric_of(optics.jacobian), wp.float32),
                warp_array(self._filter, wp.float32),
                warp_array(self._filter_steps, wp.float32),
                warp_array(np.ones((n_star, n_wave)) if photons is None else photons, wp.float32),
                warp_array(along_x, samples),
                warp_array(along_y, samples),
                warp_array(np.empty((n_star, 2 * pupil.n_spoke, RIM_NUMBERS), dtype=np.float32), wp.float32),
                warp_array(np.empty((n_star, 2 * pupil.n_spoke), dtype=np.int32), wp.int32),
                warp_array(np.empty((n_star, 4, LANES), dtype=np.float32), samples),
                warp_array(spectrum, samples),
            ],
            threads=self._threads,
        )
        return spectrum

    def _sampled(self, spectrum: np.ndarray, offsets: np.ndarray, lit: np.ndarray, points: np.ndarray) -> ExposedStars:
        return ExposedStars(
            lambda shift: self._sample(spectrum, offsets if shift is None else offsets - shift), lit, points
        )

    def _sample(self, spectrum: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Return the stamps of transfer functions, shape [n_star, side, side]."""
        n_star, side = len(spectrum), self._plane.size
        n_packet = self._detector.shape[2]
        lines = np.empty((n_star, 4 * n_packet * LANES), dtype=np.float32)
        image = np.empty((n_star, side, self._pixel_columns.shape[2], LANES), dtype=np.float32)
        launch(
            sample_pixels,
            n_star,
            [
                warp_array(spectrum, samples),
                warp_array(self._detector, samples),
                warp_array(self._rows, wp.int32),
                warp_array((offsets * (self._plane.pixel_size / self.period)).astype(np.float32), wp.float32),
                warp_array(self._pixel_rows, wp.vec2f),
                warp_array(self._pixel_columns, samples),
                warp_array(np.empty_like(spectrum), samples),
                warp_array(lines, wp.float32),
                warp_array(image, samples),
            ],
            threads=self._threads,
        )
        return image.reshape(n_star, side, -1)[:, :, :side].astype(np.float64)
