r"""Spectra of stars within a band, as blackbodies, and the temperatures that belong to colours.

A colour is of two bands, each taken at its pivot wavelength; that of a blackbody in AB magnitudes is
:math:`-2.5 \log_{10}[f_\nu(\lambda_1) / f_\nu(\lambda_2)]` with :math:`f_\nu \propto \lambda^{-3} / (e^{h c /
\lambda k T} - 1)`. Within one band the slope of a star's spectrum is close to that of the blackbody of its colour;
molecular bands of cool stars and lines are not in it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, check_choice
from ..core.units import metres, pure_numbers

#: Pivot wavelengths of two bands [m], and what is to be subtracted from the colour to have AB magnitudes: SDSS
#: (Fukugita et al. 1996) and Gaia EDR3 (Riello et al. 2021, Table 3 and sec. 8.2).
COLORS: dict[str, tuple[float, float, float]] = {
    "g_r": (468.6e-9, 616.6e-9, 0.0),
    "g_i": (468.6e-9, 748.0e-9, 0.0),
    "r_i": (616.6e-9, 748.0e-9, 0.0),
    "bp_rp": (511.0e-9, 776.9e-9, 0.3406),
}
#: Lowest temperature that stars are taken to have [K].
COOLEST = 2000.0
#: Highest temperature that stars are taken to have [K].
HOTTEST = 50000.0
#: Second radiation constant, h c / k [m K].
_RADIATION = 1.438776877e-2
_STEPS = 400


@check_arguments
def blackbody_photons(temperature: ArrayLike, wavelengths: ArrayLike) -> np.ndarray:
    """Return the relative numbers of photons of blackbodies at wavelengths.

    Parameters
    ----------
    temperature : array_like, shape [n_star]
        Temperatures [K]; NaN for a flat spectrum, as many photons at each wavelength.
    wavelengths : array_like or Quantity, shape [n_wave]
        Wavelengths [m].

    Returns
    -------
    ndarray, shape [n_star, n_wave]
        Numbers per unit of wavelength, of mean 1 for each star.

    Raises
    ------
    DomainError
        If a temperature is not above 0, or a wavelength is not a positive length.
    """
    kelvin = np.atleast_1d(pure_numbers(temperature, "temperature"))
    waves = np.atleast_1d(metres(wavelengths, "wavelengths"))
    if kelvin.ndim != 1 or (kelvin <= 0.0).any() or np.isinf(kelvin).any():
        raise DomainError("temperature: expected a list of temperatures in K above 0")
    if waves.ndim != 1 or not waves.size or not (np.isfinite(waves) & (waves > 0.0)).all():
        raise DomainError("wavelengths: expected one or more positive lengths in metres")
    # Over the largest: far in the blue of a cool star numbers would be below what floating point holds.
    x = _RADIATION / (waves * np.where(np.isnan(kelvin), 1.0, kelvin)[:, None])
    logarithm = -4.0 * np.log(waves / waves.max()) - x - np.log1p(-np.exp(-x))
    photons = np.exp(logarithm - logarithm.max(axis=1, keepdims=True))
    photons = np.where(np.isnan(kelvin)[:, None], 1.0, photons)
    return np.asarray(photons / photons.mean(axis=1, keepdims=True))


@check_arguments
def color_temperature(color: ArrayLike, bands: str = "g_r") -> np.ndarray:
    """Return the temperatures of blackbodies of given colours [K].

    Parameters
    ----------
    color : array_like
        Colours [mag]; NaN stays NaN.
    bands : {"g_r", "g_i", "r_i", "bp_rp"}
        Bands: AB magnitudes of SDSS or the LSST, or Vega magnitudes of Gaia.

    Returns
    -------
    ndarray
        Between 2000 and 50 000 K: redder and bluer stars are taken as the coolest and the hottest.
    """
    check_choice("bands", bands, COLORS)
    first, second, zero = COLORS[bands]
    log_kelvin = np.linspace(math.log(HOTTEST), math.log(COOLEST), _STEPS)
    inverse = _RADIATION * np.exp(-log_kelvin)
    # Colours rise as the temperature falls.
    colors = 7.5 * math.log10(first / second) + 2.5 * (
        np.log10(np.expm1(inverse / first)) - np.log10(np.expm1(inverse / second))
    )
    ab_colors = pure_numbers(color, "color") - zero
    return np.asarray(np.exp(np.interp(ab_colors, colors, log_kelvin)))
