"""Field angles of the field points that design data state: angles, heights of the object or of the image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..core.errors import DomainError
from ..models.paraxial import stop_image
from ..models.telescope import Telescope
from ..raytrace.aiming import entrance_points
from ..raytrace.landing import derivatives, determinants, find_points, solve_2x2
from ..raytrace.rays import Projection, field_angles, field_direction, straight_bundles
from ..raytrace.trace import trace

#: Step of the slopes for the scale on the axis.
_SLOPE = 1e-4
#: Height of a paraxial chief ray at the image, for a slope of 1 and over the diameter of the pupil, that is rounding.
_ROUNDING = 1e-12
#: Steps in which real image heights are followed from the axis outwards.
_STEPS = 10


def design_fields(telescope: Telescope, projection: Projection = "zemax") -> np.ndarray:
    """Return the field angles [rad], shape [n, 2], of the fields that the design data of a telescope state.

    Of an object height it is the angle of the ray to the middle of the entrance pupil; of a paraxial image height that
    of the paraxial chief ray, and of a real one that of the chief ray which lands there, at the default wavelength.

    Raises
    ------
    DomainError
        If image heights are stated of a telescope whose surfaces do not share one axis, or no chief ray lands there.
    """
    data = telescope.design_data
    points = np.array(data.fields)
    if data.field_type == "angle" and projection == "zemax":
        return points
    if data.field_type == "angle":
        return field_angles(np.tan(points), projection)
    if data.field_type == "object_height":
        return field_angles(points / (telescope.stop_z - telescope.object_distance), projection)
    if data.field_type == "paraxial_image_height":
        scale = stop_image(telescope).image_scale
        if abs(scale) < _ROUNDING * telescope.pupil_diameter:
            raise DomainError(
                f"{telescope.name}: fields as paraxial_image_height: expected a stop that is not at the image, where "
                "chief rays of all fields land on the axis"
            )
        return field_angles(points / scale, projection)
    return field_angles(_real_slopes(telescope), projection)


@lru_cache(maxsize=64)
def _real_slopes(telescope: Telescope) -> np.ndarray:
    """Return the slopes [n, 2] of the fields whose chief rays land at the stated image heights."""
    target = np.array(telescope.design_data.fields)
    light, size = telescope.default_wavelength, float(np.abs(target).max())
    if size == 0.0:
        return np.zeros_like(target)

    def landing(slopes: np.ndarray, indices: np.ndarray) -> np.ndarray:
        directions = field_direction(slopes[:, 0], slopes[:, 1], "gnomonic")
        points = entrance_points(telescope, directions, light, np.zeros((1, 2)))
        end = trace(telescope, straight_bundles(telescope, directions, light, points))
        return telescope.surfaces[-1].to_local(end.position)[:, :2]

    axis = np.zeros((1, 2))
    origin, scale = landing(axis, np.zeros(1, dtype=int)), derivatives(landing, axis, _SLOPE)[0]
    if not np.isfinite(scale).all() or determinants(scale[None])[0] == 0.0:
        raise DomainError(f"{telescope.name}: image heights as fields: no chief ray on the axis reaches the image")
    linear = solve_2x2(np.repeat(scale[None], len(target), axis=0), target - origin)
    slopes = find_points(landing, linear, target, size, _SLOPE)
    lost = np.isnan(slopes).any(axis=1)
    lost_slopes = linear[lost] * 0.0
    for k in range(1, _STEPS + 1) if lost.any() else ():
        lost_slopes = find_points(landing, lost_slopes, origin + (target[lost] - origin) * (k / _STEPS), size, _SLOPE)
    slopes[lost] = lost_slopes
    lost = np.isnan(slopes).any(axis=1)
    if lost.any():
        x, y = target[lost][0] / telescope.design_data.unit
        unit = telescope.design_data.length_unit
        raise DomainError(
            f"field = ({x:.6g}, {y:.6g}) {unit} on the image: no chief ray of {telescope.name} lands there"
        )
    slopes.flags.writeable = False
    return slopes
