"""Intersections of rays with triangle meshes: focal planes and surfaces that are meshes."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lanes
from .surface import ONE, ZERO

wp.set_module_options(FORWARD_OPTIONS)

#: Rays start this far [m] before the highest or lowest vertex of a mesh: several times what single precision resolves
#: over some metres.
MESH_MARGIN = wp.constant(wp.float64(1.0e-4))
NO_FACET = wp.constant(wp.float64(float("nan")))


@wp.struct
class PackedMeshes:
    """The meshes among a telescope's surfaces.

    ``ids`` [surface]: ``wp.Mesh``, or 0. ``first_facet`` [surface]: where its facets begin among all. ``span``
    [surface, 2]: lowest and highest vertex [m]. ``facets`` [facet, 15]: three corners [m], and the slopes along x and y
    at each.
    """

    ids: wp.array(dtype=wp.uint64)
    first_facet: wp.array(dtype=wp.int32)
    span: wp.array2d(dtype=wp.float64)
    facets: wp.array2d(dtype=wp.float64)


@wp.func
def mesh_distance(meshes: PackedMeshes, s: wp.int32, x: lanes, y: lanes, z: lanes, u: lanes, v: lanes, w: lanes):
    """Distance to the mesh of surface ``s``, NaN where it is missed, and the slopes along x and y there.

    ``wp.Mesh`` finds the facet in single precision; the intersection is computed in double precision.
    """
    t = lanes(NO_FACET)
    slope_x = lanes(ZERO)
    slope_y = lanes(ZERO)
    low = meshes.span[s, 0] - MESH_MARGIN
    high = meshes.span[s, 1] + MESH_MARGIN
    # A loop that the compiler does not unroll.
    for i in range(LANES + 0 * s):
        # From one side of the mesh to the other, wherever the ray is now.
        first = (wp.where(w[i] < ZERO, high, low) - z[i]) / w[i]
        reach = wp.float32((high - low) / wp.abs(w[i]))
        if reach > wp.float32(0.0):
            start = wp.vec3(
                wp.float32(x[i] + first * u[i]), wp.float32(y[i] + first * v[i]), wp.float32(z[i] + first * w[i])
            )
            heading = wp.vec3(wp.float32(u[i]), wp.float32(v[i]), wp.float32(w[i]))
            query = wp.mesh_query_ray(meshes.ids[s], start, heading, reach)
            if query.result:
                f = meshes.first_facet[s] + query.face
                ax = meshes.facets[f, 0]
                ay = meshes.facets[f, 1]
                az = meshes.facets[f, 2]
                px = meshes.facets[f, 3] - ax
                py = meshes.facets[f, 4] - ay
                pz = meshes.facets[f, 5] - az
                qx = meshes.facets[f, 6] - ax
                qy = meshes.facets[f, 7] - ay
                qz = meshes.facets[f, 8] - az
                nx = py * qz - pz * qy
                ny = pz * qx - px * qz
                nz = px * qy - py * qx
                distance = (nx * (ax - x[i]) + ny * (ay - y[i]) + nz * (az - z[i])) / (
                    nx * u[i] + ny * v[i] + nz * w[i]
                )
                # Weights of the corners, seen along z.
                rx = x[i] + distance * u[i] - ax
                ry = y[i] + distance * v[i] - ay
                b = (rx * qy - ry * qx) / nz
                c = (px * ry - py * rx) / nz
                a = ONE - b - c
                t[i] = distance
                slope_x[i] = a * meshes.facets[f, 9] + b * meshes.facets[f, 11] + c * meshes.facets[f, 13]
                slope_y[i] = a * meshes.facets[f, 10] + b * meshes.facets[f, 12] + c * meshes.facets[f, 14]
    return t, slope_x, slope_y


@wp.kernel
def first_facet(
    first: wp.int32,
    mesh: wp.uint64,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    reach: wp.float32,
    facet: wp.array(dtype=wp.int32),
):
    """Index of the first facet within ``reach`` metres, -1 where there is none."""
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, origin[i], direction[i], reach)
    facet[i] = wp.where(query.result, query.face, -1)
