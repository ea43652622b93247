"""Wave."""
from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.fft
import warp as wp

from ..models.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.launch import launch, thread_count
from ..raytrace.rays import field_direction
from .atmosphere import Atmosphere
from .fast_psf import RenderedStars
from .image_plane import ImagePlane, focal_length
from .pupil_optics import trace_pupils
from .wave_psf_kernels import LANES, indices, places, points, pupil_fields

LONGEST_BASELINE = 1.5
LARGEST_SPACING = 0.02


class WavePsfEngine:
    def __init__(
        self,
        telescope: Telescope,
        wavelengths: np.ndarray,
        plane: ImagePlane,
        *,
        focal_plane: FocalPlane | None = None,
        atmosphere: Atmosphere | None = None,
        dispersion: np.ndarray | None = None,
        projection: str = "zemax",
        threads: int | None = None,
        padding: bool | None = None,
        pupil_spacing: float | None = None,
    ) -> None:
        self.telescope = telescope
        self.wavelengths = wavelengths
        self.plane = plane
        self.focal_plane = focal_plane
        self.atmosphere = atmosphere
        self.dispersion = np.zeros((len(wavelengths), 2)) if dispersion is None else dispersion
        self.projection = projection
        self.threads = threads
        self.batch = max(1, thread_count(threads))
        self.focal = float(focal_length(trace_pupils(telescope, [(0.0, 0.0)], wavelengths, np.zeros((1, 2)), threads=threads).jacobian)[0])
        shortest = float(wavelengths.min())
        if pupil_spacing is None:
            pupil_spacing = min(LARGEST_SPACING, shortest * self.focal / plane.side)
        self.spacing = pupil_spacing
        if padding is None:
            k = 2 * math.pi * LONGEST_BASELINE / (float(wavelengths.max()) * self.focal)
            padding = atmosphere is None or math.exp(-0.5 * (k * plane.diffusion) ** 2) > 1e-4
        diameter = telescope.pupil_diameter * 1.01
        self.longest = diameter if padding else LONGEST_BASELINE
        self.size = scipy.fft.next_fast_len(math.ceil((diameter + self.longest) / self.spacing) + 1)
        # Baselines of up to this many samples are free of those that come round from the other side.
        self.reach = min(math.floor(self.longest / self.spacing), self.size // 2)
        self.radius = 0.5 * diameter
        if atmosphere is not None:
            self.low = np.stack([atmosphere.low_screen(n, "spline", threads=threads) for n in range(atmosphere.layer_count)])
            self.high = np.stack([atmosphere.high_screen(n, "spline", threads=threads) for n in range(atmosphere.layer_count)])
        else:
            self.low = self.high = np.zeros((1, 4, 4), np.float32)

    def render(self, fields: np.ndarray, offsets: np.ndarray) -> RenderedStars:
        with ThreadPoolExecutor(thread_count(self.threads)) as pool:
            stars = list(pool.map(self._render_star, fields, offsets))
        return RenderedStars(
            np.stack([s.image for s in stars]),
            np.stack([s.throughput for s in stars]),
            np.stack([s.jacobian for s in stars]),
            np.stack([s.reference for s in stars]),
        )

    def _render_star(self, field: np.ndarray, offset: np.ndarray) -> RenderedStars:
        chief = trace_pupils(self.telescope, field[None], self.wavelengths, np.zeros((1, 2)), self.focal_plane, self.projection, threads=1)
        jacobian = chief.jacobian[0]
        # q = f J^-T p is the exit direction of a ray times f: regular in q, the transform to the focal plane is separable.
        line = (np.arange(self.size) - self.size // 2) * self.spacing
        q = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        p = q @ jacobian / self.focal
        inside = np.flatnonzero(np.hypot(p[:, 0], p[:, 1]) < self.radius)
        optics = trace_pupils(self.telescope, field[None], self.wavelengths, p[inside], self.focal_plane, self.projection, threads=1)
        lit = optics.lit[0]
        some = lit.any(axis=0)
        at, lit, path, pupil = inside[some], lit[:, some], optics.path[0][:, some], p[inside[some]]
        intensity = self._expose(field, pupil, at, path, lit)
        image = self._sample(intensity, jacobian, offset)
        area = math.pi / 4 * self.telescope.pupil_diameter**2 * (1 - self.telescope.pupil_obscuration**2)
        cell = self.spacing**2 * abs(np.linalg.det(jacobian)) / self.focal**2
        return RenderedStars(image, lit.sum(axis=1) * cell / area, jacobian, optics.reference[0])

    def _expose(self, field, pupil, at, path, lit) -> np.ndarray:
        n_wave, size = len(self.wavelengths), self.size
        missing = -len(at) % LANES
        packets = lambda a, **kw: np.ascontiguousarray(np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, missing)], mode="edge").reshape(*a.shape[:-1], -1, LANES))
        turns = path / self.wavelengths[:, None]
        turns = np.where(lit, turns - np.rint(turns), 0.0)
        fields = np.zeros((n_wave, size * size), dtype=np.complex64)
        a = self.atmosphere
        n_time, n_layer = 1, 0
        start = np.zeros((1, 1, 4))
        pixels = wp.vec2d(1.0, 1.0)
        if a is not None:
            n_time, n_layer = len(a.times), a.layer_count
            direction = field_direction(*field, self.projection)
            slope = direction[:2] / -direction[2]
            center = a.offsets - a.altitudes[:, None] * slope - a.velocities * a.times[:, None, None]
            start = np.concatenate([center / a.screen_pixel % a.screen_size, center / a.fine_pixel % a.fine_size], axis=-1)
            pixels = wp.vec2d(1.0 / a.screen_pixel, 1.0 / a.fine_pixel)
        starts = [_array(np.ascontiguousarray(s), wp.float64) for s in start]
        inputs = [
            _array(packets(pupil[:, 0]), places),
            _array(packets(pupil[:, 1]), places),
            _array(self.low, wp.float32),
            _array(self.high, wp.float32),
            n_layer,
            None,
            pixels,
            _array((1.0 / self.wavelengths).astype(np.float32), wp.float32),
            _array(packets(turns.astype(np.float32)), points),
            _array(packets(lit.astype(np.float32)), points),
            _array(packets(at.astype(np.int32)), indices),
            _array(fields.view(np.float32).reshape(n_wave, -1, 2), wp.vec2f),
        ]
        intensity = np.zeros((n_wave, size, size))
        for t in range(n_time):
            inputs[5] = starts[t]
            launch(pupil_fields, inputs[0].shape[0], inputs, threads=1)
            for wave in range(n_wave):
                image = scipy.fft.fft2(fields[wave].reshape(size, size)).view(np.float32)
                np.multiply(image, image, out=image)
                intensity[wave] += image[:, 0::2]
                intensity[wave] += image[:, 1::2]
        return intensity / (n_time * lit.sum() * size * size)

    def _sample(self, intensity, jacobian, offset) -> np.ndarray:
        image = 0.0
        # fields are centred on sample size // 2, which puts no phase on an intensity
        step = np.arange(-self.reach, self.reach + 1)
        for wave, wavelength in enumerate(self.wavelengths):
            otf = scipy.fft.ifft2(intensity[wave])[np.ix_(step, step)]
            k = -2.0 * math.pi * self.spacing / (wavelength * self.focal) * step
            otf *= self.plane.transfer(k, k[:, None])
            x, y = jacobian @ self.dispersion[wave] + offset * self.plane.pixel_size
            to_x = np.exp(1j * k * (self.plane.pixel_centers - x)[:, None])
            to_y = np.exp(1j * k * (self.plane.pixel_centers - y)[:, None])
            share = self.plane.pixel_size**2 * (self.spacing / (wavelength * self.focal)) ** 2
            image = image + share * (to_y @ otf @ to_x.T).real * self.size**2
        return image


def _array(values, dtype):
    return wp.array(values, dtype=dtype, device="cpu", copy=False)
