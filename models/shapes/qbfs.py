"""Aspheres of Forbes's Qbfs terms: slope-orthogonal departures from a conic along its normal."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from .shape import (
    Conic,
    Pair,
    Plane,
    Rotational,
    Shape,
    Triple,
    check_coefficients,
    check_conic,
    check_radius,
    conic_derivative,
    root,
    with_coefficient,
)


@check_arguments
@dataclass(frozen=True)
class QbfsAsphere(Shape):
    """Conic plus Forbes's Qbfs terms (2007, Opt. Express 15, 5218; 2010, 18, 19700).

    With ``s = r^2``, ``v = s / norm_radius^2``, curvature c and conic constant k::

        z = conic + v (1 - v) sqrt((1 - k c^2 s) / (1 - (1 + k) c^2 s)) (a_0 Q_0(v) + a_1 Q_1(v) + ...)

    The root is one over the cosine of the conic's slope; for a sphere it is Forbes's own.

    Parameters
    ----------
    radius : float
        Radius of curvature at the vertex of the conic [m]; infinite for a plane.
    conic : float
        Conic constant.
    norm_radius : float
        Radius at which v is 1 [m].
    coefficients : tuple of float
        Coefficients a_0, a_1... [m].
    """

    radius: float
    conic: float
    norm_radius: float
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        check_radius(self.radius, flat=True)
        check_conic(self.conic)
        check_coefficients(self.coefficients)
        if not 0.0 < self.norm_radius < math.inf:
            raise PrescriptionError(f"norm_radius = {self.norm_radius!r}: expected a positive radius in m")

    @property
    def base(self) -> Rotational:
        """The conic without the terms; a plane where the radius is infinite."""
        return Conic(self.radius, self.conic) if np.isfinite(self.radius) else Plane()

    @property
    def curvature(self) -> float:  # noqa: D102
        return 1.0 / self.radius + 2.0 * float(self._departure(np.zeros(1))[1][0])

    @property
    def fourth_order(self) -> float:  # noqa: D102
        second = float(self._departure(np.zeros(1))[2][0])
        return (1 + self.conic) / self.radius**3 / 8 + 0.5 * second - self.curvature**3 / 8

    @property
    def series(self) -> tuple[float, ...]:
        """Coefficients [m] of the auxiliary polynomials P_m in place of the terms Q_m (Forbes 2010, eq. A.8-A.16).

        ``P_0 = 2, P_1 = 6 - 8 v, P_(m+1) = (2 - 4 v) P_m - P_(m-1)``.
        """
        f, g, h = _recurrence(len(self.coefficients))
        series = [0.0] * (len(self.coefficients) + 2)
        for m in range(len(self.coefficients) - 1, -1, -1):
            series[m] = (self.coefficients[m] - g[m] * series[m + 1] - h[m] * series[m + 2]) / f[m]
        return tuple(series[: len(self.coefficients)])

    def _terms(self, s: np.ndarray) -> Triple:
        """Return ``v (1 - v) sum a_m Q_m(v)`` [m] and its first two derivatives by s, by Clenshaw's recurrence."""
        scale = 1.0 / self.norm_radius**2
        v = scale * s
        first, after = ([np.zeros_like(s) for _ in range(3)] for _ in range(2))
        factor = 2.0 - 4.0 * v
        series = self.series
        for b in reversed(series):
            ahead = [
                b + factor * first[0] - after[0],
                factor * first[1] - 4.0 * first[0] - after[1],
                factor * first[2] - 8.0 * first[1] - after[2],
            ]
            first, after = ahead, first
        value, slope, second = (2.0 * (a + b) for a, b in zip(first, after, strict=True))
        bump, bump_v = v * (1.0 - v), 1.0 - 2.0 * v
        return (
            bump * value,
            scale * (bump * slope + bump_v * value),
            scale**2 * (bump * second + 2.0 * bump_v * slope - 2.0 * value),
        )

    def _secant(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return one over the cosine of the conic's slope, and two derivatives by s of its logarithm."""
        c, k = 1.0 / self.radius, self.conic
        top, bottom = 1.0 - k * c * c * s, 1.0 - (1.0 + k) * c * c * s
        along, beneath = -k * c * c / top, -(1.0 + k) * c * c / bottom
        return root(top / bottom), 0.5 * (along - beneath), 0.5 * (beneath**2 - along**2)

    def _departure(self, s: np.ndarray) -> Triple:
        """Return the sag of the terms [m] and its first two derivatives by s."""
        value, slope, second = self._terms(s)
        secant, log_slope, log_second = self._secant(s)
        return (
            secant * value,
            secant * (slope + value * log_slope),
            secant * (second + 2.0 * slope * log_slope + value * (log_slope**2 + log_second)),
        )

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.base.sag(x, y) + self._departure(x * x + y * y)[0]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        slope = 2.0 * self._departure(x * x + y * y)[1]
        sx, sy = self.base.gradient(x, y)
        return sx + slope * x, sy + slope * y

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        _, slope, second = self._departure(x * x + y * y)
        xx, xy, yy = self.base.hessian(x, y)
        return xx + 2 * slope + 4 * second * x * x, xy + 4 * second * x * y, yy + 2 * slope + 4 * second * y * y

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        conic_parameters = {"radius": self.radius, "curvature": 1.0 / self.radius, "conic": self.conic}
        return conic_parameters | {f"Q{m}": a for m, a in enumerate(self.coefficients)}

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        s = x * x + y * y
        if name.startswith("Q"):
            unit_coefficients = (0.0,) * int(name[1:]) + (1.0,)
            f, slope, _ = replace(self, coefficients=unit_coefficients)._departure(s)
            return f, 2 * x * slope, 2 * y * slope
        f, slope = conic_derivative(1.0 / self.radius, self.conic, name, s)
        c, k = 1.0 / self.radius, self.conic
        top, bottom = 1.0 - k * c * c * s, 1.0 - (1.0 + k) * c * c * s
        # Derivatives of top and bottom by the parameter over s, and by s alone.
        (top_p, bottom_p) = (-2.0 * k * c, -2.0 * (1.0 + k) * c) if name == "curvature" else (-c * c, -c * c)
        top_s, bottom_s = -k * c * c, -(1.0 + k) * c * c
        change = 0.5 * s * (top_p / top - bottom_p / bottom)
        change_s = 0.5 * (
            top_p / top - bottom_p / bottom - s * (top_p * top_s / top**2 - bottom_p * bottom_s / bottom**2)
        )
        value, value_s, _ = self._departure(s)
        f, slope = f + value * change, slope + value_s * change + value * change_s
        return f, 2 * x * slope, 2 * y * slope

    def _changed(self, name: str, value: float) -> Shape:
        if name.startswith("Q"):
            return replace(self, coefficients=with_coefficient(self.coefficients, int(name[1:]), value))
        if name == "curvature":
            return replace(self, radius=1.0 / value if value else math.inf)
        return replace(self, conic=value) if name == "conic" else replace(self, radius=value)


def _recurrence(count: int) -> tuple[list[float], list[float], list[float]]:
    """Return f, g and h of the first terms: ``Q_m = (P_m - g_(m-1) Q_(m-1) - h_(m-2) Q_(m-2)) / f_m``."""
    f, g, h = [2.0, 0.5 * math.sqrt(19.0)], [-0.5], []
    for m in range(2, count + 1):
        h.append(-m * (m - 1) / (2.0 * f[m - 2]))
        g.append(-(1.0 + g[m - 2] * h[m - 2]) / f[m - 1])
        f.append(math.sqrt(m * (m + 1) + 3.0 - g[m - 1] ** 2 - h[m - 2] ** 2))
    return f, [*g, 0.0, 0.0], [*h, 0.0, 0.0]
