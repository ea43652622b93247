"""Charge collected by pixels whose boundaries are displaced."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import spline_filter1d

#: Pixels by which stamps are continued with the values at their rim, for light that crosses it.
RIM = 8
# Pixels by which rows are continued for the spline.
_BEYOND = 12


def with_rim(images: np.ndarray) -> np.ndarray:
    """Return stamps [n, ny, nx] continued on all sides by :data:`RIM` pixels."""
    return np.pad(images, ((0, 0), (RIM, RIM), (RIM, RIM)), mode="edge")


def without_rim(images: np.ndarray) -> np.ndarray:
    """Return stamps [n, ny, nx] without the pixels that :func:`with_rim` adds."""
    return images[:, RIM:-RIM, RIM:-RIM]


def collect(images: np.ndarray, shift_x: np.ndarray, shift_y: np.ndarray) -> np.ndarray:
    """Return the charge within displaced pixel boundaries.

    The sum of the charge along a row is interpolated by a spline of degree 5 and read off at the boundaries; then along
    columns. So all charge stays in some pixel, unless the outermost boundaries move.

    Parameters
    ----------
    images : ndarray, shape [n, ny, nx]
        Charge in pixels without displacements.
    shift_x : ndarray, shape [n, ny, nx + 1]
        Displacement along x of the boundaries left and right of each pixel [pixel].
    shift_y : ndarray, shape [n, ny + 1, nx]
        Displacement along y of the boundaries below and above each pixel [pixel].
    """
    rows = _collect_along_rows(images, shift_x)
    return _collect_along_rows(rows.swapaxes(1, 2), shift_y.swapaxes(1, 2)).swapaxes(1, 2)


def _collect_along_rows(images: np.ndarray, shift: np.ndarray) -> np.ndarray:
    n = images.shape[2]
    boundary = np.arange(n + 1)
    # The spline has a kink at its own ends, which must lie far off: it falls by 0.43 a pixel.
    wide = np.pad(images, ((0, 0), (0, 0), (_BEYOND, _BEYOND)), mode="symmetric")
    charge = np.concatenate([np.zeros_like(wide[:, :, :1]), np.cumsum(wide, axis=2)], axis=2)
    # Without its mean slope, so that even illumination is exact.
    slope = charge[:, :, -1:] / wide.shape[2]
    coefficients = spline_filter1d(charge - slope * np.arange(wide.shape[2] + 1), order=5, axis=2, mode="mirror")
    place = _BEYOND + np.clip(boundary + shift, 0.0, n)
    first = np.floor(place).astype(np.int64)
    fraction = place - first
    total, pieces = slope * place, _basis_spline()
    for step in range(-2, 4):
        total += np.polyval(pieces[:, 3 - step], fraction) * np.take_along_axis(coefficients, first + step, axis=2)
    return np.diff(total, axis=2)


@cache
def _basis_spline() -> np.ndarray:
    """Return the polynomial, highest power first, of the basis spline on each of the six intervals of its support."""
    from scipy.interpolate import BSpline, PPoly  # a fifth of a second

    spline = PPoly.from_spline(BSpline.basis_element(np.arange(-3.0, 4.0)))
    pieces: np.ndarray = spline.c[:, np.isin(spline.x[:-1], range(-3, 3))]
    return pieces
