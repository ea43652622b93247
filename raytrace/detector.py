"""Propagation of rays from the nominal detector surface to the CCD surfaces at their heights over it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..core.threads import thread_count
from ..models.camera.focal_plane import FocalPlane
from ..models.shapes.shape import Plane, Shape
from ..models.surface import Surface

Triple = tuple[np.ndarray, np.ndarray, np.ndarray]
#: Newton steps to a CCD surface. Heights are tens of micrometres and slopes below 1e-3, so each step gains three
#: digits: the third leaves less than 1e-14 m.
STEPS = 3
#: For many photons two are enough: from 0.1 mm, with curvatures below 0.1 per metre, they leave 1e-20 m.
BUNDLE_STEPS = 2
#: Rays propagated at a time, so that their numbers stay in the cache.
CHUNK = 8192


@dataclass(frozen=True)
class Landing:
    """Intersections of rays with the CCD surfaces."""

    position: np.ndarray  #: on the CCD surfaces (on the nominal surface in a gap), telescope frame [m], [n, 3]
    path: np.ndarray  #: optical path from the nominal surface [m], [n]; negative where the CCD stands in front of it
    ccd: np.ndarray  #: index of the CCD, -1 in a gap, int32 [n]


def land_on_ccds(
    detector: Surface, focal_plane: FocalPlane, position: np.ndarray, direction: np.ndarray, *, index: float = 1.0
) -> Landing:
    """Propagate rays from the nominal detector surface to the CCD surfaces.

    Heights are those over the nominal surface, along the z axis of the detector's own frame, which is the telescope's
    +z unless the detector was tilted; positions on the CCDs are that frame's x and y. ``position`` [m] and
    ``direction``, [n, 3], are in the telescope frame; ``index`` is the refractive index before the detector.
    """
    (x, y, z), (u, v, w) = detector.to_local(position).T, detector.along(direction).T
    ccd = focal_plane.ccd_at(x, y)
    t = _distance_to_ccd(detector.shape, focal_plane, ccd, (x, y, z), (u, v, w), STEPS)
    # A ray that crosses the edge on its last micrometres has left the CCD. (In a gap, index -1, t has no meaning.)
    on_ccd = (ccd >= 0) & (focal_plane.camera.depth(ccd, x + t * u, y + t * v) >= 0.0)
    ccd = np.where(on_ccd, ccd, -1).astype(np.int32)
    t = np.where(ccd >= 0, t, 0.0)
    return Landing(position + t[:, None] * direction, index * t, ccd)


def land_bundle(
    detector: Surface, focal_plane: FocalPlane, position: Triple, direction: Triple, *, threads: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Propagate rays that land close to one another from the nominal surface to the CCD surfaces.

    ``position`` [m], ``direction`` and the returned x, y [m] are in the frame of the detector. Returned too is whether
    there is a CCD; where there is none, x and y are those on the nominal surface. Each CCD is treated on its own, with
    the numbers of its surface once and not for every ray.
    """
    x, y, _ = position
    ccd = _bundle_ccds(focal_plane, x, y)
    t = np.zeros_like(x)

    def carry(first: int) -> None:
        chunk = slice(first, first + CHUNK)
        for ccd_index in np.unique(ccd[chunk]):
            ray_indices = first + np.flatnonzero(ccd[chunk] == ccd_index)
            (px, py, pz), (u, v, w) = (
                [component[ray_indices] for component in vector] for vector in (position, direction)
            )
            if ccd_index >= 0:
                t[ray_indices] = _distance_to_ccd(
                    detector.shape, focal_plane, np.array([ccd_index]), (px, py, pz), (u, v, w), BUNDLE_STEPS
                )

    starts = range(0, len(x), CHUNK)
    if len(starts) == 1:
        carry(0)
    else:
        with ThreadPoolExecutor(thread_count(threads)) as pool:
            list(pool.map(carry, starts))
    x, y = x + t * direction[0], y + t * direction[1]
    on_ccd = (ccd >= 0) & (_bundle_ccds(focal_plane, x, y) == ccd)
    return np.where(on_ccd, x, position[0]), np.where(on_ccd, y, position[1]), on_ccd


def _distance_to_ccd(
    nominal: Shape, focal_plane: FocalPlane, ccd: np.ndarray, position: Triple, direction: Triple, steps: int
) -> np.ndarray:
    """Return the distances to the surfaces of CCDs, one for each ray or one for all, in lengths of the direction.

    Heights of CCDs are those over a nominal shape.
    """
    (x, y, z), (u, v, w) = position, direction
    frame, t = focal_plane.camera.frame(ccd), np.zeros(len(x))
    across_x, across_y = frame.along_ccd(u, v)
    for _ in range(steps):
        # The CCD stays that of the first intersection, so a ray near an edge cannot alternate between two CCDs.
        px, py = x + t * u, y + t * v
        dx, dy = frame.to_local(px, py)
        slope = focal_plane.surfaces.gradient(ccd, dx, dy)
        rate = w - slope[:, 0] * across_x - slope[:, 1] * across_y
        height = focal_plane.surfaces.height(ccd, dx, dy)
        if not isinstance(nominal, Plane):
            nominal_slope_x, nominal_slope_y = nominal.gradient(px, py)
            rate = rate - nominal_slope_x * u - nominal_slope_y * v
            height = height + nominal.sag(px, py)
        t = t + (height - (z + t * w)) / rate
    return t


def _bundle_ccds(focal_plane: FocalPlane, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the CCDs of positions [m], most of which lie on one."""
    camera = focal_plane.camera
    finite = np.isfinite(x)
    if not finite.any():
        return np.full(x.shape, -1)
    [main_ccd] = focal_plane.ccd_at(np.median(x[finite])[None], np.median(y[finite])[None])
    ccd = np.where(camera.depth(main_ccd, x, y) >= 0.0, main_ccd, -1)
    off_main = np.flatnonzero(ccd < 0)
    ccd[off_main] = focal_plane.ccd_at(x[off_main], y[off_main])
    return ccd
