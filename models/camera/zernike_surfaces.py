r"""Heights of sensors given by circular Zernike polynomials, as metrology of cameras publishes them.

About its origin a sensor has the height :math:`\sum_j a_j Z_j(x / R, y / R)`, with Noll's (1976, J. Opt. Soc. Am. 66,
207) polynomials of unit mean square over the circle of radius `R`. It is kept as a polynomial in `x` and `y`.
Outside the measured rectangle, where a polynomial of degree six soon runs away, each power of `x` and of `y` goes on
along its tangent at the rim: height and slope are continuous, and a plane stays a plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..zernike_polynomials import zernike_monomials


@dataclass(frozen=True, eq=False)
class ZernikeSurfaces:
    """Height functions of `n` sensors."""

    radius: np.ndarray  #: radius of the Zernike circle [m], [n]
    origin: np.ndarray  #: centre of the circle (x, y) from the centre of the sensor [m], [n, 2]
    coefficients: np.ndarray  #: height [m] of (x / radius)^p (y / radius)^q about the origin, [n, d + 1, d + 1]
    limits: np.ndarray  #: measured range about the origin [m], index order sensor, axis, low and high, [n, 2, 2]

    def __post_init__(self) -> None:
        for array in (self.radius, self.origin, self.coefficients, self.limits):
            array.flags.writeable = False

    @classmethod
    def from_noll(
        cls, zernikes: np.ndarray, radius: np.ndarray, origin: np.ndarray, limits: np.ndarray
    ) -> ZernikeSurfaces:
        """Return the surfaces of Noll coefficients 1, 2, ... [m], shape [n, jmax]."""
        monomials = zernike_monomials(zernikes.shape[1])
        return cls(radius, origin, np.einsum("nj,jpq->npq", zernikes, monomials), limits)

    @cached_property
    def _terms(self) -> list[tuple[int, int, np.ndarray]]:
        """Powers of x and y, and the coefficient of each sensor; terms beyond the total degree are left out."""
        size = self.coefficients.shape[1]
        return [(p, t - p, self.coefficients[:, p, t - p].copy()) for t in range(size) for p in range(t, -1, -1)]

    def chosen(self, index: np.ndarray) -> ZernikeSurfaces:
        """Return the surfaces of some sensors."""
        return ZernikeSurfaces(self.radius[index], self.origin[index], self.coefficients[index], self.limits[index])

    def scaled(self, factor: float) -> ZernikeSurfaces:
        """Return the surfaces with all heights multiplied by a factor."""
        return ZernikeSurfaces(self.radius, self.origin, factor * self.coefficients, self.limits)

    def turned(self, quarters: np.ndarray) -> ZernikeSurfaces:
        """Return the surfaces in axes turned by quarters from +x towards +y, one number each sensor, shape [n]."""
        origin, coefficients, limits = self.origin.copy(), self.coefficients.copy(), self.limits.copy()
        odd = np.where(np.arange(coefficients.shape[1]) % 2, -1.0, 1.0)
        for i, quarter in enumerate(quarters % 4):
            for _ in range(quarter):
                # New coordinates are (y, -x): x is minus the new y, y the new x.
                x, y = origin[i].tolist()
                origin[i] = y, -x
                coefficients[i] = (coefficients[i] * odd[:, None]).T
                limits[i] = limits[i, 1].copy(), -limits[i, 0, ::-1]
        return ZernikeSurfaces(self.radius.copy(), origin, coefficients, limits)

    def height(self, sensor: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return heights [m] at positions about the centres [m] of sensors of given index, all of one shape (n,)."""
        x, y = self._powers(sensor, dx, 0)[0], self._powers(sensor, dy, 1)[0]
        return self._sum(sensor, x, y)

    def gradient(self, sensor: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return slopes dh/dx and dh/dy at positions about the centres [m] of sensors of given index."""
        (x, slope_x), (y, slope_y) = self._powers(sensor, dx, 0), self._powers(sensor, dy, 1)
        return self._sum(sensor, slope_x, y), self._sum(sensor, x, slope_y)

    def inside(self, sensor: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return whether positions about the centres [m] of sensors of given index lie within the limits."""
        position = np.stack([dx, dy], axis=-1) - self.origin[sensor]
        low, high = np.moveaxis(self.limits[sensor], -1, 0)
        return np.all((position >= low) & (position <= high), axis=-1)

    def curvature_bound(self, half_size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return upper bounds of |d2h/dx2|, |d2h/dy2|, |d2h/dxdy| [1/m] on squares of half sizes [m], each [n]."""
        # The tangent of a power at the rim nowhere exceeds the power itself, so the bound holds outside the limits too.
        reach = (half_size + np.abs(self.origin).max(axis=1, initial=0.0)) / self.radius
        bounds = np.zeros((3, len(self.radius)))
        for p, q, coefficient in self._terms:
            for bound, factor in zip(bounds, (p * (p - 1), q * (q - 1), p * q), strict=True):
                if factor:
                    bound += factor * np.abs(coefficient) * reach ** (p + q - 2) / self.radius**2
        return bounds[0], bounds[1], bounds[2]

    def _powers(self, sensor: np.ndarray, position: np.ndarray, axis: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the powers 0, 1, ... along an axis, and their derivatives [1/m], both continued beyond the limits."""
        radius = self.radius[sensor]
        low, high = self.limits[sensor, axis].T
        position = position - self.origin[sensor, axis]
        inside = np.clip(position, low, high)
        t, beyond = inside / radius, position - inside
        plain = [np.ones_like(t)]
        for _ in range(self.coefficients.shape[1] - 1):
            plain.append(plain[-1] * t)
        slopes = [np.zeros_like(t), *(k * power / radius for k, power in enumerate(plain[:-1], start=1))]
        return [power + slope * beyond for power, slope in zip(plain, slopes, strict=True)], slopes

    def _sum(self, sensor: np.ndarray, x: list[np.ndarray], y: list[np.ndarray]) -> np.ndarray:
        total = np.zeros_like(x[0])
        for p, q, coefficient in self._terms:
            total = total + coefficient[sensor] * x[p] * y[q]
        return total
