"""Optical path differences of many field points at once, in one launch for each batch of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from ..core.errors import DomainError
from ..core.launch import launch
from ..core.units import radians
from ..core.warp_arrays import warp_array
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..raytrace.kernels.packet import LANES, lane_flags, lanes, packet_count, ray_packets, to_packets
from ..raytrace.kernels.trace import PackedSurfaces
from ..raytrace.pack.surfaces import pack_surfaces, refractive_indices
from ..raytrace.rays import check_wavelength, field_direction, object_points
from .opd import pupil_points, sphere_radius_of
from .opd_batch_kernels import trace_opds
from .reference_sphere import reference_spheres

#: Rays in one batch: enough that starting a batch does not count, and 0.2 s between two reports of progress.
RAYS_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class OpdMaps:
    """Optical path differences over the entrance pupil, a map for each field point.

    Attributes
    ----------
    value : ndarray, shape [n_field, ...]
        Path of the chief ray minus path of the ray [m], to the reference sphere; positive where the wavefront leads.
        NaN where no light passes. Behind the fields the shape of the pupil coordinates.
    x, y : ndarray, shape [...]
        Entrance-pupil coordinates [m].
    wavelength : float
        Vacuum wavelength [m].
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    centers : ndarray, shape [n_field, 3]
        Centres of the reference spheres, telescope frame [m].
    radius : float
        Radius of the reference spheres [m].
    """

    value: np.ndarray
    x: np.ndarray
    y: np.ndarray
    wavelength: float
    fields: np.ndarray
    centers: np.ndarray
    radius: float

    def __len__(self) -> int:
        return len(self.fields)

    @cached_property
    def lit(self) -> np.ndarray:
        """Where light passes, shape [n_field, ...] bool."""
        return np.isfinite(self.value)

    @property
    def waves(self) -> np.ndarray:
        """The maps in waves at their own wavelength, shape [n_field, ...]."""
        return self.value / self.wavelength

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of each map over its lit points, piston removed [m], shape [n_field]; NaN where dark."""
        value, lit = self.value.reshape(len(self), -1), self.lit.reshape(len(self), -1)
        count = lit.sum(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            mean = np.where(lit, value, 0.0).sum(axis=1, keepdims=True) / count
            rest = np.where(lit, value - mean, 0.0)
            return np.sqrt((rest**2).sum(axis=1) / count[:, 0])


def wavefront_opds(
    telescope: Telescope,
    fields: Any,
    wavelength: Any,
    pupil: tuple[Any, Any] | None = None,
    projection: str = "zemax",
    focal_plane: FocalPlane | None = None,
    *,
    grid: int | None = None,
    sphere_radius: Any = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> OpdMaps:
    """Return the optical path difference over the entrance pupil of many field points.

    The maps are those of :func:`~pachon.wavefront.opd.wavefront_opd` with the chief ray as reference, field by field.
    No ray is kept, and light that the first aperture stops is followed no further; beside the maps themselves a batch
    takes a few megabytes.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_field, 2]
        Field angles [rad], in the stated projection; slopes of the light's own travel.
    wavelength : float or Quantity
        Vacuum wavelength [m].
    pupil : (px, py), optional
        Entrance-pupil coordinates [m], arrays of one shape, the same for all fields.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    focal_plane : FocalPlane, optional
        CCD surfaces; the nominal detector surface without it.
    grid : int, optional
        In place of ``pupil``: cells across the pupil diameter of a square grid. 64 when neither is given.
    sphere_radius : float or Quantity, optional
        Radius of the reference spheres [m]; the telescope's own by default.
    threads : int, optional
        Number of threads; all processors by default. The result does not depend on it.
    progress : callable, optional
        Called with the number of fields done, batch by batch.

    Returns
    -------
    OpdMaps

    Raises
    ------
    ConfigError
        If both ``pupil`` and ``grid`` are given, or the projection is unknown.
    DomainError
        If a field or the wavelength lies outside what the telescope covers, or a chief ray does not reach the image or
        lands between the CCDs.
    """
    angles = radians(fields, "fields")
    if angles.ndim == 1 and angles.size == 2:
        angles = angles[None]
    if angles.ndim != 2 or angles.shape[1] != 2:
        raise DomainError(f"fields of shape {list(angles.shape)}: expected [n_field, 2] angles")
    telescope.check_field(angles[:, 0], angles[:, 1])
    wavelength = check_wavelength(wavelength)
    x, y = pupil_points(telescope, pupil, grid)
    radius = sphere_radius_of(telescope, sphere_radius)
    directions = field_direction(angles[:, 0], angles[:, 1], projection)
    spheres = reference_spheres(telescope, angles, directions, wavelength, radius, focal_plane, threads)

    value = np.full((len(angles), x.size), np.nan)
    plan = _Plan.of(telescope, wavelength, x.ravel(), y.ravel(), radius)
    step = max(1, RAYS_AT_ONCE // max(1, x.size))
    for first in range(0, len(angles), step):
        part = slice(first, first + step)
        sphere = np.concatenate([spheres.center[part], spheres.path[part, None]], axis=1)
        plan.trace(directions[part], sphere, value[part], threads)
        if progress is not None:
            progress(min(first + step, len(angles)))
    return OpdMaps(value.reshape(-1, *x.shape), x, y, wavelength, angles, spheres.center, radius)


@dataclass(frozen=True)
class _Plan:
    """What the batches have in common: the telescope up to its first aperture and as a whole, and the pupil."""

    telescope: Telescope
    stages: tuple[PackedSurfaces, ...]
    indices: wp.array
    pupil: wp.array
    place: wp.array
    radius: float

    @classmethod
    def of(cls, telescope: Telescope, wavelength: float, x: np.ndarray, y: np.ndarray, radius: float) -> _Plan:
        whole = pack_surfaces(telescope)
        stages: tuple[PackedSurfaces, ...] = (whole,)
        stop = next((i for i, s in enumerate(telescope.surfaces) if s.aperture is not None), None)
        if stop is not None and stop + 1 < len(telescope.surfaces):
            front = PackedSurfaces()
            for name in ("numbers", "coefficients", "deformations", "apertures", "obstructions", "special"):
                setattr(front, name, getattr(whole, name))
            # The kernel goes through as many surfaces as there are rows of kinds.
            front.kinds = whole.kinds[: stop + 1]
            stages = (front, whole)
        # From the centre outwards, so that what a central obscuration or a rim stops fills packets of its own.
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

    def trace(self, directions: np.ndarray, sphere: np.ndarray, value: np.ndarray, threads: int | None) -> None:
        """Fill the maps [n_field, n_pupil] of some fields; ``sphere`` holds centres and chief paths [n_field, 4]."""
        telescope, packets = self.telescope, len(self.place)

        start = np.empty((0, 3))
        if np.isfinite(telescope.object_distance):
            start = object_points(telescope, directions)
        lit = np.ones(len(directions) * packets, dtype=np.int32)
        # The first stage only tells which packets hold light at all.
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
                    warp_array(sphere),
                    self.radius,
                    ray_packets(),
                    warp_array(filled),
                    warp_array(lit, wp.int32),
                ],
                threads=threads,
            )
