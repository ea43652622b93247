"""Packets of pupil points that the apertures before the first mirror or lens can transmit."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..models.shapes.mesh import MeshSurface
from ..models.surface import Interaction, Surface
from ..models.telescope import Telescope
from ..raytrace.pack.surfaces import clear_annulus

#: Radii at which the sag within an aperture is sampled.
_RADII = 257
#: Angles at which the sag within an aperture is sampled.
_ANGLES = 32
#: Rounding of a landing point [m].
_ROUNDING = 1e-9


def transmitted_packets(
    telescope: Telescope, pupil: np.ndarray, directions: np.ndarray, start: np.ndarray
) -> np.ndarray | None:
    """Return the packets that can have light behind these apertures, bool [n_field, n_packet].

    They are the discs and rings up to the first surface that deflects light. ``pupil`` [2, n_packet, lanes]: points on
    the plane of the entrance pupil [m]. ``directions`` [n_field, 3]: unit vectors of light from infinity, or ``start``
    [n_field, 3] where it is not empty: points of the object [m]. None without such an aperture.
    """
    points = np.stack([*pupil, np.full_like(pupil[0], telescope.stop_z)], axis=-1)
    passing = None
    for surface in telescope.surfaces:
        heights = _sag_range(surface)
        if heights is not None:
            through = _packets_through_ring(surface, heights, points, directions, start)
            passing = through if passing is None else passing & through
        if surface.interaction != Interaction.PASS:
            return passing
    return passing


def _packets_through_ring(
    surface: Surface, heights: tuple[float, float], points: np.ndarray, directions: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the packets of points [n_packet, lanes, 3] [m] whose straight rays can pass a ring, [n_field, n_packet].

    A ray lands within the ring at a height between the lowest and the highest sag there. Its distance from the centre
    differs from that of its pupil point by at most its slope times the height between them.
    """
    ring = clear_annulus(surface.aperture)
    assert ring is not None
    x, y, inner, outer = ring
    local = surface.to_local(points)
    distance = np.hypot(local[..., 0] - x, local[..., 1] - y)
    rise = np.maximum(np.abs(local[..., 2] - heights[0]), np.abs(local[..., 2] - heights[1])).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        if len(start):
            light = local[None] - surface.to_local(start)[:, None, None]
            slope = (np.hypot(light[..., 0], light[..., 1]) / np.abs(light[..., 2])).max(axis=-1)
        else:
            light = surface.along(directions)
            slope = (np.hypot(light[:, 0], light[:, 1]) / np.abs(light[:, 2]))[:, None]
        shift = slope * rise + _ROUNDING
    # Written so that a NaN counts as light.
    return np.asarray(~((distance.max(axis=-1) + shift < inner) | (distance.min(axis=-1) - shift > outer)))


@lru_cache(maxsize=64)
def _sag_range(surface: Surface) -> tuple[float, float] | None:
    """Return bounds of the sag within a disc or ring [m]; None where the surface has none."""
    ring = clear_annulus(surface.aperture)
    if surface.aperture is None or ring is None:
        return None
    if isinstance(surface.shape, MeshSurface) or surface.interaction == Interaction.PHASE:
        return None
    x, y, inner, outer = ring
    r, angle = np.meshgrid(np.linspace(inner, outer, _RADII), np.arange(_ANGLES) * (2 * np.pi / _ANGLES), indexing="ij")
    sag = surface.shape.sag(x + r * np.cos(angle), y + r * np.sin(angle))
    if not np.isfinite(sag).all():
        return None
    # Between samples the sag leaves their range by no more than it changes from one to the next.
    margin = max(np.abs(np.diff(sag, axis=0)).max(), np.abs(np.diff(sag, axis=1, append=sag[:, :1])).max())
    return float(sag.min() - margin), float(sag.max() + margin)
