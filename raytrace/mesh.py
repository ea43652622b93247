"""Trace rays to a triangle mesh, such as the tiles of a focal plane or a measured surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.launch import launch, start_warp
from ..core.warp_arrays import warp_array
from ..models.surface import Surface
from .kernels.mesh import first_facet
from .pack.meshes import warp_mesh

if TYPE_CHECKING:
    import trimesh

#: Rays are started this far in front of the nominal surface [m] and followed for twice as far: heights of a focal
#: plane are micrometres, and single precision resolves 0.1 nm over this distance.
REACH = 1.0e-3


@dataclass(frozen=True)
class MeshLanding:
    """Intersections of rays with a mesh."""

    position: np.ndarray  #: on the facets, telescope frame [m], [n, 3]; NaN without one
    path: np.ndarray  #: distance from the given points along the rays [m], [n]
    facet: np.ndarray  #: index of the facet, -1 for none, int32 [n]


@check_arguments
def land_on_mesh(
    detector: Surface, mesh: trimesh.Trimesh, position: np.ndarray, direction: np.ndarray, *, threads: int | None = None
) -> MeshLanding:
    """Propagate rays from the nominal detector surface to a mesh in the detector's frame.

    ``wp.Mesh`` works in single precision and only finds the facet of each ray; the intersection with the plane of that
    facet is then computed in double precision.

    Parameters
    ----------
    detector : Surface
        The nominal detector, whose frame the mesh is in.
    mesh : trimesh.Trimesh
        Facets [m], within 1 mm of the detector's plane (``FocalPlane.to_mesh()``).
    position, direction : ndarray, shape [n, 3]
        Rays at the nominal detector, telescope frame [m].
    threads : int, optional
        Number of threads.

    Returns
    -------
    MeshLanding
    """
    if position.ndim != 2 or position.shape[1] != 3 or direction.shape != position.shape:
        shapes = f"{position.shape}, {direction.shape}"
        raise DomainError(f"position, direction have shapes {shapes}: expected [n, 3] twice")
    start_warp()
    p = detector.to_local(position)
    d = detector.along(direction)
    start = p - (REACH / np.abs(d[:, 2]))[:, None] * d

    facets = warp_mesh(mesh.vertices, mesh.faces)
    facet = wp.empty(len(p), dtype=wp.int32, device="cpu")
    # Rays that are lost have no direction.
    reach = float(2 * REACH / np.nanmin(np.abs(d[:, 2]), initial=1.0))
    inputs = [facets.id, warp_array(start, wp.vec3), warp_array(d, wp.vec3), reach, facet]
    launch(first_facet, len(p), inputs, threads=threads)

    index = facet.numpy()
    corners = np.asarray(mesh.triangles, dtype=np.float64)[index]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    path = np.einsum("ij,ij->i", normal, corners[:, 0] - p) / np.einsum("ij,ij->i", normal, d)
    path = np.where(index >= 0, path, np.nan)
    return MeshLanding(position + path[:, None] * direction, path, index)
