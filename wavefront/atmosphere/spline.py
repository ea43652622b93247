"""Uniform cubic B-splines on periodic screens: gain of the modes, weights of the samples, values between them."""

from __future__ import annotations

import numpy as np

from ...core.errors import unknown_name

#: Ways of reading a screen, which decide the gain of its modes:
#:
#: - ``samples``: at the samples only; the values are the path there.
#: - ``spline``: as coefficients of a uniform cubic B-spline that passes through the samples.
STENCILS = ("samples", "spline")


def stencil_gain(kx: np.ndarray, ky: np.ndarray, stencil: str) -> np.ndarray:
    """Return the factor of each mode's amplitude that offsets the smoothing by one of :data:`STENCILS`.

    Wavenumbers ``kx`` and ``ky`` [rad per pixel] are broadcast against each other.
    """
    if stencil not in STENCILS:
        raise unknown_name("stencil", stencil, STENCILS)
    if stencil == "spline":
        # A B-spline of samples scales the amplitude of a mode by (2 + cos k)/3 along each axis.
        return 9.0 / ((2.0 + np.cos(kx)) * (2.0 + np.cos(ky)))
    return np.ones(np.broadcast_shapes(kx.shape, ky.shape))


def spline_weights(fraction: np.ndarray) -> np.ndarray:
    """Return the weights of the four samples around a point, shape [..., 4], in the precision of ``fraction``.

    ``fraction`` is the distance of the point from the second of the four samples [pixels], 0 to 1.
    """
    u, v = fraction, 1.0 - fraction
    weights = np.stack([v**3, 4.0 + u * u * (3.0 * u - 6.0), 4.0 + v * v * (3.0 * v - 6.0), u**3], axis=-1)
    return weights * weights.dtype.type(1.0 / 6.0)


def evaluate(spline: np.ndarray, pixel: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the path [m], float64, at places x, y [m] of a periodic screen of spline coefficients [size, size]."""
    place = np.stack([np.asarray(x), np.asarray(y)]) / pixel
    first = np.floor(place).astype(np.int64)
    weight_x, weight_y = spline_weights(place - first)
    result = np.zeros(np.shape(x))
    for j in range(4):
        for i in range(4):
            row, column = (first[1] + j - 1) % spline.shape[0], (first[0] + i - 1) % spline.shape[1]
            result += weight_y[..., j] * weight_x[..., i] * spline[row, column]
    return result
