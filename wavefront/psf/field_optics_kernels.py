"""Kernel of optics over the field: landing points of rays on tilted CCDs."""

from __future__ import annotations

import warp as wp

from ...core.launch import FORWARD_OPTIONS

wp.set_module_options(FORWARD_OPTIONS)


@wp.kernel
def land_rays(
    first: wp.int32,
    nominal: wp.array4d(dtype=wp.vec2d),
    aside: wp.array(dtype=wp.vec2d),
    height: wp.array(dtype=wp.float64),
    steepness: wp.array(dtype=wp.vec2d),
    jacobian: wp.array(dtype=wp.mat22d),
    gradient: wp.array2d(dtype=wp.vec2d),
    displacement: wp.array3d(dtype=wp.vec2f),
):
    """Follow the rays of one star from the nominal surface to the tangent plane of its CCD.

    Arguments: nominal [star, 2, wave, point]: landing points from that of the chief ray [m], and slopes of the rays;
    aside [star]: landing point of the chief ray on the nominal surface from the reference point [m]; height [star] of
    the reference point [m]; steepness [star] of the CCD there; jacobian [star] [m/rad]; gradient [star, point] of an
    aberration [rad]; displacement [star, wave, point]: landing points from the reference point [m].
    """
    star = first + wp.tid()
    for wave in range(displacement.shape[1]):
        for point in range(displacement.shape[2]):
            beside = nominal[star, 0, wave, point] + aside[star]
            slope = nominal[star, 1, wave, point]
            rise = height[star] + wp.dot(beside, steepness[star])
            rise = rise / (wp.float64(1.0) - wp.dot(slope, steepness[star]))
            landed = beside + rise * slope - jacobian[star] * gradient[star, point]
            displacement[star, wave, point] = wp.vec2f(wp.float32(landed[0]), wp.float32(landed[1]))
