"""Repeated traces of few rays, as in a search for their landing points."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.launch import launch, load_kernels
from ..core.warp_arrays import warp_array
from ..models.telescope import Telescope
from .kernels.packet import LANES, RayPackets, from_packets, lanes, packet_count, ray_packets
from .kernels.trace import trace_rays
from .pack.surfaces import indices_and_wavelength, leading_surfaces, pack_surfaces
from .rays import Rays

#: Rays that several threads trace faster than one.
_MANY = 4096


class RepeatedTrace:
    """Trace of rays of one wavelength [m] to one surface of a telescope, by its index; arrays are made once.

    Of few rays, making them costs twenty times what the rays do. The arrays are those of the object: no two threads may
    use it at once.
    """

    def __init__(self, telescope: Telescope, wavelength: float, surface: int) -> None:
        self._packed = leading_surfaces(pack_surfaces(telescope), surface + 1)
        self._indices = warp_array(indices_and_wavelength(telescope, wavelength)[None])
        self._kernel = trace_rays.variant_for(self._packed)
        load_kernels(self._kernel)
        self._room = 0

    def positions(self, rays: Rays) -> np.ndarray:
        """Return where rays meet the surface [m], telescope frame, shape [n, 3]; NaN where they do not."""
        n = len(rays)
        packets = packet_count(n)
        if packets > self._room:
            # Searches trace twice as many rays for derivatives.
            self._allocate(2 * packets)
        if n == 0:
            return np.empty((0, 3))
        self._position[:, :n], self._direction[:, :n] = rays.position.T, rays.direction.T
        if n > _MANY:
            launch(self._kernel, packets, [self._packed, self._indices, *self._ends])
        else:
            self._launch.set_dim(packets)
            self._launch.launch()
        return self._landing[:, :n].T.copy()

    def _allocate(self, packets: int) -> None:
        """Make arrays and launch for a number of packets; lanes without a ray hold any."""
        self._room = packets
        start: Any = RayPackets()
        end = ray_packets(1, packets)
        # Warp arrays do not keep the memory alive that they are made of.
        self._memory = position, direction, path = (
            np.zeros((1, 3, packets, LANES)),
            np.zeros((1, 3, packets, LANES)),
            np.zeros((1, packets, LANES)),
        )
        start.position, start.direction = warp_array(position, lanes), warp_array(direction, lanes)
        start.path = warp_array(path, lanes)
        self._position, self._direction = position.reshape(3, -1), direction.reshape(3, -1)
        self._ends = start, end
        inputs = [0, self._packed, self._indices, start, end]
        self._launch = wp.launch(self._kernel, dim=packets, inputs=inputs, device="cpu", record_cmd=True)
        self._landing = from_packets(end.position, packets * LANES)[0]
