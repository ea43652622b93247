"""Best focus of silicon detectors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.units import length
from ..models.camera.silicon import Silicon
from ..models.telescope import Telescope
from .chief_rays import chief_rays, image_jacobians


@check_arguments
def focus_height(telescope: Telescope, silicon: Silicon, wavelength: ArrayLike, threads: int | None = None) -> float:
    """Return the height of CCDs at which silicon is best in focus, along +z of the detector's own frame [m].

    That is +z of the telescope unless the detector is tilted, as behind a folding mirror. The surface then stands in
    front of the focus, by the mean equivalent defocus times the mean cosine of the cone of light (0.94 at f/1.23). On
    the axis of the field, at one vacuum wavelength [m]; nominal heights are 0.

    Raises
    ------
    DomainError
        If silicon is transparent at the wavelength.
    """
    light = length(wavelength, "wavelength")
    axis = np.array([[0.0, 0.0, -1.0]])
    scale = abs(float(np.linalg.det(image_jacobians(telescope, axis, light, threads)[0])))
    # The mean over the annulus of the square of the light's direction cosines, pupil coordinate over focal length.
    square = 0.125 * telescope.pupil_diameter**2 * (1.0 + telescope.pupil_obscuration**2) / scale
    direction = chief_rays(telescope, axis, light, threads=threads).direction
    travel = float(telescope.surfaces[-1].along(direction)[0, 2])
    return -math.copysign(silicon.defocus(light)[0] * math.sqrt(1.0 - square), travel)
