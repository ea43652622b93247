"""Crystalline silicon: refractive index and absorption length against wavelength and temperature.

Both start from measurements at 295 K (Schinke et al. 2015, Vogt 2015). The index changes with temperature by the slope
of Franta et al. (2017). The absorption length changes as in the formula of Rajkanan, Singh & Shewchun (1979,
Solid-State Electronics 22, 793) for indirect transitions with two phonons and a direct one: its ratio between two
temperatures is used, not its value, which is 30 % too short at 295 K. Between 173 K and 293 K the ratio differs from
that of Franta et al. by 10 to 20 % from 620 to 970 nm, which is the uncertainty of the absorption length there.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError
from ...core.yaml_reader import read_mapping
from .medium import wavelengths_within

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

#: Shortest and longest vacuum wavelength [m]: beyond the longest, silicon is transparent.
WAVELENGTH_RANGE = (0.3e-6, 1.1e-6)
#: Lowest and highest temperature [K].
TEMPERATURE_RANGE = (100.0, 350.0)
_DATA = Path(__file__).parents[1] / "data" / "silicon.yaml"

#: Boltzmann constant [eV/K].
_BOLTZMANN = 8.617e-5
#: Energy of a photon times its wavelength, h c [eV m].
_PHOTON = 1.239842e-6
# Rajkanan et al. (1979), Table 1.
#: Indirect band gaps at 0 K [eV].
_GAPS = (1.1557, 2.5)
#: Absorption of the transitions over each of these gaps [1/cm/eV^2].
_STRENGTHS = (3.231e2, 7.237e3)
#: Energies of the phonons [eV].
_PHONONS = (1.827e-2, 5.773e-2)
#: Relative strengths of the transitions with each of these phonons.
_COUPLINGS = (5.5, 4.0)
#: Direct band gap at 0 K [eV].
_DIRECT_GAP = 3.2
#: Absorption of the direct transition [1/cm/eV^0.5].
_DIRECT_STRENGTH = 1.052e6
#: Narrowing of the gaps with temperature T after Varshni, a T^2 / (T + b): a [eV/K].
_VARSHNI = 7.021e-4
#: The temperature b of that formula [K].
_VARSHNI_TEMPERATURE = 1108.0


class _Measured(NamedTuple):
    """Interpolators over the wavelength [m], and the temperature [K] of the first two."""

    index: PchipInterpolator
    log_extinction: PchipInterpolator
    index_slope: PchipInterpolator
    temperature: float


def check_temperature(temperature: float) -> None:
    """Raise DomainError unless a temperature [K] is within :data:`TEMPERATURE_RANGE`."""
    low, high = TEMPERATURE_RANGE
    if not low <= temperature <= high:
        raise DomainError(f"temperature = {temperature!r}: expected {low:g} to {high:g} K for silicon")


def silicon_index(wavelength: ArrayLike, temperature: float = 295.0) -> np.ndarray:
    """Return the refractive index of silicon.

    Parameters
    ----------
    wavelength : float, array or Quantity
        Vacuum wavelength [m], 300 to 1100 nm.
    temperature : float
        Temperature [K], 100 to 350.

    Returns
    -------
    ndarray
        Refractive index, shape of `wavelength`.

    Raises
    ------
    DomainError
        If a wavelength or the temperature is outside its range.
    """
    light = wavelengths_within(wavelength, WAVELENGTH_RANGE, "silicon")
    check_temperature(temperature)
    measured = _measured()
    return np.asarray(measured.index(light) + (temperature - measured.temperature) * measured.index_slope(light))


def absorption_length(wavelength: ArrayLike, temperature: float = 295.0) -> np.ndarray:
    """Return the length over which silicon absorbs all but 1/e of the light [m].

    Parameters and errors are those of :func:`silicon_index`.
    """
    light = wavelengths_within(wavelength, WAVELENGTH_RANGE, "silicon")
    check_temperature(temperature)
    measured = _measured()
    length = light / (4.0 * np.pi * np.exp(measured.log_extinction(light)))
    return np.asarray(length * _rajkanan(light, measured.temperature) / _rajkanan(light, temperature))


def _rajkanan(wavelength: np.ndarray, temperature: float) -> np.ndarray:
    """Return the absorption coefficient [1/cm] of Rajkanan et al. (1979), their eq. 4."""
    photon = _PHOTON / wavelength
    narrowing = _VARSHNI * temperature**2 / (temperature + _VARSHNI_TEMPERATURE)
    coefficient = _DIRECT_STRENGTH * np.sqrt(np.maximum(photon - (_DIRECT_GAP - narrowing), 0.0))
    for phonon, coupling in zip(_PHONONS, _COUPLINGS, strict=True):
        occupied = np.exp(phonon / (_BOLTZMANN * temperature))
        for gap, strength in zip(_GAPS, _STRENGTHS, strict=True):
            beyond = photon - (gap - narrowing)
            absorbed = np.maximum(beyond + phonon, 0.0) ** 2 / (occupied - 1.0)
            emitted = np.maximum(beyond - phonon, 0.0) ** 2 / (1.0 - 1.0 / occupied)
            coefficient = coefficient + coupling * strength * (absorbed + emitted)
    return np.asarray(coefficient)


@cache
def _measured() -> _Measured:
    from scipy.interpolate import PchipInterpolator  # a fifth of a second

    content = read_mapping(_DATA)
    wavelength, index, extinction, slope = np.array(content["rows"]).T
    light = wavelength * 1e-9
    return _Measured(
        PchipInterpolator(light, index),
        PchipInterpolator(light, np.log(extinction)),
        PchipInterpolator(light, slope),
        content["temperature"],
    )
