"""Obstructions on the way of rays to a surface."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import LANES, lanes
from .surface import OK, VIGNETTED

wp.set_module_options(FORWARD_OPTIONS)

#: Length [m] at both ends of the path between two surfaces that is exempt: several times the resolution of single
#: precision over 20 m.
MARGIN = wp.constant(wp.float32(1.0e-5))


@wp.struct
class PackedObstructions:
    """Meshes [obstruction], ids of ``wp.Mesh``, and ``blocks`` [surface, obstruction]: 1 on the way to a surface."""

    meshes: wp.array(dtype=wp.uint64)
    blocks: wp.array2d(dtype=wp.int32)


@wp.func
def obstructed_status(
    obstructions: PackedObstructions,
    s: wp.int32,
    x: lanes,
    y: lanes,
    z: lanes,
    u: lanes,
    v: lanes,
    w: lanes,
    t: lanes,
    status: lanes,
):
    """Ray statuses after obstructions on a path of length t from (x, y, z) to surface ``s``, telescope frame."""
    for m in range(obstructions.meshes.shape[0]):
        if obstructions.blocks[s, m] == 1:
            for i in range(LANES):
                length = wp.float32(t[i]) - wp.float32(2.0) * MARGIN
                # Lanes that are vignetted already, and NaN, are skipped.
                if status[i] == OK and length > wp.float32(0.0):
                    heading = wp.vec3(wp.float32(u[i]), wp.float32(v[i]), wp.float32(w[i]))
                    start = wp.vec3(wp.float32(x[i]), wp.float32(y[i]), wp.float32(z[i])) + MARGIN * heading
                    if wp.mesh_query_ray_anyhit(obstructions.meshes[m], start, heading, length):
                        status[i] = VIGNETTED
    return status
