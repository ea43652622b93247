r"""The wave PSF engine: the reference engine, by Fourier optics.

The field on the focal plane at X from the reference point is the sum over the pupil of

.. math:: A \, e^{i k (\psi + w)} \, e^{-i k X \cdot (J^{-T} p)},

with the path :math:`\psi` of the atmosphere and :math:`w` of the optics (to the reference sphere, less the chief
ray's), the entrance-pupil coordinate p, and the Jacobian J of the position on the focal plane with respect to the
direction of the incoming light: :math:`J^{-T} p` are the direction cosines of the light at the focus, less the chief
ray's. The pupil is a square lattice along the axes of the screens, on which these are interpolated row by row; the
Fourier transform of the lattice has its points at regular steps of :math:`J^{-1} X`, an angle on the sky. The squared
modulus is averaged over time steps; its transform is the optical transfer function (OTF) at the differences of lattice
points, the baselines, and the pixels are sums over these.

Averaged over time, turbulence leaves no OTF at baselines beyond 1.5 m, and of what a short exposure still has there,
charge diffusion leaves exp(-17) (4 um rms, 620 nm, f = 10.3 m). The grid then needs no padding to twice the pupil: it
is wider than the pupil by 1.5 m, so that baselines up to there are free of those that wrap around. Where diffusion
leaves more, as of red light and of charge from deep in silicon, it is wider by as much as that takes. Without an
atmosphere, or without diffusion, it is padded and holds all baselines.

Transforms are those of SciPy in single precision. On 480 to 512 points a side FFTW and MKL take half its time and ducc0
as much (``benchmarks/fft_libraries.py``); a third of a star's time goes into them, so either would win a sixth. They
would cost hundreds of megabytes for one make of processor (MKL) or another licence (FFTW), and bytes that depend on the
machine or on a timing.

In silicon w is the path to one depth; time steps take turns at the depths, and each depth has a mean of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
import warp as wp

from ...core.arguments import check_arguments
from ...core.launch import launch
from ...core.memory import require_bytes
from ...core.threads import thread_count
from ...core.units import require_positive
from ...core.warp_arrays import warp_array
from ..atmosphere.spline import spline_weights
from ..pupil_optics import PupilOptics
from .engine import ExposedStars, PsfEngine, PsfInputs, PsfRenderer, Stars
from .inner_rim import clipped_by_apertures, traced_obscuration
from .pupil_lattice import PupilLattice
from .sample_packets import LANES, indices, samples
from .wave_kernels import Screens, Taps, add_squares, pupil_fields

#: Least of the longest baselines of an unpadded grid [m].
LONGEST_BASELINE = 1.5
#: Largest distance of pupil points [m] under an atmosphere: the scale below which turbulence is left out.
LARGEST_SPACING = 0.02
#: Largest distance of pupil points [m] for the optics alone, which vary over metres: it is limited by the image, which
#: repeats itself after lambda / spacing (3" at 0.04 m), and by the rim of the pupil.
LARGEST_SPACING_OPTICS = 0.04
#: Fewest pupil points across the diameter: the rim of a small telescope is as fine as that of a large one.
FEWEST_ACROSS = 96
# Largest transfer function of charge diffusion at longer baselines than those of a grid.
_NEGLIGIBLE = 1e-4
# Longest baselines of a grid that are tried.
_TRIED = 64
# Most pairs of a pixel and a baseline at a time [64 MB an array of complex numbers]; stamps of 64 pixels have fewer.
_PAIRS = 2**22


@check_arguments
@dataclass(frozen=True)
class WaveEngine(PsfEngine):
    """Fourier optics, the slow reference engine.

    Attributes
    ----------
    padding : bool, optional
        Whether all baselines are used, up to the diameter of the pupil. By default they are where there is no
        atmosphere or next to no charge diffusion.
    pupil_spacing : float, optional
        Distance of the pupil points [m], above 0. By default the image repeats itself outside the stamp only, and the
        distance is at most 0.02 m, or 0.04 m without an atmosphere, and a 96th of the diameter.

    Raises
    ------
    DomainError
        If the distance is not positive.
    """

    name = "wave"
    screens = ("low", "high")

    padding: bool | None = None
    pupil_spacing: float | None = None

    def __post_init__(self) -> None:
        if self.pupil_spacing is not None:
            require_positive(self.pupil_spacing, "pupil_spacing", "metres")

    def _renderer(self, inputs: PsfInputs) -> WaveRenderer:
        return WaveRenderer(inputs, self)


class WaveRenderer(PsfRenderer):
    """Renderer of :class:`WaveEngine`; each thread computes one star at a time."""

    depths = 3

    def __init__(self, inputs: PsfInputs, options: WaveEngine) -> None:
        super().__init__(inputs)
        self._make_pupil_lattice(options.padding, options.pupil_spacing)
        self._load_screens()
        self._schedule = self._channels.depth_schedule(1 if inputs.atmosphere is None else len(inputs.atmosphere.times))
        self.batch = thread_count(inputs.threads)

    def _make_pupil_lattice(self, padding: bool | None, spacing: float | None) -> None:
        if spacing is None:
            largest = LARGEST_SPACING_OPTICS if self._atmosphere is None else LARGEST_SPACING
            largest = min(largest, self._diameter / FEWEST_ACROSS)
            spacing = min(largest, float(self._wavelengths.min()) * self.focal_length / self._plane.side)
        diameter = self._diameter
        longest = diameter
        if padding is False:
            longest = LONGEST_BASELINE
        elif padding is None and self._atmosphere is not None:
            longest = self._longest_baseline()
        # One star's fields, their squares, the intensity and its transform.
        across, n_channel = math.ceil((diameter + longest) / spacing), len(self._channels.wave)
        needed = across**2 * (8 * len(self._wavelengths) + 16 * n_channel + 24)
        require_bytes(needed, f"{across} points across the wave engine's grid, {spacing:.2g} m apart")
        self._lattice = PupilLattice.fill(diameter, traced_obscuration(self._obscuration), spacing)
        self._packets = -(-self._lattice.size // LANES)
        across = max(across, self._packets * LANES)
        # Multiples of 4 fill whole packets.
        self._size = 4 * scipy.fft.next_fast_len(-(-across // 4))
        self._reach = min(math.floor(longest / spacing), (self._size - 1) // 2)

    def _longest_baseline(self) -> float:
        """Return the baseline [m] beyond which the transfer of charge diffusion is negligible, at most the diameter."""
        baseline = np.linspace(min(LONGEST_BASELINE, self._diameter), self._diameter, _TRIED)
        k = 2.0 * math.pi * baseline / (float(self._wavelengths.max()) * self.focal_length)
        spread = self._channels.of_wavelength(self._channels.spread(k)).max(axis=0)
        transfer = spread * np.exp(-0.5 * (k * self._plane.diffusion) ** 2)
        too_short = int(np.count_nonzero(transfer > _NEGLIGIBLE))
        return float(baseline[min(too_short, _TRIED - 1)])

    def _load_screens(self) -> None:
        """Load the spline coefficients of the low and the high screens [m], and place the lattice on them."""
        atmosphere = self._atmosphere
        if atmosphere is None:
            self._splines = [np.zeros((1, 1), dtype=np.float32)] * 2
            self._sides, self._steps = np.ones(2, dtype=np.int64), np.ones(2)
        else:
            self._splines = [
                atmosphere.screens(scale, self._threads).reshape(atmosphere.layer_count, -1)
                for scale in WaveEngine.screens
            ]
            self._sides = np.array([atmosphere.screen_size, atmosphere.fine_size])
            self._steps = self._lattice.spacing / np.array([atmosphere.screen_pixel, atmosphere.fine_pixel])
        # Packets of samples that a row of the pupil spans: four taps wide at least, and a fraction of a sample more.
        spans = np.ceil(self._steps * self._packets * LANES) + 5
        self._runs = tuple(int(-(-span // LANES)) for span in spans)

    def _packed_screens(self) -> list[Any]:
        """Return the low and the high screens as the kernel takes them."""
        packed = [Screens(), Screens()]
        for screens, values, size, run in zip(packed, self._splines, self._sides, self._runs, strict=True):
            screens.values, screens.size, screens.run = warp_array(values, wp.float32), int(size), run
        return packed

    def _expose(self, stars: Stars) -> ExposedStars:
        photons = [None] * len(stars) if stars.photons is None else stars.photons
        optics, spectra = zip(*self._map(self._expose_star, stars.fields, photons), strict=True)
        area = 0.25 * math.pi * self._diameter**2 * (1.0 - self._obscuration**2)
        lit = np.stack([star.lit[0].sum(axis=1) * self._lattice.spacing**2 / area for star in optics])

        def draw(shift: np.ndarray | None) -> np.ndarray:
            places = stars.offsets if shift is None else stars.offsets - shift
            jacobians = [star.jacobian[0] for star in optics]
            return np.stack(self._map(self._sample, spectra, jacobians, places))

        return ExposedStars(draw, lit, np.concatenate([star.reference_points for star in optics]))

    def _expose_star(self, field: np.ndarray, photons: np.ndarray | None) -> tuple[PupilOptics, np.ndarray]:
        """Return the optics of a star and its spectra, the OTF times the transfer function of the detector."""
        points = self._lattice.points
        optics = self._trace(field[None], points, 1, exit_pupil=True)
        optics = clipped_by_apertures(optics, points, 0.5 * self._diameter * self._obscuration)
        spectra = self._filtered(self._intensity(field, optics), optics.jacobian[0])
        if photons is not None and optics.lit.any():
            # Wavelengths count by their light, of which the spectra have a sum of 1.
            lit = optics.lit[0].sum(axis=1)
            spectra *= (photons * lit.sum() / (photons @ lit))[:, None, None]
        return optics, spectra

    def _intensity(self, field: np.ndarray, optics: PupilOptics) -> np.ndarray:
        """Return the squared field on the focal plane, averaged over time, shape [n_channel, size, size].

        Scaled so that the means over the grid add up to 1 over the channels, if all turn light into charge.
        """
        n_wave, size, line = len(self._wavelengths), self._size, self._lattice.size
        channels, n_channel = self._channels, len(self._channels.wave)
        lit = optics.lit[0]
        if not lit.any():
            return np.zeros((n_channel, size, size))
        turns = channels.path(optics)[0] / self._wavelengths[channels.wave, None]
        turns = np.where(lit[channels.wave], turns - np.rint(turns), 0.0)
        phase, amplitude = (self._rows(values) for values in (turns, lit))
        used = np.asarray(amplitude.any(axis=(0, 3)), dtype=np.int32)
        fields = np.zeros((n_wave, size, size), dtype=np.complex64)
        squares = [wp.zeros(2 * size * size // LANES, dtype=samples, device="cpu") for _ in range(n_channel)]
        screens, n_layer = self._packed_screens(), 0 if self._atmosphere is None else self._atmosphere.layer_count
        before = [warp_array(used, wp.int32), warp_array((1.0 / self._wavelengths).astype(np.float32), wp.float32)]
        after: list[Any] = [
            warp_array(phase, samples),
            warp_array(amplitude, samples),
            wp.empty((line, max(self._runs) * LANES), dtype=wp.float32, device="cpu"),
            wp.empty((line, self._packets), dtype=samples, device="cpu"),
            warp_array(fields, wp.vec2f),
        ]
        moments = self._screen_places(field)
        for step, time in enumerate(self._schedule.time):
            step_channels = np.ascontiguousarray(self._schedule.channel[:, step, 0])
            step_arguments = [
                *screens,
                n_layer,
                self._screen_samples(moments[time]),
                *before,
                warp_array(step_channels, wp.int32),
            ]
            launch(pupil_fields, line, [*step_arguments, *after], threads=1)
            for wave in range(n_wave):
                focused = scipy.fft.fft2(fields[wave]).view(np.float32).reshape(-1, LANES)
                launch(
                    add_squares, len(focused), [warp_array(focused, samples), squares[step_channels[wave]]], threads=1
                )
        intensity = np.empty((n_channel, size, size))
        count = len(self._schedule.time) * lit.sum()
        for channel, scale in enumerate(channels.weight / self._schedule.fraction):
            parts = squares[channel].numpy().reshape(size, size, 2)
            intensity[channel] = scale * (parts.sum(axis=-1, dtype=np.float64) / count)
        return intensity

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """Return values [n_wave, n_pupil] as float32 packets along the pupil's rows, [n_wave, row, packet, LANES]."""
        line = self._lattice.size
        rows = np.zeros((len(values), line, self._packets * LANES), dtype=np.float32)
        rows[:, self._lattice.row, self._lattice.column] = values
        return rows.reshape(len(values), line, self._packets, LANES)

    def _screen_places(self, field: np.ndarray) -> np.ndarray:
        """Return the first lattice point on each screen at each time [pixels], shape [n_time, n_screen, 2].

        Screens are counted layer by layer, low before high.
        """
        atmosphere = self._atmosphere
        if atmosphere is None:
            return np.zeros((1, 2, 2))
        corner = atmosphere.pupil_centers(self._direction(field), atmosphere.times) + self._lattice.origin
        first_points = np.stack([corner / atmosphere.screen_pixel, corner / atmosphere.fine_pixel], axis=-2)
        return first_points.reshape(len(atmosphere.times), -1, 2)

    def _screen_samples(self, places: np.ndarray) -> Any:
        """Return the samples of the screens around the lattice points at one time, and their weights."""
        sides, steps = np.tile(self._sides, len(places) // 2), np.tile(self._steps, len(places) // 2)
        start = places - sides[:, None] * np.floor(places / sides[:, None])
        first_sample = np.floor(start)
        along = (start - first_sample)[..., None] + steps[:, None, None] * np.arange(self._packets * LANES)
        sample = np.floor(along)
        weights = spline_weights((along - sample).astype(np.float32))
        first = first_sample.astype(np.int32)
        sample = sample.astype(np.int32)
        # The spline's first tap is one sample before the point.
        column = (first[:, 0] - 1) % sides
        row = (first[:, 1, None] + sample[:, 1]) % sides[:, None]
        packed = (len(places), self._packets, LANES)
        taps = Taps()
        taps.column, taps.row = warp_array(column, wp.int32), warp_array(row, wp.int32)
        taps.row_weight = warp_array(weights[:, 1], wp.vec4f)
        taps.sample = warp_array(sample[:, 0].reshape(packed), indices)
        taps.column_weight = warp_array(np.moveaxis(weights[:, 0].reshape(*packed, 4), -1, 1), samples)
        return taps

    def _filtered(self, intensity: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Return the OTF times the transfer function of the detector, shape [n_wave, baseline y, baseline x]."""
        step = np.arange(-self._reach, self._reach + 1)
        # the wavenumber on the focal plane of a baseline of one step in x and in y, by the sign of the transform
        per_step = -2.0 * math.pi * self._lattice.spacing * np.linalg.inv(jacobian)
        spectra = np.zeros((len(self._wavelengths), len(step), len(step)), dtype=np.complex128)
        channels, depths = self._channels, self._channels.depths
        for wave, wavelength in enumerate(self._wavelengths):
            k = (per_step[0, :, None, None] * step + per_step[1, :, None, None] * step[:, None]) / wavelength
            transfer, square = self._plane.transfer(*k), (k * k).sum(axis=0)
            for channel in range(wave * depths, (wave + 1) * depths):
                variance = channels.variance[channel]
                filters = transfer * np.exp(-0.5 * variance * square) if variance else transfer
                spectra[wave] += scipy.fft.ifft2(intensity[channel])[np.ix_(step, step)] * filters
        return spectra

    def _sample(self, spectra: np.ndarray, jacobian: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the stamp: the spectra of all wavelengths evaluated at the pixel centres."""
        side = self._plane.size
        step = np.arange(-self._reach, self._reach + 1)
        x, y = np.meshgrid(self._plane.pixel_centers, self._plane.pixel_centers)
        pixels = np.stack([x, y], axis=-1).reshape(-1, 2) - offset * self._plane.pixel_size
        angles = np.linalg.solve(jacobian, pixels.T)
        image = np.zeros(side * side)
        at_a_time = max(1, _PAIRS // len(step))
        for wave, wavelength in enumerate(self._wavelengths):
            k_step = 2.0 * math.pi * self._lattice.spacing / wavelength
            per_pair = (self._plane.pixel_size * k_step / (2.0 * math.pi)) ** 2 / abs(np.linalg.det(jacobian))
            turns = -1j * k_step * (angles - self._dispersion[wave][:, None])
            for first in range(0, side * side, at_a_time):
                some = slice(first, first + at_a_time)
                turn = turns[:, some]
                rows = np.exp(turn[1][:, None] * step) @ spectra[wave]
                total = np.einsum("px,px->p", rows, np.exp(turn[0][:, None] * step)).real
                image[some] += per_pair * total
        return image.reshape(side, side)
