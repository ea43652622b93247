"""Central obscuration of the entrance pupil: the shadow that apertures of surfaces throw into the light of the axis."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from ..core.errors import DomainError
from .aperture import Annulus, Aperture, Circle, Complement, Intersection, Union
from .parabasal import axis_ray_at
from .telescope import Telescope

#: Decimals of the ratio: rounding of the trace is below them.
_DECIMALS = 12
#: Distance of the chief ray from a vertex, over the size of the pupil, and its tilt, that rounding leaves.
_ROUNDING = 1e-9
#: Steps of Newton's method from the paraxial ray at the edge of a shadow to the real one, and where they end.
_STEPS = 20
_CONVERGED = 1e-12


def central_obscuration(telescope: Telescope) -> float:
    """Return the inner over the outer radius of the entrance pupil: as stated, or else as the light on the axis has it.

    Where none is stated, discs and rings about the axis count, on surfaces that the light of the axis meets upright.
    Prescriptions in formats of other programs state none. The result is 0 where nothing but the shadow is left.
    """
    if telescope.pupil_obscuration:
        return telescope.pupil_obscuration
    rim = 0.5 * telescope.pupil_diameter
    shadows = [0.0]
    for place, surface in enumerate(telescope.surfaces):
        dark = 0.0 if surface.aperture is None else _disc_radius(surface.aperture, covered=False)
        if dark > 0.0:
            # No ray of the axis may reach the surface.
            with suppress(DomainError):
                shadows.append(_pupil_radius(telescope, place, dark, rim))
    obscuration = round(max(shadows) / rim, _DECIMALS)
    return obscuration if obscuration < 1.0 else 0.0


def _pupil_radius(telescope: Telescope, place: int, dark: float, rim: float) -> float:
    """Return the distance [m] from the middle of the pupil of the ray of the axis that meets a surface at `dark` [m].

    It is 0 where the chief ray of the axis does not meet the surface upright at its vertex. Where real rays miss a
    surface, or there is a thin lens, it is that of the paraxial ray.
    """
    chief = axis_ray_at(telescope, place, 0.0)
    scale = float(np.hypot(*chief.moved[:2, 1]))
    if float(np.hypot(*chief.place[:2])) > _ROUNDING * rim or abs(chief.direction[2]) < 1.0 - _ROUNDING or not scale:
        return 0.0
    paraxial = radius = dark / scale
    with suppress(DomainError):
        for _ in range(_STEPS):
            ray = axis_ray_at(telescope, place, radius)
            height = float(np.hypot(*ray.place[:2]))
            if abs(height - dark) <= _CONVERGED * dark:
                return radius
            radius -= (height - dark) * height / float(ray.place[:2] @ ray.moved[:2, 1])
    return paraxial


def _disc_radius(aperture: Aperture, *, covered: bool) -> float:
    """Return the radius of a disc about the origin within a region, or else outside it [m]: the largest of a shape.

    A disc outside a region is one within its complement.
    """
    if isinstance(aperture, Complement):
        return _disc_radius(aperture.part, covered=not covered)
    if isinstance(aperture, Union | Intersection):
        radii = [_disc_radius(part, covered=covered) for part in aperture.parts]
        return max(radii) if isinstance(aperture, Union) == covered else min(radii)
    if isinstance(aperture, Circle):
        inner, outer = 0.0, aperture.radius
    elif isinstance(aperture, Annulus):
        inner, outer = aperture.inner, aperture.outer
    else:
        return 0.0
    if covered and inner > 0.0:
        return 0.0
    return max(0.0, (outer if covered else inner) - float(np.hypot(aperture.x, aperture.y)))
