"""The atmosphere over one exposure: frozen layers of turbulence on two scales, blown across the pupil.

Every layer has a *low* screen, which holds exactly the modes with wavenumber ``|k| <= cutoff`` on a large coarse grid,
and a *high* screen with the modes ``|k| > cutoff`` on a small fine grid. Both are periodic. Power is neither counted
twice nor missing below the Nyquist limit of the fine grid. Geometric optics uses the low screen alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.units import metres, pure_numbers, require_positive, require_within
from ...models.io.site_file import load_site
from ...models.site import Site
from .layer_screens import LayerScreens, screen_samples
from .layers import check_drift, layer_random, line_of_sight, wind_directions
from .refraction import require_zenith_angle
from .screen_sampling import ScreenSampling

# More would fill the memory.
_MOST_STEPS = 10_000_000
#: Fried parameters at 500 nm [m]: images of 100" across to no turbulence.
_FRIED_PARAMETERS = (1e-3, 1e9)


@dataclass(frozen=True, eq=False, kw_only=True)
class Atmosphere(LayerScreens):
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
    store : ScreenStore
        Memory of the screens, by default an empty one. Atmospheres that differ in nothing that determines the screens
        share it: those of ``replace(atmosphere, times=...)``, and of ``replace(atmosphere, store=other.store)``.
    """

    exposure: float
    times: np.ndarray

    def __repr__(self) -> str:
        air = f"r0 {self.r0:.4g} m, outer scale {self.outer_scale:.4g} m"
        return (
            f"<Atmosphere: {len(self.altitudes)} layers, {air}, {self.exposure:.6g} s, "
            f"seed {self.seed}, epoch {self.epoch}>"
        )

    @classmethod
    @removed_arguments(
        altitudes="site=load_site(...).with_layers(altitudes=...)",
        weights="site=load_site(...).with_layers(weights=...)",
        wind_speeds="site=load_site(...).with_layers(wind_speeds=...)",
        wind_directions="site=load_site(...).with_layers(wind_directions=...)",
    )
    @check_arguments
    def from_site(
        cls,
        site: str | Site,
        seed: int,
        *,
        r0: ArrayLike | None = None,
        outer_scale: ArrayLike | None = None,
        exposure: float = 15.0,
        time_step: float = 0.05,
        epoch: int = 0,
        ground_lift: float = 0.0,
        zenith_angle: ArrayLike = 0.0,
        screens: ScreenSampling | None = None,
    ) -> Atmosphere:
        """Return the atmosphere of a site for one exposure.

        Parameters
        ----------
        site : str or Site
            Bundled site, path of a site file, or site; :meth:`Site.with_layers` gives one with other layers and winds.
            Engines with screens take exposures in which no layer drifts farther than its screen is long.
        seed : int
            Seed of the run, not negative: it fixes offsets, screens, and those directions of the wind that the site
            does not state.
        r0 : float or Quantity, optional
            Fried parameter at 500 nm at the zenith [m]; the site's by default.
        outer_scale : float or Quantity, optional
            Outer scale [m]; the site's by default. Screens miss the modes longer than their own side.
        exposure, time_step : float
            Length of the exposure and of a time step [s]; the step is shortened to divide the exposure evenly.
        epoch : int
            Number of the exposure, not negative.
        ground_lift : float
            Height given to a layer at exactly 0 [m]: at 0 all stars share one and the same patch of the ground layer.
        zenith_angle : float or Quantity
            Angle of the line of sight from the zenith [rad]: it takes the layers farther by its secant and makes the
            Fried parameter smaller by its cosine to the 3/5.
        screens : ScreenSampling, optional
            Sizes and samples of the screens; by default 8192 samples over 1300 m, and 3072 of 14 mm for the high modes.

        Raises
        ------
        DomainError
            If an argument is outside its range.
        UnknownNameError
            If there is no such site.
        """
        if not isinstance(site, Site):
            site = load_site(site)
        screens = ScreenSampling() if screens is None else screens
        for name, value in (("seed", seed), ("epoch", epoch)):
            if not (isinstance(value, int | np.integer) and value >= 0):
                raise DomainError(f"{name} = {value!r}: expected a whole number from 0")
        zenith = require_zenith_angle(zenith_angle)
        fried = require_within(_length(site.r0 if r0 is None else r0, "r0"), "r0", *_FRIED_PARAMETERS, "m")
        fried *= math.cos(zenith) ** 0.6
        outer = _length(site.outer_scale if outer_scale is None else outer_scale, "outer_scale")
        if not (math.isfinite(ground_lift) and ground_lift >= 0.0):
            raise DomainError(f"ground_lift = {ground_lift!r}: expected a height of 0 m or more")
        height = line_of_sight(np.array(site.altitudes), ground_lift, zenith)
        exposure = require_positive(exposure, "exposure", "seconds")
        ratio = exposure / require_positive(time_step, "time_step", "seconds")
        if ratio > _MOST_STEPS:
            raise DomainError(f"time_step = {time_step!r}: expected at most {_MOST_STEPS} steps in {exposure:g} s")
        steps = max(1, math.ceil(ratio - 1e-9))
        speed, length = np.array(site.wind_speeds), float(screens.screen_length)
        direction = wind_directions(site, seed, epoch)
        weights = np.array(site.weights)
        offsets = length * np.array([layer_random(seed, epoch, n, "offset", 2) for n in range(len(height))])
        velocities = speed[:, np.newaxis] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        times = (np.arange(steps) + 0.5) * (exposure / steps)
        fraction = weights / float(weights.sum())
        for array in (height, fraction, velocities, offsets, times):
            array.setflags(write=False)
        return cls(
            altitudes=height,
            weights=fraction,
            velocities=velocities,
            offsets=offsets,
            r0=fried,
            outer_scale=outer,
            exposure=exposure,
            times=times,
            cutoff=screens.cutoff_at(fried),
            screen_size=screen_samples(screens.screen_size, "screen_size"),
            screen_length=length,
            fine_size=screen_samples(screens.fine_size, "fine_size"),
            fine_pixel=float(screens.fine_pixel),
            seed=int(seed),
            epoch=int(epoch),
            fixed_modulus=bool(screens.fixed_modulus),
        )

    @check_arguments
    def at_times(self, times: ArrayLike, exposure: float | None = None) -> Atmosphere:
        """Return the same turbulence at other times, with shared screens.

        Screens made by either are stored for both, until neither uses them, see :meth:`release`.

        Parameters
        ----------
        times : array_like
            Middles of equal time steps [s], rising.
        exposure : float, optional
            Length of the new exposure [s]; by default as many of this one's time steps as there are times.

        Raises
        ------
        DomainError
            If the times are not the middles of equal steps of the exposure.
        """
        middles = pure_numbers(times, "times").copy()
        if middles.ndim != 1 or len(middles) == 0 or not np.all(np.isfinite(middles)):
            raise DomainError(f"times of shape {middles.shape}: expected a list of finite times in seconds")
        if exposure is None:
            exposure = self.exposure / len(self.times) * len(middles)
        exposure = require_positive(exposure, "exposure", "seconds")
        step = exposure / len(middles)
        if not np.allclose(np.diff(middles), step, rtol=1e-6, atol=0.0):
            raise DomainError(f"times: expected the middles of {len(middles)} equal steps of {step:g} s, rising")
        middles.setflags(write=False)
        return replace(self, exposure=exposure, times=middles)

    @check_arguments
    def at_altitudes(self, altitudes: ArrayLike) -> Atmosphere:
        """Return the same layers at other altitudes, with shared screens.

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
        return replace(self, altitudes=heights)

    def screens(self, kind: str, threads: int | None = None, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the screens of all layers, as :meth:`.LayerScreens.screens` does.

        DomainError, besides, if a layer drifts farther in the exposure than its screen is long.
        """
        check_drift(self.altitudes, np.hypot(*self.velocities.T), self.exposure, self.screen_length)
        return super().screens(kind, threads, rows)

    def rows_under(self, directions: np.ndarray, radius: float) -> np.ndarray:
        """Return the rows of the low screens that light of a pupil crosses, bool [n_layer, screen_size].

        ``directions`` [n, 3] are those in which the light of stars travels, and ``radius`` [m] is that of the pupil.
        Rows between those of two stars count too, and two on either side for rounding.
        """
        size, pixel = self.screen_size, self.screen_pixel
        if not len(directions):
            return np.zeros((self.layer_count, size), dtype=bool)
        middle = self.pupil_centers(directions[:, None], self.times[[0, -1]])[..., 1]
        first = np.floor((middle.min(axis=(0, 1)) - radius) / pixel) - 2.0
        last = np.ceil((middle.max(axis=(0, 1)) + radius) / pixel) + 2.0
        from_first = (np.arange(size) - first[:, None]) % size
        return np.asarray(from_first <= (last - first)[:, None])


def _length(value: Any, name: str) -> float:
    array = metres(value, name)
    return require_positive(array.item() if array.size == 1 else value, name, "metres")
