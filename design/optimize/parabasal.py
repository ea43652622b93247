"""Focal length from parallel rays close to the chief ray of the axis, with exact derivatives; folded telescopes too.

Two rays at heights ``+h`` and ``-h`` over the chief ray leave with directions that differ by ``dd``, and the focal
length is ``-2 n h / (n' dd)``. The error goes with h^2; two heights remove it.
"""

from __future__ import annotations

import math

import numpy as np

from ...core.errors import DomainError
from ...models.paraxial import curvatures_across, require_on_axis
from ...models.surface import Interaction
from ...models.telescope import Telescope
from ...raytrace.adjoint.backward_pass import direction_gradient
from ...raytrace.adjoint.forward_pass import forward_pass
from ...raytrace.aiming import entrance_points
from ...raytrace.rays import Rays, field_direction
from ...raytrace.trace import trace
from .jacobian import ParameterColumns

#: Heights of the rays, in units of the radius of the entrance pupil, in pairs.
_HEIGHTS = 1e-3 * np.array([1.0, -1.0, 2.0, -2.0])
#: Power times radius of the entrance pupil below which light stays parallel.
_PARALLEL = 1e-9
_AXIS = np.zeros((1, 2))


def parabasal_focal_length(
    columns: ParameterColumns, wavelength: float, meridian: str | None = None
) -> tuple[float, np.ndarray]:
    """Return the focal length [m] of a telescope at a wavelength [m], and its derivatives [n_parameter].

    The meridian "x" or "y" is the plane of the rays; by default y, or x where there is no power along y. It is negative
    where the image of a distant object is upright, as of a Gregorian telescope. For the derivatives of a telescope
    without symmetry the chief ray stays where it enters.

    Raises
    ------
    DomainError
        If rays close to the axis are lost, or the telescope has no power.
    """
    for axis in ("y", "x") if meridian is None else (meridian,):
        power, change = _power(columns, wavelength, axis)
        if abs(power) * 0.5 * columns.telescope.pupil_diameter >= _PARALLEL:
            return 1.0 / power, -change / power**2
    afocal = "; of an afocal one the operands are image_scale and AMAG" if columns.telescope.design_data.afocal else ""
    raise DomainError(
        f"telescope {columns.telescope.name}: expected one with a focus, its power is {power:.3g} 1/m{afocal}"
    )


def _power(columns: ParameterColumns, wavelength: float, meridian: str) -> tuple[float, np.ndarray]:
    """Return the power [1/m] in a meridian and its derivatives."""
    telescope = columns.telescope
    heights = 0.5 * telescope.pupil_diameter * _HEIGHTS
    offsets = np.outer(heights, np.array([1.0, 0.0] if meridian == "x" else [0.0, 1.0]))
    light = field_direction(0.0, 0.0)[None]
    chief = entrance_points(telescope, light, wavelength, _AXIS).reshape(1, 2)
    # The focal length is that of a distant object, wherever the object is: light along the axis, from above everything.
    height = max(s.vertex[2] for s in telescope.surfaces) + telescope.launch_distance
    start = np.column_stack([chief + offsets, np.full(len(offsets), height)])
    rays = Rays(start, np.repeat(light, len(offsets), axis=0), np.zeros(len(offsets)), wavelength)
    forward = forward_pass(telescope, rays, threads=1)
    if not forward.arrived.all():
        raise DomainError(f"telescope {telescope.name}: expected rays close to the axis that reach the image")
    slopes = columns.derivatives(forward, direction_gradient(forward), threads=1)
    differences = (forward.direction[:, ::2] - forward.direction[:, 1::2]) / (heights[::2] - heights[1::2])
    turned = (4.0 * differences[:, 0] - differences[:, 1]) / 3.0
    rates = (slopes[:, ::2] - slopes[:, 1::2]) / (heights[::2] - heights[1::2])[:, None]
    change = (4.0 * rates[:, 0] - rates[:, 1]) / 3.0
    size = float(np.linalg.norm(turned))
    index = forward.indices[-2] / forward.indices[0]
    if size == 0.0:
        return 0.0, np.zeros(slopes.shape[-1])
    side = -math.copysign(1.0, float(turned @ _transported(telescope, rays, offsets[0] / heights[0])))
    return side * index * size, side * index / size * (turned @ change)


def _transported(telescope: Telescope, rays: Rays, across: np.ndarray) -> np.ndarray:
    """Return a vector across the axis in front of the telescope, carried along the rays and its mirrors, shape [3]."""
    vector, direction = np.array([*across, 0.0]), rays.direction[0]
    for surface, landed in zip(telescope.surfaces, trace(telescope, rays, surfaces="all", threads=1), strict=True):
        turn = landed.direction[0] - direction
        if surface.interaction == Interaction.MIRROR:
            vector = vector - 2.0 * (vector @ turn) / (turn @ turn) * turn
        direction = landed.direction[0]
    return vector


def group_focal_length(
    telescope: Telescope, ends: tuple[str | None, str | None], wavelength: float, meridian: str | None = None
) -> float:
    """Return the paraxial focal length [m] of the surfaces from one to another, both included, in their media.

    The media in front of and behind them are those of the telescope. A meridian as in :func:`parabasal_focal_length`.

    Raises
    ------
    DomainError
        If the surfaces have no power, are off the axis, or the last is in front of the first.
    """
    first, last = surface_range(telescope, *ends)
    before = telescope.medium_before if first == 0 else telescope.surfaces[first - 1].medium_after
    mirrors = [s.interaction == Interaction.MIRROR for s in telescope.surfaces]
    start = float(before.index(wavelength)) * (-1.0) ** sum(mirrors[:first])
    for axis in (1, 0) if meridian is None else ("xy".index(meridian),):
        height, slope, n = 1.0, 0.0, start
        place = telescope.surfaces[first].vertex[2]
        for surface, mirror in zip(telescope.surfaces[first : last + 1], mirrors[first:], strict=False):
            require_on_axis(surface, telescope.name)
            # Along s = -z, as in models/paraxial.py.
            height += slope * (place - surface.vertex[2])
            place = surface.vertex[2]
            n_after = -n if mirror else math.copysign(float(surface.medium_after.index(wavelength)), n)
            slope = (n * slope + height * curvatures_across(surface)[axis] * (n_after - n)) / n_after
            n = n_after
        power = -n * slope / abs(start)
        if abs(power) * 0.5 * telescope.pupil_diameter >= _PARALLEL:
            return 1.0 / power
    raise DomainError(
        f"surfaces {telescope.surface_names[first]} to {telescope.surface_names[last]} of {telescope.name}: "
        f"expected a focus, their power is {power:.3g} 1/m"
    )


def surface_range(telescope: Telescope, first: str | None, last: str | None) -> tuple[int, int]:
    """Return the indices of two surfaces of given names; by default of the first and last mirror or lens surface."""
    acting = [i for i, s in enumerate(telescope.surfaces) if s.interaction in (Interaction.MIRROR, Interaction.REFRACT)]
    if not acting:
        raise DomainError(f"telescope {telescope.name}: expected at least one mirror or lens surface")
    names = telescope.surface_names
    start = acting[0] if first is None else names.index(telescope.surface(first).name)
    end = acting[-1] if last is None else names.index(telescope.surface(last).name)
    if end < start:
        raise DomainError(f"surfaces {first or names[start]} to {last or names[end]}: expected the last not in front")
    return start, end
