"""The refractive index of moist air.

Ciddor (1996), Appl. Opt. 35, 1566, appendix B: names and numbers of equations, in brackets, are his. Filippenko (1982),
PASP 94, 715, eqs. 1 to 3, is the older formula of Edlen, still common in models of ground-based telescopes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_prescription
from ...core.errors import PrescriptionError
from .medium import Medium, wavelengths_within

AirFormula = Literal["ciddor", "filippenko"]
#: Ciddor's equations hold from the ultraviolet to 1.7 um, Filippenko's to 2 um.
WAVELENGTH_RANGES: dict[AirFormula, tuple[float, float]] = {"ciddor": (0.23e-6, 1.7e-6), "filippenko": (0.2e-6, 2.0e-6)}
STANDARD_ATMOSPHERE = 101325.0
#: Pascal in a millimetre of mercury, of which 760 are a standard atmosphere.
MMHG = STANDARD_ATMOSPHERE / 760.0
ZERO_CELSIUS = 273.15
GAS_CONSTANT = 8.314510
WATER_MOLAR_MASS = 0.018015


@check_prescription
@dataclass(frozen=True)
class Air(Medium):
    """Moist air as a medium.

    Parameters
    ----------
    pressure : float
        Total pressure [Pa].
    temperature : float
        Temperature [K].
    water_vapour : float
        Partial pressure of water vapour [Pa].
    co2_ppm : float
        Carbon dioxide, parts in a million by number; without effect in Filippenko's formula.
    formula : {"ciddor", "filippenko"}
        Formula of the refractive index.
    name : str
        Name for messages and files; not part of equality.
    """

    pressure: float = STANDARD_ATMOSPHERE
    temperature: float = 288.15
    water_vapour: float = 0.0
    co2_ppm: float = 450.0
    formula: AirFormula = "ciddor"
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not 0 <= self.pressure <= 1e7:
            raise PrescriptionError(f"pressure = {self.pressure!r} Pa: expected 0 to 1e7")
        if not 0 < self.temperature <= 1000:
            raise PrescriptionError(f"temperature = {self.temperature!r} K: expected up to 1000, above 0")
        if not 0 <= self.water_vapour <= self.pressure:
            raise PrescriptionError(f"water_vapour = {self.water_vapour!r} Pa: expected 0 to the pressure")
        if not 0 <= self.co2_ppm <= 1e6:
            raise PrescriptionError(f"co2_ppm = {self.co2_ppm!r}: expected 0 to 1e6")

    @classmethod
    def at_humidity(
        cls,
        humidity: float,
        *,
        pressure: float = STANDARD_ATMOSPHERE,
        temperature: float = 288.15,
        co2_ppm: float = 450,
    ) -> Air:
        """Return air of a relative humidity (0 to 1), with Ciddor's saturation pressure.

        Raises
        ------
        PrescriptionError
            If the humidity is not from 0 to 1, or another argument is out of range.
        """
        if not 0 <= humidity <= 1:
            raise PrescriptionError(f"humidity = {humidity!r}: expected 0 to 1")
        return cls(pressure, temperature, humidity * saturation_pressure(temperature), co2_ppm)

    @property
    def wavelength_range(self) -> tuple[float, float]:
        """Shortest and longest wavelength [m] that the formula covers."""
        return WAVELENGTH_RANGES[self.formula]

    def refractivity(self, wavelength: ArrayLike) -> np.ndarray:
        """Return the index less one, without the rounding of adding one.

        Parameters
        ----------
        wavelength : float, array or Quantity
            Vacuum wavelength [m].

        Raises
        ------
        DomainError
            If a wavelength lies outside `wavelength_range`.
        """
        w = wavelengths_within(wavelength, self.wavelength_range, "air")
        s2 = (1e-6 / w) ** 2
        if self.formula == "filippenko":
            celsius = self.temperature - ZERO_CELSIUS
            return filippenko_refractivity(s2, self.pressure / MMHG, celsius, self.water_vapour / MMHG)
        return self._ciddor(s2)

    def index(self, wavelength: ArrayLike) -> np.ndarray:  # noqa: D102
        return 1.0 + self.refractivity(wavelength)

    def _ciddor(self, s2: np.ndarray) -> np.ndarray:
        # Standard air, 15 C, 101325 Pa, dry, 450 ppm of CO2 [1], and the same with other CO2 [2].
        standard = 1e-8 * (5792105.0 / (238.0185 - s2) + 167917.0 / (57.362 - s2))
        dry = standard * (1.0 + 0.534e-6 * (self.co2_ppm - 450.0))
        # Water vapour at 20 C and 1333 Pa [3].
        vapour = 1.022e-8 * (295.235 + 2.6422 * s2 - 0.032380 * s2**2 + 0.004028 * s2**3)
        air_mass = 1e-3 * (28.9635 + 12.011e-6 * (self.co2_ppm - 400.0))
        t = self.temperature - ZERO_CELSIUS
        # Fraction of water molecules, with the enhancement factor of vapour among air.
        enhancement = 1.00062 + 3.14e-8 * self.pressure + 5.6e-7 * t**2
        fraction = enhancement * self.water_vapour / self.pressure if self.pressure > 0 else 0.0
        pressure_over_zt = self.pressure / (
            _compressibility(self.pressure, self.temperature, fraction) * self.temperature
        )
        dry_density = pressure_over_zt * air_mass * (1.0 - fraction) / GAS_CONSTANT
        vapour_density = pressure_over_zt * WATER_MOLAR_MASS * fraction / GAS_CONSTANT
        warm, warmer = 288.15, 293.15
        dry_standard = STANDARD_ATMOSPHERE * air_mass / (_compressibility(STANDARD_ATMOSPHERE, warm, 0.0) * warm)
        vapour_standard = 1333.0 * WATER_MOLAR_MASS / (_compressibility(1333.0, warmer, 1.0) * warmer)
        # [5]: each part in proportion to its density.
        return GAS_CONSTANT * (dry_density / dry_standard * dry + vapour_density / vapour_standard * vapour)


def saturation_pressure(temperature: float) -> float:
    """Return the saturation pressure of water vapour [Pa] at a temperature [K] (Ciddor 1996, appendix A)."""
    t = temperature
    return math.exp(1.2378847e-5 * t**2 - 1.9121316e-2 * t + 33.93711047 - 6.3431645e3 / t)


def _compressibility(pressure: float, temperature: float, fraction: float) -> float:
    """Return the compressibility of moist air (Ciddor 1996, eq. 12)."""
    t = temperature - ZERO_CELSIUS
    ratio = pressure / temperature
    first = (
        1.58123e-6
        - 2.9331e-8 * t
        + 1.1043e-10 * t**2
        + (5.707e-6 - 2.051e-8 * t) * fraction
        + (1.9898e-4 - 2.376e-6 * t) * fraction**2
    )
    return 1.0 - ratio * first + ratio**2 * (1.83e-11 - 0.765e-8 * fraction**2)


def filippenko_refractivity(
    wavenumber_squared: np.ndarray, pressure_mmhg: float, temperature_c: float, water_vapour_mmhg: float
) -> np.ndarray:
    """Return the refractive index of air less one (Filippenko 1982, eqs. 1 to 3).

    Arguments: square of the wave number in vacuum [1/um^2], pressure and partial pressure of water vapour [mm Hg],
    temperature [deg C].
    """
    # Eq. 1: dry air at 15 C and 760 mm Hg; eq. 2: other temperatures and pressures; eq. 3: water vapour.
    standard = 64.328 + 29498.1 / (146.0 - wavenumber_squared) + 255.4 / (41.0 - wavenumber_squared)
    expansion = 1.0 + 0.003661 * temperature_c
    density = pressure_mmhg * (1.0 + (1.049 - 0.0157 * temperature_c) * 1e-6 * pressure_mmhg) / (720.883 * expansion)
    return 1e-6 * (standard * density - (0.0624 - 0.000680 * wavenumber_squared) / expansion * water_vapour_mmhg)
