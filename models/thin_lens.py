"""Ideal thin lenses: points to points, without aberrations, by a focal length alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..core.arguments import check_arguments
from ..core.errors import PrescriptionError


@check_arguments
@dataclass(frozen=True)
class ThinLens:
    """An ideal thin lens on the plane of a surface, about its vertex.

    With the slopes t = (dx/ds, dy/ds) of a ray along the axis, s counting with the light, its point P in the plane and
    the indices n in front and n' behind, ``n' t' = n t - P / focal_length``: every point of a plane is imaged to a
    point of another. Optical paths between two such points can be equal for one pair of planes alone: those of the
    object at `object_distance` and its image.

    Parameters
    ----------
    focal_length : float
        Focal length in vacuum [m]; negative for a diverging lens.
    object_distance : float
        From the object to the lens along the light [m], of which paths are equal; negative behind the lens,
        infinite by default.

    Raises
    ------
    PrescriptionError
        If the focal length is 0 or not finite, or the distance is 0.
    """

    focal_length: float
    object_distance: float = math.inf

    def __post_init__(self) -> None:
        if not math.isfinite(self.focal_length) or self.focal_length == 0.0:
            raise PrescriptionError(f"focal_length = {self.focal_length!r}: expected a finite length in m, not zero")
        if math.isnan(self.object_distance) or self.object_distance == 0.0:
            raise PrescriptionError(f"object_distance = {self.object_distance!r}: expected a distance in m, not zero")
