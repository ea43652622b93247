"""Shapes of surfaces: sag, slopes, curvatures, and derivatives of the sag by the parameters of a shape.

The sag z(x, y) [m] is the height over the vertex plane in the frame of the surface. Most shapes are a conic of
revolution and something added; with ``s = x^2 + y^2``, curvature ``c = 1/R`` and conic constant ``k``::

    z = c s / (1 + sqrt(1 - (1 + k) c^2 s)) + a_4 s^2 + a_6 s^3 + ...

A positive radius has its centre of curvature on the +z side of the vertex. Beyond the rim of a shape its sag is NaN.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, unknown_name
from ...core.units import plane_points

Pair = tuple[np.ndarray, np.ndarray]
Triple = tuple[np.ndarray, np.ndarray, np.ndarray]


def check_radius(radius: float, name: str = "radius", *, flat: bool = False) -> None:
    """Raise PrescriptionError for a radius [m] of zero or, unless `flat` is set, of infinity."""
    if np.isnan(radius) or radius == 0 or (np.isinf(radius) and not flat):
        raise PrescriptionError(f"{name} = {radius!r}: expected a finite radius of curvature in m, not zero")


def check_conic(conic: float, name: str = "conic") -> None:
    """Raise PrescriptionError for a conic constant that is not finite."""
    if not np.isfinite(conic):
        raise PrescriptionError(f"{name} = {conic!r}: expected a finite conic constant")


def check_coefficients(coefficients: tuple[float, ...]) -> None:
    """Raise PrescriptionError for coefficients that are not finite."""
    if not np.all(np.isfinite(coefficients)):
        raise PrescriptionError(f"coefficients = {coefficients!r}: expected finite numbers")


def with_coefficient(coefficients: tuple[float, ...], place: int, value: float) -> tuple[float, ...]:
    """Return coefficients with another value at one place."""
    return (*coefficients[:place], value, *coefficients[place + 1 :])


def coordinates(x: ArrayLike, y: ArrayLike) -> Pair:
    """Return x and y [m] as float64 arrays of one shape."""
    x, y = plane_points(x, y)
    return x, y


def root(inside: np.ndarray) -> np.ndarray:
    """Return the square root, NaN without a warning where the argument is negative."""
    return np.sqrt(np.where(inside >= 0, inside, np.nan))


@check_arguments
class Shape(ABC):
    """Shape of a surface: immutable and hashable.

    Positions x, y [m] are in the surface's own frame, scalars or arrays; results have their common shape.
    """

    def sag(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the height over the vertex plane [m]; NaN beyond the rim of the shape."""
        return self._sag(*coordinates(x, y))

    def gradient(self, x: ArrayLike, y: ArrayLike) -> Pair:
        """Return the slopes dz/dx and dz/dy; NaN beyond the rim of the shape."""
        return self._gradient(*coordinates(x, y))

    def normal(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the unit normals on the +z side, shape [..., 3]; NaN beyond the rim of the shape."""
        along_x, along_y = self.gradient(x, y)
        normal = np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def hessian(self, x: ArrayLike, y: ArrayLike) -> Triple:
        """Return the second derivatives of the sag along xx, xy and yy [1/m]."""
        return self._hessian(*coordinates(x, y))

    @abstractmethod
    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair: ...

    @abstractmethod
    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple: ...

    @property
    @abstractmethod
    def curvature(self) -> float:
        """Paraxial curvature at the vertex [1/m], the mean over azimuth."""

    @property
    def curvatures(self) -> tuple[float, float]:
        """Paraxial curvatures along x and y [1/m]; of shapes other than cylinders and toroids both are the mean."""
        return self.curvature, self.curvature

    @property
    @abstractmethod
    def fourth_order(self) -> float:
        """Coefficient of r^4 of the sag less that of the sphere of the same curvature [m^-3], mean over azimuth.

        For a conic ``k c^3 / 8``, for an even asphere a_4 more.
        """

    @property
    @abstractmethod
    def parameters(self) -> dict[str, float]:
        """Parameters by name, in SI; radius and curvature are two names of one."""

    def with_parameter(self, name: str, value: float) -> Shape:
        """Return the shape with another value of a parameter.

        Raises
        ------
        UnknownNameError
            If the shape has no such parameter.
        """
        self._check_parameter(name)
        return self._changed(name, float(value))

    def with_parameters(self, values: Mapping[str, float]) -> Shape:
        """Return the shape with other values of several parameters; errors are those of :meth:`with_parameter`."""
        shape = self
        for name, value in values.items():
            shape = shape.with_parameter(name, value)
        return shape

    def sag_derivative(self, name: str, x: ArrayLike, y: ArrayLike) -> Triple:
        """Return the derivative of the sag by a parameter.

        Parameters
        ----------
        name : str
            Name of the parameter, one of `parameters`.
        x, y : float or array
            Position in the surface's own frame [m].

        Returns
        -------
        f, fx, fy : ndarray
            Derivative of the sag with respect to the parameter, and the slopes of that derivative along x and y.

        Raises
        ------
        UnknownNameError
            If the shape has no such parameter.
        """
        self._check_parameter(name)
        x, y = coordinates(x, y)
        if name.startswith("radius"):
            # By curvature c = 1/R: d/dR = -c^2 d/dc.
            name = name.replace("radius", "curvature")
            factor = -(self.parameters[name] ** 2)
            f, fx, fy = self._derivative(name, x, y)
            return factor * f, factor * fx, factor * fy
        return self._derivative(name, x, y)

    def _changed(self, name: str, value: float) -> Shape:
        """Return `with_parameter` for an existing parameter."""
        raise NotImplementedError

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        """Return `sag_derivative` for an existing parameter other than a radius."""
        raise NotImplementedError

    def _check_parameter(self, name: str) -> None:
        if name not in self.parameters:
            raise unknown_name(f"parameter of {type(self).__name__}", name, self.parameters)


class Rotational(Shape):
    """Conic of revolution plus even powers of the distance from the axis, from the fourth."""

    #: Radius of curvature at the vertex [m]; infinite for a plane.
    radius: float = np.inf
    #: Conic constant.
    conic: float = 0.0
    #: Coefficients of r^4, r^6... [m^-3, m^-5, ...].
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_radius(self.radius, flat=isinstance(self, (Plane, EvenAsphere)))
        check_conic(self.conic)
        check_coefficients(self.coefficients)

    @property
    def curvature(self) -> float:  # noqa: D102
        return 1.0 / self.radius

    @property
    def fourth_order(self) -> float:  # noqa: D102
        return self.conic * self.curvature**3 / 8 + (*self.coefficients, 0.0)[0]

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._radial(x * x + y * y)[0]

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        _, first, _ = self._radial(x * x + y * y)
        return 2 * x * first, 2 * y * first

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        _, first, second = self._radial(x * x + y * y)
        return 2 * first + 4 * x * x * second, 4 * x * y * second, 2 * first + 4 * y * y * second

    def _radial(self, s: np.ndarray) -> Triple:
        """Return the sag and its first and second derivative by ``s = x^2 + y^2``."""
        c, k = self.curvature, self.conic
        w = root(1.0 - (1.0 + k) * c**2 * s)
        # Where the rim of a sphere is vertical the slope is infinite; the sag there is still finite.
        with np.errstate(divide="ignore"):
            z, z_s, z_ss = c * s / (1.0 + w), 0.5 * c / w, 0.25 * (1.0 + k) * c**3 / w**3
        if self.coefficients:
            value, first, second = (np.zeros_like(s) for _ in range(3))
            for a in (*reversed(self.coefficients), 0.0, 0.0):
                second = second * s + 2 * first
                first = first * s + value
                value = value * s + a
            z, z_s, z_ss = z + value, z_s + first, z_ss + second
        return z, z_s, z_ss

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        c = self.curvature
        conic_parameters = {"radius": 1.0 / c if c else np.inf, "curvature": c, "conic": self.conic}
        return conic_parameters | {
            f"a{power}": a for power, a in zip(range(4, 1000, 2), self.coefficients, strict=False)
        }

    def _derivative(self, name: str, x: np.ndarray, y: np.ndarray) -> Triple:
        s = x * x + y * y
        if name.startswith("a"):
            power = int(name[1:]) // 2
            f, slope = s**power, power * s ** (power - 1)
        else:
            f, slope = conic_derivative(self.curvature, self.conic, name, s)
        return f, 2 * x * slope, 2 * y * slope

    def _changed(self, name: str, value: float) -> Shape:
        if name.startswith("a"):
            terms = with_coefficient(self.coefficients, int(name[1:]) // 2 - 2, value)
            return EvenAsphere(self.parameters["radius"], self.conic, terms)
        conic = value if name == "conic" else self.conic
        if name == "curvature" and value == 0 and not any(self.coefficients):
            return Plane()
        radius = self.parameters["radius"]
        if name in ("radius", "curvature"):
            radius = value if name == "radius" else (1.0 / value if value else np.inf)
        if isinstance(self, EvenAsphere):
            return EvenAsphere(radius, conic, self.coefficients)
        return Conic(radius, conic) if conic != 0 else Sphere(radius)


def conic_derivative(c: float, k: float, name: str, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivative of a conic's sag by "curvature" or "conic" at ``s = r^2``, and its derivative by s.

    From ``G = c (s + (1 + k) z^2) - 2 z = 0``: dz/dc = (s + (1 + k) z^2) / (2 w) and dz/dk = c z^2 / (2 w), with
    w = 1 - (1 + k) c z, the root of the closed form.
    """
    w = root(1.0 - (1.0 + k) * c**2 * s)
    z, z_s, w_s = c * s / (1.0 + w), 0.5 * c / w, -0.5 * (1.0 + k) * c**2 / w
    if name == "curvature":
        top, top_s = s + (1.0 + k) * z * z, 1.0 + 2.0 * (1.0 + k) * z * z_s
    else:
        top, top_s = c * z * z, 2.0 * c * z * z_s
    return 0.5 * top / w, 0.5 * (top_s - top * w_s / w) / w


@dataclass(frozen=True)
class Plane(Rotational):
    """Flat surface, ``z = 0``."""

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        return {"curvature": 0.0}

    def _changed(self, name: str, value: float) -> Shape:
        return Sphere(1.0 / value) if value else self


@check_arguments
@dataclass(frozen=True)
class Sphere(Rotational):
    """Sphere.

    Parameters
    ----------
    radius : float
        Radius of curvature [m], positive where the centre lies on the +z side.
    """

    radius: float


@check_arguments
@dataclass(frozen=True)
class Conic(Rotational):
    """Conic of revolution.

    Parameters
    ----------
    radius : float
        Radius of curvature at the vertex [m].
    conic : float
        Conic constant: 0 is a sphere, -1 a paraboloid.
    """

    radius: float
    conic: float


@check_arguments
@dataclass(frozen=True)
class EvenAsphere(Rotational):
    """Conic plus even powers of the distance from the axis.

    Parameters
    ----------
    radius : float
        Radius of curvature at the vertex [m]; infinite for the powers alone, as on a Schmidt plate.
    conic : float
        Conic constant.
    coefficients : tuple of float
        Coefficients of r^4, r^6, r^8... [m^-3, m^-5, m^-7, ...].
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
