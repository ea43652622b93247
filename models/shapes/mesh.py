"""Surfaces made of triangles, such as measured shapes or those of a CAD program."""

from __future__ import annotations

import os
from collections.abc import Hashable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError, UnknownNameError, error_context
from ..content_equality import ContentEquality
from ..mesh_file import load_mesh
from .shape import Pair, Shape, Triple

if TYPE_CHECKING:
    import trimesh

#: A point this far beyond the edge of a facet, as a fraction of the facet, still belongs to it: rounding must not open
#: gaps between facets.
EDGE = 1e-9


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class MeshSurface(ContentEquality, Shape):
    """Surface of triangles with one height at each x, y.

    Parameters
    ----------
    vertices : array_like, shape [n_vertex, 3]
        Points [m] in the surface's own frame.
    faces : array_like of int, shape [n_facet, 3]
        Vertices of each facet; facets that share an edge share its vertices.
    smooth : bool
        Whether slopes are interpolated between the vertices, each of which has the mean slope of its facets weighted
        with their areas, or (by default) those of the facet itself. Intersections are on the facet in either case.

    Raises
    ------
    PrescriptionError
        If there is no facet, a number is not finite, a facet is seen edge-on, an edge belongs to more than two facets,
        or the surface folds over itself, as a closed solid does.
    """

    vertices: np.ndarray
    faces: np.ndarray
    smooth: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("vertices", "faces"):
            # Of an empty array any shape will do.
            if np.size(getattr(self, name)) and np.shape(getattr(self, name))[1:] != (3,):
                raise PrescriptionError(f"mesh {name} of shape {np.shape(getattr(self, name))}: expected [n, 3]")
            object.__setattr__(self, name, np.reshape(getattr(self, name), (-1, 3)))
        self._freeze(vertices=np.float64, faces=np.int32)
        n = len(self.vertices)
        if len(self.faces) == 0:
            raise PrescriptionError("mesh without facets: expected at least one")
        if not np.all(np.isfinite(self.vertices)):
            raise PrescriptionError("mesh vertices: expected finite numbers")
        if self.faces.min() < 0 or self.faces.max() >= n:
            raise PrescriptionError(f"mesh faces: expected vertices 0 to {n - 1}")
        self._check_manifold()
        area = self._facet_normals()[:, 2]
        if area.min() < 0 < area.max():
            raise PrescriptionError(
                f"mesh folds over: {int((area < 0).sum())} of {len(area)} facets face the other way; "
                "expected an open surface with one height at each x, y"
            )
        if np.any(area == 0):
            raise PrescriptionError(f"mesh facet {int(np.flatnonzero(area == 0)[0])} is seen edge-on: expected an area")
        if area[0] < 0:
            object.__setattr__(self, "faces", self.faces[:, ::-1])
            self._freeze(faces=np.int32)

    @classmethod
    def from_mesh(cls, mesh: trimesh.Trimesh, *, scale: float = 1.0, smooth: bool = False) -> MeshSurface:
        """Return the surface of a mesh whose unit is `scale` metres."""
        return cls(np.asarray(mesh.vertices) * scale, mesh.faces, smooth=smooth)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], *, scale: float = 1.0, smooth: bool = False) -> MeshSurface:
        """Read a mesh file (STL, GLB, OBJ, PLY, OFF) whose unit is `scale` metres.

        Raises
        ------
        PrescriptionError
            If the file cannot be read, or is no such surface.
        """
        with error_context(file=path):
            return cls.from_mesh(load_mesh(path, merged=True), scale=scale, smooth=smooth)

    def _check_manifold(self) -> None:
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, counts = np.unique(edges, axis=0, return_counts=True)
        if counts.max() > 2:
            raise PrescriptionError(
                f"mesh is no manifold: {int((counts > 2).sum())} edges belong to more than two facets; "
                "expected at most two"
            )

    @cached_property
    def _content(self) -> tuple[Hashable, ...]:
        return self.vertices.tobytes(), self.faces.tobytes(), self.smooth

    def __repr__(self) -> str:
        return f"MeshSurface({len(self.vertices)} vertices, {len(self.faces)} facets, smooth={self.smooth})"

    @property
    def corners(self) -> np.ndarray:
        """Corners of the facets [m], shape [n_facet, 3, 3]."""
        return self.vertices[self.faces]

    def _facet_normals(self) -> np.ndarray:
        """Return the normals of the facets, their length twice the area, shape [n_facet, 3]."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def corner_slopes(self) -> np.ndarray:
        """Slopes dz/dx, dz/dy at the corners of each facet, shape [n_facet, 3, 2]."""
        normals = self._facet_normals()
        if not self.smooth:
            slope = -normals[:, :2] / normals[:, 2:]
            return np.repeat(slope[:, None], 3, axis=1)
        total = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(total, self.faces[:, corner], normals)
        with np.errstate(invalid="ignore"):
            # Vertices without facets are ignored.
            slope = -total[:, :2] / total[:, 2:]
        return slope[self.faces]

    @cached_property
    def _bins(self) -> tuple[np.ndarray, np.ndarray, int, np.ndarray, np.ndarray]:
        """Return bins over x and y: their corner, size, number a side, where each begins in the list of its facets."""
        low, high = self.vertices[:, :2].min(axis=0), self.vertices[:, :2].max(axis=0)
        side = max(1, int(np.sqrt(len(self.faces))))
        size = (high - low) / side
        corners = self.corners[..., :2]
        first = np.clip(((corners.min(axis=1) - low) / size).astype(int), 0, side - 1)
        last = np.clip(((corners.max(axis=1) - low) / size).astype(int), 0, side - 1)
        spans = last - first + 1
        count = spans.prod(axis=1)
        facet = np.repeat(np.arange(len(self.faces)), count)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        column = first[facet, 0] + within % spans[facet, 0]
        row = first[facet, 1] + within // spans[facet, 0]
        order = np.argsort(row * side + column, kind="stable")
        starts = np.searchsorted((row * side + column)[order], np.arange(side * side + 1))
        return low, size, side, starts, facet[order]

    def _locate(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the facet over each point, -1 where there is none, and the weights of its corners [..., 3]."""
        low, size, side, starts, facets = self._bins
        place = np.stack([x, y], axis=-1)
        cell = np.floor((place - low) / size)
        inside = np.all((cell >= -1) & (cell <= side), axis=-1)
        column, row = np.moveaxis(np.clip(np.where(inside[..., None], cell, 0).astype(int), 0, side - 1), -1, 0)
        start, stop = starts[row * side + column], starts[row * side + column + 1]
        facet_index, weights = np.full(x.shape, -1), np.full((*x.shape, 3), np.nan)
        corners = self.corners[..., :2]
        for step in range(int(np.where(inside, stop - start, 0).max(initial=0))):
            open_ = inside & (facet_index < 0) & (start + step < stop)
            facet = facets[(start + step)[open_]]
            a, b, c = np.moveaxis(corners[facet], 1, 0)
            p, q, r = b - a, c - a, place[open_] - a
            area = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
            wb = (r[:, 0] * q[:, 1] - r[:, 1] * q[:, 0]) / area
            wc = (p[:, 0] * r[:, 1] - p[:, 1] * r[:, 0]) / area
            w = np.stack([1 - wb - wc, wb, wc], axis=-1)
            within = np.all(w >= -EDGE, axis=-1)
            facet_index[open_] = np.where(within, facet, -1)
            weights[open_] = np.where(within[:, None], w, np.nan)
        return facet_index, weights

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        facet, weights = self._locate(x, y)
        return np.einsum("...i,...i", self.corners[facet][..., 2], weights)

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        facet, weights = self._locate(x, y)
        slope = np.einsum("...ij,...i->...j", self.corner_slopes[facet], weights)
        return slope[..., 0], slope[..., 1]

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        # Change of the slopes within a facet: zero unless smooth.
        facet, weights = self._locate(x, y)
        a, b, c = np.moveaxis(self.corners[facet][..., :2], -2, 0)
        edges = np.stack([b - a, c - a], axis=-2)
        slopes = self.corner_slopes[facet]
        change = np.linalg.solve(edges, slopes[..., 1:, :] - slopes[..., :1, :])
        change = np.where(np.isnan(weights[..., :1, None]), np.nan, change)
        return change[..., 0, 0], 0.5 * (change[..., 0, 1] + change[..., 1, 0]), change[..., 1, 1]

    @cached_property
    def _radial_fit(self) -> np.ndarray:
        """Least squares of the vertices by 1, x, y, r^2 and r^4: its coefficients [m, 1, 1, 1/m, 1/m^3]."""
        x, y, z = self.vertices[np.unique(self.faces)].T
        s = x * x + y * y
        unit = s.max()
        basis = np.stack([np.ones_like(x), x, y, s / unit, (s / unit) ** 2], axis=-1)
        return np.linalg.lstsq(basis, z, rcond=None)[0] / [1, 1, 1, unit, unit**2]

    @property
    def curvature(self) -> float:
        """Curvature at the vertex [1/m], of a fit by r^2 and r^4."""
        return 2.0 * float(self._radial_fit[3])

    @property
    def fourth_order(self) -> float:  # noqa: D102
        return float(self._radial_fit[4]) - self.curvature**3 / 8

    @property
    def parameters(self) -> dict[str, float]:
        """No parameters."""
        return {}

    def _check_parameter(self, name: str) -> NoReturn:
        raise UnknownNameError(f"unknown parameter {name!r} of a mesh: a mesh has none")
