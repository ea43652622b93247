"""Optical path differences of many field points, traced in packets without storing rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ..core.buffers import empty
from ..core.launch import launch
from ..core.warp_arrays import warp_array
from ..raytrace.kernels.opds import trace_opds
from ..raytrace.kernels.packet import LANES, lane_flags, lanes, packet_count, ray_packets, to_packets
from ..raytrace.pack.surfaces import indices_and_wavelength, leading_surfaces, pack_surfaces
from ..raytrace.rays import object_points
from .request import Request
from .transmitted_packets import transmitted_packets

#: Rays in one batch: enough that starting a batch does not count, and 0.2 s between two reports of progress.
_RAYS_AT_ONCE = 1 << 22


def traced_opds(
    request: Request,
    x: np.ndarray,
    y: np.ndarray,
    spheres: np.ndarray,
    radius: float,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray:
    """Return the OPD [m] of pupil points x, y [n_pupil] [m], shape [n_field, n_pupil], NaN where no light passes.

    ``spheres`` [n_field, 4] holds the centres of the reference spheres of a radius [m] and the optical paths of the
    chief rays to them [m]. ``progress`` is called with the number of fields of each batch. Light that the first
    apertures stop is traced no further: geometry selects the packets where they are discs or rings, and elsewhere a
    first stage, up to the first aperture, selects those of the second.
    """
    telescope, directions = request.telescope, request.directions
    if telescope.design_data.afocal:
        return _plane_wave_opds(request, np.stack([x, y], axis=-1), progress)
    all_surfaces = pack_surfaces(telescope)
    stages = [all_surfaces]
    stop = next((i for i, s in enumerate(telescope.surfaces) if s.aperture is not None), None)
    if stop is not None and stop + 1 < len(telescope.surfaces):
        stages.insert(0, leading_surfaces(all_surfaces, stop + 1))
    start = object_points(telescope, directions) if np.isfinite(telescope.object_distance) else np.empty((0, 3))
    indices = warp_array(indices_and_wavelength(telescope, request.wavelength)[None])
    # From the centre outwards, so that a central obscuration or a rim stops whole packets.
    order = np.argsort(np.hypot(x, y), kind="stable")
    points = request.entrance_points(request.wavelength, np.stack([x, y], axis=-1)[order])
    shared = to_packets(points.T) if points.ndim == 2 else None
    place = np.full(packet_count(len(order)) * LANES, -1, dtype=np.int32)
    place[: len(order)] = order
    packed_place = warp_array(place.reshape(-1, LANES), lane_flags)
    value = empty((len(directions), x.size))
    value.fill(np.nan)
    # Fields with pupil points of their own are traced one by one.
    step = 1 if shared is None else max(1, _RAYS_AT_ONCE // max(1, x.size))
    for first in range(0, len(value), step):
        batch = slice(first, min(first + step, len(value)))
        pupil = to_packets(points[first].T) if shared is None else shared
        passing = transmitted_packets(telescope, pupil, directions[batch], start[batch])
        lit = np.ones((batch.stop - first) * len(packed_place)) if passing is None else passing.ravel()
        lit = lit.astype(np.int32)
        for surfaces in stages if passing is None else stages[-1:]:
            work = np.flatnonzero(lit).astype(np.int32)
            # Stages before the last one only count the lit lanes.
            filled = value[batch] if surfaces is all_surfaces else value[:0]
            launch(
                trace_opds.variant_for(surfaces),
                len(work),
                [
                    surfaces,
                    indices,
                    warp_array(work, wp.int32),
                    warp_array(pupil, lanes),
                    packed_place,
                    float(telescope.stop_z),
                    float(telescope.launch_distance),
                    warp_array(directions[batch]),
                    warp_array(start[batch]),
                    warp_array(spheres[batch]),
                    radius,
                    ray_packets(),
                    warp_array(filled),
                    warp_array(lit, wp.int32),
                ],
                threads=request.threads,
            )
        if progress is not None:
            progress(batch.stop - first)
    return value


def _plane_wave_opds(request: Request, points: np.ndarray, progress: Callable[[int], None] | None) -> np.ndarray:
    """Return :func:`traced_opds` of an afocal telescope, to planes across its chief rays."""
    value = np.empty((len(request.fields), len(points)))
    for i in range(len(value)):
        bundle = request.at_fields(slice(i, i + 1)).bundles(request.wavelength, points)
        value[i] = np.where(bundle.lit, bundle.opd(np.inf), np.nan)[0]
        if progress is not None:
            progress(1)
    return value
