"""Ideal lens behind a telescope whose image is at infinity: directions of its light become places.

The lens of focal length f = 1 m stands in the plane of the detector. Light of the direction (u, v, w), in the frame of
the detector, comes to the point f (u, v) / abs(w) of its focal plane, from all of the lens in phase. Metres on the
image are therefore tangents of angles: 1 um is 1 urad. A wavefront refers to a plane wave where its reference sphere is
the one through the lens, of radius f in front of the image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.errors import DomainError
from ..models.telescope import Telescope
from .pack.surfaces import refractive_indices
from .trace import TraceResult


def imaged(telescope: Telescope, end: TraceResult, wavelength: float) -> TraceResult:
    """Return rays at the image: those at the detector or, of an afocal telescope, behind the ideal lens.

    The image plane is drawn at the detector, in the frame of the telescope.
    """
    if not telescope.design_data.afocal:
        return end
    detector, index = telescope.surfaces[-1], float(refractive_indices(telescope, wavelength)[-2])
    place, travel = detector.to_local(end.position), detector.along(end.direction)
    image = -telescope.sphere_radius * travel / np.abs(travel[:, 2:])
    reach = image - place
    direction = reach / np.linalg.norm(reach, axis=-1)[:, None]
    # A plane wave meets the middle of the lens as its ray there does: the others are ahead by the place along it.
    path = end.path_length + index * (np.linalg.norm(image, axis=-1) - (place * travel).sum(axis=-1))
    image[:, 2] = 0.0
    return replace(
        end,
        position=image @ detector.matrix.T + np.asarray(detector.vertex),
        direction=direction @ detector.matrix.T,
        path_length=path,
    )


def require_image(telescope: Telescope, purpose: str) -> None:
    """Raise a DomainError for an afocal telescope, which has no image for a purpose."""
    if telescope.design_data.afocal:
        raise DomainError(
            f"{telescope.name} is afocal, its light parallel: {purpose} needs an image at a finite distance"
        )
