"""Optical paths to reference spheres and their derivatives, the forward sweep and the way back in one go."""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.threads import thread_count
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ..kernels.packet import LANES, lane_flags, lanes, to_packets
from ..pack.surfaces import pack_surfaces
from .gradient import Polynomials, SurfaceResponse, check_differentiable, polynomial_tables, row_count
from .sphere_sweep_kernels import SPHERE_ROWS, sweep_sphere


class SphereSweep:
    """Rays of several field points to their reference spheres, and the derivatives of their optical path.

    What :func:`~.sweep` and :func:`~pachon.raytrace.adjoint.gradient.respond` do in two, but the rays
    never leave the processor's cache. All that field points share is made ready once.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    directions : ndarray, shape [n_field, 3]
        Unit vectors in which the light of each field point travels.
    indices : ndarray, shape [n_surface + 1]
        Refractive index before the first surface and after each.
    pupil : ndarray, shape [n_pupil, 2]
        Entrance-pupil coordinates [m].
    center : ndarray, shape [3, n_field]
        Centre of each sphere [m], telescope frame.
    path : ndarray, shape [n_field]
        Optical path [m] that is subtracted from those of the rays: the chief ray's.
    radius : float
        Radius of the spheres [m].
    rows : ndarray of int, shape [n_surface + 1, 13]
        Columns wanted, from :func:`~pachon.raytrace.adjoint.gradient.columns`, which leave out four rows.
    sphere_row : int
        The first of these: the path less `path` [m] and its derivatives with respect to the landing point, which are
        opposite to those with respect to the centre.
    polynomials : sequence of (surface, scale, degree, rows)
        As in :func:`~pachon.raytrace.adjoint.gradient.respond`.
    lit_only : bool
        Whether all is zero for rays that are vignetted.

    Raises
    ------
    DomainError
        If a surface is a mesh.
    """

    def __init__(
        self,
        telescope: Telescope,
        directions: np.ndarray,
        indices: np.ndarray,
        pupil: np.ndarray,
        center: np.ndarray,
        path: np.ndarray,
        radius: float,
        rows: np.ndarray,
        sphere_row: int,
        polynomials: Polynomials = (),
        *,
        lit_only: bool = False,
    ) -> None:
        check_differentiable(telescope)
        self._rows, self._surfaces, self._n_pupil = rows, len(telescope.surfaces), len(pupil)
        self._n_rows = max(sphere_row + SPHERE_ROWS, row_count(rows, polynomials))
        points = to_packets(pupil.T)
        self._n_packets = points.shape[1]
        self._inputs = [
            pack_surfaces(telescope),
            warp_array(indices[None]),
            warp_array(indices),
            warp_array(np.column_stack([directions, center.T, path])),
            warp_array(points, lanes),
            float(telescope.stop_z),
            float(telescope.launch_distance),
            float(radius),
            warp_array(rows, wp.int32),
            *polynomial_tables(rows, polynomials),
            sphere_row,
            int(lit_only),
        ]

    def respond(self, fields: slice, *, threads: int | None = None) -> tuple[SurfaceResponse, np.ndarray]:
        """Trace the rays of some of the field points and carry the derivatives back.

        Parameters
        ----------
        fields : slice
            Which field points; start and stop are given.
        threads : int, optional
            Number of threads; all processors by default.

        Returns
        -------
        response : SurfaceResponse
            One output; the axis of rays is two, [n_field, n_pupil].
        status : ndarray of int32, shape [n_field, n_pupil]
            A :class:`~pachon.raytrace.rays.RayStatus` each.
        """
        n_fields = fields.stop - fields.start
        count = n_fields * self._n_packets
        # As many parts as threads: each thread keeps the rays of one packet at all surfaces, not more.
        parts = min(thread_count(threads), max(count, 1))
        response = wp.empty((1, self._n_rows, count), dtype=lanes, device="cpu")
        status = wp.empty(count, dtype=lane_flags, device="cpu")
        launch(
            sweep_sphere.suited(self._inputs[0]),
            parts,
            [
                *self._inputs,
                fields.start,
                parts,
                *(wp.empty((3, parts), dtype=lanes, device="cpu") for _ in range(2)),
                *(wp.empty((self._surfaces, 3, parts), dtype=lanes, device="cpu") for _ in range(2)),
                wp.empty((self._surfaces, parts), dtype=lanes, device="cpu"),
                wp.empty((self._surfaces, parts), dtype=lane_flags, device="cpu"),
                response,
                status,
            ],
            threads=threads,
        )

        def as_rays(values: wp.array) -> np.ndarray:
            return values.numpy().reshape(*values.shape[:-1], n_fields, self._n_packets * LANES)[..., : self._n_pupil]

        return SurfaceResponse(self._rows, as_rays(response)), as_rays(status)
