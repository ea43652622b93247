"""Heights of CCD surfaces: a cubic polynomial, two cosine waves and, where measured, a B-spline or Zernikes.

On CCD ``i``, with ``dx, dy`` the distance from its centre along its own axes [m] and ``u, v = dx / a, dy / b`` (``a``
and ``b`` halves of its sides)::

    h = sum_k polynomial[i, k] * (1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3)[k]
      + sum_w amplitude_w cos(kx_w dx + ky_w dy + phase_w)
      + sum_jk grid[i, j, k] B_j(v) B_k(u)
      + zernikes of the CCD (:mod:`~.zernike_surfaces`)

`B` are the uniform cubic B-splines whose ``m - 3`` cells cover the CCD evenly. Positive heights are displaced along +z
of the telescope frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .zernike_surfaces import ZernikeSurfaces

# Powers (of u, of v) of the ten terms.
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


@dataclass(frozen=True, eq=False)
class CcdSurfaces:
    """Height functions of `n` CCDs."""

    half_sizes: np.ndarray  #: halves of the sides of each CCD [m], [n, 2]
    polynomial: np.ndarray  #: coefficients [m] of 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3, [n, 10]
    waves: np.ndarray  #: amplitude [m], kx [rad/m], ky [rad/m], phase [rad] of two waves, [n, 2, 4]
    grid: np.ndarray | None = None  #: B-spline coefficients [m], index order CCD, y, x, [n, m, m]
    zernikes: ZernikeSurfaces | None = None  #: published Zernike coefficients, [n]

    def __post_init__(self) -> None:
        for array in (self.half_sizes, self.polynomial, self.waves, self.grid):
            if array is not None:
                array.flags.writeable = False

    @classmethod
    def level(cls, half_sizes: np.ndarray, heights: ArrayLike = 0.0) -> CcdSurfaces:
        """Return planes at given heights [m], one of each CCD or one of all."""
        polynomial = np.zeros((len(half_sizes), 10))
        polynomial[:, 0] = heights
        return cls(half_sizes, polynomial, np.zeros((len(half_sizes), 2, 4)))

    def scaled(self, factor: float) -> CcdSurfaces:
        """Return the surfaces with all heights multiplied by a factor."""
        grid = None if self.grid is None else factor * self.grid
        zernikes = None if self.zernikes is None else self.zernikes.scaled(factor)
        return CcdSurfaces(self.half_sizes, factor * self.polynomial, self.waves * [factor, 1, 1, 1], grid, zernikes)

    def height(self, ccd: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return heights [m] at local positions [m] on CCDs of given index, all of one shape (n,)."""
        c = self.polynomial[ccd]
        a, b = self._halves(ccd)
        u, v = dx / a, dy / b
        h = c[:, 0] + u * (c[:, 1] + u * (c[:, 3] + u * c[:, 6])) + v * (c[:, 2] + v * (c[:, 5] + v * c[:, 9]))
        h = h + u * v * (c[:, 4] + u * c[:, 7] + v * c[:, 8])
        for w in (0, 1):
            amplitude, kx, ky, phase = self.waves[ccd, w].T
            h = h + amplitude * np.cos(kx * dx + ky * dy + phase)
        if self.grid is not None:
            h = h + self._spline(ccd, u, v, 0, 0)
        if self.zernikes is not None:
            h = h + self.zernikes.height(ccd, dx, dy)
        return h

    def gradient(self, ccd: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return slopes along the axes of the CCDs, shape (n, 2), at local positions [m] on CCDs of given index."""
        c = self.polynomial[ccd]
        a, b = self._halves(ccd)
        u, v = dx / a, dy / b
        gx = c[:, 1] + 2 * u * c[:, 3] + v * c[:, 4] + 3 * u**2 * c[:, 6] + 2 * u * v * c[:, 7] + v**2 * c[:, 8]
        gy = c[:, 2] + u * c[:, 4] + 2 * v * c[:, 5] + u**2 * c[:, 7] + 2 * u * v * c[:, 8] + 3 * v**2 * c[:, 9]
        if self.grid is not None:
            gx = gx + self._spline(ccd, u, v, 1, 0)
            gy = gy + self._spline(ccd, u, v, 0, 1)
        gx, gy = gx / a, gy / b
        for w in (0, 1):
            amplitude, kx, ky, phase = self.waves[ccd, w].T
            fall = -amplitude * np.sin(kx * dx + ky * dy + phase)
            gx, gy = gx + kx * fall, gy + ky * fall
        if self.zernikes is not None:
            along_x, along_y = self.zernikes.gradient(ccd, dx, dy)
            gx, gy = gx + along_x, gy + along_y
        return np.stack([gx, gy], axis=-1)

    def measured_at(self, ccd: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return whether local positions [m] lie within the measured rectangle; all do where there are no Zernikes."""
        return np.ones(dx.shape, dtype=bool) if self.zernikes is None else self.zernikes.inside(ccd, dx, dy)

    def curvature_bound(self) -> np.ndarray:
        """Return an upper bound on the largest second derivative in any direction [1/m], shape (n,)."""
        c = self.polynomial
        # Second derivatives of a cubic are linear, so largest at a corner of the tile.
        uu = 2 * np.abs(c[:, 3]) + 6 * np.abs(c[:, 6]) + 2 * np.abs(c[:, 7])
        vv = 2 * np.abs(c[:, 5]) + 6 * np.abs(c[:, 9]) + 2 * np.abs(c[:, 8])
        uv = np.abs(c[:, 4]) + 2 * np.abs(c[:, 7]) + 2 * np.abs(c[:, 8])
        if self.grid is not None:
            # A derivative of a B-spline lies within the hull of the differences of its coefficients.
            cell = 2.0 / (self.grid.shape[1] - 3)
            uu = uu + np.abs(np.diff(self.grid, 2, axis=2)).max(axis=(1, 2)) / cell**2
            vv = vv + np.abs(np.diff(self.grid, 2, axis=1)).max(axis=(1, 2)) / cell**2
            uv = uv + np.abs(np.diff(np.diff(self.grid, axis=1), axis=2)).max(axis=(1, 2)) / cell**2
        a, b = self.half_sizes.T
        uu, vv, uv = uu / a**2, vv / b**2, uv / (a * b)
        if self.zernikes is not None:
            along_x, along_y, across = self.zernikes.curvature_bound(self.half_sizes.max(axis=1))
            uu, vv, uv = uu + along_x, vv + along_y, uv + across
        # Spectral norm of a symmetric matrix: at most its larger diagonal element plus the off-diagonal one.
        bound = np.maximum(uu, vv) + uv
        amplitude, kx, ky = self.waves[:, :, 0], self.waves[:, :, 1], self.waves[:, :, 2]
        return bound + np.sum(np.abs(amplitude) * (kx**2 + ky**2), axis=1)

    @cached_property
    def _common(self) -> tuple[float, float] | None:
        """Halves of the sides of all CCDs [m]; None where they are not alike."""
        a, b = self.half_sizes[0].tolist()
        return (a, b) if (self.half_sizes == (a, b)).all() else None

    def _halves(self, ccd: np.ndarray) -> tuple[Any, Any]:
        """Return the halves of the sides of CCDs of given index [m]."""
        if self._common is not None:
            return self._common
        a, b = self.half_sizes[ccd].T
        return a, b

    def _spline(self, ccd: np.ndarray, u: np.ndarray, v: np.ndarray, order_u: int, order_v: int) -> np.ndarray:
        assert self.grid is not None
        m = self.grid.shape[1]
        i, wu = spline_weights(u, m, order_u)
        j, wv = spline_weights(v, m, order_v)
        total = np.zeros_like(u)
        for b in range(4):
            for a in range(4):
                total = total + wv[b] * wu[a] * self.grid[ccd, j + b, i + a]
        return total


def spline_weights(u: np.ndarray, m: int, order: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the index [n] of the first of the four B-splines that are not zero at `u`, and their values [4, n].

    `u` [n] is the position on the tile, -1 to 1, whose side has ``m`` coefficients, ``m - 3`` cells. With ``order`` 1
    first derivatives with respect to `u` replace the values.
    """
    t = (u + 1.0) * (0.5 * (m - 3))
    # Of rays that do not arrive the place is NaN, and stays so.
    first = np.clip(np.nan_to_num(np.floor(t)), 0, m - 4).astype(np.int64)
    f = t - first
    if order == 0:
        weights = ((1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3)
        return first, np.stack(weights) / 6.0
    weights = (-((1 - f) ** 2), 3 * f**2 - 4 * f, -3 * f**2 + 2 * f + 1, f**2)
    return first, np.stack(weights) * (0.25 * (m - 3))
