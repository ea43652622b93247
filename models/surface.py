"""One optical surface: shape, clear aperture, place and interaction with light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, PrescriptionError
from ..core.units import metres, pure_numbers
from .aperture import Aperture
from .coating import AnyCoating
from .grating import Grating
from .layer_stack import LayerStack
from .media.medium import Medium
from .shapes.shape import Plane, Shape
from .thin_lens import ThinLens

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Interaction(IntEnum):
    """Interaction of a surface with a ray."""

    MIRROR = 0
    REFRACT = 1
    DETECTOR = 2
    #: Crossed without refraction: a baffle plane, a stop, a dummy surface.
    PASS = 3
    #: Thin phase screen on the plane z = 0: the shape is a map of optical path [m], which is added to the path of the
    #: ray; its slopes are added to the ray's components along x and y, times the index.
    PHASE = 4
    #: Ideal thin lens on the plane z = 0.
    THIN_LENS = 5


@check_arguments
@dataclass(frozen=True)
class Surface:
    """One surface of a telescope, in the order that light meets them.

    Parameters
    ----------
    name : str
        Name, unique within its telescope.
    interaction : Interaction
        Mirror, refracting interface, detector, surface without effect, phase screen, or ideal thin lens.
    shape : Shape
        Shape in the surface's own frame; for a phase screen, the map of optical path [m].
    vertex : tuple of float, shape (3,)
        Vertex in the telescope frame [m].
    medium_after : Medium
        Medium of the light behind the surface.
    aperture : Aperture, optional
        Clear region in the surface's own x, y; None for an unbounded one.
    rotation : nested tuple of float, shape (3, 3)
        Rotation matrix; its columns are the surface's axes in the telescope frame.
    semi_diameter : float, optional
        Radius [m] that the surface is made or drawn to; it stops no light.
    coating : Coating, CoatingTable or LayerStack, optional
        Coating, for throughput, illumination and ghosts; rays do not depend on it. Layers are those of lens surfaces.
    grating : Grating, optional
        Grooves of a mirror or lens surface.
    thin_lens : ThinLens, optional
        The lens that an ideal thin lens is, on a plane.
    """

    name: str
    interaction: Interaction
    shape: Shape
    vertex: Vector
    medium_after: Medium
    aperture: Aperture | None = None
    rotation: Matrix = IDENTITY
    semi_diameter: float | None = None
    coating: AnyCoating | None = None
    grating: Grating | None = None
    thin_lens: ThinLens | None = None

    def __post_init__(self) -> None:
        if len(self.vertex) != 3 or not np.all(np.isfinite(self.vertex)):
            raise PrescriptionError(f"vertex = {self.vertex!r}: expected three finite numbers")
        if self.semi_diameter is not None and not 0 < self.semi_diameter < np.inf:
            raise PrescriptionError(f"semi_diameter = {self.semi_diameter!r}: expected a positive number")
        if self.grating is not None and self.interaction not in (Interaction.MIRROR, Interaction.REFRACT):
            raise PrescriptionError("grating: expected a mirror or a lens surface", key="grating")
        if (self.thin_lens is not None) != (self.interaction == Interaction.THIN_LENS):
            raise PrescriptionError("thin_lens: expected one of a thin lens, and of that alone", key="thin_lens")
        if self.thin_lens is not None and not isinstance(self.shape, Plane):
            raise PrescriptionError(f"shape {type(self.shape).__name__}: expected a plane of a thin lens", key="shape")
        axes = np.array(self.rotation, dtype=np.float64)
        # 1e-9 admits what many rotations accumulate in rounding, and no scaling or reflection.
        if self.rotation != IDENTITY and (
            axes.shape != (3, 3) or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9) or np.linalg.det(axes) < 0
        ):
            raise PrescriptionError(f"rotation = {self.rotation!r}: expected a 3 x 3 rotation matrix")

    @cached_property
    def matrix(self) -> np.ndarray:
        """Rotation matrix, shape (3, 3): columns are the surface's axes in the telescope frame."""
        matrix = np.array(self.rotation, dtype=np.float64)
        matrix.flags.writeable = False
        return matrix

    @property
    def meeting_shape(self) -> Shape:
        """Shape that rays meet: the plane z = 0 of a phase screen."""
        return Plane() if self.interaction == Interaction.PHASE else self.shape

    def sag(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the height [m] over the vertex plane at x, y [m] of the surface's own frame; NaN beyond the rim."""
        return self.meeting_shape.sag(x, y)

    def normal(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the unit normals on the +z side at x, y [m], in the surface's own frame, [..., 3]; NaN beyond the rim.

        Where rays meet a surface, and how they leave it: :func:`pachon.intersect`, :func:`pachon.reflect` and
        :func:`pachon.refract`.
        """
        return self.meeting_shape.normal(x, y)

    def coated(self, coating: AnyCoating | None) -> Surface:
        """Return the surface with a coating, or none; PrescriptionError for layers on what is no lens surface."""
        if isinstance(coating, LayerStack) and self.interaction != Interaction.REFRACT:
            raise PrescriptionError("layers are those of lens surfaces; expected a table", key="coating")
        return replace(self, coating=coating)

    def to_local(self, points: ArrayLike) -> np.ndarray:
        """Return points [m], shape (..., 3), of the telescope frame in the surface's own frame; NaN where they are."""
        # Added, so that no negative zeros of symmetric systems are left.
        offset = _points(points) + (0.0 - np.array(self.vertex))
        return offset if self.rotation == IDENTITY else offset @ self.matrix

    def along(self, directions: np.ndarray) -> np.ndarray:
        """Return directions, shape (..., 3), of the telescope frame in the surface's own frame."""
        return directions + 0.0 if self.rotation == IDENTITY else directions @ self.matrix

    def to_telescope(self, points: ArrayLike) -> np.ndarray:
        """Return points [m], shape (..., 3), of the surface's own frame in the telescope frame; NaN where they are."""
        return _points(points) @ self.matrix.T + np.array(self.vertex)

    def moved(
        self, *, rotation: ArrayLike = IDENTITY, about: ArrayLike = (0.0, 0.0, 0.0), shift: ArrayLike = (0, 0, 0)
    ) -> Surface:
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


def _points(points: ArrayLike) -> np.ndarray:
    values = metres(points, "points")
    if values.shape[-1:] != (3,):
        raise DomainError(f"points of shape {values.shape}: expected [..., 3]")
    return values


def move_frame(
    vertex: Vector, axes: Matrix, *, rotation: ArrayLike, about: ArrayLike, shift: ArrayLike
) -> tuple[Vector, Matrix]:
    """Return a frame (origin [m] and axes as columns) rotated about a point [m], then shifted [m]."""
    rotation = pure_numbers(rotation, "rotation")
    about, shift = metres(about, "about"), metres(shift, "shift")
    for name, value, shape in (("rotation", rotation, (3, 3)), ("about", about, (3,)), ("shift", shift, (3,))):
        if value.shape != shape or not np.isfinite(value).all():
            raise DomainError(f"{name} of shape {value.shape}: expected finite numbers of shape {shape}")
    if np.array_equal(rotation, np.eye(3)):
        # Without a rotation the axes keep their exact values.
        x, y, z = (float(v) for v in np.array(vertex) + shift)
        return (x, y, z), axes
    x, y, z = (float(v) for v in rotation @ (np.array(vertex) - about) + about + shift)
    rotated = rotation @ np.array(axes)
    return (x, y, z), cast(Matrix, tuple(tuple(float(v) for v in row) for row in rotated))
