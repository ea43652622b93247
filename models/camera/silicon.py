r"""The silicon of a CCD: the depths at which light turns into charge, and how far the charge spreads from there.

Light enters the back surface, is refracted, and is absorbed after a path of exponential distribution, truncated where
it reaches the gates. Light that gets there is lost: reflection by the gates, and with it fringing, is ignored, and so
is reflection by the surface. Paths are those of light along the normal; at f/1.23 the slant makes them 0.5 % longer.

A ray with direction cosines :math:`u` along the surface has :math:`u/n` inside, so after a path :math:`s` it has moved
by :math:`(s/n) u`, exactly. To first order that is a detector shifted by :math:`s/n`, the *equivalent defocus*.

Charge drifts to the gates with a spread of :math:`\sigma \sqrt{d/t}` along each axis, where :math:`d` is the distance
drifted, :math:`t` the thickness and :math:`\sigma` the spread from the surface, as in GalSim's SiliconSensor.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError
from ...core.gauss_rule import gauss_rule
from ...core.units import length, one_number
from ..media.silicon import absorption_length, check_temperature, silicon_index

# Absorption lengths beyond which no light is left, to double precision.
_ALL_ABSORBED = 40.0
# Gauss-Legendre rule from which the rules of the paths are made.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True)
class ConversionPaths:
    """Paths of light in silicon up to where it turns into charge, as a quadrature rule."""

    length: np.ndarray  #: rising paths, [n] m
    weight: np.ndarray  #: parts of the light that enters, [n]; their sum is what is absorbed


@dataclass(frozen=True)
class Silicon:
    """Silicon of a CCD.

    Parameters
    ----------
    thickness : float or Quantity
        Thickness [m], from the surface that light enters to the gates.
    temperature : float
        Temperature [K].
    """

    thickness: float = 100e-6
    temperature: float = 173.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "thickness", length(self.thickness, "thickness"))
        if not 1e-6 <= self.thickness <= 1e-3:
            raise DomainError(f"thickness = {self.thickness!r}: expected 1e-06 to 0.001 m of silicon")
        object.__setattr__(self, "temperature", one_number(self.temperature, "temperature"))
        check_temperature(self.temperature)

    def index(self, wavelength: ArrayLike) -> float:
        """Return the refractive index at a vacuum wavelength [m]."""
        return float(silicon_index(length(wavelength, "wavelength"), self.temperature))

    def absorption_length(self, wavelength: ArrayLike) -> float:
        """Return the absorption length at a vacuum wavelength [m]."""
        return float(absorption_length(length(wavelength, "wavelength"), self.temperature))

    def absorbed(self, wavelength: ArrayLike) -> float:
        """Return the part of the light that is absorbed before it reaches the gates."""
        return -math.expm1(-self.thickness / self.absorption_length(wavelength))

    def paths(self, wavelength: ArrayLike, count: int) -> ConversionPaths:
        """Return the Gauss rule of ``count`` points over the distribution of paths at a vacuum wavelength [m].

        It integrates polynomials of the path up to the order ``2 count - 1`` (Golub & Welsch 1969, Math. Comp. 23,
        221).
        """
        return _gauss_rule(self, length(wavelength, "wavelength"), count)

    def defocus(self, wavelength: ArrayLike) -> tuple[float, float]:
        """Return mean and rms about it of the equivalent defocus [m], behind the surface, at a vacuum wavelength [m].

        This is that of rays near the axis; moving the detector towards the light by the mean times the mean cosine of
        the cone, 0.94 at f/1.23, refocuses.
        """
        paths = self.paths(wavelength, 2)
        shift, weight = paths.length / self.index(wavelength), paths.weight / paths.weight.sum()
        mean = float(weight @ shift)
        return mean, math.sqrt(float(weight @ (shift - mean) ** 2))

    def diffusion(self, path: np.ndarray, from_surface: float) -> np.ndarray:
        """Return the rms spread of charge along each axis [m] after paths of light [m].

        ``from_surface`` [m] is that of charge which drifts through the whole thickness.
        """
        return from_surface * np.sqrt(np.clip(1.0 - path / self.thickness, 0.0, 1.0))


@functools.lru_cache(maxsize=256)
def _gauss_rule(silicon: Silicon, wavelength: float, count: int) -> ConversionPaths:
    """Return the rule of :meth:`Silicon.paths`; maps of many fields ask for the same one again and again."""
    length = silicon.absorption_length(wavelength)
    path = 0.5 * min(silicon.thickness / length, _ALL_ABSORBED) * (_NODE + 1.0)
    density = _WEIGHT * np.exp(-path)
    density /= density.sum()
    roots, parts = gauss_rule(path, density, count)
    rule = ConversionPaths(length * roots, silicon.absorbed(wavelength) * parts)
    # Shared by all callers.
    rule.length.flags.writeable = rule.weight.flags.writeable = False
    return rule
