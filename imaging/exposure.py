"""Exposures of a noise-free scene: sky, dark current, Poisson and read noise, saturation, gain."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.random_streams import stream
from ..core.threads import one_blas_thread, thread_count
from ..core.units import pure_numbers, require_positive
from ..models.camera.photometry import DARK_CURRENT, FULL_WELL, PIXEL_SCALE, READ_NOISE, Band, BandName
from ..pipeline.experiment import Experiment
from ..pipeline.sensor.brighter_fatter import SensorVendor, boundary_shifts
from ..pipeline.sensor.pixel_boundaries import collect, with_rim, without_rim
from ..pipeline.simulate.photometry import band_named, sky_electrons_per_pixel

#: Bit of the mask of a pixel that reaches the full well.
SATURATED = 1
#: Names of the bits of the mask, by their value.
MASK_BITS = {SATURATED: "SAT"}
#: Brightest and faintest sky that is taken for one [AB mag/arcsec^2].
_MOST_MAGNITUDES = 100.0
#: Rows of a band of the image; each band has its own random stream.
_ROWS = 128
#: Rows beside a band whose charge counts for that collected in it: the spline of the charge falls by 0.43 a row.
_BESIDE = 16


@check_arguments
@dataclass(frozen=True)
class Exposure:
    """Settings of an image: the sum of exposures of one scene under one PSF.

    Attributes
    ----------
    band : str
        Filter, ``u`` to ``y``.
    time : float
        Time of one exposure [s].
    exposures : int
        Number of exposures.
    gain : float
        Electrons of one ADU.
    sky : float or None
        Brightness of the sky [AB mag/arcsec^2]; the dark sky of the band by default.
    pixel_scale : float
        Angle of a pixel [rad].
    read_noise : float
        rms of the read noise of one exposure [electron].
    dark_current : float
        [electron/s] of a pixel.
    full_well : float
        Electrons at which a pixel saturates in one exposure.
    subtract_background : bool
        Whether the expected sky and dark current are subtracted.
    noise : bool
        Whether there is noise; without it an image is the expected one.
    photometry : Band, optional
        Zero point, sky and extinction; by default those of the LSST in the band.
    brighter_fatter : {"itl", "e2v"}, optional
        Make of the CCD, whose charge moves the boundaries of pixels of 10 um, columns along y; by default it does not.
    snaps : int
        Snaps that each exposure is the sum of: the charge of one moves boundaries.
    """

    band: BandName = "r"
    time: float = 15.0
    exposures: int = 1
    gain: float = 1.0
    sky: float | None = None
    pixel_scale: float = PIXEL_SCALE
    read_noise: float = READ_NOISE
    dark_current: float = DARK_CURRENT
    full_well: float = FULL_WELL
    subtract_background: bool = True
    noise: bool = True
    photometry: Band | None = None
    brighter_fatter: SensorVendor | None = None
    snaps: int = 1

    @classmethod
    def of_run(cls, experiment: Experiment, exposures: int = 1, **settings: Any) -> Exposure:
        """Return exposures with the time, the band and the pixels of a run's camera, but for other `settings`."""
        band = experiment.band
        run_values: dict[str, Any] = {
            "gain": band.gain,
            "pixel_scale": band.pixel_scale,
            "read_noise": band.read_noise,
            "dark_current": band.dark_current,
            "full_well": band.full_well,
            "brighter_fatter": experiment.config.sensor.brighter_fatter,
            "snaps": experiment.snaps,
        }
        return cls(
            band.name, experiment.config.atmosphere.exposure_s, exposures, photometry=band, **(run_values | settings)
        )

    def __post_init__(self) -> None:
        if self._band.name != self.band:
            raise DomainError(f"band = {self.band}: expected {self._band.name}, the band of photometry")
        for name in ("time", "gain", "full_well", "pixel_scale"):
            require_positive(getattr(self, name), name)
        for name in ("exposures", "snaps"):
            if getattr(self, name) < 1:
                raise DomainError(f"{name} = {getattr(self, name)}: expected 1 or more")
        for name in ("read_noise", "dark_current"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise DomainError(f"{name} = {getattr(self, name)}: expected a number that is not negative")
        if self.sky is not None and not abs(self.sky) < _MOST_MAGNITUDES:
            limits = f"{-_MOST_MAGNITUDES:g} to {_MOST_MAGNITUDES:g}"
            raise DomainError(f"sky = {self.sky}: expected a finite brightness in AB mag/arcsec^2, {limits}")
        if self.background >= self.well:
            raise DomainError(
                f"sky = {self._brightness:.2f}: its {self.background / self.exposures:.0f} electrons a pixel fill the "
                f"full well of {self.full_well:g}; expected a fainter sky or a shorter exposure"
            )

    @property
    def total_time(self) -> float:
        """Time of all exposures [s]."""
        return self.time * self.exposures

    @property
    def zero_point(self) -> float:
        """AB magnitude of one ADU in the whole image."""
        return self._band.zero_point + 2.5 * np.log10(self.total_time / self.gain)

    @property
    def background(self) -> float:
        """Expected electrons of sky and dark current in a pixel, without vignetting."""
        return float(self.background_of(1.0))

    @property
    def well(self) -> float:
        """Electrons at which a pixel saturates in all exposures together."""
        return self.exposures * self.full_well

    @property
    def saturation_level(self) -> float:
        """Least value of saturated pixels [ADU], to the last bit; vignetted ones have less subtracted."""
        return float(np.float32((self.well - (self.background if self.subtract_background else 0.0)) / self.gain))

    @property
    def noise_rms(self) -> float:
        """Noise of a pixel without sources and vignetting, rms [electron]."""
        return float(np.sqrt(self.background + self.exposures * self.read_noise**2))

    def background_of(self, lit_fraction: float | np.ndarray) -> float | np.ndarray:
        """Return the expected electrons of sky and dark current in pixels where a part of the sky's light arrives."""
        sky = sky_electrons_per_pixel(self._band, self.total_time, self.pixel_scale, sky=self.sky)
        return sky * lit_fraction + self.dark_current * self.total_time

    def electrons(self, magnitude: ArrayLike) -> np.ndarray:
        """Return the electrons of sources of AB magnitudes above the atmosphere; NaN of NaN."""
        return self.total_time * 10.0 ** (0.4 * (self._band.zero_point - pure_numbers(magnitude, "magnitude")))

    @property
    def _band(self) -> Band:
        return band_named(self.photometry or self.band)

    @property
    def _brightness(self) -> float:
        return self._band.dark_sky if self.sky is None else self.sky


@dataclass(frozen=True, eq=False)
class ExposedImage:
    """An exposed image."""

    image: np.ndarray  #: [ny, nx] ADU, float32
    variance: np.ndarray  #: expected variance, ADU^2, float32
    mask: np.ndarray  #: int16, bits of :data:`MASK_BITS`


def expose(
    scene: np.ndarray,
    exposure: Exposure,
    seed: int,
    *key: str | int,
    lit_fraction: Callable[[slice], np.ndarray] | None = None,
    threads: int | None = None,
) -> ExposedImage:
    """Expose a noise-free scene.

    A sum of Poisson variates is a Poisson variate, so all exposures are drawn at once. A pixel saturates where its sum
    reaches as many full wells; its charge does not bleed.

    Parameters
    ----------
    scene : ndarray, shape [ny, nx]
        Expected electrons of the sources in all exposures. Those below zero, from Fourier ringing, count as none in the
        noise.
    exposure : Exposure
        Settings.
    seed : int
        Seed.
    *key : str or int
        Name of the random stream, such as those of CCD and visit. Bands of 128 rows have their own.
    lit_fraction : callable, optional
        Function that gives the part of the sky's light that arrives at the pixels of some rows [n_row, nx], as
        :meth:`.LitFraction.on_rows` does; 1 by default.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    """
    image, variance = np.empty(scene.shape, dtype=np.float32), np.empty(scene.shape, dtype=np.float32)
    mask = np.zeros(scene.shape, dtype=np.int16)
    well, gain = exposure.well, exposure.gain
    read = exposure.exposures * exposure.read_noise**2
    beside = 0 if exposure.brighter_fatter is None else _BESIDE

    def fill(band: int) -> None:
        rows = slice(band * _ROWS, (band + 1) * _ROWS)
        first = max(rows.start - beside, 0)
        wide, inner = slice(first, rows.stop + beside), slice(rows.start - first, rows.stop - first)
        light = scene[wide].astype(np.float64)
        lit = 1.0 if lit_fraction is None else lit_fraction(wide)
        background = np.broadcast_to(exposure.background_of(lit), light.shape)
        collected = _collected(light + background, exposure)[inner]
        variance[rows] = (np.maximum(collected, 0.0) + read) / gain**2
        if exposure.noise:
            random = stream(seed, "image noise", *key, band)
            collected = random.poisson(np.maximum(collected, 0.0)).astype(np.float64)
            collected += random.normal(0.0, np.sqrt(read), collected.shape)
        mask[rows][collected >= well] |= SATURATED
        collected = np.minimum(collected, well)
        if exposure.subtract_background:
            collected -= background[inner]
        image[rows] = collected / gain

    with one_blas_thread(), ThreadPoolExecutor(thread_count(threads)) as pool:
        list(pool.map(fill, range(-(-scene.shape[0] // _ROWS))))
    return ExposedImage(image, variance, mask)


def _collected(light: np.ndarray, exposure: Exposure) -> np.ndarray:
    """Return the expected charge of light [electron] in the pixels of rows, [n_row, nx]."""
    if exposure.brighter_fatter is None:
        return light
    # Boundaries move anew in each snap, by no more charge than a pixel holds.
    light = with_rim(light[None])
    charge = np.minimum(light / exposure.exposures, exposure.full_well) / exposure.snaps
    return np.asarray(without_rim(collect(light, *boundary_shifts(0.5 * charge, exposure.brighter_fatter)))[0])
