"""The last step of a ray: from the nominal focal surface to the CCD surface at its own height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..models.camera.focal_plane import FocalPlane
from ..models.surface import Surface

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
    p = detector.to_local(position)
    d = direction @ detector.matrix
    ccd = focal_plane.ccd_at(p[:, 0], p[:, 1])
    center = focal_plane.camera.centers[ccd]
    t = np.zeros(len(p))
    for _ in range(STEPS):
        # The CCD stays that of the first intersection, so a ray near an edge cannot alternate between two CCDs.
        dx = p[:, 0] + t * d[:, 0] - center[:, 0]
        dy = p[:, 1] + t * d[:, 1] - center[:, 1]
        slope = focal_plane.surfaces.gradient(ccd, dx, dy)
        rate = d[:, 2] - slope[:, 0] * d[:, 0] - slope[:, 1] * d[:, 1]
        t = t + (focal_plane.surfaces.height(ccd, dx, dy) - (p[:, 2] + t * d[:, 2])) / rate
    x, y = p[:, 0] + t * d[:, 0], p[:, 1] + t * d[:, 1]
    # A ray that crosses the edge on its last micrometres has left the CCD. (In a gap, index -1, t has no meaning.)
    ccd = np.where(focal_plane.ccd_at(x, y) == ccd, ccd, -1).astype(np.int32)
    t = np.where(ccd >= 0, t, 0.0)
    return Landing(position + t[:, None] * direction, index * t, ccd)
