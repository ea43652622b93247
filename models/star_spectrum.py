r"""Spectra of stars within a band, as blackbodies, and the temperatures that belong to colours.

A colour is of two bands, each taken at its pivot wavelength; that of a blackbody in AB magnitudes is
:math:`-2.5 \log_{10}[f_\nu(\lambda_1) / f_\nu(\lambda_2)]` with :math:`f_\nu \propto \lambda^{-3} / (e^{h c /
\lambda k T} - 1)`. Within one band the slope of a star's spectrum is close to that of the blackbody of its colour;
molecular bands of cool stars and lines are not in it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import metres, pure_numbers

ColorBands = Literal["g_r", "g_i", "r_i", "bp_rp"]
#: Pivot wavelengths of two bands [m], and what is to be subtracted from the colour to have AB magnitudes: SDSS
#: (Fukugita et al. 1996) and Gaia EDR3 (Riello et al. 2021, Table 3 and sec. 8.2).
COLORS: dict[ColorBands, tuple[float, float, float]] = {
    "g_r": (468.6e-9, 616.6e-9, 0.0),
    "g_i": (468.6e-9, 748.0e-9, 0.0),
    "r_i": (616.6e-9, 748.0e-9, 0.0),
    "bp_rp": (511.0e-9, 776.9e-9, 0.3406),
}
#: Kinds of the colours of PSF models: mean wavelength in the band, or colours of two bands.
ColorKind = Literal["wavelength", "g_r", "g_i", "r_i", "bp_rp"]
#: Names of columns of temperatures in catalogues, in lower case, in order of preference.
TEMPERATURE_COLUMNS = ("teff", "teff_gspphot", "temperature")
#: Catalogues have -99, -999 and the like for colours that are missing; no colour of stars is so low in any unit.
MISSING = -90.0
#: Lowest temperature that stars are taken to have [K].
COOLEST = 2000.0
#: Highest temperature that stars are taken to have [K].
HOTTEST = 50000.0
#: Second radiation constant, h c / k [m K].
_RADIATION = 1.438776877e-2
#: Shortest wavelength of a spectrum [m].
_SHORTEST = 1e-9
#: Longest wavelength of a spectrum [m].
_LONGEST = 1e-3
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
def color_temperature(color: ArrayLike, bands: ColorBands = "g_r") -> np.ndarray:
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
    log_kelvin = _log_temperatures()
    ab_colors = pure_numbers(color, "color") - COLORS[bands][2]
    return np.asarray(np.exp(np.interp(ab_colors, _ab_colors(log_kelvin, bands), log_kelvin)))


@check_arguments
def effective_colour(wavelengths: ArrayLike, photons: ArrayLike, kind: ColorKind = "wavelength") -> np.ndarray:
    """Return the colours of spectra within a band, as PSF models take them.

    The PSF of a spectrum is the mean of those of its wavelengths, each by its photons: as far as these are linear in
    the wavelength it is that of the mean wavelength. Another `kind` of colour is that of the blackbody of the same mean
    wavelength, so that a model whose stars have g - i predicts the PSF of a galaxy's spectrum.

    Parameters
    ----------
    wavelengths : array_like or Quantity, shape [n_wave]
        Wavelengths in steps of equal size, of the band alone [m].
    photons : array_like, shape [n_wave] or [n, n_wave]
        Relative numbers of photons per unit of wavelength, such as :func:`blackbody_photons` gives; times the
        throughput where that varies over the band.
    kind : {"wavelength", "g_r", "g_i", "r_i", "bp_rp"}
        Mean wavelength [m], or colour [mag] as in :func:`color_temperature`.

    Returns
    -------
    ndarray, shape [n]
        Colours, one of each spectrum. Magnitudes are those of blackbodies of 2000 to 50 000 K: redder and bluer spectra
        have those of the coolest and the hottest one.

    Raises
    ------
    DomainError
        If shapes differ, numbers of photons are negative, or a spectrum has none.
    """
    waves = np.atleast_1d(metres(wavelengths, "wavelengths"))
    if waves.ndim != 1 or not ((waves >= _SHORTEST) & (waves <= _LONGEST)).all():
        raise DomainError(f"wavelengths: expected one or more lengths of {_SHORTEST:g} to {_LONGEST:g} m")
    spectra = np.atleast_2d(pure_numbers(photons, "photons"))
    if spectra.ndim != 2 or spectra.shape[1] != len(waves):
        raise DomainError(f"photons have shape {np.shape(photons)}: expected [{len(waves)}] or [n, {len(waves)}]")
    light = spectra.sum(axis=1)
    if not (np.isfinite(light) & (light > 0.0) & (spectra >= 0.0).all(axis=1)).all():
        raise DomainError("photons: expected numbers from 0, in each spectrum some above 0")
    mean = (spectra * waves).sum(axis=1) / light
    if kind == "wavelength":
        return np.asarray(mean)
    log_kelvin = _log_temperatures()
    blackbodies = blackbody_photons(np.exp(log_kelvin), waves)
    return blackbody_color(np.exp(np.interp(mean, (blackbodies * waves).mean(axis=1), log_kelvin)), kind)


def blackbody_color(temperature: np.ndarray, bands: ColorBands) -> np.ndarray:
    """Return the colours [mag] of blackbodies of temperatures [K], as :func:`color_temperature` takes them."""
    return _ab_colors(np.log(temperature), bands) + COLORS[bands][2]


def psf_colours(values: np.ndarray, column: str) -> np.ndarray:
    """Return the values of a column of a catalogue as colours in which PSFs are nearly linear.

    Temperatures, by the name of their column, become the g - i of blackbodies; anything else is as it stands. Values
    that are not finite, or :data:`MISSING` or less, become NaN.
    """
    known = np.isfinite(values) & (values > MISSING)
    if column.lower() not in TEMPERATURE_COLUMNS:
        return np.where(known, values, np.nan)
    kelvin = np.where(known & (values > 0.0), values, np.nan)
    return blackbody_color(np.clip(kelvin, COOLEST, HOTTEST), "g_i")


def _log_temperatures() -> np.ndarray:
    """Return logarithms of temperatures [K] from the hottest to the coolest: colours and mean wavelengths rise."""
    return np.linspace(math.log(HOTTEST), math.log(COOLEST), _STEPS)


def _ab_colors(log_kelvin: np.ndarray, bands: ColorBands) -> np.ndarray:
    """Return the colours of blackbodies by the logarithms of their temperatures [K], AB magnitudes."""
    first, second, _ = COLORS[bands]
    inverse = _RADIATION * np.exp(-log_kelvin)
    return np.asarray(
        7.5 * math.log10(first / second)
        + 2.5 * (np.log10(np.expm1(inverse / first)) - np.log10(np.expm1(inverse / second)))
    )
