"""Distance of rays to a sphere beyond the image."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS
from .packet import lanes, lanes_sqrt

wp.set_module_options(FORWARD_OPTIONS)


@wp.func
def sphere_distance(x: lanes, y: lanes, z: lanes, u: lanes, v: lanes, w: lanes, radius: wp.float64):
    """Distance from points q to a sphere about the origin, root - q.d with root = sqrt((q.d)^2 - q.q + R^2).

    Returned with it: q.d and the root.
    """
    along = wp.cw_mul(x, u) + wp.cw_mul(y, v) + wp.cw_mul(z, w)
    square = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
    root = lanes_sqrt(wp.cw_mul(along, along) - square + lanes(radius * radius))
    return root - along, along, root
