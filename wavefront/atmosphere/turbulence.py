r"""Von Karman turbulence in closed form: spectrum, structure functions, long exposures.

Everything is *optical path* in metres, which does not depend on the wavelength: the phase is
:math:`2 \pi \psi / \lambda`. The spectrum of the phase at the wavelength of the Fried parameter (Jee & Tyson 2011,
eq. 1, which rounds the constant to 0.023) is

.. math:: W(\nu) = c \, r_0^{-5/3} (\nu^2 + L_0^{-2})^{-11/6}, \qquad
          c = \frac{\Gamma(11/6)^2}{2 \pi^{11/3}} \left[\tfrac{24}{5} \Gamma(6/5)\right]^{5/6} = 0.0228956,

with :math:`\nu` in cycles per metre, the constant that makes the Kolmogorov structure function exactly
:math:`6.88388 (r/r_0)^{5/3}` (Fried 1966; Conan 2000). Lengths are in metres; Fried parameters
are those at 500 nm.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma, j0, kv

from ...core.errors import DomainError
from ...core.units import require_positive

#: Wavelength at which Fried parameters are given [m].
REFERENCE_WAVELENGTH = 500e-9
_KOLMOGOROV = (24.0 / 5.0 * gamma(6.0 / 5.0)) ** (5.0 / 6.0)
#: Constant of the phase spectrum in cycles per metre.
SPECTRUM_CONSTANT = float(gamma(11.0 / 6.0) ** 2 / (2.0 * math.pi ** (11.0 / 3.0)) * _KOLMOGOROV)
_PATH_PER_RADIAN = REFERENCE_WAVELENGTH / (2.0 * math.pi)
# The exponent of the closed forms, and the number of terms with which its series is exact to rounding below unity.
_NU = 5.0 / 6.0
_SERIES_TERMS = 10
# Light of a core of no width that counts as none.
_LARGEST_CORE = 1e-8
# Transfer of the light about a core over that of the core, at which it ends.
_TAIL = 1e-9


def fried_parameter(r0: float, wavelength: ArrayLike) -> np.ndarray:
    """Return the Fried parameter [m] at a wavelength [m]; ``r0`` [m] is that at 500 nm."""
    return r0 * (np.asarray(wavelength, dtype=np.float64) / REFERENCE_WAVELENGTH) ** 1.2


def path_spectrum(frequency: ArrayLike, r0: float, outer_scale: float) -> np.ndarray:
    """Return the power spectrum of the optical path [m^2 per (cycles/m)^2] at frequencies [cycles/m].

    It is two-sided and two-dimensional: its integral over the plane is the variance.
    """
    r0, outer_scale = require_positive(r0, "r0", "metres"), require_positive(outer_scale, "outer_scale", "metres")
    nu = np.asarray(frequency, dtype=np.float64)
    scale = SPECTRUM_CONSTANT * _PATH_PER_RADIAN**2 * r0 ** (-5.0 / 3.0)
    return scale * (nu * nu + outer_scale**-2) ** (-11.0 / 6.0)


def path_variance(r0: float, outer_scale: float) -> float:
    """Return the variance of the optical path [m^2], half the structure function at infinite separation."""
    r0, outer_scale = require_positive(r0, "r0", "metres"), require_positive(outer_scale, "outer_scale", "metres")
    factor = gamma(11.0 / 6.0) * gamma(5.0 / 6.0) / (2.0 * math.pi ** (8.0 / 3.0)) * _KOLMOGOROV
    return float(factor * (outer_scale / r0) ** (5.0 / 3.0) * _PATH_PER_RADIAN**2)


def structure_function(separation: ArrayLike, r0: float, outer_scale: float) -> np.ndarray:
    r"""Return the structure function of the optical path [m^2]: its mean squared difference at separations [m].

    :math:`D(r) = 2 \sigma^2 [1 - \frac{2^{1/6}}{\Gamma(5/6)} x^{5/6} K_{5/6}(x)]` with :math:`x = 2 \pi r / L_0` (Conan
    2000; Tokovinin 2002, eq. 16). Times ``(2 pi / wavelength)^2`` it is that of the phase.
    """
    variance = path_variance(r0, outer_scale)
    x = 2.0 * math.pi * np.abs(np.asarray(separation, dtype=np.float64)) / outer_scale
    small = np.minimum(x, 1.0)
    large = np.maximum(x, 1.0)
    # Near zero the closed form is the small difference of two near-equal numbers; the power series is not.
    quarter = small * small / 4.0
    growing, falling = np.zeros_like(small), np.zeros_like(small)
    term_growing, term_falling = np.ones_like(small), np.ones_like(small)
    for k in range(1, _SERIES_TERMS + 1):
        falling = falling + term_falling
        term_growing = term_growing * quarter / (k * (k - _NU))
        term_falling = term_falling * quarter / (k * (k + _NU))
        growing = growing + term_growing
    ratio = gamma(-_NU) / gamma(_NU) * 4.0**-_NU
    series = -ratio * small ** (2.0 * _NU) * falling - growing
    closed = 1.0 - 2.0 ** (1.0 - _NU) / gamma(_NU) * large**_NU * kv(_NU, large)
    return 2.0 * variance * np.where(x < 1.0, series, closed)


def _gauss_panels(end: float, panels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss-Legendre quadrature from 0 to ``end``, in equal panels of 32 nodes."""
    node, weight = np.polynomial.legendre.leggauss(32)
    width = end / panels
    nodes = width * (np.arange(panels)[:, np.newaxis] + 0.5 * (node + 1.0))
    return nodes.ravel(), np.tile(0.5 * width * weight, panels)


@lru_cache(maxsize=64)
def slope_variance(r0: float, outer_scale: float, cutoff: float, lag: float = 0.0) -> float:
    """Return the variance [rad^2] of one component of the slope of the modes with ``|k| <= cutoff`` [rad/m].

    Half of the integral of ``(k sinc(k lag / 2))^2 W`` over the disc of frequencies, ``k = 2 pi nu``; ``lag`` [m] is
    the distance over which the slope is taken, 0 for the gradient.
    """
    # nu = sinh(t) / L0 spreads the knee of the spectrum at 1/L0 evenly over the nodes.
    t, weight = _gauss_panels(math.asinh(cutoff / (2.0 * math.pi) * outer_scale), 8)
    nu = np.sinh(t) / outer_scale
    squared = (2.0 * math.pi * nu * np.sinc(nu * lag)) ** 2
    return float(
        np.sum(weight * np.cosh(t) / outer_scale * math.pi * nu * squared * path_spectrum(nu, r0, outer_scale))
    )


def _lens_area(distance: np.ndarray, radius_a: float, radius_b: float) -> np.ndarray:
    """Return the common area [m^2] of two discs whose centres are a distance apart [m]."""
    a, b = max(radius_a, radius_b), min(radius_a, radius_b)
    if b == 0.0:
        return np.zeros_like(distance)
    d = np.clip(distance, a - b, a + b)
    safe = np.maximum(d, 1e-12 * a)
    cos_a = np.clip((d * d + a * a - b * b) / (2.0 * safe * a), -1.0, 1.0)
    cos_b = np.clip((d * d + b * b - a * a) / (2.0 * safe * b), -1.0, 1.0)
    kite = np.maximum((a + b - d) * (d + a - b) * (d - a + b) * (d + a + b), 0.0)
    area = a * a * np.arccos(cos_a) + b * b * np.arccos(cos_b) - 0.5 * np.sqrt(kite)
    return np.where(distance <= a - b, math.pi * b * b, area)


def diffraction_otf(separation: ArrayLike, diameter: float, obscuration: float = 0.0) -> np.ndarray:
    """Return the optical transfer function of an annular pupil, as its autocorrelation (O'Neill 1956).

    It is 1 at zero and 0 from the diameter [m] on. A separation [m] is a baseline in the pupil, the wavelength times an
    angular frequency; ``obscuration`` is the inner over the outer diameter.
    """
    outer = 0.5 * require_positive(diameter, "diameter", "metres")
    if not 0.0 <= obscuration < 1.0:
        raise DomainError(f"obscuration = {obscuration!r}: expected a ratio of diameters in [0, 1)")
    inner = obscuration * outer
    b = np.abs(np.asarray(separation, dtype=np.float64))
    common = _lens_area(b, outer, outer) - 2.0 * _lens_area(b, outer, inner) + _lens_area(b, inner, inner)
    return np.maximum(common, 0.0) / (math.pi * (outer**2 - inner**2))


def coherence(structure: np.ndarray, wavelength: float | np.ndarray) -> np.ndarray:
    """Return the mean transfer function ``exp(-k^2 D / 2)`` of a structure function D [m^2] (Roddier 1981, sec. 4)."""
    return np.exp(-0.5 * (2.0 * math.pi / wavelength) ** 2 * structure)


def long_exposure_otf(
    separation: ArrayLike,
    wavelength: float,
    r0: float,
    outer_scale: float,
    *,
    diameter: float | None = None,
    obscuration: float = 0.0,
) -> np.ndarray:
    """Return the optical transfer function of an infinitely long exposure.

    It is that of the atmosphere, times :func:`diffraction_otf` of the pupil where a diameter [m] is given.
    """
    wavelength = require_positive(wavelength, "wavelength", "metres")
    otf = coherence(structure_function(separation, r0, outer_scale), wavelength)
    if diameter is not None:
        otf = otf * diffraction_otf(separation, diameter, obscuration)
    return otf


def long_exposure_fwhm(
    wavelength: float,
    r0: float,
    outer_scale: float,
    *,
    diameter: float | None = None,
    obscuration: float = 0.0,
    halo: bool = False,
) -> float:
    """Return the full width at half maximum of an infinitely long exposure [rad].

    The point spread function is the Hankel transform of :func:`long_exposure_otf`, by quadrature. Without a pupil,
    turbulence so weak that the image has a core of no width is a :class:`DomainError`, unless the width is to be that
    of the light about this core, the `halo`.
    """
    wavenumber = 2.0 * math.pi / require_positive(wavelength, "wavelength", "metres")
    floor = math.exp(-(wavenumber**2) * path_variance(r0, outer_scale))
    core = floor if halo and floor > _LARGEST_CORE else 0.0
    if diameter is None and floor - core > _LARGEST_CORE:
        raise DomainError(
            f"outer_scale = {outer_scale!r}: with r0 = {r0!r} m expected one so large that no coherent core remains"
            " (give the diameter of the pupil to see that core)"
        )
    fried = float(fried_parameter(r0, wavelength))
    # Beyond 7 Fried parameters Kolmogorov turbulence has left exp(-88); an outer scale slows that down.
    longest = 7.0 * fried
    while (diameter is None or longest < diameter) and (
        long_exposure_otf(longest, wavelength, r0, outer_scale) - core > max(1e-12, 2.0 * (floor - core), _TAIL * core)
    ):
        longest *= 1.5
    if diameter is not None:
        longest = min(longest, diameter)
    b, weight = _gauss_panels(longest, 32)
    otf = long_exposure_otf(b, wavelength, r0, outer_scale, diameter=diameter, obscuration=obscuration)
    otf = (otf - core) * b * weight

    from scipy.optimize import brentq  # a fifth of a second

    def excess(angle: float) -> float:
        return float(np.sum(otf * (j0(wavenumber * b * angle) - 0.5)))

    upper = 0.1 * wavelength / fried if diameter is None else 0.1 * wavelength / max(fried, diameter)
    while excess(upper) > 0.0:
        upper *= 1.5
    return 2.0 * float(brentq(excess, 0.0, upper, xtol=1e-8 * upper))
