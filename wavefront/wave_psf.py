r"""The wave PSF engine: the truth that the fast engine is held to.

The field on the focal plane at X from the reference point is the sum over the pupil of

.. math:: A \, e^{i k (\psi + w)} \, e^{-i k X \cdot (J^{-T} p)},

with the path :math:`\psi` of the atmosphere and :math:`w` of the optics (to the reference sphere, less the chief
ray's), the entrance-pupil coordinate p, and the Jacobian J of the position on the focal plane with respect to the
direction of the incoming light: :math:`J^{-T} p` are the direction cosines of the light at the focus, less the chief
ray's. The pupil grid is regular in :math:`q = f J^{-T} p`, so the transform is separable along the axes of the CCD. The
squared modulus is averaged over time steps; its transform is the optical transfer function (OTF) at the differences of
grid points, the baselines.

A long exposure through an atmosphere has no OTF left at baselines beyond 1.5 m, and charge diffusion leaves none in any
case. The grid then needs no padding to twice the pupil: it is so wide that baselines up to 1.5 m are free of those that
come round.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.fft
import warp as wp

from ..models.errors import DomainError
from ..models.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.launch import launch, thread_count
from ..raytrace.rays import field_direction
from .atmosphere import Atmosphere
from .image_plane import ImagePlane, RenderedStars, focal_length
from .pupil_optics import PupilOptics, trace_pupils
from .sample_packets import indices, places, samples, shared, to_packets
from .wave_psf_kernels import pupil_fields

#: Longest baseline [m] that an unpadded grid keeps.
LONGEST_BASELINE = 1.5
#: Largest distance of pupil points [m] under an atmosphere: the scale below which turbulence is left out.
LARGEST_SPACING = 0.02
#: Largest distance of pupil points [m] for the optics alone, which vary over metres: what limits it is the image, which
#: repeats itself after lambda / spacing (3" at 0.04 m), and the rim of the pupil.
LARGEST_SPACING_OPTICS = 0.04
# What charge diffusion may leave of longer baselines for a grid without padding.
_NEGLIGIBLE = 1e-4


class WavePsfEngine:
    """Renders stars by Fourier optics.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    plane : ImagePlane
        Stamp and detector.
    focal_plane : FocalPlane, optional
        CCD heights.
    atmosphere : Atmosphere, optional
        The exposure.
    dispersion : ndarray, shape [n_wave, 2]
        Shift in field angle of each wavelength [rad].
    padding : bool, optional
        Keep all baselines, up to the diameter of the pupil; by default where there is no atmosphere or next to no
        charge diffusion.
    pupil_spacing : float, optional
        Distance of the pupil points [m]; by default so small that the image repeats itself outside the stamp only, and
        at most :data:`LARGEST_SPACING`, or :data:`LARGEST_SPACING_OPTICS` without an atmosphere.
    projection : str
        Meaning of the field angles.
    threads : int, optional
        Number of threads, one star each; no byte depends on it.
    """

    def __init__(
        self,
        telescope: Telescope,
        wavelengths: np.ndarray,
        plane: ImagePlane,
        *,
        dispersion: np.ndarray,
        focal_plane: FocalPlane | None = None,
        atmosphere: Atmosphere | None = None,
        padding: bool | None = None,
        pupil_spacing: float | None = None,
        projection: str = "zemax",
        threads: int | None = None,
    ) -> None:
        self._telescope = telescope
        self._wavelengths = wavelengths
        self._plane = plane
        self._dispersion = dispersion
        self._focal_plane = focal_plane
        self._atmosphere = atmosphere
        self._projection = projection
        self._threads = threads
        center = trace_pupils(telescope, np.zeros((1, 2)), wavelengths, np.zeros((1, 2)), threads=threads)
        #: Effective focal length on the axis [m].
        self.focal_length = float(focal_length(center.jacobian)[0])
        self._lay_grid(padding, pupil_spacing)
        self._low, self._high = self._spline_screens()

    @property
    def batch(self) -> int:
        """Number of stars to render at a time."""
        return thread_count(self._threads)

    def _lay_grid(self, padding: bool | None, spacing: float | None) -> None:
        if spacing is None:
            largest = LARGEST_SPACING_OPTICS if self._atmosphere is None else LARGEST_SPACING
            spacing = min(largest, float(self._wavelengths.min()) * self.focal_length / self._plane.side)
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise DomainError(f"pupil_spacing = {spacing!r}: expected a positive length in metres")
        if padding is None:
            k = 2.0 * math.pi * LONGEST_BASELINE / (float(self._wavelengths.max()) * self.focal_length)
            left = math.exp(-0.5 * (k * self._plane.diffusion) ** 2)
            padding = self._atmosphere is None or left > _NEGLIGIBLE
        # 1 %: the scale of the pupil in q changes by some tenths of a per cent over the field.
        diameter = 1.01 * self._telescope.pupil_diameter
        longest = diameter if padding else LONGEST_BASELINE
        self._spacing = spacing
        # Multiples of 16 keep the rows aligned, and sizes with small factors the transforms fast.
        self._size = 16 * scipy.fft.next_fast_len(math.ceil((diameter + longest) / spacing / 16.0))
        self._reach = min(math.floor(longest / spacing), self._size // 2 - 1)

    def _spline_screens(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the spline coefficients of the low and the high screens [m], shape [n_layer, size * size]."""
        atmosphere = self._atmosphere
        if atmosphere is None:
            nothing = np.zeros((1, 1), dtype=np.float32)
            return nothing, nothing
        low, high = (atmosphere.kept_screens(scale, "spline", self._threads) for scale in ("low", "high"))
        return low.reshape(len(low), -1), high.reshape(len(high), -1)

    def render(self, fields: np.ndarray, offsets: np.ndarray) -> RenderedStars:
        """Render one batch of stars.

        Parameters
        ----------
        fields : ndarray, shape [n_star, 2]
            Field angles [rad].
        offsets : ndarray, shape [n_star, 2]
            Places of the reference points from the centre of the middle pixel [pixels].

        Returns
        -------
        RenderedStars
        """
        with ThreadPoolExecutor(thread_count(self._threads)) as pool:
            stars = list(pool.map(self._render_star, fields, offsets))
        return RenderedStars(
            np.stack([star.image for star in stars]),
            np.stack([star.throughput for star in stars]),
            np.stack([star.reference for star in stars]),
        )

    def _render_star(self, field: np.ndarray, offset: np.ndarray) -> RenderedStars:
        def seen(pupil: np.ndarray) -> PupilOptics:
            return trace_pupils(
                self._telescope,
                field[None],
                self._wavelengths,
                pupil,
                self._focal_plane,
                self._projection,
                threads=1,
            )

        chief = seen(np.zeros((1, 2)))
        jacobian = chief.jacobian[0]
        focal = float(focal_length(jacobian))
        line = (np.arange(self._size) - self._size // 2) * self._spacing
        q = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        p = q @ jacobian / focal
        place = np.flatnonzero(np.hypot(p[:, 0], p[:, 1]) < 0.5 * self._telescope.pupil_diameter)
        optics = seen(p[place])
        lit = optics.lit[0]
        used = lit.any(axis=0)
        intensity = self._expose(field, p[place[used]], place[used], optics.path[0][:, used], lit[:, used])
        area = 0.25 * math.pi * self._telescope.pupil_diameter**2 * (1.0 - self._telescope.pupil_obscuration**2)
        return RenderedStars(
            self._sample(intensity, jacobian, focal, offset),
            lit.sum(axis=1) * self._spacing**2 / area,
            chief.reference[0],
        )

    def _expose(
        self, field: np.ndarray, pupil: np.ndarray, place: np.ndarray, path: np.ndarray, lit: np.ndarray
    ) -> np.ndarray:
        """Return the squared field on the focal plane, averaged over time, shape [n_wave, size, size].

        Scaled so that the means over the grid add up to 1 over the wavelengths.
        """
        n_wave, size = len(self._wavelengths), self._size
        intensity = np.zeros((n_wave, size, size))
        if not len(place):
            return intensity
        turns = path / self._wavelengths[:, None]
        turns = np.where(lit, turns - np.rint(turns), 0.0)
        starts, n_layer, pixels_per_meter = self._screen_places(field)
        fields = np.zeros((n_wave, size * size), dtype=np.complex64)
        before = [
            shared(to_packets(pupil[:, 0], np.float64), places),
            shared(to_packets(pupil[:, 1], np.float64), places),
            shared(self._low, wp.float32),
            math.isqrt(self._low.shape[1]),
            shared(self._high, wp.float32),
            math.isqrt(self._high.shape[1]),
            n_layer,
        ]
        after = [
            pixels_per_meter,
            shared((1.0 / self._wavelengths).astype(np.float32), wp.float32),
            shared(to_packets(turns, np.float32), samples),
            shared(to_packets(lit, np.float32), samples),
            shared(to_packets(place, np.int32), indices),
            shared(fields, wp.vec2f),
        ]
        for start in starts:
            launch(pupil_fields, len(before[0]), [*before, shared(start, wp.float64), *after], threads=1)
            for wave in range(n_wave):
                parts = scipy.fft.fft2(fields[wave].reshape(size, size)).view(np.float32)
                np.multiply(parts, parts, out=parts)
                intensity[wave] += parts[:, 0::2]
                intensity[wave] += parts[:, 1::2]
        intensity /= len(starts) * lit.sum()
        return intensity

    def _screen_places(self, field: np.ndarray) -> tuple[np.ndarray, int, wp.vec2d]:
        """Return where the pupil's centre is seen on the screens at each time [pixels], [n_time, n_layer, 4]."""
        atmosphere = self._atmosphere
        if atmosphere is None:
            return np.zeros((1, 1, 4)), 0, wp.vec2d(1.0, 1.0)
        direction = field_direction(field[0], field[1], self._projection)
        center = atmosphere.pupil_centers(direction, atmosphere.times)
        starts = np.concatenate([center / atmosphere.screen_pixel, center / atmosphere.fine_pixel], axis=-1)
        return starts, atmosphere.layer_count, wp.vec2d(1.0 / atmosphere.screen_pixel, 1.0 / atmosphere.fine_pixel)

    def _sample(self, intensity: np.ndarray, jacobian: np.ndarray, focal: float, offset: np.ndarray) -> np.ndarray:
        """Return the stamp: the OTF, filtered by the detector, evaluated at the pixel centres."""
        image = np.zeros((self._plane.stamp_size, self._plane.stamp_size))
        step = np.arange(-self._reach, self._reach + 1)
        shift = offset * self._plane.pixel_size + self._dispersion @ jacobian.T
        for wave, wavelength in enumerate(self._wavelengths):
            otf = scipy.fft.ifft2(intensity[wave])[np.ix_(step, step)]
            # the wavenumber on the focal plane of a baseline of so many steps, by the sign of the transform
            k_step = 2.0 * math.pi * self._spacing / (wavelength * focal)
            k = -k_step * step
            otf *= self._plane.transfer(k, k[:, None])
            at_x = np.exp(1j * k * (self._plane.pixel_centers - shift[wave, 0])[:, None])
            at_y = np.exp(1j * k * (self._plane.pixel_centers - shift[wave, 1])[:, None])
            image += (self._plane.pixel_size * k_step / (2.0 * math.pi)) ** 2 * (at_y @ otf @ at_x.T).real
        return image
