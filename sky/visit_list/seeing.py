"""Fried parameters of seeing: widths of long exposures through turbulence with an outer scale."""

from __future__ import annotations

import numpy as np

from ...core.errors import DomainError
from ...core.units import ARCSEC

#: Wavelength of the seeing of lists and of the Fried parameter [m].
WAVELENGTH = 500e-9
#: Width of a long exposure over lambda / r0 without an outer scale (Fried 1966; GalSim has the same number).
KOLMOGOROV_WIDTH = 0.9758634
#: Width of an image motion monitor over lambda / r0 (Tokovinin 2002, PASP 114, 1156, eq. 1).
MONITOR_WIDTH = 0.98
# Outer scale: FWHM^2 = FWHM_Kolmogorov^2 (1 - 2.183 (r0 / L0)^0.356) (Tokovinin 2002, eq. 19).
_OUTER_SCALE_FACTOR = 2.183
_OUTER_SCALE_POWER = 0.356
#: Largest r0 / L0 for which Tokovinin's formula holds.
LARGEST_RATIO = 1.0 / 20.0
#: Smallest Fried parameter that is looked for [m]: a seeing of a hundred arcsec.
_SMALLEST = 1e-3
# Halvings of the interval, which end below a part in 1e12.
_HALVINGS = 60


def seeing_width(r0: np.ndarray, outer_scale: np.ndarray) -> np.ndarray:
    """Return the FWHM at 500 nm [rad] of Fried parameters at 500 nm and outer scales [m] (Tokovinin 2002, eq. 19)."""
    loss = _OUTER_SCALE_FACTOR * (r0 / outer_scale) ** _OUTER_SCALE_POWER
    return np.asarray(KOLMOGOROV_WIDTH * WAVELENGTH / r0 * np.sqrt(np.maximum(1.0 - loss, 0.0)))


def is_allowed(fwhm: np.ndarray, outer_scale: np.ndarray) -> np.ndarray:
    """Return whether turbulence with an outer scale [m] can have a seeing at 500 nm [rad]."""
    least = seeing_width(LARGEST_RATIO * outer_scale, outer_scale)
    return np.asarray((fwhm >= least) & (fwhm < seeing_width(np.array(_SMALLEST), outer_scale)))


def fried_parameter(fwhm: np.ndarray, outer_scale: np.ndarray) -> np.ndarray:
    """Return the Fried parameters at 500 nm [m] of seeing at 500 nm [rad], shape [n]: :func:`seeing_width` solved.

    DomainError if a seeing is better than the outer scale allows.
    """
    fwhm, outer_scale = np.broadcast_arrays(np.asarray(fwhm, dtype=np.float64), outer_scale)
    wrong = np.flatnonzero(~is_allowed(fwhm, outer_scale))
    high = LARGEST_RATIO * outer_scale
    if wrong.size:
        least = seeing_width(high, outer_scale)
        raise DomainError(
            f"seeing = {fwhm[wrong[0]] / ARCSEC:.3g} arcsec: expected at least {least[wrong[0]] / ARCSEC:.3g} arcsec "
            f"with an outer scale of {outer_scale[wrong[0]]:g} m (r0 at most a twentieth of it, Tokovinin 2002)"
        )
    low = np.full(fwhm.shape, _SMALLEST)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        # The width falls as r0 grows.
        wide = seeing_width(middle, outer_scale) > fwhm
        low, high = np.where(wide, middle, low), np.where(wide, high, middle)
    return 0.5 * (low + high)
