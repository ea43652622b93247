"""Derivatives of what rays end with, exact, by one sweep back through the surfaces.

:func:`sweep` traces rays and remembers every surface; :func:`respond` takes the derivatives of some outputs (landing
points, paths to a sphere: any function of the rays at the last surface) and returns what every surface answers for. All
figures of a telescope act through few columns of each surface: a change of its sag and of the slopes of that, the
indices on both sides, and, for motions, force and torque of the ray on either side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from ...core.errors import DomainError
from ...core.launch import launch
from ...core.warp_arrays import warp_array
from ...models.shapes.mesh import MeshSurface
from ...models.telescope import Telescope
from ..kernels.packet import LANES, lanes
from ..pack.surfaces import pack_surfaces
from ..rays import Rays, RayStatus
from ..trace import PacketTrace, trace_packets
from .adjoint_kernels import COLUMNS, FORCE, HIT, INDEX, SAG
from .gradient_kernels import sweep_back

#: Columns of a surface by name: first column and how many.
_COLUMNS = {
    "sag": (int(SAG), 3),
    "index": (int(INDEX), 2),
    "hit": (int(HIT), 2),
    "gap": (int(FORCE), 6),
}


@dataclass(frozen=True)
class Sweep:
    """Rays traced forward, with all that the way back needs.

    Attributes
    ----------
    telescope : Telescope
        What they went through.
    wavelength : float
        Vacuum wavelength [m].
    count : int
        Number of rays, ``n``.
    packets : PacketTrace
        The rays after every surface.
    """

    telescope: Telescope
    wavelength: float
    count: int
    packets: PacketTrace

    @property
    def indices(self) -> np.ndarray:
        """Refractive index before the first surface and after each, shape [n_surface + 1]."""
        return self.packets.indices

    def _last(self, values: wp.array) -> np.ndarray:
        last = values.numpy()[-1]
        return last.reshape(*last.shape[:-2], -1)[..., : self.count]

    @property
    def position(self) -> np.ndarray:
        """Where the rays meet the last surface [m], telescope frame, shape [3, n]."""
        return self._last(self.packets.position)

    @property
    def direction(self) -> np.ndarray:
        """Unit directions at the last surface, telescope frame, shape [3, n]."""
        return self._last(self.packets.direction)

    @property
    def path(self) -> np.ndarray:
        """Optical path to the last surface [m], shape [n]."""
        return self._last(self.packets.path)

    @property
    def status(self) -> np.ndarray:
        """A :class:`~pachon.raytrace.rays.RayStatus` each, shape [n]."""
        return self._last(self.packets.status)

    @property
    def arrived(self) -> np.ndarray:
        """Rays that reached the last surface, vignetted ones too, shape [n] bool."""
        return self.status <= RayStatus.VIGNETTED

    @property
    def landing(self) -> np.ndarray:
        """Where the rays meet the last surface, in its own frame [m], shape [3, n]."""
        last = self.telescope.surfaces[-1]
        return last.matrix.T @ (self.position - np.array(last.vertex)[:, None])


def check_differentiable(telescope: Telescope) -> None:
    """Raise DomainError if a surface is a mesh: facets have no curvature that slopes of rays could follow from."""
    for surface in telescope.surfaces:
        if isinstance(surface.shape, MeshSurface):
            raise DomainError(f"surface {surface.name}: expected a shape that can be differentiated, not a mesh")


def sweep(telescope: Telescope, rays: Rays, *, threads: int | None = None) -> Sweep:
    """Trace rays and remember them at every surface.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    rays : Rays
        Rays of one wavelength.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    DomainError
        If the telescope does not cover the wavelength, or a surface is a mesh.
    """
    check_differentiable(telescope)
    packets = trace_packets(telescope, rays, len(telescope.surfaces), threads=threads)
    return Sweep(telescope, rays.wavelength, len(rays), packets)


@dataclass(frozen=True)
class Seeds:
    """Derivatives of outputs with respect to the rays at the last surface.

    Attributes
    ----------
    position, direction : ndarray, shape [n_output, 3, n]
        With respect to position [1/m] and direction of each ray, telescope frame; the direction taken as a free vector.
    path : ndarray, shape [n_output]
        With respect to the optical path: 1 or 0.
    index : ndarray, shape [n_output, n], optional
        With respect to the refractive index before the last surface, where an output depends on that directly.
    own_frame : bool
        Whether the outputs are x and y in the frame of the last surface, which then moves with it.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    index: np.ndarray | None = None
    own_frame: bool = False


def landing_seeds(swept: Sweep) -> Seeds:
    """Return the seeds of the landing x and y in the frame of the last surface: two outputs [m]."""
    axes = swept.telescope.surfaces[-1].matrix[:, :2].T
    position = np.broadcast_to(axes[:, :, None], (2, 3, swept.count))
    return Seeds(position, np.zeros_like(position), np.zeros(2), own_frame=True)


def position_seeds(swept: Sweep) -> Seeds:
    """Return the seeds of the landing point in the telescope frame: three outputs [m]."""
    position = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, swept.count))
    return Seeds(position, np.zeros_like(position), np.zeros(3))


@dataclass(frozen=True)
class SurfaceResponse:
    """What each surface does to each output of each ray, to first order.

    Attributes
    ----------
    rows : ndarray of int, shape [n_surface + 1, 13]
        In which row of ``values`` a column of a surface stands; -1 where it was not asked for.
    values : ndarray, shape [n_output, n_row, n]
        The columns.
    start : ndarray, shape [n_output, 6, n], or None
        Derivatives with respect to position [1/m] and direction of the ray at its start, telescope frame.
    """

    rows: np.ndarray
    values: np.ndarray
    start: np.ndarray | None = None

    def _columns(self, surface: int, name: str) -> np.ndarray:
        first, count = _COLUMNS[name]
        rows = self.rows[surface, first : first + count]
        assert (rows >= 0).all(), f"column {name!r} of surface {surface} was not asked for"
        return self.values[:, rows[0] : rows[0] + count]

    def sag(self, surface: int) -> np.ndarray:
        """Response to a change of the sag [per m] and of its slopes along x and y at the hit, [n_output, 3, n]."""
        return self._columns(surface, "sag")

    def gap(self, gap: int) -> np.ndarray:
        """Force and torque in the gap in front of a surface, [n_output, 6, n]; the last gap is behind the last one."""
        return self._columns(gap, "gap")

    def motion(self, surface: int) -> np.ndarray:
        """Response to a motion of the surface, shape [n_output, 6, n].

        A point r of it moves by ``v + w x r``, in the telescope frame: the first three are per unit of v [m], the
        others per unit of w [rad].
        """
        return self.gap(surface + 1) - self.gap(surface)

    def index(self, surface: int) -> np.ndarray:
        """Response to the refractive index before and after the surface, shape [n_output, 2, n]."""
        return self._columns(surface, "index")

    def hit(self, surface: int) -> np.ndarray:
        """Where the rays meet the surface, in its own x and y [m], shape [2, n]."""
        return self._columns(surface, "hit")[0]


def columns(telescope: Telescope, wanted: Iterable[tuple[int, str]] | None = None, first: int = 0) -> np.ndarray:
    """Return the table of rows for the wanted columns, shape [n_surface + 1, 13]; for all of them by default.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    wanted : iterable of (surface, name), optional
        Index of a surface and "sag", "index", "hit", or "gap" for the gap in front of it; the gap behind the last
        surface belongs to the index after that.
    first : int
        Number of the first row.
    """
    count = len(telescope.surfaces)
    if wanted is None:
        every = [(s, name) for s in range(count) for name in _COLUMNS]
        wanted = [*every, (count, "gap")]
    rows = np.full((count + 1, COLUMNS), -1, dtype=np.int32)
    row = first
    for surface, name in sorted(set(wanted)):
        start, width = _COLUMNS[name]
        rows[surface, start : start + width] = range(row, row + width)
        row += width
    return rows


def polynomial_terms(degree: int) -> list[tuple[int, int, bool]]:
    """Return m, k and "is it the imaginary part" of the sags ``s^k (x + i y)^m``, ``m + 2 k <= degree``, in order."""
    return [
        (m, k, part)
        for m in range(degree + 1)
        for k in range((degree - m) // 2 + 1)
        for part in (False, True)[: 1 + (m > 0)]
    ]


Polynomials = Sequence[tuple[int, float, int, np.ndarray]]


def respond(
    swept: Sweep,
    seeds: Seeds,
    rows: np.ndarray | None = None,
    *,
    polynomials: Polynomials = (),
    start: bool = False,
    threads: int | None = None,
) -> SurfaceResponse:
    """Carry derivatives at the last surface back through all of them.

    Parameters
    ----------
    swept : Sweep
        The rays, traced forward.
    seeds : Seeds
        Derivatives of the outputs with respect to the rays at the last surface.
    rows : ndarray of int, shape [n_surface + 1, 13], optional
        Columns wanted, from :func:`columns`; all by default.
    polynomials : sequence of (surface, scale, degree, rows)
        Surfaces whose response to polynomial sags is wanted too: the row of each that :func:`polynomial_terms` lists,
        -1 where it is not wanted, with x and y in units of ``scale`` [m]. Their "sag" and "hit" must be among the
        columns.
    start : bool
        Whether to keep the derivatives with respect to the start of the rays.
    threads : int, optional
        Number of threads; all processors by default.

    Returns
    -------
    SurfaceResponse
    """
    packets, packed = swept.packets, pack_surfaces(swept.telescope)
    outputs, count = len(seeds.path), packets.start.shape[1]
    rows = columns(swept.telescope) if rows is None else rows
    response = wp.empty((outputs, row_count(rows, polynomials), count), dtype=lanes, device="cpu")
    first = wp.empty((outputs if start else 0, 6, count), dtype=lanes, device="cpu")
    launch(
        sweep_back.suited(packed),
        outputs * count,
        [
            packed,
            warp_array(swept.indices),
            count,
            packets.start,
            packets.start_direction,
            packets.position,
            packets.direction,
            _seed_packets(seeds.position, count),
            _seed_packets(seeds.direction, count),
            warp_array(seeds.path),
            warp_array(rows, wp.int32),
            *polynomial_tables(rows, polynomials),
            response,
            first,
        ],
        threads=threads,
    )
    values = as_rays(response, swept.count)
    if seeds.index is not None and rows[-2, INDEX] >= 0:
        values[:, rows[-2, INDEX]] += seeds.index
    if seeds.own_frame and rows[-1, FORCE] >= 0:
        # Behind the last surface the light is seen from that surface: what moves it along moves nothing.
        values[:, rows[-1, FORCE:]] = 0.0
    return SurfaceResponse(rows, values, as_rays(first, swept.count) if start else None)


def row_count(rows: np.ndarray, polynomials: Polynomials) -> int:
    """Return how many rows columns and polynomials take."""
    return 1 + max([int(rows.max()), *(int(own.max()) for *_, own in polynomials)])


def polynomial_tables(rows: np.ndarray, polynomials: Polynomials) -> tuple[wp.array, wp.array]:
    """Return the tables of polynomials as the kernels read them: degree and rows, and the scales."""
    table = np.full((max(len(polynomials), 1), 3 + max([0, *(len(own) for *_, own in polynomials)])), -1)
    for j, (surface, _, degree, own) in enumerate(polynomials):
        table[j, :3] = degree, rows[surface, SAG], rows[surface, HIT]
        table[j, 3 : 3 + len(own)] = own
    scales = np.array([scale for _, scale, *_ in polynomials], dtype=np.float64)
    return warp_array(table, wp.int32), warp_array(scales)


def as_rays(values: wp.array, n: int) -> np.ndarray:
    """Return packets [n_output, n_row, n_packet] as rays, shape [n_output, n_row, n]."""
    outputs, rows, count = values.shape
    return values.numpy().reshape(outputs, rows, count * LANES)[:, :, :n]


def _seed_packets(values: np.ndarray, count: int) -> wp.array:
    """Return seeds [n_output, 3, n] as packets, the last one filled up with zeros."""
    padded = np.zeros((*values.shape[:2], count * LANES))
    padded[:, :, : values.shape[2]] = values
    return warp_array(padded.reshape(*values.shape[:2], count, LANES), lanes)
