"""One optical surface: its shape, its clear aperture, its place and what it does to light.

Every shape is an even asphere or a special case of one. With ``r^2 = x^2 + y^2``, curvature ``c = 1/R``, conic
constant ``k`` and coefficients ``a_4, a_6, ...``::

    z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a_4 r^4 + a_6 r^6 + ...

A positive radius has its centre of curvature on the +z side of the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, cast

import numpy as np

from .errors import PrescriptionError
from .glass import Medium

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Interaction(IntEnum):
    """What a surface does to a ray."""

    MIRROR = 0
    REFRACT = 1
    DETECTOR = 2


def _sag(x: Any, y: Any, curvature: float, conic: float, coefficients: tuple[float, ...]) -> np.ndarray:
    r2 = np.asarray(x, dtype=np.float64) ** 2 + np.asarray(y, dtype=np.float64) ** 2
    inside = 1.0 - (1.0 + conic) * curvature**2 * r2
    z = curvature * r2 / (1.0 + np.sqrt(np.where(inside >= 0, inside, np.nan)))
    if coefficients:
        # Horner in r^2: r^4 (a4 + r^2 (a6 + ...)).
        polynomial = np.zeros_like(r2)
        for a in reversed(coefficients):
            polynomial = polynomial * r2 + a
        z = z + polynomial * r2**2
    return z


def _check_radius(radius: float) -> None:
    if not np.isfinite(radius) or radius == 0:
        raise PrescriptionError(f"radius = {radius!r}: expected a finite radius of curvature in m, not zero")


def _check_conic(conic: float) -> None:
    if not np.isfinite(conic):
        raise PrescriptionError(f"conic = {conic!r}: expected a finite conic constant")


class _Figure(Protocol):
    @property
    def curvature(self) -> float: ...
    @property
    def conic(self) -> float: ...
    @property
    def coefficients(self) -> tuple[float, ...]: ...


class _Rotational:
    """What all shapes share: seen as an even asphere, their sag."""

    def sag(self: _Figure, x: Any, y: Any) -> np.ndarray:
        """Return the height of the surface over its vertex plane.

        Parameters
        ----------
        x, y : float or array
            Position in the surface's own frame [m].

        Returns
        -------
        ndarray
            Sag [m]; NaN where the conic does not reach.
        """
        return _sag(x, y, self.curvature, self.conic, self.coefficients)


@dataclass(frozen=True)
class Plane(_Rotational):
    """Flat surface, ``z = 0``."""

    @property
    def curvature(self) -> float:
        """Vertex curvature [1/m]."""
        return 0.0

    @property
    def conic(self) -> float:
        """Conic constant."""
        return 0.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of r^4, r^6...: none."""
        return ()


@dataclass(frozen=True)
class Sphere(_Rotational):
    """Sphere of radius of curvature `radius` [m]."""

    radius: float

    def __post_init__(self) -> None:
        _check_radius(self.radius)

    @property
    def conic(self) -> float:
        """Conic constant."""
        return 0.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of r^4, r^6...: none."""
        return ()

    @property
    def curvature(self) -> float:
        """Vertex curvature [1/m]."""
        return 1.0 / self.radius


@dataclass(frozen=True)
class Conic(_Rotational):
    """Conic of revolution: vertex radius [m] and conic constant (0 sphere, -1 paraboloid)."""

    radius: float
    conic: float

    def __post_init__(self) -> None:
        _check_radius(self.radius)
        _check_conic(self.conic)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of r^4, r^6...: none."""
        return ()

    @property
    def curvature(self) -> float:
        """Vertex curvature [1/m]."""
        return 1.0 / self.radius


@dataclass(frozen=True)
class EvenAsphere(_Rotational):
    """Conic plus even powers of the radius; coefficients of r^4, r^6, r^8... in SI (m^-3, m^-5, ...)."""

    radius: float
    conic: float
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_radius(self.radius)
        _check_conic(self.conic)
        if not np.all(np.isfinite(self.coefficients)):
            raise PrescriptionError(f"coefficients = {self.coefficients!r}: expected finite numbers")

    @property
    def curvature(self) -> float:
        """Vertex curvature [1/m]."""
        return 1.0 / self.radius


Shape = Plane | Sphere | Conic | EvenAsphere


@dataclass(frozen=True)
class Circle:
    """Clear disc of the surface's own x, y [m]; its rim is not clear."""

    radius: float
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius) and self.radius > 0 and np.isfinite(self.x) and np.isfinite(self.y)):
            raise PrescriptionError(f"circle = {self.radius!r} m: expected a positive radius and finite centre")

    def contains(self, x: Any, y: Any) -> np.ndarray:
        """Return True where (x, y) [m] lies in the clear region."""
        r2 = (np.asarray(x, dtype=np.float64) - self.x) ** 2 + (np.asarray(y, dtype=np.float64) - self.y) ** 2
        return r2 < self.radius**2


@dataclass(frozen=True)
class Annulus:
    """Clear ring of the surface's own x, y [m]; its inner rim is clear, its outer is not."""

    inner: float
    outer: float
    x: float = 0.0
    y: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.inner < self.outer < np.inf and np.isfinite(self.x) and np.isfinite(self.y)):
            raise PrescriptionError(
                f"annulus = [{self.inner!r}, {self.outer!r}] m: expected 0 <= inner < outer and finite centre"
            )

    def contains(self, x: Any, y: Any) -> np.ndarray:
        """Return True where (x, y) [m] lies in the clear region."""
        r2 = (np.asarray(x, dtype=np.float64) - self.x) ** 2 + (np.asarray(y, dtype=np.float64) - self.y) ** 2
        return (r2 >= self.inner**2) & (r2 < self.outer**2)


Aperture = Circle | Annulus


@dataclass(frozen=True)
class Surface:
    """One surface of a telescope, in the order that light meets them.

    Parameters
    ----------
    name : str
        Name, unique within its telescope.
    interaction : Interaction
        Mirror, refracting interface or detector.
    shape : Plane, Sphere, Conic or EvenAsphere
        Shape in the surface's own frame.
    vertex : tuple of float, shape (3,)
        Vertex in the telescope frame [m].
    medium_after : ConstantIndex or Sellmeier
        Medium that light travels in once it has left the surface.
    aperture : Circle or Annulus, optional
        Clear region in the surface's own x, y; None is unbounded.
    rotation : nested tuple of float, shape (3, 3)
        Rotation matrix; its columns are the surface's axes in the telescope frame.
    """

    name: str
    interaction: Interaction
    shape: Shape
    vertex: Vector
    medium_after: Medium
    aperture: Aperture | None = None
    rotation: Matrix = IDENTITY

    def __post_init__(self) -> None:
        if len(self.vertex) != 3 or not np.all(np.isfinite(self.vertex)):
            raise PrescriptionError(f"vertex = {self.vertex!r}: expected three finite numbers")
        axes = np.array(self.rotation, dtype=np.float64)
        # 1e-9 admits what many rotations accumulate in rounding, and no scaling or reflection.
        if axes.shape != (3, 3) or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9) or np.linalg.det(axes) < 0:
            raise PrescriptionError(f"rotation = {self.rotation!r}: expected a 3 x 3 rotation matrix")

    @cached_property
    def matrix(self) -> np.ndarray:
        """Rotation matrix, shape (3, 3): columns are the surface's axes in the telescope frame."""
        matrix = np.array(self.rotation, dtype=np.float64)
        matrix.flags.writeable = False
        return matrix

    def to_local(self, points: Any) -> np.ndarray:
        """Return points [m], shape (..., 3), of the telescope frame in the surface's own frame."""
        return (np.asarray(points, dtype=np.float64) - np.array(self.vertex)) @ self.matrix

    def to_telescope(self, points: Any) -> np.ndarray:
        """Return points [m], shape (..., 3), of the surface's own frame in the telescope frame."""
        return np.asarray(points, dtype=np.float64) @ self.matrix.T + np.array(self.vertex)

    def moved(self, *, rotation: Any = IDENTITY, about: Any = (0.0, 0.0, 0.0), shift: Any = (0, 0, 0)) -> Surface:
        """Return the surface rotated about a point, then shifted, all in the telescope frame.

        Parameters
        ----------
        rotation : array, shape (3, 3)
            Rotation matrix in the telescope frame.
        about : array, shape (3,)
            Fixed point of the rotation [m], telescope frame.
        shift : array, shape (3,)
            Displacement [m], telescope frame, applied after the rotation.
        """
        vertex, matrix = move_frame(self.vertex, self.rotation, rotation=rotation, about=about, shift=shift)
        return replace(self, vertex=vertex, rotation=matrix)


def move_frame(vertex: Vector, axes: Matrix, *, rotation: Any, about: Any, shift: Any) -> tuple[Vector, Matrix]:
    """Return a frame (origin [m] and axes as columns) rotated about a point [m], then shifted [m]."""
    rotation, about, shift = np.asarray(rotation, dtype=np.float64), np.asarray(about), np.asarray(shift)
    if np.array_equal(rotation, np.eye(3)):
        # A pure shift leaves the figures of the frame untouched by rounding.
        x, y, z = (float(v) for v in np.array(vertex) + shift)
        return (x, y, z), axes
    x, y, z = (float(v) for v in rotation @ (np.array(vertex) - about) + about + shift)
    turned = rotation @ np.array(axes)
    return (x, y, z), cast(Matrix, tuple(tuple(float(v) for v in row) for row in turned))
