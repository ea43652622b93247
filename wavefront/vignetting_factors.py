"""Vignetting factors that clear apertures make: the ellipse of the pupil whose rays arrive, field by field."""

from __future__ import annotations

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import field_label
from ..models.telescope import Telescope
from ..raytrace.launch import aimed_points
from ..raytrace.rays import RayStatus, field_direction, straight_bundles
from ..raytrace.trace import trace
from .design_fields import design_fields

#: Points across the pupil among which the outermost that arrive are found.
_ACROSS = 65
#: Steps by which the rim between two of them is halved: to 1e-9 of the radius.
_HALVINGS = 25


@check_arguments
def with_vignetting_factors(telescope: Telescope) -> Telescope:
    """Return a telescope with the vignetting factors that its apertures make.

    Of each stated field, rays along the y axis of the pupil through its middle, and then along x through the middle of
    those that arrive, have their outermost at the rim of what the factors leave, as "Set Vignetting" of Zemax has it.

    Raises
    ------
    DomainError
        If the design data state no fields, or no ray of a field arrives.
    """
    if not telescope.design_data.fields:
        raise DomainError(f"{telescope.name}: expected fields in its design data, which vignetting factors belong to")
    factors = made_factors(telescope, design_fields(telescope, "zemax"))
    return telescope.with_design(vignetting=tuple(map(tuple, factors.tolist())))


def made_factors(telescope: Telescope, fields: np.ndarray) -> np.ndarray:
    """Return the vignetting factors [n_field, 5] that apertures make of field angles [rad], projection "zemax"."""
    factors = np.zeros((len(fields), 5))
    for axis in (1, 0):
        low, high = _outermost(telescope, fields, axis, factors[:, :2])
        factors[:, axis] = 0.5 * (low + high)
        factors[:, 2 + axis] = 1.0 - 0.5 * (high - low)
    return factors


def _outermost(
    telescope: Telescope, fields: np.ndarray, axis: int, middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest pupil coordinates along an axis of rays that arrive, [n_field] each."""
    directions = field_direction(*fields.T)

    def arrive(along: np.ndarray) -> np.ndarray:
        """Return which rays of coordinates [n_field, n] along the axis, in units of the radius, arrive."""
        points = np.repeat(middle[:, None], along.shape[1], axis=1)
        points[..., axis] = along
        wavelength = telescope.default_wavelength
        entrance = aimed_points(telescope, directions, wavelength, 0.5 * telescope.pupil_diameter * points)
        rays = straight_bundles(telescope, directions, wavelength, entrance)
        return np.asarray(trace(telescope, rays).status == RayStatus.OK).reshape(along.shape)

    across = np.linspace(-1.0, 1.0, _ACROSS)
    lit = arrive(np.tile(across, (len(fields), 1)))
    dark = ~lit.any(axis=1)
    if dark.any():
        raise DomainError(f"{field_label(fields[dark][0])}: no ray reaches the image of {telescope.name}")
    ends = np.stack([lit.argmax(axis=1), _ACROSS - 1 - lit[:, ::-1].argmax(axis=1)], axis=1)
    beyond = np.clip(ends + np.array([-1, 1]), 0, _ACROSS - 1)
    inner, outer = across[ends], across[beyond]
    for _ in range(_HALVINGS):
        between = 0.5 * (inner + outer)
        passes = arrive(between)
        inner, outer = np.where(passes, between, inner), np.where(passes, outer, between)
    return inner[:, 0], inner[:, 1]
