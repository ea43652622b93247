"""Optical paths to reference spheres and their derivatives, forward and backward pass in one kernel."""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.threads import thread_count
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ..kernels.packet import LANES, lane_flags, lanes, ray_packets, to_packets
from ..pack.surfaces import pack_surfaces
from ..rays import object_points
from .adjoint_matrix import AdjointMatrix, Polynomials, column_count, polynomial_tables
from .forward_pass import check_differentiable
from .sphere_kernels import SPHERE_COLUMNS, sphere_paths


class SphereAdjoint:
    """Optical paths of several field points to their reference spheres, and their derivatives.

    Equal to :func:`~pachon.raytrace.adjoint.forward_pass.forward_pass` followed by
    :func:`~pachon.raytrace.adjoint.backward_pass.backward_pass`, but the rays stay in the processor's cache.

    ``directions`` [n_field, 3] are unit vectors of the light's travel, ``light`` [n_surface + 2] the refractive index
    before the first surface and after each, and the wavelength [m], ``pupil`` entrance-pupil coordinates [m],
    [n_pupil, 2] or by field point, [n_field, n_pupil, 2]. The spheres have one ``radius`` [m] and a ``center`` each
    [m], [3, n_field], telescope frame; ``path`` [n_field] is the optical path [m] of the chief ray to the sphere, which
    is subtracted. ``columns`` and ``polynomials`` are as in `backward_pass`, with four columns left free from
    ``sphere_column`` on: the path less ``path`` [m], and its derivatives with respect to the landing point, which are
    opposite to those with respect to the centre. With ``lit_only`` all is zero for vignetted rays. A mesh among the
    surfaces is a DomainError.
    """

    def __init__(
        self,
        telescope: Telescope,
        directions: np.ndarray,
        light: np.ndarray,
        pupil: np.ndarray,
        center: np.ndarray,
        path: np.ndarray,
        radius: float,
        columns: np.ndarray,
        sphere_column: int,
        polynomials: Polynomials = (),
        *,
        lit_only: bool = False,
    ) -> None:
        check_differentiable(telescope)
        self._columns, self._n_surface, self._n_pupil = columns, len(telescope.surfaces), pupil.shape[-2]
        self._n_columns = max(sphere_column + SPHERE_COLUMNS, column_count(columns, polynomials))
        points = np.stack([to_packets(pupil_set.T) for pupil_set in (pupil if pupil.ndim == 3 else pupil[None])])
        self._n_packets = points.shape[2]
        distant = not np.isfinite(telescope.object_distance)
        self._inputs = [
            pack_surfaces(telescope),
            warp_array(light[None]),
            warp_array(light),
            warp_array(np.column_stack([directions, center.T, path])),
            warp_array(np.empty((0, 3)) if distant else object_points(telescope, directions)),
            warp_array(points, lanes),
            float(telescope.stop_z),
            float(telescope.launch_distance),
            float(radius),
            warp_array(columns, wp.int32),
            *polynomial_tables(columns, polynomials),
            sphere_column,
            int(lit_only),
        ]

    def matrix(self, fields: slice, *, threads: int | None = None) -> tuple[AdjointMatrix, np.ndarray]:
        """Return the adjoint matrix of the paths of some field points, and the status of their rays.

        The slice has a start and a stop. The matrix has one output; its axis of rays is two, [n_field, n_pupil], which
        is also the shape of the statuses (:class:`~pachon.raytrace.rays.RayStatus`, int32).
        """
        n_fields = fields.stop - fields.start
        count = n_fields * self._n_packets
        # As many parts as threads: each thread stores the rays of one packet at all surfaces, not more.
        parts = min(thread_count(threads), max(count, 1))
        matrix = wp.empty((1, self._n_columns, count), dtype=lanes, device="cpu")
        status = wp.empty(count, dtype=lane_flags, device="cpu")
        rays = ray_packets(1, parts), ray_packets(self._n_surface, parts)
        inputs = [*self._inputs, fields.start, parts, *rays, matrix, status]
        launch(sphere_paths.variant_for(self._inputs[0]), parts, inputs, threads=threads)

        def as_rays(values: wp.array) -> np.ndarray:
            return values.numpy().reshape(*values.shape[:-1], n_fields, self._n_packets * LANES)[..., : self._n_pupil]

        return AdjointMatrix(self._columns, as_rays(matrix)), as_rays(status)
