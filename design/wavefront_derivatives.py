"""The wavefront of many field points and what parameters do to it, block by block."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ..models.errors import DomainError
from ..raytrace.gradient import position_seeds, sweep
from ..raytrace.launch import thread_count
from ..raytrace.rays import RayStatus, field_direction, parallel_rays
from .jacobian import ParameterColumns, sphere_seeds

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
    value : ndarray, shape [n_field, n_pupil]
        The wavefront [m], of vignetted rays too; 0 where a ray gets lost.
    status : ndarray of int32, shape [n_field, n_pupil]
        A :class:`~pachon.raytrace.rays.RayStatus` each.
    by_center : ndarray, shape [n_field, n_pupil, 3]
        Derivative of the wavefront with respect to the centre of the sphere.
    rows : ndarray, shape [n_field, n_pupil, n_row]
        Derivatives of the paths, row by row of the columns.
    moved : ndarray, shape [n_field, 3, n_parameter]
        How the centres move.
    piston : ndarray, shape [n_field, n_parameter]
        Derivative of the chief ray's path.
    """

    fields: slice
    value: np.ndarray
    status: np.ndarray
    by_center: np.ndarray
    rows: np.ndarray
    moved: np.ndarray
    piston: np.ndarray


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
    ) -> None:
        telescope = columns.telescope
        self._columns, self._wavelength, self._pupil, self._threads = columns, wavelength, pupil, thread_count(threads)
        self._light = field_direction(fields[:, 0], fields[:, 1], projection)
        chief = sweep(telescope, parallel_rays(telescope, self._light, wavelength, np.zeros((1, 2))), threads=1)
        if not chief.arrived.all():
            x, y = np.rad2deg(fields[~chief.arrived][0])
            raise DomainError(f"field = ({x:.6g}, {y:.6g}) deg: the chief ray does not reach the image")
        self._centers = chief.position
        seeds, self._zero = sphere_seeds(chief, self._centers, telescope.reference_sphere_radius)
        self._moved = columns.derivatives(chief, position_seeds(chief), threads=1).transpose(1, 0, 2)
        along = np.einsum("in,nip->np", seeds.position[0], self._moved)
        self._piston = columns.derivatives(chief, seeds, threads=1)[0] - along

    def map(self, work: Callable[[WavefrontBlock], Result]) -> list[Result]:
        """Return what a function makes of each block, in the order of the fields; blocks are worked on side by side."""
        count, step = len(self._light), max(1, _RAYS_AT_ONCE // len(self._pupil))
        # Each thread has a block; what is in it does not depend on where the blocks begin.
        blocks = max(-(-count // step), min(self._threads, count))
        bounds = [count * i // blocks for i in range(blocks + 1)]
        parts = [slice(*ends) for ends in pairwise(bounds)]
        # The first one alone compiles the kernels.
        first = [work(self.block(parts[0]))]
        if self._threads == 1 or blocks == 1:
            return first + [work(self.block(part)) for part in parts[1:]]
        with ThreadPoolExecutor(self._threads) as pool:
            return first + list(pool.map(lambda part: work(self.block(part)), parts[1:]))

    def block(self, part: slice) -> WavefrontBlock:
        """Return the block of some of the field points, worked out on one thread."""
        telescope, count = self._columns.telescope, len(self._pupil)
        rays = parallel_rays(telescope, self._light[part], self._wavelength, self._pupil)
        spheres, zeros = (np.repeat(v[..., part], count, axis=-1) for v in (self._centers, self._zero))
        radius = telescope.reference_sphere_radius
        rows, status = self._columns.to_sphere(rays, spheres, zeros, radius, threads=1)
        lost = status > RayStatus.VIGNETTED
        if lost.any():
            rows = np.where(lost, 0.0, rows)
        rows = rows.reshape(len(rows), -1, count).transpose(1, 2, 0)
        return WavefrontBlock(
            part,
            -rows[..., 0],
            status.reshape(-1, count),
            rows[..., 1:4],
            rows[..., 4:],
            self._moved[part],
            self._piston[part],
        )
