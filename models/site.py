"""Observing sites: layers of turbulence, wind and weather."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import PrescriptionError

#: How far the weights of a site may be from a sum of 1: published ones are rounded to three digits.
WEIGHT_TOLERANCE = 5e-3


@check_arguments
@dataclass(frozen=True)
class Weather:
    """Air at the telescope.

    Parameters
    ----------
    pressure_mmhg : float
        Total pressure [mm Hg].
    temperature_c : float
        Temperature [deg C].
    water_vapour_mmhg : float
        Partial pressure of water vapour [mm Hg].
    """

    pressure_mmhg: float
    temperature_c: float
    water_vapour_mmhg: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.pressure_mmhg) and self.pressure_mmhg > 0):
            raise PrescriptionError(f"pressure_mmhg = {self.pressure_mmhg!r}: expected a positive number")
        if not -273.15 < self.temperature_c < np.inf:
            raise PrescriptionError(f"temperature_c = {self.temperature_c!r}: expected above -273.15 and finite")
        if not 0 <= self.water_vapour_mmhg <= self.pressure_mmhg:
            raise PrescriptionError(f"water_vapour_mmhg = {self.water_vapour_mmhg!r}: expected 0 to the pressure")


@check_arguments
@dataclass(frozen=True)
class Site:
    """Turbulence over a site, in layers that the wind carries along.

    Parameters
    ----------
    name : str
        Name of the site.
    altitudes : tuple of float
        Altitudes of the layers above the telescope [m], rising.
    weights : tuple of float
        Fraction of the integral of Cn^2 in each layer; they sum to 1.
    wind_speeds : tuple of float
        Speed of the wind in each layer [m/s].
    r0 : float
        Fried parameter of all layers at 500 nm towards the zenith [m].
    outer_scale : float
        Outer scale of the turbulence [m].
    weather : Weather
        Air at the telescope.
    source, description : str
        Source of the numbers, and remarks.
    wind_directions : tuple of float or None
        Direction that the wind blows to in each layer, from +x towards +y of the telescope [rad]; None (the default)
        where it is drawn from the seed of the atmosphere.
    """

    name: str
    altitudes: tuple[float, ...]
    weights: tuple[float, ...]
    wind_speeds: tuple[float, ...]
    r0: float
    outer_scale: float
    weather: Weather
    source: str = ""
    description: str = ""
    wind_directions: tuple[float | None, ...] = ()

    def __post_init__(self) -> None:
        if not self.wind_directions:
            object.__setattr__(self, "wind_directions", (None,) * len(self.altitudes))
        profiles = (self.altitudes, self.weights, self.wind_speeds, self.wind_directions)
        if not self.altitudes or len({len(profile) for profile in profiles}) > 1:
            raise PrescriptionError(f"layers of site {self.name!r}: expected an altitude, weight and wind for each")
        if not (np.isfinite(self.altitudes).all() and self.altitudes[0] >= 0 and (np.diff(self.altitudes) > 0).all()):
            raise PrescriptionError(f"altitudes = {self.altitudes!r}: expected to rise from 0 m or more")
        total = sum(self.weights)
        if not (min(self.weights) >= 0 and abs(total - 1) <= WEIGHT_TOLERANCE):
            raise PrescriptionError(
                f"weights = {self.weights!r}: expected fractions from 0 that sum to 1, not {total:.6g}"
            )
        if not (np.isfinite(self.wind_speeds).all() and min(self.wind_speeds) >= 0):
            raise PrescriptionError(f"wind_speeds = {self.wind_speeds!r}: expected zero or more")
        if not all(d is None or np.isfinite(d) for d in self.wind_directions):
            raise PrescriptionError(f"wind_directions = {self.wind_directions!r}: expected angles in radians")
        for key in ("r0", "outer_scale"):
            if not (np.isfinite(getattr(self, key)) and getattr(self, key) > 0):
                raise PrescriptionError(f"{key} = {getattr(self, key)!r}: expected a positive number")

    def with_layers(
        self,
        altitudes: Sequence[float] | None = None,
        weights: Sequence[float] | None = None,
        wind_speeds: Sequence[float] | None = None,
        wind_directions: Sequence[float | None] | None = None,
    ) -> Site:
        """Return the site with other layers or winds.

        Parameters
        ----------
        altitudes, weights, wind_speeds, wind_directions : sequence of float, optional
            As in :class:`Site`; those of this site by default. Other altitudes come without directions of the wind.

        Raises
        ------
        PrescriptionError
            If a number is out of range, or there is not one for each layer.
        """
        if wind_directions is None:
            wind_directions = self.wind_directions if altitudes is None else ()
        return replace(
            self,
            altitudes=self.altitudes if altitudes is None else tuple(altitudes),
            weights=self.weights if weights is None else tuple(weights),
            wind_speeds=self.wind_speeds if wind_speeds is None else tuple(wind_speeds),
            wind_directions=tuple(wind_directions),
        )
