"""Optical path differences of many field points, traced in packets without keeping rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.launch import launch
from ..core.warp_arrays import warp_array
from ..models.telescope import Telescope
from ..raytrace.kernels.packet import LANES, lane_flags, lanes, packet_count, ray_packets, to_packets
from ..raytrace.kernels.trace import PackedSurfaces
from ..raytrace.pack.surfaces import leading_surfaces, pack_surfaces, refractive_indices
from ..raytrace.rays import object_points
from .opd_kernels import trace_opds


@dataclass(frozen=True)
class OpdTracer:
    """Inputs that all batches of field points share: the telescope, up to its first aperture and whole, and the pupil.

    Light that the first aperture stops is traced no further: a first stage up to it selects the packets of the second.
    """

    telescope: Telescope
    stages: tuple[PackedSurfaces, ...]
    indices: wp.array
    pupil: wp.array
    place: wp.array
    radius: float

    @classmethod
    def of(cls, telescope: Telescope, wavelength: float, x: np.ndarray, y: np.ndarray, radius: float) -> OpdTracer:
        """Prepare pupil points x, y [n_pupil] [m] and reference spheres of a radius [m]."""
        whole = pack_surfaces(telescope)
        stages: tuple[PackedSurfaces, ...] = (whole,)
        stop = next((i for i, s in enumerate(telescope.surfaces) if s.aperture is not None), None)
        if stop is not None and stop + 1 < len(telescope.surfaces):
            stages = (leading_surfaces(whole, stop + 1), whole)
        # From the centre outwards, so that a central obscuration or a rim stops whole packets.
        order = np.argsort(np.hypot(x, y), kind="stable")
        place = np.full(packet_count(len(order)) * LANES, -1, dtype=np.int32)
        place[: len(order)] = order
        return cls(
            telescope,
            stages,
            warp_array(refractive_indices(telescope, wavelength)[None]),
            warp_array(to_packets(np.stack([x[order], y[order]])), lanes),
            warp_array(place.reshape(-1, LANES), lane_flags),
            radius,
        )

    def trace(self, directions: np.ndarray, spheres: np.ndarray, value: np.ndarray, threads: int | None) -> None:
        """Fill the maps [n_field, n_pupil] of some fields; ``spheres`` holds centres and chief paths [n_field, 4]."""
        telescope = self.telescope
        start = np.empty((0, 3))
        if np.isfinite(telescope.object_distance):
            start = object_points(telescope, directions)
        lit = np.ones(len(directions) * len(self.place), dtype=np.int32)
        # The first stage counts the lit lanes only.
        for surfaces, filled in zip(self.stages, [value[:0], value][-len(self.stages) :], strict=True):
            work = np.flatnonzero(lit).astype(np.int32)
            launch(
                trace_opds.suited(surfaces),
                len(work),
                [
                    surfaces,
                    self.indices,
                    warp_array(work, wp.int32),
                    self.pupil,
                    self.place,
                    float(telescope.stop_z),
                    float(telescope.launch_distance),
                    warp_array(directions),
                    warp_array(start),
                    warp_array(spheres),
                    self.radius,
                    ray_packets(),
                    warp_array(filled),
                    warp_array(lit, wp.int32),
                ],
                threads=threads,
            )
