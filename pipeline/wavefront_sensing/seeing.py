r"""The long exposure: transfer functions of turbulence whose strength is fitted.

The mean transfer function at a baseline b is :math:`e^{-k^2 D(b) / 2}` with the structure function D of the optical
path (:mod:`~pachon.wavefront.atmosphere.turbulence`), which goes as :math:`r_0^{-5/3}`. The unknown is the strength
:math:`s = 1 / r_0` [1/m] at 500 nm: the width of the image is nearly proportional to it, and zero is no turbulence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ...core.units import ARCSEC
from ...wavefront.atmosphere.turbulence import (
    REFERENCE_WAVELENGTH,
    fried_parameter,
    long_exposure_fwhm,
    structure_function,
)

# 2 [(24/5) Gamma(6/5)]^(5/6) (Fried 1966)
_KOLMOGOROV = 6.88388
# FWHM of a Kolmogorov image over wavelength / r0.
_KOLMOGOROV_FWHM = 0.975863
# Strengths between which the FWHM is tabulated [1/m]: r0 of 0.5 m to 2 cm.
_STRENGTHS = np.geomspace(2.0, 50.0, 15)
_TABLE_POINTS = 4096


@dataclass(frozen=True)
class Seeing:
    """Long exposures at one wavelength [m] and outer scale [m], infinite for Kolmogorov's turbulence."""

    wavelength: float
    outer_scale: float

    def __post_init__(self) -> None:
        width = _STRENGTHS * _KOLMOGOROV_FWHM * self.wavelength / fried_parameter(1.0, self.wavelength)
        if math.isfinite(self.outer_scale):
            width = np.array([long_exposure_fwhm(self.wavelength, 1.0 / s, self.outer_scale) for s in _STRENGTHS])
        object.__setattr__(self, "_widths", width)

    def exponent(self, baseline: np.ndarray) -> np.ndarray:
        """Return minus the logarithm of the transfer function at strength 1/m, at baselines [m]."""
        if math.isinf(self.outer_scale):
            return 0.5 * _KOLMOGOROV * (REFERENCE_WAVELENGTH / self.wavelength) ** 2 * baseline ** (5.0 / 3.0)
        table = np.linspace(0.0, float(baseline.max()) ** 0.5, _TABLE_POINTS) ** 2
        phase = 0.5 * (2.0 * math.pi / self.wavelength) ** 2 * structure_function(table, 1.0, self.outer_scale)
        return np.interp(baseline, table, phase)

    def fwhm(self, strength: np.ndarray) -> np.ndarray:
        """Return the full width at half maximum [rad] of strengths [1/m]."""
        widths: np.ndarray = self._widths  # type: ignore[attr-defined]
        inside = np.clip(strength, _STRENGTHS[0], _STRENGTHS[-1])
        scale = np.interp(np.log(inside), np.log(_STRENGTHS), widths / _STRENGTHS)
        return np.asarray(strength * scale)

    def strength(self, fwhm: float) -> float:
        """Return the strength [1/m] of a full width at half maximum [rad]."""
        if fwhm == 0.0:
            return 0.0
        return float(brentq(lambda s: float(self.fwhm(np.asarray(s))) - fwhm, 0.0, 100.0 * fwhm / ARCSEC))
