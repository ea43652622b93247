"""The last step of a ray: from the nominal focal surface to the CCD surface at its own height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..models.camera.focal_plane import FocalPlane
from ..models.surface import Surface

Triple = tuple[np.ndarray, np.ndarray, np.ndarray]
#: Newton steps to a CCD surface. Heights are tens of micrometres and slopes below 1e-3, so each step gains three
#: digits: the third leaves less than 1e-14 m.
STEPS = 3


@dataclass(frozen=True)
class Landing:
    """Intersections of rays with the CCD surfaces."""

    position: np.ndarray  #: on the CCD surfaces (on the nominal surface in a gap), telescope frame [m], [n, 3]
    path: np.ndarray  #: optical path from the nominal surface [m], [n]; negative where the CCD stands in front of it
    ccd: np.ndarray  #: index of the CCD, -1 in a gap, int32 [n]


def land_on_ccds(
    detector: Surface, focal_plane: FocalPlane, position: np.ndarray, direction: np.ndarray, *, index: float = 1.0
) -> Landing:
    """Carry rays from the nominal detector surface to the CCD surfaces.

    Heights are measured along the z axis of the detector's own frame, which is the telescope's +z unless the
    detector was tilted; positions on the CCDs are that frame's x and y. ``position`` [m] and ``direction``, [n, 3], are
    in the telescope frame; ``index`` is the refractive index before the detector.
    """
    (x, y, z), (u, v, w) = detector.to_local(position).T, (direction @ detector.matrix).T
    t, ccd = _distances(focal_plane, (x, y, z), (u, v, w))
    return Landing(position + t[:, None] * direction, index * t, ccd)


def on_ccds(focal_plane: FocalPlane, position: Triple, direction: Triple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y [m] and the CCDs of rays that are carried from the nominal surface to the CCD surfaces.

    ``position`` [m], ``direction`` (of any length) and the result are in the frame of the detector. The CCD is -1 in a
    gap, where x and y are those on the nominal surface.
    """
    t, ccd = _distances(focal_plane, position, direction)
    return position[0] + t * direction[0], position[1] + t * direction[1], ccd


def _distances(focal_plane: FocalPlane, position: Triple, direction: Triple) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances from the nominal surface, in lengths of the direction, and the CCDs; 0 and -1 in a gap."""
    x, y, z = position
    u, v, w = direction
    ccd = focal_plane.ccd_at(x, y)
    center_x, center_y = focal_plane.camera.centers[ccd].T
    t = np.zeros(len(x))
    for _ in range(STEPS):
        # The CCD stays that of the first intersection, so a ray near an edge cannot alternate between two CCDs.
        dx, dy = x + t * u - center_x, y + t * v - center_y
        slope = focal_plane.surfaces.gradient(ccd, dx, dy)
        rate = w - slope[:, 0] * u - slope[:, 1] * v
        t = t + (focal_plane.surfaces.height(ccd, dx, dy) - (z + t * w)) / rate
    # A ray that crosses the edge on its last micrometres has left the CCD. (In a gap, index -1, t has no meaning.)
    ccd = np.where(focal_plane.ccd_at(x + t * u, y + t * v) == ccd, ccd, -1).astype(np.int32)
    return np.where(ccd >= 0, t, 0.0), ccd
