"""A brute-force ray trace of coaxial conics in NumPy, restated here so that tests do not lean on the product."""

from __future__ import annotations

import numpy as np


def trace(surfaces, position, direction, n=1.0):
    """Trace rays through coaxial conics.

    `surfaces` are (vertex z, radius or inf, conic, index after or None for a mirror); `position` and `direction` have
    shape (n, 3). Returns positions on every surface and the last directions.
    """
    points = []
    for z, radius, conic, after in surfaces:
        c = 0.0 if np.isinf(radius) else 1 / radius
        p = position - [0, 0, z]
        k = np.array([1.0, 1.0, 1 + conic])
        # c (x^2 + y^2 + (1 + k) z^2) - 2 z = 0 along p + t v: a t^2 + 2 b t + e = 0.
        a = c * np.sum(k * direction**2, axis=1)
        b = c * np.sum(k * p * direction, axis=1) - direction[:, 2]
        e = c * np.sum(k * p**2, axis=1) - 2 * p[:, 2]
        # The root that tends to the plane's as c goes to 0 is the one near the vertex.
        t = -e / (b - np.sign(direction[:, 2]) * np.sqrt(b**2 - a * e))
        position = position + t[:, None] * direction
        p = position - [0, 0, z]
        normal = c * k * p - [0, 0, 1]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        cosine = np.sum(direction * normal, axis=1)[:, None]
        if after is None:
            direction = direction - 2 * cosine * normal
        else:
            ratio = n / after
            root = np.sign(cosine) * np.sqrt(1 - ratio**2 * (1 - cosine**2))
            direction = ratio * direction + (root - ratio * cosine) * normal
            n = after
        points.append(position)
    return points, direction


def land(surfaces, focus_z, stop_z, x, y, tangent):
    """Return where rays through the stop at (x, y), of field (0, atan(tangent)), meet the plane at `focus_z`."""
    x, y = np.broadcast_arrays(np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float))
    position = np.stack([x, y, np.full(x.shape, stop_z)], axis=-1)
    direction = np.tile(np.array([0.0, tangent, -1.0]) / np.hypot(1, tangent), (x.size, 1))
    points, direction = trace(surfaces, position, direction)
    step = (focus_z - points[-1][:, 2]) / direction[:, 2]
    return points[-1] + step[:, None] * direction, points


def fan_coefficients(surfaces, focus_z, stop_z, radius, tangent, degree=9):
    """Return Taylor coefficients of the landing points along both fans of the pupil, in units of its radius.

    The meridional fan gives y against pupil y, the sagittal fan x against pupil x; powers rise from 0.
    """
    rho = np.cos(np.pi * (np.arange(40) + 0.5) / 40)
    meridional, _ = land(surfaces, focus_z, stop_z, 0 * rho, radius * rho, tangent)
    sagittal, _ = land(surfaces, focus_z, stop_z, radius * rho, 0 * rho, tangent)
    series = np.polynomial.Chebyshev.fit
    kind = np.polynomial.Polynomial
    along_y = series(rho, meridional[:, 1], degree, domain=[-1, 1]).convert(kind=kind).coef
    along_x = series(rho, sagittal[:, 0], degree, domain=[-1, 1]).convert(kind=kind).coef
    return along_y, along_x
