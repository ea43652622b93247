"""Atmospheric dispersion: the refractive index of air and differential refraction (Filippenko 1982, PASP 94, 715)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError
from ...core.units import angle, metres, radians
from ...models.media.air import filippenko_refractivity
from ...models.site import Weather

#: Range of wavelengths that the formulae cover [m].
WAVELENGTH_RANGE = (0.2e-6, 2.0e-6)
#: Largest angle from the zenith for which the layers of air may be taken as flat [rad].
LARGEST_ZENITH_ANGLE = math.radians(80.0)


def require_zenith_angle(value: Any) -> float:
    """Return an angle from the zenith in radians, or raise :class:`DomainError` if it is not from 0 to 80 degrees."""
    array = radians(value, "zenith_angle")
    if not (array.size == 1 and 0.0 <= array.item() <= LARGEST_ZENITH_ANGLE):
        raise DomainError(f"zenith_angle = {value!r}: expected 0 to {LARGEST_ZENITH_ANGLE:.4f} rad (80 degrees)")
    return array.item()


def air_refractivity(wavelength: ArrayLike, weather: Weather) -> np.ndarray:
    """Return the refractive index of air less one (Filippenko 1982, eqs. 1 to 3), at 0.2 to 2 um in vacuum [m]."""
    lam = metres(wavelength, "wavelength")
    low, high = WAVELENGTH_RANGE
    outside = lam[~((lam >= low) & (lam <= high))]
    if outside.size:
        raise DomainError(
            f"wavelength = {outside[0]:g} m: expected {low:g} to {high:g} m, which the index of air covers"
        )
    return filippenko_refractivity(
        (1e-6 / lam) ** 2, weather.pressure_mmhg, weather.temperature_c, weather.water_vapour_mmhg
    )


def dispersion_shift(
    wavelength: ArrayLike,
    reference_wavelength: float,
    zenith_angle: float,
    position_angle: float,
    weather: Weather,
) -> np.ndarray:
    """Return the shift in field angle of each wavelength against a reference wavelength [rad], shape [n_wave, 2].

    Refraction lifts a star towards the zenith by ``(n - 1) tan z``, so one wavelength against another by the difference
    of the indices (Filippenko 1982, eq. 4, there in arcseconds): shorter wavelengths lie nearer to the zenith *on the
    sky*. A field angle is the slope of the light's own travel, and the source on the sky lies the opposite way, so
    shorter wavelengths shift in field angle *away from* the zenith's direction.

    Parameters
    ----------
    wavelength, reference_wavelength : array_like or Quantity
        Wavelengths in vacuum [m], 0.2 to 2 um.
    zenith_angle : float or Quantity
        Angle of the line of sight from the zenith [rad], 0 to 80 degrees.
    position_angle : float or Quantity
        Direction, on the sky as viewed from the telescope, towards the zenith: angle in the x-y plane of the
        telescope frame from +x towards +y [rad].
    weather : Weather
        Weather at the telescope, such as ``site.weather``.
    """
    zenith, position = require_zenith_angle(zenith_angle), angle(position_angle, "position_angle")
    if not math.isfinite(position):
        raise DomainError(f"position_angle = {position!r} rad: expected a finite angle")
    waves = np.atleast_1d(metres(wavelength, "wavelength"))
    lift = (air_refractivity(waves, weather) - air_refractivity(reference_wavelength, weather)) * math.tan(zenith)
    return -lift[:, np.newaxis] * np.array([math.cos(position), math.sin(position)])
