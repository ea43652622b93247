r"""Channels of light: one a wavelength and, in silicon, one a conversion depth; their images add up to the PSF.

Light that turns into charge after a path :math:`s` in silicon of index n lands :math:`(s/n) u` from where it entered,
with its direction cosines u along the surface, and its charge spreads less than that from the surface. The paths of a
channel are a point of the Gauss rule over their distribution (:meth:`.Silicon.paths`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...models.camera.silicon import Silicon
from ..pupil_optics import PupilOptics

# Fewest time steps over which conversion depths alternate; with fewer, each is computed at every depth.
_FEW_STEPS = 128
# Smallest transfer function of charge diffusion: products of smaller ones would be denormal, which takes processors ten
# times as long as zero.
_DARK = 1e-15
# Fractions of a turn from one step to the next: irrational, and far from simple fractions and from each other, so that
# few or many of them fill a turn evenly. Of time steps:
_TIME_STEP = 0.5 * (5.0**0.5 - 1.0)
# Of groups of pupil points.
_GROUP_STEP = 2.0**0.5 - 1.0
# Of wavelengths.
_WAVE_STEP = 0.5497004779019703


@dataclass(frozen=True)
class DepthSchedule:
    """Channel of each wavelength to which the rays of a time step and of a group of pupil points belong."""

    time: np.ndarray  #: index of the moment of each step, rising, [n_step] int
    channel: np.ndarray  #: [n_wave, n_step, n_group] int
    fraction: np.ndarray  #: of the rays of its wavelength that each channel gets, [n_channel]


@dataclass(frozen=True)
class Channels:
    """Parts of the light whose images add up: equally many of each wavelength, in the order of the wavelengths."""

    wave: np.ndarray  #: index of the wavelength, [n_channel] int
    weight: np.ndarray  #: part of the light of the wavelength that turns into charge there, [n_channel]
    shift: np.ndarray  #: path in silicon over its index [m], [n_channel]
    variance: np.ndarray  #: of the charge diffusion along each axis beyond that of all channels [m^2], [n_channel]
    diffusion: float  #: rms along each axis of the charge diffusion of all channels [m]

    @classmethod
    def of(cls, silicon: Silicon | None, wavelengths: np.ndarray, diffusion: float, depths: int) -> Channels:
        """Return the channels of wavelengths [m], in silicon so many of each; ``diffusion`` [m] from the surface."""
        n_wave = len(wavelengths)
        if silicon is None:
            nothing = np.zeros(n_wave)
            return cls(np.arange(n_wave), np.ones(n_wave), nothing, nothing, diffusion)
        paths = [silicon.paths(float(w), depths) for w in wavelengths]
        shift = np.array([p.length / silicon.index(float(w)) for p, w in zip(paths, wavelengths, strict=True)])
        spread = silicon.diffusion(np.array([p.length for p in paths]), diffusion).ravel()
        return cls(
            wave=np.repeat(np.arange(n_wave), depths),
            weight=np.array([p.weight for p in paths]).ravel(),
            shift=shift.ravel(),
            variance=spread**2 - spread.min() ** 2,
            diffusion=float(spread.min()),
        )

    @property
    def depths(self) -> int:
        """Channels of each wavelength."""
        return len(self.wave) // (int(self.wave[-1]) + 1)

    def displacement(self, optics: PupilOptics) -> np.ndarray:
        """Return landing points minus reference points [m], float32, shape [n_star, n_channel, n_pupil, 2]."""
        if not self.shift.any():
            return optics.displacement
        moved = optics.displacement[:, self.wave]
        moved += (self.shift[:, None, None] * optics.exit_cosines[:, None]).astype(np.float32)
        return moved

    def path(self, optics: PupilOptics) -> np.ndarray:
        """Return :attr:`PupilOptics.exit_pupil_path` [m] of the displacements, [n_star, n_channel, n_pupil]."""
        path = optics.exit_pupil_path
        assert path is not None
        if not self.shift.any():
            return path
        square = (optics.exit_cosines**2).sum(axis=-1) - (optics.reference_cosines**2).sum(axis=-1)[:, None]
        return np.asarray(path[:, self.wave] - 0.5 * self.shift[:, None] * square[:, None])

    def spread(self, k: np.ndarray) -> np.ndarray:
        """Return the transfer function of the further diffusion at wavenumbers [n] [rad/m], shape [n_channel, n]."""
        spread = np.exp(-0.5 * self.variance[:, None] * k * k)
        return np.where(spread < _DARK, 0.0, spread)

    def of_wavelength(self, values: np.ndarray) -> np.ndarray:
        """Return means over the light of each wavelength of values [n_channel, ...], shape [n_wave, ...]."""
        n_wave = len(self.wave) // self.depths
        by_depth = values.reshape(n_wave, self.depths, *values.shape[1:])
        weight = self.weight.reshape(n_wave, self.depths)
        return np.asarray(np.einsum("wd,wd...->w...", weight / weight.sum(axis=1, keepdims=True), by_depth))

    def depth_schedule(self, n_time: int, n_group: int = 1) -> DepthSchedule:
        """Assign rays of time steps and groups of pupil points to the depths, evenly and deterministically."""
        depths = self.depths
        first = depths * np.arange(len(self.wave) // depths)[:, None, None]
        if n_time < _FEW_STEPS:
            time = np.repeat(np.arange(n_time), depths)
            depth = np.tile(np.arange(depths), n_time)[None, :, None]
            channel = np.broadcast_to(first + depth, (len(first), len(time), n_group))
        else:
            time = np.arange(n_time)
            # Each wavelength has its own order, so that depths do not share an excess of some image motion.
            wave = _WAVE_STEP * np.arange(len(first))
            place = np.add.outer(wave, np.add.outer(_TIME_STEP * time, _GROUP_STEP * np.arange(n_group))) % 1.0
            weight = self.weight.reshape(-1, depths)
            ends = np.cumsum(weight, axis=1)[:, :-1] / weight.sum(axis=1)[:, None]
            channel = first + (place[:, None] >= ends[:, :, None, None]).sum(axis=1)
        number = np.bincount(channel.ravel(), minlength=len(self.wave))
        return DepthSchedule(time, np.ascontiguousarray(channel, dtype=np.int32), number / (len(time) * n_group))
