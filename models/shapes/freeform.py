"""Shapes in closed form: odd powers of the radius, biconics, toroids, polynomials, Zernike polynomials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
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
class OddAsphere(Shape):
    """Conic plus all powers of the distance from the axis.

    A term in r^1 makes a cone; the slope at its tip is taken as zero.

    Parameters
    ----------
    radius : float
        Radius of curvature at the vertex [m]; infinite for the powers alone.
    conic : float
        Conic constant.
    coefficients : tuple of float
        Coefficients of r^1, r^2, r^3... [1, m^-1, m^-2, ...].
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        check_radius(self.radius, flat=True)
        check_conic(self.conic)
        check_coefficients(self.coefficients)

    @property
    def base(self) -> Rotational:
        """The conic without the powers; a plane where the radius is infinite."""
        return Conic(self.radius, self.conic) if np.isfinite(self.radius) else Plane()

    @property
    def curvature(self) -> float:  # noqa: D102
        return 1.0 / self.radius + 2 * (*self.coefficients, 0.0, 0.0)[1]

    @property
    def fourth_order(self) -> float:  # noqa: D102
        a4 = (*self.coefficients, 0.0, 0.0, 0.0, 0.0)[3]
        return (1 + self.conic) / self.radius**3 / 8 + a4 - self.curvature**3 / 8

    def _powers(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return r and the powers' sum, its derivative by r over r, and its second derivative by r."""
        r = np.hypot(x, y)
        value, slope, second = (np.zeros_like(r) for _ in range(3))
        for a in (*reversed(self.coefficients), 0.0):
            second = second * r + 2 * slope
            slope = slope * r + value
            value = value * r + a
        return r, value, np.divide(slope, r, out=np.where(r == 0, second, 0.0), where=r > 0), second

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.base.sag(x, y) + self._powers(x, y)[1]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        slope = self._powers(x, y)[2]
        sx, sy = self.base.gradient(x, y)
        return sx + slope * x, sy + slope * y

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        r, _, over, second = self._powers(x, y)
        xx, xy, yy = self.base.hessian(x, y)
        twist = np.divide(second - over, r * r, out=np.zeros_like(r), where=r > 0)
        return xx + over + twist * x * x, xy + twist * x * y, yy + over + twist * y * y

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        conic_parameters = {"radius": self.radius, "curvature": 1.0 / self.radius, "conic": self.conic}
        return conic_parameters | {f"a{power}": a for power, a in enumerate(self.coefficients, start=1)}

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        if name.startswith("a"):
            unit_coefficients = (0.0,) * (int(name[1:]) - 1) + (1.0,)
            _, value, slope, _ = replace(self, coefficients=unit_coefficients)._powers(x, y)
            return value, slope * x, slope * y
        f, slope = conic_derivative(1.0 / self.radius, self.conic, name, x * x + y * y)
        return f, 2 * x * slope, 2 * y * slope

    def _changed(self, name: str, value: float) -> Shape:
        if name.startswith("a"):
            return replace(self, coefficients=with_coefficient(self.coefficients, int(name[1:]) - 1, value))
        return replace(self, **_conic_change(name, value))


def _conic_change(name: str, value: float) -> dict[str, Any]:
    """Return the field and the value for a parameter: a curvature is stored as a radius."""
    if name.startswith("curvature"):
        return {name.replace("curvature", "radius"): 1.0 / value if value else np.inf}
    return {name: value}


@dataclass(frozen=True)
class _TwoRadii(Shape):
    """Base of shapes with different radii along x and y.

    Parameters
    ----------
    radius_x, radius_y : float
        Radii of curvature [m].
    """

    radius_x: float
    radius_y: float

    def __post_init__(self) -> None:
        for axis in "xy":
            check_radius(getattr(self, f"radius_{axis}"), f"radius_{axis}", flat=True)
            check_conic(getattr(self, f"conic_{axis}", 0.0), f"conic_{axis}")

    @property
    def curvature(self) -> float:
        return sum(self.curvatures) / 2

    @property
    def curvatures(self) -> tuple[float, float]:
        return 1.0 / self.radius_x, 1.0 / self.radius_y

    @property
    def parameters(self) -> dict[str, float]:
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "coefficients"}
        return fields | {"curvature_x": 1.0 / self.radius_x, "curvature_y": 1.0 / self.radius_y}

    def _changed(self, name: str, value: float) -> Shape:
        return replace(self, **_conic_change(name, value))


@check_arguments
@dataclass(frozen=True)
class Biconic(_TwoRadii):
    """Conics of different radii `radius_x`, `radius_y` [m] along x and y; an infinite radius is flat.

    With cx, cy the curvatures and kx, ky the conic constants `conic_x`, `conic_y`::

        z = (cx x^2 + cy y^2) / (1 + sqrt(1 - (1 + kx) cx^2 x^2 - (1 + ky) cy^2 y^2))
    """

    conic_x: float = 0.0
    conic_y: float = 0.0

    @property
    def fourth_order(self) -> float:  # noqa: D102
        # z = u/2 + u v/8 + ..., u = cx x^2 + cy y^2, v = (1 + kx) cx^2 x^2 + (1 + ky) cy^2 y^2; means of x^4 and y^4
        # over azimuth are 3/8 r^4, of x^2 y^2 1/8 r^4.
        cx, cy = 1.0 / self.radius_x, 1.0 / self.radius_y
        px, py = (1 + self.conic_x) * cx**2, (1 + self.conic_y) * cy**2
        return (3 * cx * px + 3 * cy * py + cx * py + cy * px) / 64 - self.curvature**3 / 8

    def _pieces(self, x: np.ndarray, y: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return u and v of the formula and their derivatives by x, y and the parameters, named by letters."""
        cx, cy = 1.0 / self.radius_x, 1.0 / self.radius_y
        kx, ky = 1 + self.conic_x, 1 + self.conic_y
        unit = np.ones_like(x)
        u = {"": cx * x * x + cy * y * y, "x": 2 * cx * x, "y": 2 * cy * y, "xx": 2 * cx * unit, "yy": 2 * cy * unit}
        v = {
            "": kx * cx**2 * x * x + ky * cy**2 * y * y,
            "x": 2 * kx * cx**2 * x,
            "y": 2 * ky * cy**2 * y,
            "xx": 2 * kx * cx**2 * unit,
            "yy": 2 * ky * cy**2 * unit,
        }
        # a, b: the curvatures; k, l: the conic constants.
        u |= {"a": x * x, "ax": 2 * x, "b": y * y, "by": 2 * y}
        v |= {"a": 2 * kx * cx * x * x, "ax": 4 * kx * cx * x, "b": 2 * ky * cy * y * y, "by": 4 * ky * cy * y}
        v |= {"k": cx**2 * x * x, "kx": 2 * cx**2 * x, "l": cy**2 * y * y, "ly": 2 * cy**2 * y}
        return u, v

    def _derivatives(self, x: np.ndarray, y: np.ndarray, *names: str) -> list[np.ndarray]:
        """Return first (one letter) and second derivatives (two) of the sag ``u / (1 + w)``, ``w = sqrt(1 - v)``."""
        u, v = self._pieces(x, y)
        w = root(1.0 - v[""])
        zero = np.zeros_like(x)

        def slope(of: str) -> np.ndarray:
            return -0.5 * v.get(of, zero) / w

        derivatives = []
        for name in names:
            if not name:
                derivatives.append(u[""] / (1 + w))
            elif len(name) == 1:
                derivatives.append(u.get(name, zero) / (1 + w) - u[""] * slope(name) / (1 + w) ** 2)
            else:
                p, q = name[0], name[1]
                w_p, w_q = slope(p), slope(q)
                w_pq = -0.5 * v.get(name, zero) / w - w_p * w_q / w
                derivatives.append(
                    u.get(name, zero) / (1 + w)
                    - (u.get(p, zero) * w_q + u.get(q, zero) * w_p + u[""] * w_pq) / (1 + w) ** 2
                    + 2 * u[""] * w_p * w_q / (1 + w) ** 3
                )
        return derivatives

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._derivatives(x, y, "")[0]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        sx, sy = self._derivatives(x, y, "x", "y")
        return sx, sy

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        xx, xy, yy = self._derivatives(x, y, "xx", "xy", "yy")
        return xx, xy, yy

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        letter = {"curvature_x": "a", "curvature_y": "b", "conic_x": "k", "conic_y": "l"}[name]
        f, fx, fy = self._derivatives(x, y, letter, letter + "x", letter + "y")
        return f, fx, fy


@check_arguments
@dataclass(frozen=True)
class Toroid(_TwoRadii):
    """A curve of the y, z plane rotated about an axis parallel to y, `radius_x` [m] from the vertex.

    With g(y) the conic of radius `radius_y` [m] and constant `conic_y`, plus `coefficients` of y^2, y^4, y^6... [m^-1,
    m^-3...], and ``cx = 1 / radius_x`` (0, of an infinite radius: a cylinder)::

        z = g + q x^2 / (1 + sqrt(1 - q^2 x^2)),    q = cx / (1 - cx g)
    """

    conic_y: float = 0.0
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_coefficients(self.coefficients)

    @property
    def curvatures(self) -> tuple[float, float]:  # noqa: D102
        return 1.0 / self.radius_x, 1.0 / self.radius_y + 2 * (*self.coefficients, 0.0)[0]

    @property
    def fourth_order(self) -> float:  # noqa: D102
        # z = cx x^2/2 + g(y) + cx^3 x^4/8 + cx^2 g''(0) x^2 y^2/4 + ...; means as for a biconic.
        cx, cy = self.curvatures
        y4 = (1 + self.conic_y) / self.radius_y**3 + 8 * (*self.coefficients, 0.0, 0.0)[1]
        return (3 * cx**3 + 3 * y4 + 2 * cx**2 * cy) / 64 - self.curvature**3 / 8

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        return super().parameters | {f"y{2 * i}": a for i, a in enumerate(self.coefficients, start=1)}

    def _changed(self, name: str, value: float) -> Shape:
        if name.startswith("y"):
            return replace(self, coefficients=with_coefficient(self.coefficients, int(name[1:]) // 2 - 1, value))
        return super()._changed(name, value)

    def _pieces(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the sag and the pieces of its derivatives: q, w, g', g'', h_q and h_qq, with h the sag less g."""
        cx, cy = 1.0 / self.radius_x, 1.0 / self.radius_y
        b = root(1.0 - (1.0 + self.conic_y) * cy**2 * y * y)
        g, g1, g2 = cy * y * y / (1 + b), cy * y / b, cy / b**3
        for power, a in zip(range(2, 1000, 2), self.coefficients, strict=False):
            g, g1 = g + a * y**power, g1 + power * a * y ** (power - 1)
            g2 = g2 + power * (power - 1) * a * y ** (power - 2)
        q = cx / (1.0 - cx * g)
        w = root(1.0 - q * q * x * x)
        h = q * x * x / (1 + w)
        h_q = 0.5 * (x * x + h * h) / w
        return g + h, q, w, g1, g2, h_q, h_q * q * x * x / w**2 + h * h_q / w

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._pieces(x, y)[0]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        _, q, w, g1, _, h_q, _ = self._pieces(x, y)
        # dq/dg = q^2: a change of g changes the sag by 1 + h_q q^2 times as much.
        return q * x / w, g1 * (1 + h_q * q**2)

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        _, q, w, g1, g2, h_q, h_qq = self._pieces(x, y)
        yy = g2 * (1 + h_q * q**2) + g1**2 * (h_qq * q**4 + 2 * h_q * q**3)
        return q / w**3, x / w**3 * q**2 * g1, yy

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        _, q, w, g1, _, h_q, h_qq = self._pieces(x, y)
        if name == "curvature_x":
            # dq/dcx = 1 / (1 - cx g)^2
            cx = 1.0 / self.radius_x
            g = replace(self, radius_x=np.inf).sag(x, y)
            q_c = 1.0 / (1.0 - cx * g) ** 2
            return h_q * q_c, x / w**3 * q_c, g1 * (h_qq * q**2 + 2 * h_q * q) * q_c
        if name.startswith("y"):
            power = int(name[1:])
            change, change_y = y**power, power * y ** (power - 1)
        else:
            change, slope = conic_derivative(1.0 / self.radius_y, self.conic_y, name.removesuffix("_y"), y * y)
            change_y = 2 * y * slope
        along_y = change_y * (1 + h_q * q**2) + change * g1 * (h_qq * q**4 + 2 * h_q * q**3)
        return change * (1 + h_q * q**2), x / w**3 * q**2 * change, along_y
