"""Images of telescopes whose light is parallel behind them: directions of the light become places.

An ideal lens of the focal length f = 1 m takes light of the direction (u, v, w), in the frame of the detector, to the
point f (u, v) / abs(w) of its focal plane. Metres on the image are therefore tangents of angles: 1 um is 1 urad.
Wavefronts refer to plane waves (:mod:`pachon.wavefront.reference_sphere`), so that no focal length enters them.
"""

from __future__ import annotations

import numpy as np

from ..core.errors import DomainError
from ..models.telescope import Telescope
from .trace import TraceResult


def tangents(travel: np.ndarray) -> np.ndarray:
    """Return the image points x, y [m] of directions [..., 3] in the frame of the detector, shape [..., 2]."""
    return np.asarray(travel[..., :2] / np.abs(travel[..., 2:]))


def image_points(telescope: Telescope, end: TraceResult) -> np.ndarray:
    """Return where rays meet the image [m], telescope frame, shape [n, 3].

    That is the detector or, of an afocal telescope, the image plane of the ideal lens, drawn at the detector.
    """
    if not telescope.design_data.afocal:
        return end.position
    detector = telescope.surfaces[-1]
    image = tangents(detector.along(end.direction))
    return np.asarray(image @ detector.matrix[:, :2].T + np.asarray(detector.vertex))


def image_direction(telescope: Telescope, image: np.ndarray, travel: np.ndarray) -> np.ndarray:
    """Return the unit vector of the light that an ideal lens takes to an image point [m], telescope frame.

    Of the two sides of the detector it is that to which most of the light travels.
    """
    detector = telescope.surfaces[-1]
    point = detector.to_local(image)
    point[2] = np.sign(np.nansum(detector.along(travel)[..., 2]))
    return np.asarray(detector.matrix @ point / np.linalg.norm(point))


def require_image(telescope: Telescope, purpose: str) -> None:
    """Raise a DomainError for an afocal telescope, which has no image for a purpose."""
    if telescope.design_data.afocal:
        raise DomainError(
            f"{telescope.name} is afocal, its light parallel: {purpose} needs an image at a finite distance"
        )
