"""The wavefront of many field points and what parameters do to it, block by block."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ...core.errors import DomainError
from ...core.threads import thread_count
from ...raytrace.adjoint.backward_pass import OutputGradient, position_gradient
from ...raytrace.adjoint.forward_pass import forward_pass
from ...raytrace.rays import RayStatus, field_direction, parallel_rays
from .jacobian import ParameterColumns, sphere_gradient

Result = TypeVar("Result")
#: Rays at once: what their sweep back leaves should stay in the processor's cache until it is summed up.
_RAYS_AT_ONCE = 1 << 13


@dataclass(frozen=True)
class WavefrontBlock:
    """The wavefront of some field points, and the rows that its derivatives are made of.

    The wavefront is the path of the chief ray less that of the ray, to a sphere about where the chief ray lands. That
    point moves with the parameters; so a derivative of the wavefront is
    ``by_center @ moved - rows @ weights + piston``, summed over three components of the point and over rows.

    Attributes
    ----------
    fields : slice
        Which of the field points.
    table : ndarray, shape [4 + n_row, n_field, n_pupil]
        The paths less those of the chief rays [m], their derivatives with respect to the landing point (3), and the
        rows that have weights; all 0 where a ray gets lost, and where it is vignetted if only lit ones were asked for.
    status : ndarray of int32, shape [n_field, n_pupil]
        A :class:`~pachon.raytrace.rays.RayStatus` each.
    moved : ndarray, shape [n_field, 3, n_parameter]
        How the centres move.
    piston : ndarray, shape [n_field, n_parameter]
        Derivative of the chief ray's path.
    """

    fields: slice
    table: np.ndarray
    status: np.ndarray
    moved: np.ndarray
    piston: np.ndarray

    @property
    def value(self) -> np.ndarray:
        """The wavefront [m], shape [n_field, n_pupil]."""
        return -self.table[0]

    @property
    def by_center(self) -> np.ndarray:
        """Derivative of the wavefront with respect to the centre of the sphere, shape [n_field, n_pupil, 3]."""
        return self.table[1:4].transpose(1, 2, 0)

    @property
    def rows(self) -> np.ndarray:
        """Derivatives of the paths, row by row of the columns, shape [n_field, n_pupil, n_row]."""
        return self.table[4:].transpose(1, 2, 0)

    def project(self, terms: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums over the rays, times each of some terms, of wavefront and derivatives, these without piston.

        Parameters
        ----------
        terms : ndarray, shape [n_term, n_pupil]
            What the rays count.
        weights : ndarray, shape [n_row, n_parameter]
            Those of the columns.

        Returns
        -------
        value : ndarray, shape [n_field, n_term]
            Sums of the wavefront [m].
        change : ndarray, shape [n_field, n_term, n_parameter]
            Sums of its derivatives.
        """
        # The rays are summed up first, there are fewer rows than rays; all rows and field points in one product.
        count, n_field, n_pupil = self.table.shape
        sums = (terms @ self.table.reshape(-1, n_pupil).T).reshape(len(terms), count, n_field).transpose(2, 0, 1)
        return -sums[..., 0], sums[..., 1:4] @ self.moved - sums[..., 4:] @ weights


class FieldWavefronts:
    """The wavefronts of many field points at one wavelength, ready to be computed part by part.

    Parameters
    ----------
    columns : ParameterColumns
        The telescope and its parameters.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    pupil : ndarray, shape [n_pupil, 2]
        Entrance-pupil coordinates [m].
    projection : str
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.
    lit_only : bool
        Whether vignetted rays are left out, as zeros.

    Raises
    ------
    DomainError
        If a chief ray does not reach the image.
    """

    def __init__(
        self,
        columns: ParameterColumns,
        fields: np.ndarray,
        wavelength: float,
        pupil: np.ndarray,
        projection: str = "zemax",
        threads: int | None = None,
        *,
        lit_only: bool = False,
    ) -> None:
        telescope = columns.telescope
        self._columns, self._threads, self._size = columns, thread_count(threads), (len(fields), len(pupil))
        light = field_direction(fields[:, 0], fields[:, 1], projection)
        chief = forward_pass(telescope, parallel_rays(telescope, light, wavelength, np.zeros((1, 2))), threads=1)
        if not chief.arrived.all():
            x, y = np.rad2deg(fields[~chief.arrived][0])
            raise DomainError(f"field = ({x:.6g}, {y:.6g}) deg: the chief ray does not reach the image")
        gradient, path = sphere_gradient(chief, chief.position, telescope.reference_sphere_radius)
        self._rays = columns.to_spheres(light, chief.indices, pupil, chief.position, path, lit_only=lit_only)
        # Landing points and paths together, four outputs.
        axes, zero = position_gradient(chief), np.zeros((3, len(fields)))
        both = OutputGradient(
            np.concatenate([axes.position, gradient.position]),
            np.concatenate([axes.direction, gradient.direction]),
            np.append(axes.path, gradient.path),
            index=np.concatenate([zero, gradient.index]),
        )
        derivatives = columns.derivatives(chief, both, threads=1)
        self._moved = derivatives[:3].transpose(1, 0, 2)
        self._piston = derivatives[3] - np.einsum("in,nip->np", gradient.position[0], self._moved)

    def map(self, work: Callable[[WavefrontBlock], Result]) -> list[Result]:
        """Return what a function makes of each block, in the order of the fields; blocks are worked on side by side."""
        count, step = self._size[0], max(1, _RAYS_AT_ONCE // self._size[1])
        # The same blocks on any number of threads, so that sums are rounded the same way.
        blocks = -(-count // step)
        bounds = [count * i // blocks for i in range(blocks + 1)]
        parts = [slice(*ends) for ends in pairwise(bounds)]
        if self._threads == 1 or blocks == 1:
            return [work(self.block(part)) for part in parts]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(lambda part: work(self.block(part)), parts))

    def block(self, part: slice) -> WavefrontBlock:
        """Return the block of some of the field points, worked out on one thread."""
        response, status = self._rays.matrix(part, threads=1)
        table = self._columns.of_path(response)
        lost = status > RayStatus.VIGNETTED
        if lost.any():
            table = np.where(lost, 0.0, table)
        return WavefrontBlock(part, table, status, self._moved[part], self._piston[part])
