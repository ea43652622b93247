"""Wavefronts of many field points and their derivatives with respect to parameters, block by block."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ...core.errors import DomainError
from ...core.threads import thread_count
from ...core.units import field_label
from ...raytrace.adjoint.backward_pass import OutputGradient, direction_gradient, position_gradient
from ...raytrace.adjoint.sphere_adjoint import SphereAdjoint
from ...raytrace.rays import RayStatus
from ...wavefront.reference_sphere import require_met
from ...wavefront.request import Request
from .aimed_rays import AimedRays
from .jacobian import ParameterColumns, plane_gradient, sphere_gradient

Result = TypeVar("Result")
#: Rays at once, so that their adjoint matrix stays in the cache of the processor until it is summed.
_RAYS_AT_ONCE = 1 << 13


@dataclass(frozen=True)
class WavefrontBlock:
    """Wavefront of some field points, and the columns of the adjoint matrix for its derivatives.

    The wavefront is the path of the chief ray minus that of the ray, to a sphere about the landing point of the chief
    ray. That point moves with the parameters, so a derivative of the wavefront is
    ``by_center @ moved - columns @ weights + aimed + piston``, summed over three components of the point and columns.

    In `table` stand paths minus those of the chief rays [m], their derivatives with respect to the landing point (3),
    and the columns with weights; 0 where a ray is lost, and with `lit_only` where it is vignetted. `moved` holds the
    derivatives of the centres, `piston` those of the paths of the chief rays, `aimed` what rays change that are aimed
    again at the stop.
    """

    fields: slice
    table: np.ndarray  #: [4 + n_column, n_field, n_pupil]
    status: np.ndarray  #: [n_field, n_pupil] RayStatus
    moved: np.ndarray  #: [n_field, 3, n_parameter]
    piston: np.ndarray  #: [n_field, n_parameter]
    aimed: np.ndarray | None  #: [n_field, n_pupil, n_parameter]; None without ray aiming

    @property
    def value(self) -> np.ndarray:
        """The wavefront [m], shape [n_field, n_pupil]."""
        return -self.table[0]

    @property
    def by_center(self) -> np.ndarray:
        """Derivative of the wavefront with respect to the centre of the sphere, shape [n_field, n_pupil, 3]."""
        return self.table[1:4].transpose(1, 2, 0)

    @property
    def columns(self) -> np.ndarray:
        """Derivatives of the paths, shape [n_field, n_pupil, n_column]."""
        return self.table[4:].transpose(1, 2, 0)

    def change(self, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives without piston, [n_field, n_pupil, n_parameter], from the weights of the columns."""
        change: np.ndarray = self.by_center @ self.moved - self.columns @ weights
        return change if self.aimed is None else change + self.aimed

    def project(self, terms: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums over the rays of terms times wavefront and derivatives, these without piston.

        From terms [n_term, n_pupil] and weights of the columns [n_column, n_parameter] these are sums of the wavefront
        [m], shape [n_field, n_term], and of its derivatives, shape [n_field, n_term, n_parameter].
        """
        # Sums over the rays first, as there are fewer columns than rays; all columns and field points in one product.
        count, n_field, n_pupil = self.table.shape
        sums = (terms @ self.table.reshape(-1, n_pupil).T).reshape(len(terms), count, n_field).transpose(2, 0, 1)
        change = sums[..., 1:4] @ self.moved - sums[..., 4:] @ weights
        return -sums[..., 0], change if self.aimed is None else change + terms @ self.aimed


class FieldWavefronts:
    """Wavefronts of many field points at one wavelength, part by part; with `lit_only`, vignetted rays are zero."""

    def __init__(
        self, columns: ParameterColumns, request: Request, wavelength: float, *, lit_only: bool = False
    ) -> None:
        telescope, fields = columns.telescope, request.fields
        self._columns, self._threads = columns, thread_count(request.threads)
        self._size = (len(fields), len(request.pupil))
        aimed = AimedRays(columns, request, wavelength, np.zeros((1, 2)))
        chief = aimed.forward(threads=1)
        if not chief.arrived.all():
            raise DomainError(f"{field_label(fields[~chief.arrived][0])}: the chief ray does not reach the image")
        self._aimed = AimedRays(columns, request, wavelength, request.pupil.points)
        self._lit_only, self._chief_path = lit_only, chief.path_length
        self._rays: SphereAdjoint | None = None
        if telescope.design_data.afocal:
            # Planes across the chief rays, in place of spheres about their landing points.
            self._references, axes = chief.direction, direction_gradient(chief)
            gradient, self._chief_path, by_along = plane_gradient(chief, chief.direction)
            by_reference = -by_along
        else:
            self._references, axes = chief.position, position_gradient(chief)
            gradient, self._chief_path = sphere_gradient(chief, chief.position, telescope.reference_sphere_radius)
            by_reference = gradient.position[0]
            self._rays = SphereAdjoint(
                telescope,
                request.directions,
                chief.packets.light,
                self._aimed.points,
                chief.position,
                self._chief_path,
                telescope.reference_sphere_radius,
                columns.table,
                columns.intermediate,
                columns.polynomials,
                lit_only=lit_only,
            )
        # Landing points, or directions, and paths together, four outputs.
        zero = np.zeros((3, len(fields)))
        outputs = OutputGradient(
            np.concatenate([axes.position, gradient.position]),
            np.concatenate([axes.direction, gradient.direction]),
            np.append(axes.path, gradient.path),
            index=np.concatenate([zero, gradient.index]),
        )
        derivatives = aimed.derivatives(chief, outputs, threads=1)
        self._moved = derivatives[:3].transpose(1, 0, 2)
        self._piston = derivatives[3] - np.einsum("in,nip->np", by_reference, self._moved)

    def map(self, work: Callable[[WavefrontBlock], Result]) -> list[Result]:
        """Return the results of a function of each block, in the order of the fields; blocks run in parallel."""
        count, step = self._size[0], max(1, _RAYS_AT_ONCE // self._size[1])
        # The same blocks on any number of threads, for the same rounding of sums.
        blocks = -(-count // step)
        bounds = [count * i // blocks for i in range(blocks + 1)]
        parts = [slice(*ends) for ends in pairwise(bounds)]
        if self._threads == 1 or blocks == 1:
            return [work(self.block(field_slice)) for field_slice in parts]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(lambda part: work(self.block(part)), parts))

    def block(self, part: slice) -> WavefrontBlock:
        """Return the block of some of the field points, computed on one thread."""
        if self._rays is None:
            table, status = self._to_planes(part)
        else:
            matrix, status = self._rays.matrix(part, threads=1)
            table = self._columns.of_path(matrix)
            require_met(table[0], status == RayStatus.OK, self._columns.telescope.reference_sphere_radius)
        lost = status > RayStatus.VIGNETTED
        if lost.any():
            table = np.where(lost, 0.0, table)
        return WavefrontBlock(part, table, status, self._moved[part], self._piston[part], self._by_aim(part, status))

    def _to_planes(self, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the table of the block of an afocal telescope, and the status of its rays."""
        aimed = self._aimed.part(self._of_rays(part))
        forward = aimed.forward(threads=1)
        along, chief_path = self._references_of(part), np.repeat(self._chief_path[part], self._size[1])
        gradient, path, by_along = plane_gradient(forward, along)
        columns = self._columns.adjoints(forward, gradient, threads=1)[0]
        # Derivatives by the directions stand with the sign of those by landing points.
        table = np.concatenate([(path - chief_path)[None], -by_along, columns])
        status = forward.status.reshape(-1, self._size[1])
        if self._lit_only:
            table = np.where(forward.status == RayStatus.OK, table, 0.0)
        return table.reshape(-1, *status.shape), status

    def _of_rays(self, part: slice) -> slice:
        return slice(part.start * self._size[1], part.stop * self._size[1])

    def _references_of(self, part: slice) -> np.ndarray:
        """Return the centre of the sphere, or the normal of the plane, of each ray of some fields, shape [3, n]."""
        return np.repeat(self._references[:, part], self._size[1], axis=1)

    def _by_aim(self, part: slice, status: np.ndarray) -> np.ndarray | None:
        """Return the change of wavefronts by the motion of aimed rays, [n_field, n_pupil, n_parameter]."""
        if self._aimed.motion is None:
            return None
        aimed = self._aimed.part(self._of_rays(part))
        assert aimed.motion is not None
        forward = aimed.forward(threads=1)
        if self._rays is None:
            gradient, *_ = plane_gradient(forward, self._references_of(part))
        else:
            radius = self._columns.telescope.reference_sphere_radius
            gradient, _ = sphere_gradient(forward, self._references_of(part), radius)
        by_points = aimed.by_points(forward, gradient, threads=1)[0]
        change = -np.einsum("na,nap->np", by_points, aimed.motion).reshape(*status.shape, -1)
        dark = status > (RayStatus.OK if self._lit_only else RayStatus.VIGNETTED)
        return np.where(dark[..., None], 0.0, change)
