"""Corner rafts of the LSST camera: wavefront sensors in halves on either side of the focus, and guiders.

The halves of a wavefront sensor stand 1.5 mm from the focus: ``SW0`` behind it, where the light arrives after the
focus, and ``SW1`` in front of it. Positions and heights are in the telescope frame.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ..io.heights.zernike_table import bundled_heights
from .camera import Camera
from .cameras import load_camera
from .ccd_surfaces import CcdSurfaces
from .focal_plane import FocalPlane

#: Distance of the halves of a wavefront sensor from the focus [m].
WAVEFRONT_OFFSET = 1.5e-3
#: Cameras of the corner rafts, by the kind of their sensors.
CornerKind = Literal["wavefront", "guider"]
CornerHeights = Literal["nominal", "lsstcam"]
#: Heights of the sensors: nominal ones, or those of a camera as built.
_CAMERAS: dict[CornerKind, str] = {"wavefront": "lsst_wavefront", "guider": "lsst_guider"}


@check_arguments
def corner_focal_plane(kind: CornerKind = "wavefront", heights: CornerHeights = "nominal") -> FocalPlane:
    """Return the focal plane of the sensors in the corners of the LSST camera.

    Parameters
    ----------
    kind : {"wavefront", "guider"}
        Kind of the sensors.
    heights : {"nominal", "lsstcam"}
        Flat sensors at their nominal heights, 1.5 mm behind (SW0) and in front of (SW1) the focus and 0 for guiders; or
        as measured in cold metrology, as in :meth:`FocalPlane.as_measured`.

    Raises
    ------
    ConfigError
        If the kind or the heights are unknown.
    """
    camera = load_camera(_CAMERAS[kind])
    if heights != "nominal":
        return FocalPlane(camera, *bundled_heights(heights).on(camera))
    surfaces = CcdSurfaces.level(camera.half_sizes, _nominal_heights(camera))
    return FocalPlane(camera, surfaces, np.zeros(len(camera), dtype=bool))


def _nominal_heights(camera: Camera) -> list[float]:
    """Return the nominal height of each sensor [m]."""
    height = {"SW0": WAVEFRONT_OFFSET, "SW1": -WAVEFRONT_OFFSET}
    return [height.get(name.split("_")[1], 0.0) for name in camera.ccd_names]
