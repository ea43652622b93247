"""Optical paths to reference spheres and their derivatives, the forward sweep and the way back in one go."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..models.telescope import Telescope
from .gradient import Polynomials, SurfaceResponse, as_rays, check_differentiable, polynomial_tables, row_count
from .launch import launch, thread_count
from .packed import pack_surfaces, refractive_indices
from .packet import lane_flags, lanes, packet_count, to_packets
from .rays import Rays
from .sphere_sweep_kernels import SPHERE_ROWS, sweep_sphere


def respond_to_sphere(
    telescope: Telescope,
    rays: Rays,
    center: np.ndarray,
    path: np.ndarray,
    radius: float,
    rows: np.ndarray,
    sphere_row: int,
    *,
    polynomials: Polynomials = (),
    threads: int | None = None,
) -> tuple[SurfaceResponse, np.ndarray]:
    """Trace rays to reference spheres and carry the derivative of their optical path back, in one go.

    What :func:`sweep` and :func:`respond` do in two, but the rays never leave the processor's cache.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    rays : Rays
        Rays of one wavelength, in phase.
    center : ndarray, shape [3, n]
        Centre of the sphere of each ray [m], telescope frame.
    path : ndarray, shape [n]
        Optical path [m] that is subtracted from that of each ray: the chief ray's.
    radius : float
        Radius of the spheres [m].
    rows : ndarray of int, shape [n_surface + 1, 13]
        Columns wanted, from :func:`columns`, which leave out four rows.
    sphere_row : int
        The first of these: the path less `path` [m] and its derivatives with respect to the landing point, which are
        opposite to those with respect to the centre.
    polynomials : sequence of (surface, scale, degree, rows)
        As in :func:`respond`.
    threads : int, optional
        Number of threads; all processors by default.

    Returns
    -------
    response : SurfaceResponse
        One output.
    status : ndarray of int32, shape [n]
        A :class:`~pachon.raytrace.rays.RayStatus` each.
    """
    check_differentiable(telescope)
    packed = pack_surfaces(telescope)
    count, surfaces = packet_count(len(rays)), len(telescope.surfaces)
    # As many parts as threads: each thread keeps the rays of one packet at all surfaces, not more.
    parts = min(thread_count(threads), max(count, 1))
    index = refractive_indices(telescope, rays.wavelength)
    total = max(sphere_row + SPHERE_ROWS, row_count(rows, polynomials))
    response = wp.empty((1, total, count), dtype=lanes, device="cpu")
    status = wp.empty(count, dtype=lane_flags, device="cpu")
    launch(
        sweep_sphere,
        parts,
        [
            packed,
            wp.array(index[None], dtype=wp.float64, device="cpu"),
            wp.array(index, dtype=wp.float64, device="cpu"),
            parts,
            *(_packets(values) for values in (rays.position.T, rays.direction.T, np.vstack([center, path]))),
            float(radius),
            *(wp.empty((surfaces, 3, parts), dtype=lanes, device="cpu") for _ in range(2)),
            wp.empty((surfaces, parts), dtype=lanes, device="cpu"),
            wp.empty((surfaces, parts), dtype=lane_flags, device="cpu"),
            wp.array(rows, dtype=wp.int32, device="cpu"),
            *polynomial_tables(rows, polynomials),
            sphere_row,
            response,
            status,
        ],
        threads=threads,
    )
    return SurfaceResponse(rows, as_rays(response, len(rays))), status.numpy().reshape(-1)[: len(rays)]


def _packets(values: np.ndarray) -> wp.array:
    return wp.array(to_packets(values), dtype=lanes, device="cpu", copy=False)
