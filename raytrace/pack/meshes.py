"""The meshes among a telescope's surfaces, for the trace kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ...core.warp_arrays import warp_array
from ...models.shapes.mesh import MeshSurface
from ...models.surface import Surface
from ..kernels.mesh import PackedMeshes


def warp_mesh(points: np.ndarray, faces: np.ndarray, device: str = "cpu") -> wp.Mesh:
    """Return a mesh of points [m], [n, 3], and of three of their indices for each triangle."""
    indices = warp_array(faces.ravel(), wp.int32, device=device)
    return wp.Mesh(points=warp_array(points, wp.vec3, device=device), indices=indices)


def pack_meshes(surfaces: tuple[Surface, ...], device: str = "cpu") -> Any:
    """Return the shapes that are meshes as a :class:`PackedMeshes` struct on a device."""
    ids = np.zeros(len(surfaces), dtype=np.uint64)
    first = np.zeros(len(surfaces), dtype=np.int32)
    span = np.zeros((len(surfaces), 2))
    facets = [np.zeros((0, 15))]
    meshes = []
    for row, shape in enumerate(s.shape for s in surfaces):
        if not isinstance(shape, MeshSurface):
            continue
        mesh = warp_mesh(shape.vertices, shape.faces, device)
        meshes.append(mesh)
        ids[row], first[row] = mesh.id, sum(len(f) for f in facets)
        heights = shape.corners[..., 2]
        span[row] = heights.min(), heights.max()
        n = len(shape.faces)
        facets.append(np.concatenate([shape.corners.reshape(n, 9), shape.corner_slopes.reshape(n, 6)], axis=1))
    packed = PackedMeshes()
    packed.ids = warp_array(ids, wp.uint64, device=device)
    # Kernels refer to meshes by number only: the array of numbers owns the meshes.
    packed.ids.meshes = meshes
    packed.first_facet = warp_array(first, wp.int32, device=device)
    packed.span = warp_array(span, device=device)
    packed.facets = warp_array(np.concatenate(facets), device=device)
    return packed
