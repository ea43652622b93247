"""The atmosphere over one exposure: frozen layers of turbulence, each on two scales, blown across the pupil.

Every layer has a *low* screen, which holds exactly the modes with wavenumber ``|k| <= cutoff`` on a large coarse grid,
and a *high* screen with the modes ``|k| > cutoff`` on a small fine grid; both are periodic. Power is neither counted
twice nor missing (below the Nyquist limit of the fine grid), and the low screen alone is what geometric optics may see.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError, unknown_name
from ...core.memory import require_bytes
from ...core.random_streams import stream
from ...core.units import metres
from ...models.site import Site, load_site
from .layers import check_drift, checked_layers, layer_random, line_of_sight
from .refraction import require_zenith_angle
from .screens import evaluate, phase_screen, slope_screen, working_bytes
from .turbulence import require_positive, slope_variance

_cache_lock = threading.Lock()

#: Default cut-off in units of 1/r0 [rad/m]. Of 1.0, 1.2, 1.4 and 2.0 this brings the fast PSF engine's ellipticities
#: nearest to the wave engine's (docs/accuracy.md); beyond it geometric optics makes the image too wide.
DEFAULT_CUTOFF = 1.4
#: Distance over which rays feel the slope of the low screens [m]: a gradient proper lets waves of a metre bend light
#: more than they do where it interferes over baselines of some tenths of a metre.
SLOPE_LAG = 0.2
# Beyond these a slip of the pen would fill the memory: 10 million steps, screens of 17 GB.
_MOST_STEPS = 10_000_000
_LARGEST_SIZE = 65536


@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Layers of frozen turbulence during one exposure; make one with :meth:`from_site`.

    Light of a star in field direction ``(tx, ty)`` (slopes of its travel) that meets the pupil at ``p`` at time ``t``
    crosses a layer at the screen coordinates ``p - altitude * (tx, ty) - velocity * t + offset``, modulo the side of
    each screen.

    Attributes
    ----------
    altitudes : ndarray
        Distances of the layers from the telescope along the line of sight [m], shape [n_layer].
    weights : ndarray
        Fractions of the turbulence, of sum 1, shape [n_layer].
    velocities : ndarray
        Wind in the telescope's x-y plane [m/s], shape [n_layer, 2]: the screens move this way.
    offsets : ndarray
        Screen coordinates over the pupil's centre at time 0 [m], shape [n_layer, 2].
    r0 : float
        Fried parameter at 500 nm along the line of sight [m].
    outer_scale : float
        Outer scale [m].
    exposure : float
        Length of the exposure [s].
    times : ndarray
        Middles of the time steps [s], shape [n_time].
    cutoff : float
        Wavenumber that divides the low from the high modes [rad/m].
    screen_size, screen_length : int, float
        Samples on a side of a low screen, and its side [m].
    fine_size, fine_pixel : int, float
        Samples on a side of a high screen, and their distance [m].
    seed, epoch : int
        Seed of the run and number of the exposure: each epoch has its own winds and screens.
    fixed_modulus : bool
        Whether modes have a fixed modulus and a random phase in place of a Gaussian amplitude.
    """

    altitudes: np.ndarray
    weights: np.ndarray
    velocities: np.ndarray
    offsets: np.ndarray
    r0: float
    outer_scale: float
    exposure: float
    times: np.ndarray
    cutoff: float
    screen_size: int
    screen_length: float
    fine_size: int
    fine_pixel: float
    seed: int
    epoch: int
    fixed_modulus: bool = False
    _cache: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def from_site(
        cls,
        site: str | Site,
        seed: int,
        *,
        r0: float | None = None,
        outer_scale: float | None = None,
        exposure: float = 15.0,
        time_step: float = 0.05,
        screen_size: int = 8192,
        screen_length: float = 1300.0,
        cutoff: float | None = None,
        fine_size: int = 3072,
        fine_pixel: float = 0.014,
        epoch: int = 0,
        altitudes: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        wind_speeds: ArrayLike | None = None,
        wind_directions: ArrayLike | None = None,
        ground_lift: float = 0.0,
        zenith_angle: float = 0.0,
        fixed_modulus: bool = False,
    ) -> Atmosphere:
        """Return the atmosphere of a site for one exposure.

        Parameters
        ----------
        site : str or Site
            Bundled site, path of a site file, or site.
        seed : int
            Seed of the run, not negative: it fixes wind directions, offsets and screens.
        r0 : float or Quantity, optional
            Fried parameter at 500 nm at the zenith [m]; the site's by default.
        outer_scale : float or Quantity, optional
            Outer scale [m]; the site's by default. Screens miss the modes longer than their own side.
        exposure, time_step : float
            Length of the exposure and of a time step [s]; the step is shortened to divide the exposure evenly.
        screen_size, screen_length : int, float
            Samples on a side of a low screen, and its side [m].
        cutoff : float, optional
            Wavenumber that divides the low from the high modes [rad/m]; by default :data:`DEFAULT_CUTOFF` over the
            Fried parameter, but at most half the Nyquist limit of the low screens.
        fine_size, fine_pixel : int, float
            Samples on a side of a high screen, and their distance [m].
        epoch : int
            Number of the exposure, not negative.
        altitudes, weights, wind_speeds : array_like, optional
            Layers in place of the site's: heights above the telescope [m], fractions of the turbulence that sum to 1
            but for their rounding, wind [m/s]. No layer may drift farther in the exposure than its screen is long.
        wind_directions : array_like, optional
            Directions that the wind blows to, from +x towards +y [rad]; the site's by default, and random where it has
            none.
        ground_lift : float
            Height given to a layer at exactly 0 [m]: at 0 neighbouring stars see one and the same ground layer.
        zenith_angle : float or Quantity
            Angle of the line of sight from the zenith [rad]: it takes the layers farther by its secant and makes the
            Fried parameter smaller by its cosine to the 3/5.
        fixed_modulus : bool
            Give modes a fixed modulus and a random phase only (Jee & Tyson 2011, eq. 2); not a Gaussian field.

        Raises
        ------
        DomainError
            If an argument is outside its range.
        UnknownNameError
            If there is no such site.
        """
        if not isinstance(site, Site):
            site = load_site(site)
        if not (isinstance(seed, int | np.integer) and seed >= 0):
            raise DomainError(f"seed = {seed!r}: expected a whole number from 0")
        if not (isinstance(epoch, int | np.integer) and epoch >= 0):
            raise DomainError(f"epoch = {epoch!r}: expected a whole number from 0")
        zenith = require_zenith_angle(zenith_angle)
        fried = _length(site.r0 if r0 is None else r0, "r0") * math.cos(zenith) ** 0.6
        outer = _length(site.outer_scale if outer_scale is None else outer_scale, "outer_scale")
        height, fraction, speed, direction = checked_layers(
            site, altitudes, weights, wind_speeds, wind_directions, seed, epoch
        )
        if not (math.isfinite(ground_lift) and ground_lift >= 0.0):
            raise DomainError(f"ground_lift = {ground_lift!r}: expected a height of 0 m or more")
        height = line_of_sight(height, ground_lift, zenith)
        exposure = require_positive(exposure, "exposure", "seconds")
        steps = max(1, math.ceil(exposure / require_positive(time_step, "time_step", "seconds") - 1e-9))
        if steps > _MOST_STEPS:
            raise DomainError(f"time_step = {time_step!r}: expected at most {_MOST_STEPS} steps in {exposure:g} s")
        length = require_positive(screen_length, "screen_length", "metres")
        check_drift(height, speed, exposure, length)
        offsets = length * np.array([layer_random(seed, epoch, n, "offset", 2) for n in range(len(height))])
        velocities = speed[:, np.newaxis] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        times = (np.arange(steps) + 0.5) * (exposure / steps)
        for array in (height, fraction, velocities, offsets, times):
            array.setflags(write=False)
        size = _size(screen_size, "screen_size")
        # Up to half the Nyquist limit: rays read slopes at the nearest sample, then at most an eighth of a wave away.
        split = min(DEFAULT_CUTOFF / fried, 0.5 * math.pi * size / length)
        atmosphere = cls(
            altitudes=height,
            weights=fraction,
            velocities=velocities,
            offsets=offsets,
            r0=fried,
            outer_scale=outer,
            exposure=exposure,
            times=times,
            cutoff=require_positive(split if cutoff is None else cutoff, "cutoff", "radians per metre"),
            screen_size=size,
            screen_length=length,
            fine_size=_size(fine_size, "fine_size"),
            fine_pixel=require_positive(fine_pixel, "fine_pixel", "metres"),
            seed=int(seed),
            epoch=int(epoch),
            fixed_modulus=bool(fixed_modulus),
        )
        atmosphere._check_cutoff()
        return atmosphere

    @property
    def screen_pixel(self) -> float:
        """Distance of the samples of a low screen [m]."""
        return self.screen_length / self.screen_size

    @property
    def fine_length(self) -> float:
        """Side of a high screen [m]."""
        return self.fine_size * self.fine_pixel

    @property
    def layer_count(self) -> int:
        """Number of layers."""
        return len(self.altitudes)

    def _check_cutoff(self) -> None:
        """Refuse a cut-off that one of the two grids cannot hold."""
        grids = {
            "low": (self.screen_length, math.pi / self.screen_pixel),
            "high": (self.fine_length, math.pi / self.fine_pixel),
        }
        for scale, (length, nyquist) in grids.items():
            lowest = 2.0 * math.pi / length
            if not lowest < self.cutoff < nyquist:
                raise DomainError(
                    f"cutoff = {self.cutoff:.6g} rad/m: expected between the lowest mode and the Nyquist limit of the"
                    f" {scale} screens, {lowest:.4g} to {nyquist:.4g} rad/m"
                )

    def _band(self, scale: str) -> tuple[int, float, tuple[float, float]]:
        """Return samples, side [m] and wavenumbers [rad/m] of one kind of screens."""
        if scale == "high":
            return self.fine_size, self.fine_length, (self.cutoff, math.inf)
        return self.screen_size, self.screen_length, (0.0, self.cutoff)

    def screen_bytes(self, scales: Iterable[str]) -> int:
        """Return how much memory the kept screens of some scales take, and the making of the last of them."""
        grids = [self._band(scale) for scale in scales]
        kept = sum(4 * self.layer_count * size * size for size, _, _ in grids)
        return kept + max((working_bytes(*grid) for grid in grids), default=0)

    def low_screen(
        self, layer: int, stencil: str = "spline", *, threads: int | None = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the low screen of a layer: the modes at and below the cut-off.

        Parameters
        ----------
        layer : int
            Index of the layer.
        stencil : str
            How it will be read, one of :data:`.STENCILS`; the modes are the same for all.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        out : ndarray, optional
            Where to write the screen: float32, shape [screen_size, screen_size].

        Returns
        -------
        ndarray
            Path [m], float32, shape [screen_size, screen_size], ``[y, x]``.
        """
        return phase_screen(**self._drawing(layer, "low"), stencil=stencil, threads=threads, out=out)

    def high_screen(
        self, layer: int, stencil: str = "spline", *, threads: int | None = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the high screen of a layer: the modes above the cut-off.

        Arguments are those of :meth:`low_screen`; the screen has shape [fine_size, fine_size].
        """
        return phase_screen(**self._drawing(layer, "high"), stencil=stencil, threads=threads, out=out)

    def slope_unit(self, layer: int) -> float:
        """Return the slope of one count of :meth:`slope_screen` [rad]: eight standard deviations fill 15 bits."""
        variance = slope_variance(self.r0, self.outer_scale, self.cutoff, SLOPE_LAG) * float(self.weights[layer])
        return max(8.0 * math.sqrt(variance) / 32767.0, 1e-30)

    def slope_screen(self, layer: int, *, threads: int | None = None, out: np.ndarray | None = None) -> np.ndarray:
        """Return the slopes of the low screen of a layer over :data:`SLOPE_LAG`, packed.

        Parameters
        ----------
        layer : int
            Index of the layer.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        out : ndarray, optional
            Where to write the slopes: int32, shape [screen_size, screen_size].

        Returns
        -------
        ndarray
            As :func:`~pachon.wavefront.atmosphere.screens.slope_screen` packs them, in counts of :meth:`slope_unit`.
        """
        return slope_screen(
            **self._drawing(layer, "low"), unit=self.slope_unit(layer), lag=SLOPE_LAG, threads=threads, out=out
        )

    def _drawing(self, layer: int, scale: str) -> dict[str, Any]:
        """Return what decides one screen."""
        if not 0 <= layer < self.layer_count:
            raise DomainError(f"layer = {layer!r}: expected 0 to {self.layer_count - 1}")
        size, length, band = self._band(scale)
        return {
            "generator": stream(self.seed, "atmosphere", self.epoch, layer, scale),
            "size": size,
            "length": length,
            "r0": self.r0,
            "outer_scale": self.outer_scale,
            "band": band,
            "weight": float(self.weights[layer]),
            "fixed_modulus": self.fixed_modulus,
        }

    def screens(self, kind: str, threads: int | None = None) -> np.ndarray:
        """Return the screens of all layers, made once and kept for whoever asks next.

        Parameters
        ----------
        kind : {"slopes", "low", "high"}
            Packed slopes of the low screens, for rays; the low or the high screens as spline coefficients, for waves.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.

        Returns
        -------
        ndarray
            Shape [n_layer, size, size], not writable.

        Raises
        ------
        UnknownNameError
            If there is no such kind.
        DomainError
            If they need more memory than there is.
        """
        kinds: dict[str, tuple[Callable[..., np.ndarray], Any]] = {
            "slopes": (self.slope_screen, np.int32),
            "low": (self.low_screen, np.float32),
            "high": (self.high_screen, np.float32),
        }
        if kind not in kinds:
            raise unknown_name("kind", kind, tuple(kinds))
        make, dtype = kinds[kind]
        size = self._band(kind)[0]
        name = "fine_size" if kind == "high" else "screen_size"
        with _cache_lock:
            if kind not in self._cache:
                require_bytes(self.screen_bytes([kind]), f"{name} = {size} in {self.layer_count} layers")
                screens = np.empty((self.layer_count, size, size), dtype=dtype)
                for layer in range(self.layer_count):
                    make(layer, threads=threads, out=screens[layer])
                screens.setflags(write=False)
                self._cache[kind] = screens
            return self._cache[kind]

    def at_times(self, times: ArrayLike, exposure: float | None = None) -> Atmosphere:
        """Return the same turbulence at other times: an atmosphere that shares the kept screens with this one.

        Screens that either has made are kept for both, and :meth:`release` of either forgets them for both.

        Parameters
        ----------
        times : array_like
            Middles of equal time steps [s], rising.
        exposure : float, optional
            Length of the new exposure [s]; by default as many of this one's time steps as there are times.

        Raises
        ------
        DomainError
            If the times are not the middles of equal steps of the exposure, or a layer drifts farther in it than its
            screen is long.
        """
        middles = np.array(times, dtype=np.float64)
        if middles.ndim != 1 or len(middles) == 0 or not np.all(np.isfinite(middles)):
            raise DomainError(f"times of shape {middles.shape}: expected a list of finite times in seconds")
        if exposure is None:
            exposure = self.exposure / len(self.times) * len(middles)
        exposure = require_positive(exposure, "exposure", "seconds")
        step = exposure / len(middles)
        if not np.allclose(np.diff(middles), step, rtol=1e-6, atol=0.0):
            raise DomainError(f"times: expected the middles of {len(middles)} equal steps of {step:g} s, rising")
        check_drift(self.altitudes, np.hypot(*self.velocities.T), exposure, self.screen_length)
        middles.setflags(write=False)
        return self._through_the_same_screens(exposure=exposure, times=middles)

    def at_altitudes(self, altitudes: ArrayLike) -> Atmosphere:
        """Return the same layers at other altitudes: an atmosphere that shares the kept screens with this one.

        Parameters
        ----------
        altitudes : array_like, shape [n_layer]
            Distances of the layers along the line of sight [m].

        Raises
        ------
        DomainError
            If there are not as many as layers, or one is negative or not finite.
        """
        heights = np.array(altitudes, dtype=np.float64)
        if heights.shape != self.altitudes.shape or not np.all(np.isfinite(heights) & (heights >= 0.0)):
            raise DomainError(f"altitudes = {altitudes!r}: expected {self.layer_count} distances of 0 m or more")
        heights.setflags(write=False)
        return self._through_the_same_screens(altitudes=heights)

    def _through_the_same_screens(self, **changes: Any) -> Atmosphere:
        """Return a changed atmosphere that shares the kept screens: nothing that decides them may change."""
        other = replace(self, **changes)
        object.__setattr__(other, "_cache", self._cache)
        return other

    def release(self) -> None:
        """Forget the kept screens; they come back, byte for byte, when next asked for."""
        with _cache_lock:
            self._cache.clear()

    def pupil_centers(self, direction: np.ndarray, time: ArrayLike = 0.0) -> np.ndarray:
        """Return where the light through the pupil's centre crosses each layer, in the coordinates of its screens.

        Parameters
        ----------
        direction : ndarray, shape [..., 3]
            Directions in which the light travels, of any length.
        time : array_like
            Times since the start of the exposure [s]; its shape and that of the directions are broadcast.

        Returns
        -------
        ndarray
            Screen coordinates [m], shape [..., n_layer, 2], not yet taken modulo the side.
        """
        slopes = direction[..., None, :2] / -direction[..., None, 2:]
        elapsed = np.asarray(time, dtype=np.float64)[..., None, None]
        return self.offsets - self.altitudes[:, None] * slopes - self.velocities * elapsed

    def screen_coordinates(
        self, x: ArrayLike, y: ArrayLike, layer: int, *, field: tuple[float, float] = (0.0, 0.0), time: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where light that meets the pupil at ``(x, y)`` crosses a layer.

        Parameters
        ----------
        x, y : array_like
            Pupil coordinates [m].
        layer : int
            Index of the layer.
        field : tuple of float
            Slopes ``(tx, ty)`` of the light's travel [rad].
        time : float
            Time since the start of the exposure [s].

        Returns
        -------
        tuple of ndarray
            Screen coordinates x and y [m], not yet taken modulo the side.
        """
        shift = self.pupil_centers(np.array([*field, -1.0]), time)[layer]
        return np.asarray(x, dtype=np.float64) + shift[0], np.asarray(y, dtype=np.float64) + shift[1]

    def path(self, x: ArrayLike, y: ArrayLike, layer: int, *, scale: str = "low") -> np.ndarray:
        """Return the path through one screen at screen coordinates, by plain NumPy.

        The screen is made anew at every call: this is the reference for the engines, not a tool for production.

        Parameters
        ----------
        x, y : array_like
            Screen coordinates [m].
        layer : int
            Index of the layer.
        scale : str
            ``"low"`` or ``"high"``.

        Returns
        -------
        ndarray
            Path [m], float64, shape of ``x``.
        """
        scales = {"low": (self.low_screen, self.screen_pixel), "high": (self.high_screen, self.fine_pixel)}
        if scale not in scales:
            raise unknown_name("scale", scale, tuple(scales))
        make, pixel = scales[scale]
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        return evaluate(make(layer), pixel, x, y)


def _size(value: int, name: str) -> int:
    if not (isinstance(value, int | np.integer) and 4 <= value <= _LARGEST_SIZE):
        raise DomainError(f"{name} = {value!r}: expected a whole number of samples from 4 to {_LARGEST_SIZE}")
    return int(value)


def _length(value: Any, name: str) -> float:
    array = metres(value, name)
    return require_positive(array.item() if array.size == 1 else value, name, "metres")
