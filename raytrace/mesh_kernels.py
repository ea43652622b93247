"""The kernel that finds which facet of a mesh a ray meets."""

from __future__ import annotations

import warp as wp

from .launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)


@wp.kernel
def first_facet(
    first: wp.int32,
    mesh: wp.uint64,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    reach: wp.float32,
    facet: wp.array(dtype=wp.int32),
):
    """Index of the first facet met within ``reach`` metres, -1 where there is none."""
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, origin[i], direction[i], reach)
    facet[i] = wp.where(query.result, query.face, -1)
