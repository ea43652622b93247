"""Ray along the axis through the middle of the stop: where changes of the elements in front move the entrance pupil."""

from __future__ import annotations

import math

import numpy as np

from ..core.errors import DomainError
from .surface import Interaction, Surface
from .telescope import Telescope

#: Step of the differences of where rays meet the stop, over the diameter of the entrance pupil.
_STEP = 1e-3
#: Distance from the middle of the stop at which the search ends, over that diameter.
_CLOSE = 1e-14
#: Most steps of Newton's method.
_STEPS = 20


def stop_center_point(telescope: Telescope) -> np.ndarray:
    """Return where the ray along the axis through the middle of the stop crosses z = ``stop_z`` [m], shape [2].

    The ray is that of the default wavelength, of an object at a finite distance from its point on the axis. DomainError
    where the design data name no stop, or no such ray reaches it.
    """
    data = telescope.design_data
    if data.stop is None:
        raise DomainError(f"{telescope.name}: expected a surface that is the stop (design data: stop)")
    front = telescope.surfaces[: telescope.surface_names.index(data.stop) + 1]
    step = _STEP * telescope.pupil_diameter
    point = np.zeros(2)
    for _ in range(_STEPS):
        miss = _landing(telescope, front, point)
        if np.abs(miss).max() <= _CLOSE * telescope.pupil_diameter:
            return point
        sides = [
            _landing(telescope, front, point + h) - _landing(telescope, front, point - h) for h in step * np.eye(2)
        ]
        by_point = np.stack(sides, axis=-1) / (2.0 * step)
        if not (np.isfinite(miss).all() and np.isfinite(by_point).all() and np.linalg.det(by_point)):
            break
        point = point - np.linalg.solve(by_point, miss)
    raise DomainError(f"{telescope.name}: no ray on the axis passes the middle of the stop {data.stop!r}")


def _landing(telescope: Telescope, front: tuple[Surface, ...], point: np.ndarray) -> np.ndarray:
    """Return where the ray through a point of the plane of the pupil meets the last of some surfaces, [2]; or NaN."""
    position, direction = np.array([*point, telescope.stop_z]), np.array([0.0, 0.0, -1.0])
    if math.isfinite(telescope.object_distance):
        away = position - [0.0, 0.0, telescope.object_distance]
        direction = -math.copysign(1.0, away[2]) * away / np.linalg.norm(away)
    before, wavelength = telescope.medium_before, telescope.default_wavelength
    place = np.zeros(3)
    with np.errstate(invalid="ignore", divide="ignore"):
        for surface in front:
            start, along = surface.to_local(position), surface.along(direction)
            place = start - along * (start[2] / along[2])
            for _ in range(_STEPS):
                sag, slopes = float(surface.shape.sag(*place[:2])), surface.shape.gradient(*place[:2])
                normal = np.array([*(-float(v) for v in slopes), 1.0])
                beyond = (place[2] - sag) / float(along @ normal)
                place = place - along * beyond
                if not abs(beyond) > _CLOSE * telescope.pupil_diameter:
                    break
            normal /= np.linalg.norm(normal)
            ratio = float(before.index(wavelength)) / float(surface.medium_after.index(wavelength))
            along = _deflected(along, normal, surface.interaction, ratio)
            position, direction, before = surface.to_telescope(place), surface.matrix @ along, surface.medium_after
    return np.asarray(place[:2])


def _deflected(along: np.ndarray, normal: np.ndarray, interaction: Interaction, ratio: float) -> np.ndarray:
    """Return the direction of a ray behind a surface, of a ratio of the indices before it and behind it."""
    across = float(along @ normal)
    if interaction == Interaction.MIRROR:
        return np.asarray(along - 2.0 * across * normal)
    if interaction != Interaction.REFRACT:
        return along
    inside = math.copysign(1.0, across) * np.sqrt(1.0 - ratio**2 * (1.0 - across**2))
    return np.asarray(ratio * along + (inside - ratio * across) * normal)
