r"""The long exposure: transfer functions of turbulence whose strength is fitted.

The mean transfer function at a baseline b is :math:`e^{-k^2 D(b) / 2}` with the structure function D of the optical
path (:mod:`~pachon.wavefront.atmosphere.turbulence`), which goes as :math:`r_0^{-5/3}`. The unknown is the strength
:math:`s = 1 / r_0` [1/m] at 500 nm: the width of the image is nearly proportional to it, and zero is no turbulence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from ..core.units import ARCSEC
from ..wavefront.atmosphere.turbulence import (
    REFERENCE_WAVELENGTH,
    fried_parameter,
    long_exposure_fwhm,
    structure_function,
)

# 2 [(24/5) Gamma(6/5)]^(5/6) (Fried 1966)
_KOLMOGOROV = 6.88388
# FWHM of a Kolmogorov image over wavelength / r0.
_KOLMOGOROV_FWHM = 0.975863
# Seeing of telescopes in the median [rad].
_USUAL_FWHM = 0.8 * ARCSEC
# Standard deviation of the logarithm of the seeing about that: 95 % of 0.36 to 1.8 arcsec.
_USUAL_RANGE = 0.4
# Odds of any other strength, as images without air have, over those of the median.
_OTHERWISE = 5e-5
# Strengths between which the FWHM is tabulated [1/m]: r0 of 0.5 m to 2 cm.
_STRENGTHS = np.geomspace(2.0, 50.0, 15)
_TABLE_POINTS = 4096
# Step of the slope of the FWHM over the strength, wider than the steps of the table, and the least one [1/m].
_SLOPE_STEP = 0.25
_LEAST_STEP = 1e-3


@dataclass(frozen=True)
class Seeing:
    """Long exposures at one wavelength [m] and outer scale [m], infinite for Kolmogorov's turbulence."""

    wavelength: float
    outer_scale: float

    def exponent(self, baseline: np.ndarray) -> np.ndarray:
        """Return minus the logarithm of the transfer function at strength 1/m, at baselines [m]."""
        if math.isinf(self.outer_scale):
            return 0.5 * _KOLMOGOROV * (REFERENCE_WAVELENGTH / self.wavelength) ** 2 * baseline ** (5.0 / 3.0)
        roots, structure = _structure_table(self.outer_scale, math.ceil(math.log2(float(baseline.max()))))
        return 0.5 * (2.0 * math.pi / self.wavelength) ** 2 * np.interp(np.sqrt(baseline), roots, structure)

    def fwhm(self, strength: np.ndarray) -> np.ndarray:
        """Return the full width at half maximum [rad] of strengths [1/m]."""
        widths = _widths(self.wavelength, self.outer_scale)
        inside = np.clip(strength, _STRENGTHS[0], _STRENGTHS[-1])
        scale = np.interp(np.log(inside), np.log(_STRENGTHS), widths / _STRENGTHS)
        return np.asarray(strength * scale)

    def fwhm_error(self, strength: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the standard deviations of :meth:`fwhm` [rad] by those of strengths [1/m]."""
        step = np.maximum(_SLOPE_STEP * strength, _LEAST_STEP)
        low, high = np.maximum(strength - step, 0.0), strength + step
        return np.asarray(error * (self.fwhm(high) - self.fwhm(low)) / (high - low))

    @property
    def usual_strength(self) -> float:
        """Strength of the seeing that telescopes have in the median [1/m]: a search starts there."""
        return self.strength(_USUAL_FWHM)

    def strength(self, fwhm: float) -> float:
        """Return the strength [1/m] of a full width at half maximum [rad]."""
        if fwhm == 0.0:
            return 0.0
        return float(brentq(lambda s: float(self.fwhm(np.asarray(s))) - fwhm, 0.0, 100.0 * fwhm / ARCSEC))


@dataclass(frozen=True)
class StrengthPrior:
    """Prior of the strength of turbulence: faint images tell little of it, and fit their noise best without any.

    It is a normal distribution of the logarithm of the strength, beside which no strength is ruled out.

    Attributes
    ----------
    usual : float
        Its median [1/m].
    """

    usual: float

    def loss(self, strength: float) -> float:
        """Return twice the negative logarithm of the density at a strength over that at the median."""
        return -2.0 * math.log((self._density(strength) + _OTHERWISE) / (1.0 + _OTHERWISE))

    def precision(self, strength: float) -> float:
        """Return the inverse variance [m^2] of a normal density of the same slope at a strength."""
        density = self._density(strength)
        return density / (density + _OTHERWISE) / (_USUAL_RANGE * strength) ** 2

    def deviation(self, strength: float) -> float:
        """Return how far a strength is from the mean of that density [1/m]."""
        return strength * math.log(strength / self.usual)

    def _density(self, strength: float) -> float:
        """Return the normal density of the logarithm of a strength over its maximum."""
        return math.exp(-0.5 * (math.log(strength / self.usual) / _USUAL_RANGE) ** 2)


@lru_cache(maxsize=16)
def _structure_table(outer_scale: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return roots of baselines [m^0.5] up to 2^size m and structure functions there at strength 1/m."""
    roots = np.linspace(0.0, 2.0 ** (0.5 * size), _TABLE_POINTS)
    return roots, structure_function(roots**2, 1.0, outer_scale)


@lru_cache(maxsize=16)
def _widths(wavelength: float, outer_scale: float) -> np.ndarray:
    """Return the full widths at half maximum [rad] of the tabulated strengths."""
    if math.isfinite(outer_scale):
        # Of weak turbulence, as that of the infrared, without the core that only the pupil gives a width.
        return np.array([long_exposure_fwhm(wavelength, 1.0 / s, outer_scale, halo=True) for s in _STRENGTHS])
    return np.asarray(_STRENGTHS * _KOLMOGOROV_FWHM * wavelength / fried_parameter(1.0, wavelength))
