"""Forward pass: rays traced to every surface of a telescope, as the backward pass needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ...core.errors import DomainError
from ...models.shapes.mesh import MeshSurface
from ...models.telescope import Telescope
from ..ideal_lens import tangents
from ..kernels.packet import from_packets
from ..rays import Rays, RayStatus
from ..trace import PacketTrace, trace_packets


@dataclass(frozen=True)
class ForwardPass:
    """Rays at every surface of a telescope."""

    telescope: Telescope
    wavelength: float  #: vacuum wavelength [m]
    n_rays: int  #: number of rays, ``n``
    packets: PacketTrace  #: the rays before the first surface and after each

    @property
    def indices(self) -> np.ndarray:
        """Refractive index before the first surface and after each, shape [n_surface + 1]."""
        return self.packets.light[:-1]

    def _last(self, values: wp.array) -> np.ndarray:
        return from_packets(values, self.n_rays)[-1]

    @property
    def position(self) -> np.ndarray:
        """Intersections with the last surface [m], telescope frame, shape [3, n]."""
        return self._last(self.packets.end.position)

    @property
    def direction(self) -> np.ndarray:
        """Unit directions at the last surface, telescope frame, shape [3, n]."""
        return self._last(self.packets.end.direction)

    @property
    def path_length(self) -> np.ndarray:
        """Optical path to the last surface [m], shape [n]."""
        return self._last(self.packets.end.path)

    @property
    def status(self) -> np.ndarray:
        """A :class:`~pachon.raytrace.rays.RayStatus` each, shape [n]."""
        return self._last(self.packets.end.status)

    @property
    def arrived(self) -> np.ndarray:
        """Rays that reached the last surface, vignetted ones too, shape [n] bool."""
        return self.status <= RayStatus.VIGNETTED

    @property
    def landing(self) -> np.ndarray:
        """Intersections with the last surface in its own frame [m], shape [3, n]."""
        last = self.telescope.surfaces[-1]
        return last.matrix.T @ (self.position - np.array(last.vertex)[:, None])

    @property
    def image(self) -> np.ndarray:
        """Image x and y in the frame of the last surface [m], shape [2, n]: landing points, or tangents if afocal."""
        if not self.telescope.design_data.afocal:
            return self.landing[:2]
        return tangents(self.telescope.surfaces[-1].along(self.direction.T)).T


def check_differentiable(telescope: Telescope) -> None:
    """Raise DomainError if a surface is a mesh, whose facets have no curvature."""
    for surface in telescope.surfaces:
        if isinstance(surface.shape, MeshSurface):
            raise DomainError(f"surface {surface.name}: expected a shape that can be differentiated, not a mesh")


def forward_pass(telescope: Telescope, rays: Rays, *, threads: int | None = None) -> ForwardPass:
    """Trace rays and store them at every surface; a wavelength not covered, or a mesh, is a DomainError."""
    check_differentiable(telescope)
    packets = trace_packets(telescope, rays, len(telescope.surfaces), threads=threads)
    return ForwardPass(telescope, rays.wavelength, len(rays), packets)
