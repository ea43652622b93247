"""Trace rays through a telescope, to its last surface or to every one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError
from ..core.launch import launch
from ..core.number_text import counted
from ..core.plotting import BLUE, axes_at, plain_text, styled
from ..core.result import Result
from ..core.threads import thread_count
from ..core.warp_arrays import warp_array
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from .detector import land_on_ccds
from .kernels.packet import RayPackets, from_packets, lanes, packet_count, ray_packets, to_packets
from .kernels.trace import trace_rays
from .pack.surfaces import indices_and_wavelength, pack_surfaces, refractive_indices
from .rays import Rays, RayStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Packets of rays that one thread traces.
_ONE_THREAD = 32


@dataclass(frozen=True)
class TraceResult(Result):
    """Rays at one surface, in the telescope frame.

    Attributes
    ----------
    surface : str
        Name of the surface.
    position : ndarray, shape [n, 3]
        Intersections of the rays with the surface [m].
    direction : ndarray, shape [n, 3]
        Unit directions after the surface.
    path_length : ndarray, shape [n]
        Optical path from the start of the ray [m].
    status : ndarray of int32, shape [n]
        A :class:`~pachon.raytrace.rays.RayStatus` each.
    ccd : ndarray of int32, shape [n], or None
        Index of the CCD landed on, -1 in a gap; only after a trace to a focal plane of CCDs.
    """

    _table = ("position", "direction", "path_length", "status")

    surface: str
    position: np.ndarray
    direction: np.ndarray
    path_length: np.ndarray
    status: np.ndarray
    ccd: np.ndarray | None = None
    #: The arrays as a kernel writes them, for ``trace(out=)``; None where they are not those of one trace.
    _packets: Any = field(default=None, kw_only=True, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling and copying, without the arrays of the kernel."""
        return {**self.__dict__, "_packets": None}

    def _label(self) -> str:
        return f"{counted(len(self.status), 'ray')} at {self.surface}, {int(self.vignetted.sum())} without light"

    def _columns(self) -> dict[str, Any]:
        return super()._columns() | ({} if self.ccd is None else {"ccd": self.ccd})

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw where the rays meet the surface, in x and y of the telescope."""
        with styled():
            figure, axes = axes_at(ax, 4.6, 4.6)
            lit = ~self.vignetted
            axes.plot(*self.position[~lit, :2].T * 1e3, ".", color="0.75", markersize=3, label="without light")
            axes.plot(*self.position[lit, :2].T * 1e3, ".", color=BLUE, markersize=3, label="lit")
            axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title=plain_text(f"rays at {self.surface}"))
            axes.legend(loc="upper right")
            return figure

    @property
    def vignetted(self) -> np.ndarray:
        """Rays that do not contribute light: any status but OK, shape [n] bool."""
        return self.status != RayStatus.OK


@dataclass(frozen=True)
class PacketTrace:
    """Packets of rays before the first surface and after the last ones."""

    light: np.ndarray  #: refractive index before the first surface and after each, and the wavelength [n_surface + 2]
    start: Any  #: RayPackets before the first surface, as one surface
    end: Any  #: RayPackets after each of the last surfaces


def trace_packets(
    telescope: Telescope, rays: Rays, n_stored: int, *, threads: int | None = None, out: Any = None
) -> PacketTrace:
    """Trace rays in packets, the last one filled up, and store them at the last ``n_stored`` surfaces.

    They are stored in the RayPackets ``out`` where these are given.
    """
    light = indices_and_wavelength(telescope, rays.wavelength)
    return launch_trace(pack_surfaces(telescope), light, rays, n_stored, threads=threads, out=out)


def launch_trace(
    packed: Any,
    light: np.ndarray,
    rays: Rays | TraceResult,
    n_stored: int,
    *,
    threads: int | None = None,
    out: Any = None,
) -> PacketTrace:
    """Trace as :func:`trace_packets` through packed surfaces, with their :func:`indices_and_wavelength`."""
    count = packet_count(len(rays.path_length))
    # The status of the start is not read.
    start, end = RayPackets(), ray_packets(n_stored, count) if out is None else out
    start.position = warp_array(to_packets(rays.position.T[None]), lanes)
    start.direction = warp_array(to_packets(rays.direction.T[None]), lanes)
    start.path = warp_array(to_packets(rays.path_length[None]), lanes)
    # Of few rays, threads cost more than the trace.
    threads = min(thread_count(threads), 1 if count <= _ONE_THREAD else count)
    launch(trace_rays.variant_for(packed), count, [packed, warp_array(light[None]), start, end], threads=threads)
    return PacketTrace(light, start, end)


@overload
def trace(
    telescope: Telescope,
    rays: Rays,
    surfaces: Literal["last"] = "last",
    *,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
    out: TraceResult | None = None,
) -> TraceResult: ...


@overload
def trace(
    telescope: Telescope,
    rays: Rays,
    surfaces: Literal["all"],
    *,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
) -> list[TraceResult]: ...


@check_arguments
def trace(
    telescope: Telescope,
    rays: Rays,
    surfaces: Literal["last", "all"] = "last",
    *,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
    out: TraceResult | None = None,
) -> TraceResult | list[TraceResult]:
    """Trace rays sequentially through all surfaces of a telescope.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    rays : Rays
        Rays of one wavelength, from :func:`~pachon.raytrace.launch.launch_rays` for example.
    surfaces : {"last", "all"}
        Result at the last surface, or a list with one result per surface.
    focal_plane : FocalPlane, optional
        CCD surfaces, heights measured from the last surface along its z axis. The rays then end on the CCDs, and a
        ray that lands between two of them has status GAP (or keeps its worse one) and ``ccd`` -1.
    threads : int, optional
        Number of threads; all processors by default. The result does not depend on it.
    out : TraceResult, optional
        Result of an earlier trace of as many rays to the last surface, whose arrays are overwritten and are those of
        the new result: no memory is allocated. Not with ``surfaces="all"`` or a focal plane.

    Returns
    -------
    TraceResult or list of TraceResult

    Raises
    ------
    ConfigError
        If ``surfaces`` is neither "last" nor "all", or ``out`` is given with "all" or a focal plane.
    DomainError
        If the telescope does not cover the wavelength, or ``out`` is no result of as many rays of one trace.
    """
    n = len(rays)
    n_stored = len(telescope.surfaces) if surfaces == "all" else 1
    if out is not None:
        _check_out(out, n, alone=surfaces == "last" and focal_plane is None)
    stored = None if out is None else out._packets
    end = trace_packets(telescope, rays, n_stored, threads=threads, out=stored).end
    names = telescope.surface_names if surfaces == "all" else telescope.surface_names[-1:]
    positions, directions = from_packets(end.position, n), from_packets(end.direction, n)
    paths, statuses = from_packets(end.path, n), from_packets(end.status, n)
    packets = end if n_stored == 1 else None
    # Transposed views, not copies: the rays stay in structure-of-arrays order.
    results = [
        TraceResult(name, positions[i].T, directions[i].T, paths[i], statuses[i], _packets=packets)
        for i, name in enumerate(names)
    ]
    if focal_plane is not None:
        last = results[-1]
        index = float(refractive_indices(telescope, rays.wavelength)[-2])
        landing = land_on_ccds(telescope.surfaces[-1], focal_plane, last.position, last.direction, index=index)
        status = np.where((last.status == RayStatus.OK) & (landing.ccd < 0), np.int32(RayStatus.GAP), last.status)
        path = last.path_length + landing.path
        results[-1] = TraceResult(last.surface, landing.position, last.direction, path, status, landing.ccd)
    return results if surfaces == "all" else results[0]


def _check_out(out: TraceResult, n: int, *, alone: bool) -> None:
    """Raise an error unless the arrays of a result can hold those of n rays at the last surface."""
    if not alone:
        raise ConfigError('out: expected surfaces = "last", and no focal plane', key="out")
    if out._packets is None or len(out.status) != n:
        raise DomainError(
            f"out = {out!r}: expected the result of an earlier trace of {n} rays to the last surface", key="out"
        )
